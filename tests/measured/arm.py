"""A joint with dry friction, simulated with plain `mj_step`; what its maker believes; and a run of the loop on it."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from nfc_gym.measured.loop import close_loop

DT, SECONDS = 0.005, 3.0
NOISE = {"q": 0.002, "v": 0.02}
LOSS, DAMPING = 0.25, 0.12  # N m, N m s/rad: of the machine; the model knows no dry friction and a damping of 0.05

MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="{damping}" frictionloss="{loss}"
             solreffriction="0.01 1" solimpfriction="0.99 0.99 0.001 0.5 2"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""

# What the maker believes: less damping, no dry friction, and therefore nothing said of its softness either.
GIVEN = re.sub(r'frictionloss="{loss}"\s+sol.*"/>', "/>", MODEL).format(damping=0.05)

MAPPING = """
version: 1
model: arm.xml
parameters:
  - {name: damping, field: dof_damping, of: [hinge], unit: N m s/rad, low: 0.0, high: 0.4}
logs:
  - {path: "fit_*.csv", split: fit}
  - {path: "select.csv", split: select}
  - {path: "verify.csv", split: verify}
time: {column: t}
controls:
  "ctrl:motor": {column: torque, unit: Nm}
channels:
  "joint:hinge:pos": {column: q, unit: rad, noise: 0.002}
  "joint:hinge:vel": {column: v, unit: rad/s, noise: 0.02}
segments: {length: 0.4, history: 0.0, horizons: [0.1, 0.2, 0.4]}
effects: {only: [coulomb, spring_offset, armature]}
"""


def write_log(path: Path, model: mujoco.MjModel, seed: int, seconds: float = SECONDS) -> None:
    """One run of the machine: torque held over 10 ms, joint sampled at its start."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    data.qpos[0] = rng.uniform(-0.5, 0.5)
    phase, rows = rng.uniform(0, 2 * np.pi, 3), []
    for k in range(round(seconds / (2 * DT))):
        t = 2 * k * DT
        torque = 0.9 * np.sin(3.1 * t + phase[0]) + 0.5 * np.sin(7.7 * t + phase[1]) + 0.3 * np.sin(1.3 * t + phase[2])
        q, v = data.qpos[0] + NOISE["q"] * rng.normal(), data.qvel[0] + NOISE["v"] * rng.normal()
        rows.append(f"{t:.3f},{torque:.17g},{q:.17g},{v:.17g}")
        data.ctrl[0] = torque
        mujoco.mj_step(model, data, 2)
    path.write_text("t,torque,q,v\n" + "\n".join(rows) + "\n")


def machine(
    folder: Path, loss: float = LOSS, damping: float = DAMPING, edits: tuple[tuple[str, str], ...] = ()
) -> Path:
    """Logs of the true machine, the model as its maker believes it, and the mapping; returns the mapping's path."""
    folder.mkdir(parents=True, exist_ok=True)
    real = mujoco.MjModel.from_xml_string(MODEL.format(damping=damping, loss=loss))
    for seed, name in enumerate(("fit_0", "fit_1", "fit_2", "select", "verify")):
        write_log(folder / f"{name}.csv", real, seed)
    (folder / "arm.xml").write_text(GIVEN)
    text = MAPPING
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    (folder / "mapping.yaml").write_text(text)
    return folder / "mapping.yaml"


@dataclass(frozen=True)
class Closed:
    """A finished run."""

    mapping: Path
    out: Path
    report: dict[str, Any]

    def on_disk(self) -> dict[str, Any]:
        return json.loads((self.out / "report.json").read_text())


def close(folder: Path) -> Closed:
    """The loop, closed on the machine."""
    mapping = machine(folder)
    return Closed(mapping, folder / "out", close_loop(mapping, folder / "out", seed=3, jobs=1))


def same(a: Any, b: Any) -> bool:
    drop = lambda r: json.dumps({k: v for k, v in r.items() if k != "seconds"}, sort_keys=True)  # noqa: E731
    return drop(a) == drop(b)


def claims(report: dict[str, Any]) -> tuple[Any, ...]:
    """What is said to be missing."""
    return report["verdict"], [e["id"] for e in report["effects"]], [p["id"] for p in report["proposals"]]
