"""Damaged mappings, logs, models and results: refused by name, never with a traceback, and nothing is lost.

The ways to damage are those of `benchmarks/malformed.py`, which draws ten thousand; here hypothesis draws a few, and
shrinks what fails.
"""

import json
import random
import re
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from nfc_gym import InputError
from nfc_gym.cli import app
from nfc_gym.measured.export import unpack
from nfc_gym.measured.readers import read_table, register_reader
from nfc_gym.physics.effects.saved import from_row

_BENCHMARKS = str(Path(__file__).resolve().parents[2] / "benchmarks")
sys.path.insert(0, _BENCHMARKS)
try:
    from damage import FITS, INPUTS, OPTIONS, healthy
    from damage.case import FORMATS, Case
finally:
    sys.path.remove(_BENCHMARKS)

MODEST = settings(max_examples=25, print_blob=True, suppress_health_check=list(HealthCheck))
CHOICES = st.randoms(use_true_random=False)


def call(*line: object) -> Result:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # what numpy would print on the user's screen
        return CliRunner().invoke(app, [str(word) for word in line])


def require_honest(result: Result) -> None:
    """Success, or exit code 2 with words."""
    assert result.exit_code in (0, 2), result.output
    assert "Traceback" not in result.output
    assert result.exit_code == 0 or len(result.output.strip()) > 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("malformed")


def fresh(folder: Path) -> Path:
    case = folder / "case"
    shutil.rmtree(case, ignore_errors=True)
    case.mkdir()
    return case


@pytest.mark.parametrize("suffix", FORMATS)
def test_what_is_not_damaged_passes(tmp_path: Path, suffix: str) -> None:
    result = call("check", healthy(suffix).write(tmp_path))
    assert result.exit_code == 0
    assert "Nothing wrong found" in result.output


@MODEST
@given(st.sampled_from(sorted(INPUTS)), st.sampled_from(FORMATS), CHOICES)
def test_damaged_inputs_are_refused_by_check_and_loop_alike(
    folder: Path, kind: str, suffix: str, rng: random.Random
) -> None:
    case, here = healthy(suffix), fresh(folder)
    INPUTS[kind](case, rng)
    path = case.write(here)
    checked = call("check", path)
    require_honest(checked)
    if checked.exit_code == 0:
        require_honest(call("predict", path, "--stage", "nominal", "--out", here / "p.npz"))
        return
    (here / "out").mkdir()
    (here / "out" / "report.json").write_text("earlier")
    closed = call("close-loop", path, "--out", here / "out", "--overwrite")
    require_honest(closed)
    assert closed.exit_code == 2
    assert {p.name: p.read_text() for p in (here / "out").iterdir()} == {"report.json": "earlier"}


@MODEST
@given(st.sampled_from([k for k in FITS if k.startswith("fit.json")]), CHOICES)
def test_a_damaged_fit_is_refused_by_its_file(folder: Path, kind: str, rng: random.Random) -> None:
    here = fresh(folder)
    path = healthy().write(here)
    (here / "fit.json").write_bytes(FITS[kind](rng))
    result = call("predict", path, "--fit", here, "--out", here / "p.npz")
    require_honest(result)
    assert (here / "p.npz").exists() == (result.exit_code == 0)
    assert result.exit_code == 0 or "fit.json" in result.output or "unstable" in result.output


@MODEST
@given(st.sampled_from(sorted(OPTIONS)), CHOICES)
def test_no_command_line_ends_in_a_traceback(folder: Path, kind: str, rng: random.Random) -> None:
    here = fresh(folder)
    healthy().write(here)
    line = OPTIONS[kind](here, rng)
    kept = {p: p.read_bytes() for p in here.rglob("*") if p.is_file()}
    result = call(*line)
    require_honest(result)
    if result.exit_code:
        assert {p: p.read_bytes() for p in here.rglob("*") if p.is_file()} == kept


