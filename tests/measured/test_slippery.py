"""A floor that is slippery in places is said to be so, whatever joint shows most of it."""

from pathlib import Path

import mujoco
import numpy as np

from nfc_gym.measured.loop import close_loop

DT, SAMPLE, FRICTION, LOST = 0.002, 0.01, 0.5, 0.4
SLED = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" friction="0.01"/>
    <body name="sled" pos="0 0 0.099"><joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <geom name="runner" size="0.1" mass="1" friction="{}"/></body>
  </worldbody>
  <actuator><motor name="ahead" joint="x"/><motor name="aside" joint="y"/></actuator>
</mujoco>
"""
MAPPING = """
version: 1
model: sled.xml
parameters:
  - {name: friction, field: "geom_friction[0]", of: [runner], unit: "1", low: 0.1, high: 1.0}
logs:
  - {path: "fit_*.npz", split: fit}
  - {path: "select.npz", split: select}
  - {path: "verify.npz", split: verify}
time: {column: t}
controls:
  "ctrl:ahead": {column: u0, unit: N}
  "ctrl:aside": {column: u1, unit: N}
channels:
  "joint:x:pos": {column: q0, unit: m, noise: 0.001}
  "joint:y:pos": {column: q1, unit: m, noise: 0.001}
  "joint:z:pos": {column: q2, unit: m, noise: 0.001}
  "joint:x:vel": {column: v0, unit: m/s, noise: 0.01}
  "joint:y:vel": {column: v1, unit: m/s, noise: 0.01}
segments: {length: 0.3, history: 0.0, horizons: [0.1, 0.3]}
effects: {only: [damping_poly]}
"""


def record(file: Path, rng: np.random.Generator, seconds: float = 6.0) -> None:
    """A sled that is pulled to and fro over a floor of which the half with x > 0 lacks LOST of its friction."""
    model = mujoco.MjModel.from_xml_string(SLED.format(1.1 * FRICTION))
    model.opt.timestep = DT
    data, phases, runner = mujoco.MjData(model), rng.uniform(0, 2 * np.pi, 4), model.geom("runner").id
    rows = []
    for k in range(round(seconds / SAMPLE)):
        waves = np.sin(np.array([2.1, 5.3, 2.6, 4.4]) * k * SAMPLE + phases)
        data.ctrl[:] = 9 * waves[::2] + 5 * waves[1::2] - 3 * data.qpos[:2]
        rows.append((data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
        for _ in range(round(SAMPLE / DT)):
            model.geom_friction[runner, 0] = 1.1 * FRICTION * (1 - LOST * (data.geom_xpos[runner, 0] > 0))
            mujoco.mj_step(model, data)
    q, v, u = (np.array(part) for part in zip(*rows, strict=True))
    q, v = q + 0.001 * rng.normal(size=q.shape), v + 0.01 * rng.normal(size=v.shape)
    columns = {f"{n}{i}": a[:, i] for n, a in (("q", q), ("v", v), ("u", u)) for i in range(a.shape[1])}
    np.savez(file, t=np.arange(len(q)) * SAMPLE, **columns)


def test_a_floor_that_is_slippery_in_one_half_is_left_unexplained_at_the_ground(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for name in ("fit_0", "fit_1", "select", "verify"):
        record(tmp_path / f"{name}.npz", rng)
    (tmp_path / "sled.xml").write_text(SLED.format(FRICTION))
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    report = close_loop(tmp_path / "mapping.yaml", tmp_path / "out", jobs=1)
    left = report["unexplained"]
    assert report["verdict"] == "unexplained"
    assert (left["where"], left["coordinate"]) == ("ground", "body:sled:pos")
    assert "friction of the ground that depends on the place" in left["description"]
    assert report["effects"] == []
    assert report["proposals"] == []
