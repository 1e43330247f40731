"""A robot on wheels: the same report to the bit at any number of threads, and of a run that was stopped and went on.

Where bodies touch, the loop draws starts and psi, races and polishes: all of that has to draw the same again.
"""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from test_resume import results

from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.stages import Stages

SAMPLE, FRICTION = 0.02, 0.12
CART = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" friction="0.8"/>
    <body name="cart" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <geom name="hull" type="box" size="0.2 0.1 0.03" mass="3" contype="0" conaffinity="0"/>
      <body name="front" pos="0.15 0 0"><joint name="front" axis="0 1 0" damping="0.01" frictionloss="{friction}"/>
        <geom name="front" size="0.1" mass="0.3"/></body>
      <body name="rear" pos="-0.15 0 0"><joint name="rear" axis="0 1 0" damping="0.01"/>
        <geom name="rear" size="0.1" mass="0.3"/></body>
    </body>
  </worldbody>
  <actuator><velocity name="front" joint="front" kv="0.3"/><velocity name="rear" joint="rear" kv="0.3"/></actuator>
</mujoco>
"""
JOINTS = ("x", "z", "pitch", "front", "rear")
NOISE = {"pos": 1e-3, "vel": 1e-2}
MAPPING = """
version: 1
model: cart.xml
parameters:
  - {name: mass, field: body_mass, of: [cart], unit: kg, low: 2.0, high: 4.0}
logs:
  - {path: "fit_*.npz", split: fit}
  - {path: "select.npz", split: select}
  - {path: "verify.npz", split: verify}
time: {column: t}
controls:
  "ctrl:front": {column: u0, unit: rad/s}
  "ctrl:rear": {column: u1, unit: rad/s}
segments: {length: 0.2, history: 0.0, horizons: [0.1, 0.2]}
effects: {only: [coulomb]}
channels:
"""


def record(file: Path, rng: np.random.Generator) -> None:
    """1.2 s of a cart whose front axle rubs."""
    model = mujoco.MjModel.from_xml_string(CART.format(step=0.002, friction=FRICTION))
    data, phases, rows = mujoco.MjData(model), rng.uniform(0, 2 * np.pi, 2), []
    for k in range(round(1.2 / SAMPLE)):
        data.ctrl[:] = 6 * np.sin(3 * k * SAMPLE + phases)
        rows.append((data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
        mujoco.mj_step(model, data, round(SAMPLE / 0.002))
    q, v, u = (np.array(part) for part in zip(*rows, strict=True))
    q, v = q + NOISE["pos"] * rng.normal(size=q.shape), v + NOISE["vel"] * rng.normal(size=v.shape)
    columns = {f"{n}{i}": a[:, i] for n, a in (("q", q), ("v", v), ("u", u)) for i in range(a.shape[1])}
    np.savez(file, t=np.arange(len(q)) * SAMPLE, **columns)


@pytest.fixture(scope="module")
def mapping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mapping of four logs of the cart."""
    folder, rng = tmp_path_factory.mktemp("cart"), np.random.default_rng(3)
    for name in ("fit_0", "fit_1", "select", "verify"):
        record(folder / f"{name}.npz", rng)
    (folder / "cart.xml").write_text(CART.format(step=0.005, friction=0.0))
    units = {"x": "m", "z": "m"}
    channels = [
        f'  "joint:{j}:{of}": {{column: {of[0] if of == "vel" else "q"}{i}, '
        f"unit: {units.get(j, 'rad')}{'/s' if of == 'vel' else ''}, noise: {sd}}}"
        for i, j in enumerate(JOINTS)
        for of, sd in NOISE.items()
    ]
    (folder / "mapping.yaml").write_text(MAPPING + "\n".join(channels) + "\n")
    return folder / "mapping.yaml"


def test_the_same_bits_at_any_number_of_threads_and_where_it_was_stopped_after_each_stage(
    mapping: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, out = mapping.parent / "whole", mapping.parent / "stopped"
    report = close_loop(mapping, whole, jobs=1)
    assert [e["family"] for e in report["effects"]] == ["coulomb"]
    put, stopped = Stages.put, list[str]()

    def once(self: Stages, name: str, result: Any) -> None:
        put(self, name, result)
        if name not in stopped:
            stopped.append(name)
            raise KeyboardInterrupt

    monkeypatch.setattr(Stages, "put", once)
    for turn in range(10):
        try:
            close_loop(mapping, out, jobs=1 + (turn + 1) % 2)
            break
        except KeyboardInterrupt:
            assert not (out / "report.json").exists()
    assert {"calibrated", "search", "found"} <= set(stopped)
    assert results(out) == results(whole)
