"""A wheel that is out of true is told from what it does to the vehicle."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.bench import candidates, make_bench
from nfc_gym.measured.dataset import load
from nfc_gym.measured.fit import stand
from nfc_gym.measured.metric import metric
from nfc_gym.measured.owned import Data
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.screen import Screen, screen_all
from nfc_gym.measured.search import Options, Search
from nfc_gym.measured.settle import slack
from nfc_gym.physics.effects.law import Law

DT, SAMPLE, OFF = 0.001, 0.01, 0.003
CART = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" cone="elliptic"/>
  <default><geom friction="0.8" solref="-3000 -30" solimp="0.3 0.9 0.015"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="cart" pos="0 0 0.095"><joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/><joint name="pitch" axis="0 1 0"/>
      <geom type="box" size="0.2 0.1 0.02" mass="4" contype="0" conaffinity="0"/>
      <body name="front" pos="0.15 0 0"><joint name="front" axis="0 1 0" armature="0.02" damping="0.01"/>
        <geom name="front" type="ellipsoid" size="0.1 0.04 0.1" pos="{0} 0 0" mass="0.3"/></body>
      <body name="rear" pos="-0.15 0 0"><joint name="rear" axis="0 1 0" armature="0.02" damping="0.01"/>
        <geom name="rear" type="ellipsoid" size="0.1 0.04 0.1" pos="{1} 0 0" mass="0.3"/></body></body>
  </worldbody>
  <actuator><velocity name="front" joint="front" kv="2"/><velocity name="rear" joint="rear" kv="2"/></actuator>
</mujoco>
"""
MAPPING = """
version: 1
model: cart.xml
parameters:
  - {name: damping, field: "dof_damping", of: [front, rear], tied: true, unit: "N m s/rad", low: 0.001, high: 0.1}
logs:
  - {path: "fit_*.npz", split: fit}
  - {path: "select.npz", split: select}
  - {path: "verify.npz", split: verify}
time: {column: t}
controls:
  "ctrl:front": {column: u0, unit: rad/s}
  "ctrl:rear": {column: u1, unit: rad/s}
channels:
  "joint:x:pos": {column: q0, unit: m, noise: 0.0005}
  "joint:z:pos": {column: q1, unit: m, noise: 0.0005}
  "joint:pitch:pos": {column: q2, unit: rad, noise: 0.0005}
  "joint:front:pos": {column: q3, unit: rad, noise: 0.002}
  "joint:rear:pos": {column: q4, unit: rad, noise: 0.002}
  "joint:z:vel": {column: v1, unit: m/s, noise: 0.005}
  "joint:pitch:vel": {column: v2, unit: rad/s, noise: 0.005}
segments: {length: 0.3, history: 0.0, horizons: [0.1, 0.3]}
effects: {only: [damping_poly]}
"""


def record(file: Path, rng: np.random.Generator, wheel: str, seconds: float = 2.0) -> None:
    """A cart that rolls to and fro, one of whose wheels has its axle OFF beside its middle."""
    model = mujoco.MjModel.from_xml_string(CART.format(*(OFF * (wheel == name) for name in ("front", "rear"))))
    model.opt.timestep = DT
    data, phases = mujoco.MjData(model), rng.uniform(0, 2 * np.pi, 2)
    data.qpos[3:] = rng.uniform(0, 2 * np.pi, 2) * [1, 1]
    rows = []
    for k in range(round((seconds + 0.5) / SAMPLE)):
        data.ctrl[:] = 8 + 3 * np.sin(np.array([2.1, 5.3]) * k * SAMPLE + phases).sum() + 0.4 * np.array([1, -1])
        if k * SAMPLE >= 0.5:  # at rest on its wheels by then
            rows.append((data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
        for _ in range(round(SAMPLE / DT)):
            mujoco.mj_step(model, data)
    q, v, u = (np.array(part) for part in zip(*rows, strict=True))
    q += rng.normal(size=q.shape) * [0.0005, 0.0005, 0.0005, 0.002, 0.002]
    v += 0.005 * rng.normal(size=v.shape)
    columns = dict(zip(("q0", "q1", "q2", "q3", "q4"), q.T, strict=True))
    columns |= {"v1": v[:, 1], "v2": v[:, 2], "u0": u[:, 0], "u1": u[:, 1]}
    np.savez(file, allow_pickle=False, t=np.arange(len(q)) * SAMPLE, **columns)


@pytest.mark.parametrize("wheel", ["front", "rear"])
def test_what_repeats_with_a_wheels_turn_is_told_from_forces_on_the_vehicle(tmp_path: Path, wheel: str) -> None:
    """The force under the wheel that is out of true gains most of all generic alternatives, by far."""
    rng = np.random.default_rng(3)
    (tmp_path / "cart.xml").write_text(CART.format(0, 0))
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    for name in ("fit_0", "fit_1", "select", "verify"):
        record(tmp_path / f"{name}.npz", rng, wheel)
    bench = make_bench(load(tmp_path / "mapping.yaml"), 1)
    logs, x = bench.dataset.of("fit"), bench.plant.null
    problem, other = bench.problem(logs), bench.problem(bench.dataset.of("select"))
    sigma = problem.covariance(bench.plant, x)
    extra = slack(problem, sigma, bench.plant, x)
    under = metric(problem, sigma, extra)
    current = stand(problem, under, bench.plant, x)
    screen = Screen(problem, under, current)
    generics = [e for e in candidates(bench, logs) if e.generic and not isinstance(e, Law)]
    gains = {s.effect.id: s.gain for s in screen_all(screen, generics)}
    (best, most), (_, second) = list(gains.items())[:2]
    assert best == f"generic_tread:{wheel}"
    assert most > 1.5 * second
    data, select = Data(problem, sigma), Data(other, other.covariance(bench.plant, x))
    arena = Arena(data, select, current, under, extra, rng, lambda text: None)
    # One look at which of them gains more than chance names it, were it not believed.
    search = Search(data, select, generics, Options(), lambda text: None)
    found = search._generic(arena, screen, Round([], 0.0))  # pyright: ignore[reportPrivateUsage]
    assert search._hinted == best  # pyright: ignore[reportPrivateUsage]
    assert found is None or arena.label(found) == best