def said(tmp_path: Path, damage: Callable[[Case], Any], command: str = "close-loop", *options: str) -> str:
    case = healthy()
    damage(case)
    result = call(command, case.write(tmp_path), *(options or ("--out", str(tmp_path / "out"))))
    assert result.exit_code == 2, result.output
    return " ".join(re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", result.output).split())


def test_numbers_that_nothing_measures(tmp_path: Path) -> None:
    text = said(tmp_path, lambda c: c.logs["run_0"]["gz"].__setitem__(7, 1e200))
    assert "1e+200 at row 7" in text
    assert "sensor:gyro" in text


def test_samples_years_apart(tmp_path: Path) -> None:
    text = said(tmp_path, lambda c: [t.update(t=1e9 * t["t"]) for t in c.logs.values()])
    assert "samples are 2e+07 s apart" in text
    assert "time.unit" in text


def test_columns_without_a_value(tmp_path: Path) -> None:
    text = said(tmp_path, lambda c: c.logs["run_0"].update(volts=np.zeros((60, 0))))
    assert "column 'volts' has shape (60, 0) where time has 60 rows" in text


def test_complex_columns(tmp_path: Path) -> None:
    assert "'q' holds complex numbers" in said(tmp_path, lambda c: c.logs["run_0"].update(q=np.full(60, 1j)))


def test_a_step_that_would_fill_the_memory(tmp_path: Path) -> None:
    text = said(tmp_path, lambda c: c.mapping["segments"].update(timestep=1e-9))
    assert "3e+08 steps of 1e-09 s" in text


@pytest.mark.parametrize(
    ("body", "low", "words"),
    [("world", 0.05, "body 'world' has no mass in the model"), ("bob", 0.0, "low is 0 kg; a mass must be positive")],
)
def test_masses_that_cannot_be(tmp_path: Path, body: str, low: float, words: str) -> None:
    assert words in said(tmp_path, lambda c: c.mapping["parameters"][0].update(of=[body], low=low, nominal=0.1))


def test_scalars_that_yaml_cannot_build(tmp_path: Path) -> None:
    (tmp_path / "mapping.yaml").write_text("version: 1\nmodel: !!timestamp soon\n")
    result = call("close-loop", tmp_path / "mapping.yaml", "--out", tmp_path / "out")
    assert "mapping.yaml:2: 'soon' is no timestamp" in result.output
    (tmp_path / "mapping.yaml").write_text('version: 1\nmodel: "\\ud800"\n')
    assert "is no str" in call("close-loop", tmp_path / "mapping.yaml", "--out", tmp_path / "out").output


def test_file_names_that_are_no_text(tmp_path: Path) -> None:
    def rename(case: Case) -> None:
        case.logs["run_\udcff"] = case.logs.pop("run_1")

    assert r"run_\\udcff.npz' has characters in its name that cannot be printed; rename it" in said(tmp_path, rename)


@pytest.mark.parametrize("path", ["/dev/zero", "/proc/self/mem", "/dev/null"])
def test_a_mapping_is_an_ordinary_file(path: str) -> None:
    result = call("check", path)
    require_honest(result)
    assert result.exit_code == 2
    assert path in result.output.replace("\n", "")


@pytest.mark.parametrize("restart", ["1e-300", "nan", "0.001"])
def test_restarts_shorter_than_a_sample(tmp_path: Path, restart: str) -> None:
    options = ("--stage", "nominal", "--out", str(tmp_path / "p.npz"), "--restart", restart)
    assert "--restart" in said(tmp_path, lambda c: None, "predict", *options)
    assert not (tmp_path / "p.npz").exists()


def test_whatever_a_reader_trips_over_is_the_files_fault(tmp_path: Path) -> None:
    def trips(path: Path) -> dict[str, np.ndarray]:
        raise KeyError("no such block")

    register_reader(".tripping", trips)
    file = tmp_path / "run.tripping"
    file.write_bytes(b"x")
    with pytest.raises(InputError, match=r"run\.tripping: truncated or not a tripping file \('no such block'\)"):
        read_table(file)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (3, "an effect is a mapping with the keys family, where, parameters, and not 3"),
        ({"family": "gain", "where": "m"}, "'parameters' is missing"),
        ({"family": ["gain"], "where": "m", "parameters": {}}, "family is a name"),
        ({"family": "gain", "where": [None], "parameters": {}}, r"`where` is a name of the model, a list of names"),
        ({"family": "gain", "where": [], "parameters": {}}, r"`where` is a name of the model, a list of names"),
        ({"family": "gain", "where": "m", "parameters": [1]}, "`parameters` is a mapping"),
        (
            {"family": "coulomb", "where": "m", "parameters": {"level": float("nan")}},
            "level is nan; it must be a finite",
        ),
        ({"family": "coulomb", "where": "m", "parameters": {"level": {"unit": "N"}}}, "a number as `value`"),
        ({"family": "coulomb", "where": "m", "parameters": {"level": "much"}}, "'coulomb' of 'm'"),
    ],
)
def test_rows_that_are_no_effects(row: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        from_row(row)


@pytest.mark.parametrize("data", [None, [], {}, {"psi": [], "effects": []}, {"psi": {}, "effects": {}}])
def test_data_that_are_no_model(data: Any) -> None:
    with pytest.raises(InputError, match="a fitted model has the keys psi"):
        unpack(data, None)  # type: ignore[arg-type]


@pytest.mark.parametrize("options", [("--seed", str(2**32)), ("--jobs", "100000")])
def test_options_beyond_their_range(tmp_path: Path, options: tuple[str, str]) -> None:
    assert options[0] in said(tmp_path, lambda c: None, "close-loop", "--out", str(tmp_path / "out"), *options)


@pytest.mark.parametrize(
    ("psi", "words"),
    [
        ({"girth": 1.0}, "no parameter named 'girth'; there are: mass, damping"),
        ({"mass": 0.0}, "mass is 0 kg, outside the mapping's [0.05, 0.2]"),
    ],
)
def test_a_fit_of_another_mapping_is_named(tmp_path: Path, psi: dict[str, float], words: str) -> None:
    (tmp_path / "fit.json").write_text(json.dumps({"extended": {"psi": psi, "effects": []}}))
    text = said(tmp_path, lambda c: None, "predict", "--fit", str(tmp_path), "--out", str(tmp_path / "p.npz"))
    assert f"fit.json: extended: {words}" in text
