"""What a run leaves behind: whole files or none, stages of the same inputs or none, and nothing of anybody else's."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from nfc_gym.core import InputError, files
from nfc_gym.measured.stages import OUTPUTS, Stages, digest, held, write_whole, written_by


def listing(folder: Path) -> dict[str, str]:
    return {p.name: p.read_text() for p in folder.iterdir() if p.is_file()}


def full_disk(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class _Half:
    """A file on a disk that fills up in the middle of a write."""

    def __init__(self, path: Path) -> None:
        self.handle = open(path, "w", encoding="utf-8")  # noqa: SIM115

    def __enter__(self) -> "_Half":
        return self

    def __exit__(self, *_: Any) -> None:
        self.handle.close()

    def write(self, text: str) -> None:
        self.handle.write(text[: len(text) // 2])
        self.handle.flush()
        full_disk()


@pytest.mark.parametrize("before", [None, "the old text"])
@pytest.mark.parametrize("fault", ["write", "fsync", "replace", "interrupt"])
def test_a_write_that_fails_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str | None, fault: str
) -> None:
    file = tmp_path / "report.json"
    if before is not None:
        file.write_text(before)
    untouched = listing(tmp_path)

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if fault == "write":
            patch.setattr(files, "open", lambda path, *_, **__: _Half(path), raising=False)
        elif fault == "interrupt":
            patch.setattr(os, "replace", interrupt)
        else:
            patch.setattr(os, fault, full_disk)
        with pytest.raises(KeyboardInterrupt if fault == "interrupt" else OSError) as caught:
            write_whole(file, "the whole new text")
    if fault != "interrupt":
        assert caught.value.errno == errno.ENOSPC  # type: ignore[union-attr]
    assert listing(tmp_path) == untouched
    write_whole(file, "the whole new text")
    assert listing(tmp_path) == {"report.json": "the whole new text"}


def test_the_old_file_stands_until_the_new_one_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, seen = tmp_path / "model.xml", []
    file.write_text("old")
    replace = os.replace

    def watch(part: Path, target: Path) -> None:
        seen.append((Path(part).read_text(), Path(target).read_text()))
        replace(part, target)

    monkeypatch.setattr(os, "replace", watch)
    write_whole(file, "new, and ü")
    assert seen == [("new, and ü", "old")]
    assert file.read_text(encoding="utf-8") == "new, and ü"


def test_a_digest_changes_with_every_input(tmp_path: Path) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_text("one")
    b.write_text("two")
    keys = {digest(a, b), digest(b, a), digest(a), digest(a, b, extra="seed 1"), digest(a, b, extra="seed 2")}
    assert len(keys) == 5
    before = digest(a, b)
    assert digest(a, b) == before
    b.write_text("two ")
    assert digest(a, b) != before


def test_stages_come_back_under_the_same_key_only(tmp_path: Path) -> None:
    out, result = tmp_path / "out", {"psi": {"mass": 0.1 + 0.2}, "effects": []}
    first = Stages(out, "key", overwrite=False, resume=True)
    assert first.get("calibrated") is None
    first.put("calibrated", result)
    again = Stages(out, "key", overwrite=False, resume=True)
    assert again.get("calibrated") == result  # to the last bit
    assert again.get("final") is None
    with pytest.raises(InputError, match="unfinished run on other inputs or another seed: choose another --out"):
        Stages(out, "another key", overwrite=False, resume=True)
    assert Stages(out, "key", overwrite=False, resume=True).get("calibrated") == result
    other = Stages(out, "another key", overwrite=True, resume=True)
    assert other.get("calibrated") is None
    assert Stages(out, "another key", overwrite=False, resume=True).get("calibrated") is None


@pytest.mark.parametrize("overwrite", [False, True])
def test_stages_are_dropped_where_asked(tmp_path: Path, overwrite: bool) -> None:
    out = tmp_path / "out"
    Stages(out, "key", False, True).put("calibrated", [1])
    assert Stages(out, "key", overwrite, True).get("calibrated") == [1]  # the same command, interrupted, goes on
    assert Stages(out, "key", overwrite, False).get("calibrated") is None


def test_a_finished_run_leaves_its_key_and_no_stage(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run = Stages(out, "key", False, True)
    run.put("calibrated", [1])
    run.finish()
    assert written_by(out, "key")
    assert not written_by(out, "another key")
    assert not written_by(tmp_path / "elsewhere", "key")
    assert Stages(out, "key", True, True).get("calibrated") is None  # replaced from the beginning


def test_a_folder_that_lost_its_key_is_begun_again(tmp_path: Path) -> None:
    """As a kill between making the folder and writing the key, or in the middle of removing it, leaves it."""
    out = tmp_path / "out"
    Stages(out, "key", False, True).put("calibrated", [1])
    (out / ".stages" / "key").unlink()
    assert Stages(out, "key", False, True).get("calibrated") is None


def test_a_stage_cut_short_is_not_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    run = Stages(out, "key", False, True)
    run.put("calibrated", [1])
    with monkeypatch.context() as patch:
        patch.setattr(files, "open", lambda path, *_, **__: _Half(path), raising=False)
        with pytest.raises(OSError, match="No space left"):
            run.put("final", {"x": [1.0] * 100})
    again = Stages(out, "key", False, True)
    assert again.get("calibrated") == [1]
    assert again.get("final") is None


def test_only_a_runs_own_folder_is_written_to(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(InputError, match="is not a folder"):
        Stages(file, "key", True, True)
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "photos").mkdir()
    with pytest.raises(InputError, match=r"holds 'photos', which is not a run's"):
        Stages(foreign, "key", False, True)
    assert [p.name for p in foreign.iterdir()] == ["photos"]
    empty = tmp_path / "empty"
    empty.mkdir()
    Stages(empty, "key", False, True)  # an empty folder is as good as none
    Stages(tmp_path / "deep" / "er", "key", False, True)


def test_a_finished_run_is_kept_unless_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "out"
    Stages(out, "key", False, True)
    for name in OUTPUTS:
        (out / name).write_text(json.dumps(name))
    (out / "notes.txt").write_text("mine")
    before = listing(out)
    with pytest.raises(InputError, match=r"report of a finished run: .* --overwrite"):
        Stages(out, "key", False, True)
    assert listing(out) == before
    Stages(out, "another key", True, True)
    assert listing(out) == before  # until there is something to put in its place


def test_a_folder_is_of_one_run_at_a_time(tmp_path: Path) -> None:
    out, holds = tmp_path / "out", "from nfc_gym.measured.stages import held\nimport pathlib, sys, time\n"
    holds += "with held(pathlib.Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)\n"
    with subprocess.Popen([sys.executable, "-c", holds, str(out)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with (
            pytest.raises(InputError, match="another run is writing there: wait for it, or choose another --out"),
            held(out),
        ):
            pass
        other.kill()
    with held(out):  # the system let go of what the killed one held
        pass
    with held(out):  # and a run that ended with an error, in the same process
        assert out.is_dir()
