"""A battery that falls while nobody measures it: found where it is asked for, and no candidate elsewhere."""

from pathlib import Path

import mujoco
import numpy as np

from nfc_gym.measured.loop import close_loop

RATE, STEP = 0.06, 0.005
MODEL = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/></body>
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
  - {path: "fit_*.npz", split: fit}
  - {path: "select.npz", split: select}
  - {path: "verify.npz", split: verify}
time: {column: t}
controls:
  "ctrl:motor": {column: torque, unit: Nm}
channels:
  "joint:hinge:pos": {column: q, unit: rad, noise: 0.002}
  "joint:hinge:vel": {column: v, unit: rad/s, noise: 0.01}
segments: {length: 0.2, history: 0.0, horizons: [0.1, 0.2]}
effects: {only: [loss, coulomb, supply_sag]}
"""


def record(file: Path, rng: np.random.Generator) -> None:
    """5 s of a motor that loses RATE of its first torque a second."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.opt.timestep = STEP
    data, phase, rows = mujoco.MjData(model), rng.uniform(0, 2 * np.pi), []
    for k in range(500):
        torque = 0.8 * np.sin(5 * k * 0.01 + phase)
        rows.append((k * 0.01, torque, data.qpos[0], data.qvel[0]))
        for j in range(2):
            data.ctrl[0] = torque * (1 - RATE * (k * 0.01 + j * STEP))
            mujoco.mj_step(model, data)
    t, torque, q, v = np.array(rows).T
    noisy = {"q": q + 0.002 * rng.normal(size=500), "v": v + 0.01 * rng.normal(size=500)}
    np.savez(file, t=t, torque=torque, **noisy)


def test_a_drive_that_fades_with_time_is_told_its_rate(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    for name in ("fit_0", "fit_1", "select", "verify"):
        record(tmp_path / f"{name}.npz", rng)
    (tmp_path / "arm.xml").write_text(MODEL)
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    (found,) = close_loop(tmp_path / "mapping.yaml", tmp_path / "out", jobs=1)["effects"]
    rate = found["parameters"]["rate"]
    assert (found["family"], found["where"], rate["unit"]) == ("supply_sag", "motor", "1/s")
    assert rate["low"] < RATE < rate["high"]
    assert rate["high"] - rate["low"] < 0.2 * RATE
    assert "settings" not in found
