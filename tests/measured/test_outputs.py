"""Where results go is looked at before any work is done: files in the way, read-only folders, full disks."""

import errno
import os
import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner, Result

from nfc_gym.cli import app
from nfc_gym.core import InputError
from nfc_gym.core.files import require_writable, write_together, write_whole

COMMANDS = (["close-loop", "m.yaml"], ["predict", "m.yaml", "--stage", "nominal"], ["demo"])


def call(line: list[str], out: Path) -> Result:
    result = CliRunner().invoke(app, [*line, "--out", str(out)])
    assert "Traceback" not in result.output
    return result


@pytest.mark.parametrize("line", COMMANDS)
def test_a_file_in_the_way(tmp_path: Path, line: list[str]) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    result = call(line, file / "below" / "it")
    assert result.exit_code == 2
    assert f"{file} is a file, not a folder: choose another --out" in result.stderr
    assert file.read_text() == "mine"


@pytest.mark.parametrize("line", [COMMANDS[0], COMMANDS[2]])
def test_a_file_instead_of_a_folder(tmp_path: Path, line: list[str]) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    result = call(line, file)
    assert result.exit_code == 2
    assert f"{file} exists and is not a folder: choose another --out" in result.stderr
    assert file.read_text() == "mine"


@pytest.mark.parametrize("fold", [[], ["--fold", "a"]])
def test_a_finished_run_is_refused_before_anything_is_read(tmp_path: Path, fold: list[str]) -> None:
    """The mapping is not there either: that would be told after."""
    out = tmp_path / "out"
    folder = out / fold[1] if fold else out
    folder.mkdir(parents=True)
    (folder / "report.json").write_text("earlier")
    result = call([*COMMANDS[0], *fold], out)
    assert result.exit_code == 2
    assert f"{folder} holds the report of a finished run: choose another --out" in result.stderr
    assert "no such file" in call([*COMMANDS[0], *fold, "--overwrite"], out).stderr
    assert (folder / "report.json").read_text() == "earlier"


def test_files_of_others_are_refused_before_anything_is_read(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "run_1" / ".stages").mkdir(parents=True)  # a fold's, as a run of one fold leaves it
    assert "no such file" in call(COMMANDS[0], out).stderr
    (out / "photo.jpg").write_text("mine")
    assert "holds 'photo.jpg', which is not a run's" in call(COMMANDS[0], out).stderr


def test_a_folder_instead_of_a_file(tmp_path: Path) -> None:
    result = call(COMMANDS[1], tmp_path)
    assert result.exit_code == 2
    assert f"{tmp_path} is a folder: name the file to write in it" in result.stderr


@pytest.mark.parametrize("line", COMMANDS)
@pytest.mark.parametrize("code", [errno.EACCES, errno.EROFS, errno.ENOSPC])
def test_a_folder_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: list[str], code: int
) -> None:
    def refuse(dir: Path) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    result = call(line, tmp_path / "new" / "out")
    assert result.exit_code == 2
    assert "cannot be written" in result.stderr
    assert os.strerror(code) in result.stderr
    assert str(tmp_path / "new") in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_read_only_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(InputError, match="Permission denied"):
            require_writable(tmp_path / "out")
    finally:
        tmp_path.chmod(0o755)


@pytest.mark.parametrize("line", COMMANDS)
def test_a_disk_that_is_nearly_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: list[str]) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=3_000_000))
    result = call(line, tmp_path / "out")
    assert result.exit_code == 2
    assert "only 3 MB are free there, and 20 MB are wanted" in result.stderr


def test_a_device_is_no_file_to_write(tmp_path: Path) -> None:
    """Renaming a result over it would put a file in its place."""
    device = tmp_path / "pipe"
    os.mkfifo(device)
    result = call(COMMANDS[1], device)
    assert result.exit_code == 2
    assert f"{device} is a device, not a file: choose another" in " ".join(result.stderr.split())
    with pytest.raises(InputError, match="is a device, not a file"):
        write_whole(device, "text")
    assert device.is_fifo()


def test_predictions_are_not_written_under_the_name_of_another_format(tmp_path: Path) -> None:
    result = call(COMMANDS[1], tmp_path / "p.csv")
    assert result.exit_code == 2
    assert "predictions are written as .npz; name it p.npz" in " ".join(result.stderr.split())


def test_a_name_that_is_too_long(tmp_path: Path) -> None:
    result = call(COMMANDS[0], tmp_path / ("x" * 300))
    assert result.exit_code == 2
    assert "File name too long" in result.stderr


def test_looking_leaves_nothing_behind(tmp_path: Path) -> None:
    require_writable(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fails", [1, 2, 3])
def test_files_that_belong_together_are_never_mixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: int
) -> None:
    """The disk fills up while one of them is written: all stay as they were."""
    old, new = ({n: f"{age} {n}" for n in ("model.xml", "fit.json", "report.json")} for age in ("old", "new"))
    write_together(tmp_path, old)
    seen, sync = [], os.fsync

    def full(handle: int) -> None:
        seen.append(handle)
        if len(seen) == fails:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            write_together(tmp_path, new)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == old
    write_together(tmp_path, new)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == new


def test_the_mark_is_gone_while_files_are_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_together(tmp_path, {"model.xml": "old", "report.json": "old"})
    seen, replace = [], os.replace

    def watch(part: Path, target: Path) -> None:
        seen.append((Path(target).name, (tmp_path / "report.json").exists()))
        replace(part, target)

    monkeypatch.setattr(os, "replace", watch)
    write_together(tmp_path, {"model.xml": "new", "report.json": "new"})
    assert seen == [("model.xml", False), ("report.json", False)]
