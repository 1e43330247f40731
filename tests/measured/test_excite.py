"""At constant speed dry and viscous friction are one: `excite` proposes the commands that tell them apart.

What the proposed commands tell apart is checked by code that shares nothing with the package: both machines are stepped
by formulas of these tests, and the rival is refitted by scipy.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from rotor import INERTIA, INTERVAL, LEVEL, MAPPING, NOISE, SPEED, record, steady
from scipy.optimize import least_squares
from typer.testing import CliRunner, Result

from nfc_gym.cli import app
from nfc_gym.core import InputError
from nfc_gym.measured.advice import advise
from nfc_gym.measured.bench import make_bench
from nfc_gym.measured.dataset import load
from nfc_gym.measured.excite import excite
from nfc_gym.measured.questions import look, reported
from nfc_gym.physics.effects import build
from nfc_gym.physics.effects.saved import to_row

SEGMENT = 0.4  # s


@pytest.fixture(scope="module")
def mapping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("rotor"))


@pytest.fixture(scope="module")
def closed(mapping: Path) -> Path:
    """What close-loop would have left: dry friction is claimed, and polynomial damping fits as well."""
    folder = mapping.parent / "out"
    folder.mkdir()
    effect, theta = build("coulomb", "shaft", {"level": LEVEL})
    claim = {"id": "coulomb:shaft", "equivalents": ["damping_poly:shaft"]}
    report = {"model": "rotor.xml", "verdict": "explained", "effects": [claim], "identifiability": []}
    (folder / "report.json").write_text(json.dumps(report))
    (folder / "fit.json").write_text(json.dumps({"extended": {"psi": {}, "effects": [to_row(effect, theta)]}}))
    return folder


def call(*args: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in args])


def plain(text: str) -> str:
    return " ".join(re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", text).split())


# ---- a better motion ------------------------------------------------------------------------------------------------


Step = Callable[[np.ndarray, np.ndarray, float], np.ndarray]  # speeds (n,), torques (n,), s -> speeds


def dry(v: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
    """Friction takes away at most the speed that there is."""
    free = v + h * u / INERTIA
    return np.sign(free) * np.maximum(np.abs(free) - h * LEVEL / INERTIA, 0)


def viscous(c: np.ndarray) -> Step:
    """Damping by a polynomial of the speed."""

    def step(v: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        pull = c[0] * v + c[1] * v * np.abs(v) + c[2] * v**3
        return v + h * (u - np.clip(pull, -3, 3)) / INERTIA

    return step


def driven(law: Step, start: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Speeds (n, k + 1) from starts (n,) under torques (n, k) held for an interval each, at 1 ms."""
    out, v = [start], start
    for u in torque.T:
        for _ in range(10):
            v = law(v, u, INTERVAL / 10)
        out.append(v)
    return np.stack(out, 1)


def apart(torque: np.ndarray, start: float) -> float:
    """Sigma by which a polynomial of the speed, refitted, misses a noisy recording of dry friction."""
    rng = np.random.default_rng(5)
    true = driven(dry, np.array([start]), torque[None])[0]
    width, each = round(SEGMENT / INTERVAL), (10, 20, 40)
    firsts = np.arange(0, len(torque) - width, width)
    u = np.stack([torque[i : i + width] for i in firsts])
    measured = np.stack([true[firsts + k] for k in each], 1) + NOISE * rng.normal(size=(len(firsts), 3))
    spread = np.hypot(NOISE, 0.6 * NOISE)  # of a sample, and of a start that seven samples are smoothed to

    def miss(law: Step) -> np.ndarray:
        return ((driven(law, true[firsts], u)[:, each] - measured) / spread).ravel()

    scale = [0.01, 0.002, 0.0005]
    rival = least_squares(lambda c: miss(viscous(c)), [LEVEL / SPEED, 0.0, 0.0], x_scale=scale, max_nfev=40)
    return float(np.sqrt(max(2 * rival.cost - (miss(dry) ** 2).sum(), 0.0)))


@dataclass(frozen=True)
class Proposal:
    result: dict[str, Any]
    time: np.ndarray
    torque: np.ndarray
    folder: Path


@pytest.fixture(scope="module")
def proposal(mapping: Path, closed: Path) -> Proposal:
    out = mapping.parent / "next.csv"
    result = excite(mapping, closed, out, seconds=6.0, tries=40, jobs=1)
    with out.open() as lines:
        assert lines.readline().strip() == "time,ctrl:motor"
    time, torque = np.loadtxt(out, delimiter=",", skiprows=1).T
    return Proposal(result, time, torque, mapping.parent)


def test_the_proposed_commands_tell_the_two_apart(proposal: Proposal) -> None:
    (pair,) = proposal.result["pairs"]
    assert (pair["claim"], pair["rival"]) == ("coulomb:shaft", "damping_poly:shaft")
    assert pair["sigma_before"] < 4 < 20 < pair["sigma_after"]
    assert pair["told_apart"]
    assert pair["sigma_refitted"] > 20
    assert apart(steady(np.arange(300), 0), SPEED) < 6
    assert apart(proposal.torque, SPEED) > 20


