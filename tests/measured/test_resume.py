"""A run with folds, in a process of its own, killed at any moment: the same command ends as if nothing had happened."""

import json
import secrets
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from nfc_gym.core import InputError
from nfc_gym.measured import loop, stages
from nfc_gym.measured.loop import close_loop

MODEL = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.05"{loss}/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""

MAPPING = """
version: 1
model: arm.xml
parameters:
  - {name: damping, field: dof_damping, of: [hinge], unit: N m s/rad, low: 0.0, high: 0.4}
logs:
  - {path: "run_*.npz"}
split: {by: rotate}
time: {column: t}
controls:
  "ctrl:motor": {column: torque, unit: Nm}
channels:
  "joint:hinge:pos": {column: q, unit: rad, noise: 0.002}
segments: {length: 0.2, history: 0.0, horizons: [0.1, 0.2]}
effects: {only: [coulomb]}
"""

COMMAND = [sys.executable, "-c", "from nfc_gym.cli import main; main()", "close-loop"]


def machine(folder: Path) -> Path:
    """Three logs of 1 s of a joint with dry friction, a model without, the mapping; returns the last one's path."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(loss=' frictionloss="0.3"'))
    for seed in range(3):
        rng, data, rows = np.random.default_rng(seed), mujoco.MjData(model), []
        data.qpos[0] = rng.uniform(-0.5, 0.5)
        for k in range(100):
            data.ctrl[0] = np.sin(5 * k * 0.01 + seed)
            rows.append((k * 0.01, data.ctrl[0], data.qpos[0] + 0.002 * rng.normal()))
            mujoco.mj_step(model, data)
        np.savez(folder / f"run_{seed}.npz", **dict(zip(("t", "torque", "q"), np.array(rows).T, strict=True)))
    (folder / "arm.xml").write_text(MODEL.format(loss=""))
    (folder / "mapping.yaml").write_text(MAPPING)
    return folder / "mapping.yaml"


def results(out: Path) -> dict[str, Any]:
    """Every file under a run's folder but for times; JSON as data."""

    def content(file: Path) -> Any:
        if file.name != "report.json":
            return file.read_text()
        return {k: v for k, v in json.loads(file.read_text()).items() if k != "seconds"}

    files = (f for f in out.rglob("*") if f.is_file() and ".stages" not in f.parts and not f.name.startswith("."))
    return {f.relative_to(out).as_posix(): content(f) for f in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, float]:
    """The mapping, the folder of a run without interruption, and the seconds that it took."""
    folder = tmp_path_factory.mktemp("arm")
    mapping, began = machine(folder), time.monotonic()
    close_loop(mapping, folder / "out", jobs=1)
    return mapping, folder / "out", time.monotonic() - began


