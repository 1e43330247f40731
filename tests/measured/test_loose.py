"""Something that slides about in a body is told from forces on the body."""

from pathlib import Path

import mujoco
import numpy as np

from nfc_gym.measured.bench import candidates, make_bench
from nfc_gym.measured.dataset import load
from nfc_gym.measured.fit import stand
from nfc_gym.measured.metric import metric
from nfc_gym.measured.screen import Screen, screen_all
from nfc_gym.measured.settle import slack
from nfc_gym.physics.effects.law import Law

DT, SAMPLE = 0.001, 0.01
LUMP = """<body pos="0 0 0.08"><joint type="slide" axis="0.8 0.6 0" range="-0.05 0.05" limited="true"
  frictionloss="0.06" damping="0.05"/><geom size="0.01" mass="0.25"/></body>"""
SHUTTLE = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="hull" pos="0 0 1"><freejoint name="root"/><geom type="box" size="0.15 0.1 0.05" mass="1.5"/>
      <site name="middle"/>{}</body>
  </worldbody>
  <actuator>
    <motor name="ahead" site="middle" gear="1 0 0 0 0 0"/><motor name="aside" site="middle" gear="0 1 0 0 0 0"/>
    <motor name="about" site="middle" gear="0 0 0 0 0 1"/>
  </actuator>
</mujoco>
"""
MAPPING = """
version: 1
model: shuttle.xml
parameters:
  - {name: mass, field: body_mass, of: [hull], unit: kg, low: 1.0, high: 3.0}
logs:
  - {path: "fit_*.npz", split: fit}
  - {path: "select.npz", split: select}
  - {path: "verify.npz", split: verify}
time: {column: t}
controls:
  "ctrl:ahead": {column: u0, unit: N}
  "ctrl:aside": {column: u1, unit: N}
  "ctrl:about": {column: u2, unit: N m}
channels:
  "body:hull:pos": {columns: [x, y, z], unit: m, noise: 0.0005}
  "body:hull:quat": {columns: [qw, qx, qy, qz], order: wxyz, noise: 0.0005}
  "body:hull:linvel": {columns: [vx, vy, vz], unit: m/s, noise: 0.005}
  "body:hull:angvel": {columns: [wx, wy, wz], unit: rad/s, noise: 0.005}
segments: {length: 0.4, history: 0.5, horizons: [0.1, 0.2, 0.4]}
"""


def record(file: Path, rng: np.random.Generator, seconds: float = 3.0) -> None:
    """A shuttle that is pushed to and fro, and a lump that slides in it."""
    model = mujoco.MjModel.from_xml_string(SHUTTLE.format(LUMP))
    model.opt.timestep = DT
    data, rate, phase = mujoco.MjData(model), rng.uniform(2, 12, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
    rows = []
    for k in range(round(seconds / SAMPLE)):
        data.ctrl[:] = [2.0, 2.0, 0.02] * np.sin(rate * k * SAMPLE + phase).sum(0)
        rows.append((data.qpos[:7].copy(), data.qvel[:6].copy(), data.ctrl.copy()))
        for _ in range(round(SAMPLE / DT)):
            mujoco.mj_step(model, data)
    q, v, u = (np.array(part) for part in zip(*rows, strict=True))
    v[:, 3:] = [rotated(quat, w) for quat, w in zip(q[:, 3:], v[:, 3:], strict=True)]
    q, v = q + 0.0005 * rng.normal(size=q.shape), v + 0.005 * rng.normal(size=v.shape)
    q[:, 3:] /= np.linalg.norm(q[:, 3:], axis=1, keepdims=True)
    names = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz", "u0", "u1", "u2")
    columns = dict(zip(names, np.concatenate([q, v, u], 1).T, strict=True))
    np.savez(file, allow_pickle=False, t=np.arange(len(q)) * SAMPLE, **columns)


def rotated(quat: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A body's vector in the world."""
    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, v, quat)
    return out


def test_what_slides_in_a_body_is_told_from_forces_on_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    (tmp_path / "shuttle.xml").write_text(SHUTTLE.format(""))
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    for name in ("fit_0", "fit_1", "select", "verify"):
        record(tmp_path / f"{name}.npz", rng)
    bench = make_bench(load(tmp_path / "mapping.yaml"), 1)
    logs = bench.dataset.of("fit")
    problem, x = bench.problem(logs), np.array([1.75])
    sigma = problem.covariance(bench.plant, x)
    under = metric(problem, sigma, slack(problem, sigma, bench.plant, x))
    screen = Screen(problem, under, stand(problem, under, bench.plant, x))
    generics = [e for e in candidates(bench, logs) if e.generic and not isinstance(e, Law)]
    gains = {s.effect.id: s.gain for s in screen_all(screen, generics)}
    (best, most), (_, second) = list(gains.items())[:2]
    assert best == "generic_inner:root"
    assert most > 1.5 * second