def test_the_commands_stay_within_what_is_allowed(proposal: Proposal) -> None:
    assert np.diff(proposal.time) == pytest.approx(10.0)  # the mapping's time is in ms
    assert proposal.time[-1] == pytest.approx(6000)
    assert np.abs(proposal.torque).max() <= 1
    assert proposal.torque[[0, -1]] == pytest.approx(LEVEL)  # from the command that the logs begin with, and back
    # The claim's own motion is bounded by 1.2 times what was seen; so is its rival's, of which this is nearly one.
    for law, most in ((dry, 1.25), (viscous(np.array([LEVEL / SPEED, 0, 0])), 1.6)):
        speed = driven(law, np.array([SPEED]), proposal.torque[None])
        assert np.abs(speed).max() < most * SPEED


def test_the_page_and_the_json_say_what_is_expected(proposal: Proposal) -> None:
    assert json.loads((proposal.folder / "next.json").read_text()) == proposal.result
    page = (proposal.folder / "next.html").read_text()
    assert page.rstrip().endswith("</html>")
    assert "damping_poly:shaft" in page
    assert page.count("<svg") >= 2
    assert "enough to tell them apart" in proposal.result["sentences"][0]
    assert proposal.result["kind"] == "commands"


def test_without_a_report_every_effect_is_to_show_at_a_smaller_size(mapping: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.csv"
    result = excite(mapping, None, out, seconds=4.0, tries=30, jobs=1)
    sizes = {r["id"]: r for r in result["sizes"]}
    assert set(sizes) == {"coulomb:shaft", "damping_poly:shaft"}
    assert all(r["smallest_detectable_after"] < r["smallest_detectable_before"] for r in sizes.values())
    again = excite(mapping, None, tmp_path / "b.csv", seconds=4.0, tries=30, jobs=1)
    assert (tmp_path / "b.csv").read_text() == out.read_text()
    assert again == result


POLE = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="pole">
      <joint name="pivot" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.3"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="pivot" ctrlrange="-2 2"/></actuator>
</mujoco>
"""


def test_logs_that_begin_under_a_force_still_get_commands_of_their_own(tmp_path: Path) -> None:
    def swung(time: np.ndarray, seed: int) -> np.ndarray:
        return 0.5 * np.cos(6 * time + 0.3 * seed)  # held for ever, the first one would drive the rotor away

    path = record(tmp_path, swung, speed=0.0)
    result = excite(path, None, tmp_path / "next.csv", seconds=3.0, tries=30, jobs=1)
    assert result["kind"] == "commands"
    assert result["tried"] == 30
    torque = np.loadtxt(tmp_path / "next.csv", delimiter=",", skiprows=1)[:, 1]
    assert torque[[0, -1]] == pytest.approx(0)
    assert np.abs(torque).max() > 0.2
    again = excite(path, None, tmp_path / "few.csv", seconds=3.0, tries=250, budget=1e-9, jobs=1)
    assert again["tried"] == 8  # the first that are rolled out at once, and time is up


def test_what_only_a_controller_keeps_upright_gets_a_feed_forward(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(POLE)
    for seed, name in enumerate(("fit_0", "fit_1", "select", "verify")):
        rng, data, rows = np.random.default_rng(seed), mujoco.MjData(model), []
        for k in range(200):
            q, v = data.qpos[0] + 0.001 * rng.normal(), data.qvel[0] + 0.01 * rng.normal()
            data.ctrl[0] = 4 * (0.2 * np.sin(0.06 * k + seed) - q) - 0.4 * v
            rows.append((10 * k, data.ctrl[0], q, v))
            mujoco.mj_step(model, data, 2)
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.9g", ",", header="t,torque,q,v", comments="")
    (tmp_path / "rotor.xml").write_text(POLE)
    text = MAPPING.replace("joint:shaft", "joint:pivot")
    both = '  "joint:pivot:pos": {column: q, unit: rad, noise: 0.001}\nsegments:'
    (tmp_path / "mapping.yaml").write_text(text.replace("segments:", both))
    result = excite(tmp_path / "mapping.yaml", None, tmp_path / "next.csv", seconds=3.0, tries=10, jobs=1)
    assert result["kind"] == "feed-forward"
    assert "add them to the controller's own" in result["sentences"][-1]
    added = np.loadtxt(tmp_path / "next.csv", delimiter=",", skiprows=1)[:, 1]
    assert 0 < np.abs(added).max() <= 0.2 * 2  # a fifth of the actuator's room: the rest is the controller's
    assert added[[0, -1]] == pytest.approx(0)


def test_the_report_advises_a_motion_for_what_it_cannot_tell_apart(mapping: Path, closed: Path) -> None:
    bench = make_bench(load(mapping), 1)
    logs = [*bench.dataset.of("fit"), *bench.dataset.of("select")]
    report, plant, x = reported(bench, logs, closed)
    report["identifiability"] = [{"id": "coulomb:shaft", "worst_mimic": None, "distinguishable": True}]
    advice = advise(bench, logs, report, look(bench, logs, plant, x), lambda text: None, 0)
    (row,) = advice.rows
    (few,) = advise(bench, logs, report, look(bench, logs, plant, x, 12), lambda text: None, 0).rows
    assert few["sigma"] == pytest.approx(row["sigma"])  # however many segments the search looked at
    assert row["worst_mimic"] == "damping_poly:shaft"
    assert row["sigma"] < 4
    assert not row["distinguishable"]
    (finding,) = advice.findings
    assert finding["kind"] == "advice"
    assert "coulomb:shaft and damping_poly:shaft lie" in finding["text"]
    assert "`nfc-gym excite MAPPING.yaml --fit DIR` writes such commands" in finding["text"]


# ---- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["no.yaml"], "no such file"),
        (["{m}", "--seconds", "0"], "--seconds 0: want 1 to 120"),
        (["{m}", "--seconds", "nan"], "--seconds nan: want 1 to 120"),
        (["{m}", "--fit", "{d}/nowhere"], "report.json does not exist; run close-loop"),
        (["{m}", "--out", "{d}/next.txt"], "the commands are a CSV file; name it so, next.csv"),
        (["{m}", "--out", "{d}/none/next.csv"], "no such folder"),
        (["{m}", "--out", "/proc/next.csv"], "/proc cannot be written"),
        (["{m}", "--out", "{d}/fit_0.csv"], "fit_0.csv exists: choose another --out, or say --overwrite"),
    ],
)
def test_bad_input_is_told_in_one_line(mapping: Path, args: list[str], words: str) -> None:
    result = call("excite", *(a.format(m=mapping, d=mapping.parent) for a in args))
    assert result.exit_code == 2
    assert words in plain(result.stderr)
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("pattern", "out", "words"),
    [("*.csv", "excite.csv", "logs '*.csv' would take the commands for a recording"),
     ("./**/*.csv", "next/deep/a.csv", "would take the commands"),
     ("next/*.csv", "next/deep/a.csv", ""), ("[f-v]*.csv", "next.csv", "would take"), ("[f-v]*.csv", "a.csv", "")],
)  # fmt: skip
def test_the_commands_are_not_written_where_they_would_be_read_as_a_log(
    tmp_path: Path, pattern: str, out: str, words: str
) -> None:
    path = record(tmp_path)
    if pattern.startswith("next"):
        (tmp_path / "next").mkdir()
        for log in tmp_path.glob("*.csv"):
            log.rename(tmp_path / "next" / log.name)
    (tmp_path / "next/deep").mkdir(parents=True, exist_ok=True)
    logs = path.read_text().split("time:")[0].split("logs:")[1]
    path.write_text(path.read_text().replace(logs, f'\n  - {{path: "{pattern}"}}\n'))
    args = ("excite", path, "--out", tmp_path / out, "--seconds", 2, "--tries", 2, "--jobs", 1)
    result = call(*args)
    assert result.exit_code == (2 if words else 0), result.stderr
    assert words in plain(result.stderr)
    assert (tmp_path / out).exists() == (not words)


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ([('controls:\n  "ctrl:motor": {column: torque, unit: Nm}\n', "")], "names no `controls`"),
        ([('"joint:shaft:vel": {column: v, unit: rad/s, noise: 0.02}', '"force:motor": {column: v, unit: N m}'),
          ("segments: {", "segments: {mode: inverse, ")], "no channel measures a joint or a free body"),
    ],
)  # fmt: skip
def test_nothing_to_propose_is_refused(tmp_path: Path, edits: list[tuple[str, str]], words: str) -> None:
    path = record(tmp_path)
    text = path.read_text()
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        excite(path, None, tmp_path / "next.csv", seconds=3.0, tries=30, jobs=1)
    assert not (tmp_path / "next.csv").exists()


def test_a_report_of_another_model_is_refused(mapping: Path, closed: Path, tmp_path: Path) -> None:
    for name in ("report.json", "fit.json"):
        (tmp_path / name).write_text((closed / name).read_text().replace("rotor.xml", "other.xml"))
    with pytest.raises(InputError, match=r"is of the model other\.xml, the mapping of rotor\.xml"):
        excite(mapping, tmp_path, tmp_path / "next.csv")
    (tmp_path / "report.json").write_text("[]")
    with pytest.raises(InputError, match="not what close-loop writes"):
        excite(mapping, tmp_path, tmp_path / "next.csv")


def test_a_run_over_folds_asks_for_one_of_them(mapping: Path, closed: Path, tmp_path: Path) -> None:
    (tmp_path / "run_a").mkdir()
    (tmp_path / "run_a" / "fit.json").write_text("{}")
    (tmp_path / "report.json").write_text("{}")
    (tmp_path / "b" / "run").mkdir(parents=True)  # folds are named by path where two names are alike
    (tmp_path / "b" / "run" / "fit.json").write_text("{}")
    with pytest.raises(InputError, match="it holds folds: give one of b/run, run_a"):
        excite(mapping, tmp_path, tmp_path / "next.csv")


def test_the_help_teaches() -> None:
    text = plain(call("excite", "--help").stdout)
    for words in (
        "tell apart what the present logs cannot",
        "--fit",
        "feed-forward",
        "excite mapping.yaml --fit result",
    ):
        assert words in text