def start(mapping: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    arguments = [str(mapping), "--out", str(out), "--jobs", "1", *options]
    return subprocess.Popen(
        [*COMMAND, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=heard
    )


def heard() -> None:
    """A test run in the background of a shell ignores SIGINT, and its children would too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_a_run_killed_at_any_moment_ends_as_one_that_was_not(whole: tuple[Path, Path, float], tmp_path: Path) -> None:
    mapping, reference, seconds = whole
    seed = secrets.randbits(32)
    print(f"seed of the moments: {seed}")
    out, rng, begun = tmp_path / "out", np.random.default_rng(seed), time.monotonic()
    for _ in range(3):
        run = start(mapping, out)
        while not (out / "run_0" / ".stages").exists() and run.poll() is None:  # imports take longest
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.5 * seconds))
        run.send_signal(signal.SIGKILL)
        run.communicate()
    print(
        f"killed three times in {time.monotonic() - begun:.1f} s; left: {sorted(p.name for p in out.rglob('*.json'))}"
    )
    if not (out / "report.json").exists():
        close_loop(mapping, out, jobs=2)  # resumed, and with other threads
    assert results(out) == results(reference)


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_says_how_to_go_on(
    whole: tuple[Path, Path, float], tmp_path: Path, sign: signal.Signals
) -> None:
    mapping, _, _ = whole
    run = start(mapping, tmp_path / "out")
    while not (tmp_path / "out" / "run_0" / ".stages" / "calibrated.json").exists():
        assert run.poll() is None
        time.sleep(0.01)
    run.send_signal(sign)
    _, errors = run.communicate(timeout=30)
    said = "nfc-gym close-loop: interrupted; the same command goes on from what it had finished\n"
    assert (run.returncode, errors) == (3, said)
    assert not (tmp_path / "out" / "run_0" / "report.json").exists()


def test_the_same_bits_at_any_number_of_threads(whole: tuple[Path, Path, float], tmp_path: Path) -> None:
    mapping, reference, _ = whole
    close_loop(mapping, tmp_path / "out", jobs=3)
    assert results(tmp_path / "out") == results(reference)


def blas_threads() -> set[int]:
    return {p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"}


def test_linear_algebra_runs_on_one_thread(whole: tuple[Path, Path, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums that BLAS cuts by the number of its threads round otherwise."""
    seen = []

    def stop(mapping: Path) -> None:
        seen.append(blas_threads())
        raise InputError("seen")

    monkeypatch.setattr(loop, "require", stop)
    with threadpool_limits(2, "blas"):
        with pytest.raises(InputError, match="seen"):
            close_loop(whole[0], whole[0].parent / "unused", jobs=1)
        assert seen == [{1}]
        assert blas_threads() == {2}  # given back as it was


def test_folds_that_ran_one_by_one_are_gathered(
    whole: tuple[Path, Path, float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the same inputs they are taken as they are; of others they are refused before anything is begun."""
    mapping, reference, _ = whole
    out = tmp_path / "out"
    close_loop(mapping, out, jobs=1, fold="run_1")
    before = results(out)
    assert set(before) == {f for f in results(reference) if f.startswith("run_1/")}
    with pytest.raises(InputError, match=r"run_1 holds the report of a finished run"):
        close_loop(mapping, out, jobs=1, seed=1)
    assert results(out) == before
    assert [p.name for p in out.iterdir()] == ["run_1"]
    ran, fold = [], loop._fold
    monkeypatch.setattr(loop, "_fold", lambda b, d, f, *rest: ran.append(f.name) or fold(b, d, f, *rest))
    close_loop(mapping, out, jobs=1)
    assert ran == ["run_0", "run_2"]
    assert results(out) == results(reference)


def test_a_run_that_replaces_another_loses_nothing_until_it_has_something_better(
    whole: tuple[Path, Path, float], tmp_path: Path
) -> None:
    mapping, reference, _ = whole
    out = tmp_path / "out"
    shutil.copytree(reference / "run_0", out)  # a finished run of other inputs
    before = results(out)
    run = start(mapping, out, "--overwrite")
    while not (out / "run_0" / ".stages" / "calibrated.json").exists():
        assert run.poll() is None
        time.sleep(0.01)
    run.kill()
    run.communicate()
    assert results(out) == before


def test_a_mapping_without_parameters_is_fitted_too(tmp_path: Path) -> None:
    mapping = machine(tmp_path)
    text = mapping.read_text()
    a, b = text.index("parameters:"), text.index("logs:")
    mapping.write_text(text[:a] + text[b:])
    report = close_loop(mapping, tmp_path / "out", jobs=1, fold="run_0")
    assert [e["id"] for e in report["effects"]] == ["coulomb:hinge"]
    assert report["parameters"] == []


def test_the_time_of_a_run_counts_what_was_before_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(stages.time, "monotonic", lambda: now[0])
    first = stages.Stages(tmp_path, "key", overwrite=False, resume=True)
    now[0] += 30
    first.put("calibrated", {})
    now[0] += 500  # lost: no stage was finished in them
    again = stages.Stages(tmp_path, "key", overwrite=False, resume=True)
    now[0] += 5
    assert again.seconds == 35
    other = stages.Stages(tmp_path, "key", overwrite=False, resume=False)
    assert other.seconds == 0
