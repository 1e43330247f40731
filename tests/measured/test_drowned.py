"""Noise of start states that the motion magnifies, which no law may mend."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.bench import make_bench
from nfc_gym.measured.checks import require
from nfc_gym.measured.drowned import REASON, drowned
from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.metric import metric

ROWS = 250  # of a log: 5 s

# A hull in water turns into its sideways motion: what its speed is off by turns it.
HULL = """
<mujoco><option timestep="{step}" integrator="implicitfast" density="1000" viscosity="0.001"/><worldbody>
  <body name="hull" gravcomp="1"><freejoint/>
    <geom name="hull" type="ellipsoid" size=".45 .16 .12" mass="30" fluidshape="ellipsoid"/>
    <site name="port" pos="-.4 .2 0"/><site name="starboard" pos="-.4 -.2 0"/><site name="fore" pos=".3 0 0"/></body>
</worldbody><actuator>
  <motor name="port" site="port" gear="1 0 0 0 0 0"/><motor name="starboard" site="starboard" gear="1 0 0 0 0 0"/>
  <motor name="fore" site="fore" gear="0 0 1 0 0 0"/></actuator></mujoco>"""
MAPPING = """
version: 1
model: hull.xml
parameters:
  - {{name: mass, field: body_mass, of: hull, unit: kg, low: 25, high: 40}}
logs:
  - {{path: "log*.npz"}}
time: {{column: t, unit: s}}
controls:
  ctrl:port: {{column: "u[0]", unit: N}}
  ctrl:starboard: {{column: "u[1]", unit: N}}
  ctrl:fore: {{column: "u[2]", unit: N}}
channels:
  body:hull:pos: {{columns: pos, unit: m, noise: {metres}}}
  body:hull:quat: {{columns: quat, order: wxyz, noise: 0.001}}
  body:hull:angvel@body: {{columns: gyro, unit: rad/s, noise: 0.003}}
  body:hull:linvel: {{columns: speed, unit: m/s, noise: {speeds}}}
segments: {{length: 0.4}}
effects: {{only: [payload, drag_quadratic]}}
"""


def build(folder: Path, metres: float, speeds: float) -> Path:
    """Logs of the model itself, at another step."""
    (folder / "hull.xml").write_text(HULL.format(step=0.005))
    (folder / "mapping.yaml").write_text(MAPPING.format(metres=metres, speeds=speeds))
    model = mujoco.MjModel.from_xml_string(HULL.format(step=0.001))
    for k in range(4):
        rng, data, rows = np.random.default_rng(k), mujoco.MjData(model), []
        phase = rng.uniform(0, 6, 3)
        for i in range(ROWS):
            t = 0.02 * i
            data.ctrl[:] = 8 * np.sin(np.array([1.3, 1.9, 2.7]) * t + phase) + [4, 4, 0]
            rows.append((t, data.ctrl.copy(), data.qpos.copy(), data.qvel.copy()))
            mujoco.mj_step(model, data, 20)
        t, u, q, v = (np.array(column) for column in zip(*rows, strict=True))
        quat = q[:, 3:].copy()
        for row, turn in zip(quat, 0.001 * rng.standard_normal((ROWS, 3)), strict=True):
            mujoco.mju_quatIntegrate(row, turn, 1.0)
        noisy = {name: x + sd * rng.standard_normal(x.shape) for name, x, sd in (
            ("pos", q[:, :3], metres), ("gyro", v[:, 3:], 0.003), ("speed", v[:, :3], speeds))}  # fmt: skip
        np.savez(folder / f"log{k}.npz", t=t, u=u, quat=quat, **noisy)
    return folder / "mapping.yaml"


@pytest.mark.parametrize(("metres", "speeds", "lost"), [(0.005, 0.1, True), (0.0005, 0.002, False)])
def test_noise_that_is_magnified_is_told_from_noise_that_is_not(
    tmp_path: Path, metres: float, speeds: float, lost: bool
) -> None:
    bench = make_bench(require(build(tmp_path, metres, speeds))[0], 1)
    problem, x = bench.searched(bench.dataset.of("fit")), bench.plant.null
    under = metric(problem, problem.covariance(bench.plant, x))
    assert drowned(problem, under, bench.plant, x, seed=0) is lost


@pytest.mark.parametrize(
    ("twins", "own", "lost"),
    [
        ((3.0, 1.16, 1.12), 1.47, False),  # one of them came apart in one segment
        ((1.0, 3.0, 3.0), 1.47, True),
        ((3.0, 1.0, 1.1), 0.9, False),  # noise is not magnified
    ],
)
def test_one_twin_decides_nothing(
    monkeypatch: pytest.MonkeyPatch, twins: tuple[float, ...], own: float, lost: bool
) -> None:
    made = {shared: iter(twins) for shared in (True, False)}
    problem: Any = SimpleNamespace(rough=False, residual=lambda *_: np.zeros((1, 1, 1)))
    under: Any = SimpleNamespace(whiten=lambda residual: [own])
    monkeypatch.setattr("nfc_gym.measured.drowned.twin", lambda *asked: (problem, next(made[asked[-1]])))
    monkeypatch.setattr("nfc_gym.measured.drowned.mean_square", lambda problem, shown: shown)
    assert drowned(problem, under, SimpleNamespace(), np.zeros(1), seed=0) is lost  # pyright: ignore[reportArgumentType]


def test_nothing_is_claimed_of_noise_that_is_magnified(tmp_path: Path) -> None:
    report = close_loop(build(tmp_path, 0.005, 0.1), tmp_path / "out", jobs=1)
    assert not report["effects"]
    assert report["verdict"] == "nothing missing"
    assert report["rounds"][-1]["reason"] == REASON
    assert any("start states grow so fast" in f["text"] for f in report["findings"])
