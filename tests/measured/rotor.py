"""A rotor that dry friction brakes: logs of it, a model without any friction, and the mapping."""

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

INERTIA, LEVEL, SPEED, NOISE = 0.01, 0.2, 5.0, 0.02  # kg m^2, N m, rad/s, rad/s
INTERVAL = 0.01  # s

MODEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="disc">
      <joint name="shaft" axis="0 0 1" {more}/>
      <geom name="disc" type="cylinder" size="0.1 0.02" mass="2"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="shaft" ctrlrange="-1 1"/></actuator>
</mujoco>
"""

MAPPING = """
version: 1
model: rotor.xml
logs:
  - {path: "fit_*.csv", split: fit}
  - {path: "select.csv", split: select}
  - {path: "verify.csv", split: verify}
time: {column: t, unit: ms}
controls:
  "ctrl:motor": {column: torque, unit: Nm}
channels:
  "joint:shaft:vel": {column: v, unit: rad/s, noise: 0.02}
segments: {length: 0.4, history: 0.0, horizons: [0.1, 0.2, 0.4]}
effects: {only: [coulomb, damping_poly]}
"""

Torque = Callable[[np.ndarray, int], np.ndarray]


def steady(time: np.ndarray, seed: int) -> np.ndarray:
    """Just what dry friction takes."""
    return np.full(len(time), LEVEL)


def lively(time: np.ndarray, seed: int) -> np.ndarray:
    """Through rest and both directions."""
    return 0.5 * np.sin(2.1 * time + seed) + 0.4 * np.sin(7.3 * time + 2 * seed)


def record(folder: Path, torque: Torque = steady, level: float = LEVEL, speed: float = SPEED) -> Path:
    """Logs of a machine with dry friction, a model without any, and the mapping; returns the mapping's path."""
    folder.mkdir(parents=True, exist_ok=True)
    real = mujoco.MjModel.from_xml_string(MODEL.format(more=f'frictionloss="{level}"'))
    time = np.arange(300) * INTERVAL
    for seed, name in enumerate(("fit_0", "fit_1", "fit_2", "select", "verify")):
        rng, data, rows = np.random.default_rng(seed), mujoco.MjData(real), []
        data.qvel[0] = speed
        for t, u in zip(time, torque(time, seed), strict=True):
            rows.append((1000 * t, u, data.qvel[0] + NOISE * rng.normal()))
            data.ctrl[0] = u
            mujoco.mj_step(real, data, 2)
        np.savetxt(folder / f"{name}.csv", rows, "%.9g", ",", header="t,torque,v", comments="")
    (folder / "rotor.xml").write_text(MODEL.format(more=""))
    (folder / "mapping.yaml").write_text(MAPPING)
    return folder / "mapping.yaml"
