"""The command line: exit codes, one clear message, no traceback unless asked for."""

import errno
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from nfc_gym import InputError, __version__
from nfc_gym.cli import app, main

Build = Any


def call(*args: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in args])


def plain(text: str) -> str:
    return " ".join(re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", text).split())


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException | None], list[dict[str, Any]]]:
    """Put a stand-in for `close_loop` in place that raises what it is told to; returns the calls it gets."""

    def install(error: BaseException | None) -> list[dict[str, Any]]:
        calls: list[dict[str, Any]] = []

        def close_loop(mapping: Path, out: Path, **options: Any) -> None:
            calls.append({"mapping": mapping, "out": out, **options})
            if error is not None:
                raise error

        module = ModuleType("nfc_gym.measured.loop")
        module.close_loop = close_loop  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "nfc_gym.measured.loop", module)
        return calls

    return install


def test_check_finds_nothing_wrong_and_exits_0(build: Build) -> None:
    result = call("check", build())
    assert result.exit_code == 0
    assert "Nothing wrong found" in result.stdout


def test_check_lists_errors_and_exits_2(build: Build) -> None:
    result = call("check", build(lambda t: t.pop("v"), ("sensor:gyro", "sensor:gyr")))
    assert result.exit_code == 2
    assert "no column 'v'" in result.stdout
    assert "did you mean 'gyro'" in plain(result.stdout)
    assert "2 errors" in result.stdout


def test_check_with_warnings_alone_exits_0(build: Build) -> None:
    result = call("check", build(lambda t: t.update(goal=np.full(400, 0.1))))
    assert result.exit_code == 0
    assert "0 errors, 1 warning, 0 notes" in result.stdout


def test_check_of_a_truncated_parquet_file(tmp_path: Path, build: Build) -> None:
    path = build(None, ('"*.npz"', '"*.parquet"'))
    for k in range(3):
        (tmp_path / f"run_{k}.parquet").write_bytes(b"PAR1" + bytes(50))
    result = call("check", path)
    assert result.exit_code == 2
    assert "truncated or not a parquet file" in plain(result.stdout)


def test_options_reach_the_loop(loop: Any) -> None:
    calls = loop(None)
    words = ["m.yaml", "--out", "o", "--seed", 3, "--jobs", 2, "--no-resume", "--fold", "a", "--posterior", "p.npz"]
    assert call("close-loop", *words, "--time-saved").exit_code == 0
    (options,) = calls
    options.pop("console")
    assert options == {
        "mapping": Path("m.yaml"), "out": Path("o"), "seed": 3, "jobs": 2,
        "overwrite": False, "resume": False, "fold": "a", "posterior": Path("p.npz"), "compare": True, "witness": None,
    }  # fmt: skip


def test_what_a_posterior_saves_needs_one(loop: Any) -> None:
    calls = loop(None)
    result = call("close-loop", "m.yaml", "--out", "o", "--time-saved")
    assert result.exit_code == 2
    assert "give --posterior FILE as well" in plain(result.stderr)
    assert calls == []


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (InputError("out exists: say --overwrite"), 2, "nfc-gym close-loop: out exists: say --overwrite"),
        (
            OSError(errno.ENOSPC, "No space left on device", "o/report.json"),
            2,
            "o/report.json: the disk is full: free",
        ),
        (OSError("Error writing file: No space left on device"), 2, "the disk is full"),
        (PermissionError(errno.EACCES, "denied", "/o"), 2, "/o: permission denied: choose a place"),
        (OSError(errno.EROFS, "ro", "/o"), 2, "read-only: choose another --out"),
        (KeyboardInterrupt(), 3, "interrupted; the same command goes on from what it had finished"),
        (
            ZeroDivisionError("division by zero"),
            1,
            "a fault of nfc-gym, not of yours: ZeroDivisionError: division by zero",
        ),
        (FileNotFoundError(errno.ENOENT, "No such file", "x"), 1, "a fault of nfc-gym"),
    ],
)
def test_every_ending_has_its_code_and_one_message(loop: Any, error: BaseException, code: int, words: str) -> None:
    loop(error)
    result = call("close-loop", "m.yaml", "--out", "o")
    assert result.exit_code == code
    assert words in result.stderr
    assert "Traceback" not in result.output
    assert len(result.stderr.strip().splitlines()) == 1
    debug = call("--debug", "close-loop", "m.yaml", "--out", "o")
    assert debug.exit_code == code
    assert "Traceback" in debug.stderr
    assert words in debug.stderr


def test_a_message_in_brackets_is_not_markup(loop: Any) -> None:
    loop(InputError("column 'q[0]' [bold]missing[/bold]"))
    assert "column 'q[0]' [bold]missing[/bold]" in call("close-loop", "m.yaml", "--out", "o").stderr


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["predict", "m.yaml", "--out", "p.npz"], "--stage extended needs --fit DIR"),
        (["predict", "m.yaml", "--out", "p.npz", "--fit", "o", "--mode", "inverse", "--restart", "1"],
         "--mode rollout, not inverse"),
        (["predict", "m.yaml", "--out", "p.npz", "--mode", "sideways"], "rollout"),
        (["close-loop", "m.yaml"], "--out"),
        (["close-loop", "m.yaml", "--out", "o", "--seed", "-1"], "seed"),
        (["chek", "m.yaml"], "check"),
    ],
)  # fmt: skip
def test_options_that_do_not_go_together(args: list[str], words: str) -> None:
    result = call(*args)
    assert result.exit_code == 2
    assert words in plain(result.stderr)


def test_predict_says_what_its_columns_and_rows_are() -> None:
    text = plain(call("predict", "--help").stdout)
    assert "Its columns follow the channels in the order of the mapping" in text
    assert "Its rows are those of the log, at the same times" in text
    assert "is replaced" in text


def test_what_the_entry_point_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An absent file without a traceback, the version."""
    monkeypatch.setattr(sys, "argv", ["nfc-gym", "close-loop", str(tmp_path / "no.yaml"), "--out", str(tmp_path / "o")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "no such file" in said
    assert "Traceback" not in said
    monkeypatch.setattr(sys, "argv", ["nfc-gym", "--version"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert capsys.readouterr().out.strip() == __version__


def test_as_a_program(tmp_path: Path) -> None:
    """Through a real process: `--debug` after the command, and the package as a module."""
    run = [sys.executable, "-c", "from nfc_gym.cli import main; main()"]
    debug = subprocess.run([*run, "close-loop", str(tmp_path / "no.yaml"), "--out", str(tmp_path / "o"), "--debug"],
                           capture_output=True, text=True, check=False)  # fmt: skip
    assert debug.returncode == 2
    assert "Traceback" in debug.stderr
    module = [sys.executable, "-m", "nfc_gym.cli", "chek"]
    as_module = subprocess.run(module, capture_output=True, text=True, check=False)
    assert as_module.returncode == 2
    assert "No such command" in plain(as_module.stderr)
