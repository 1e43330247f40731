"""A hinge with a spring, and friction of one kind or another, that the model knows nothing of; and a contest on it."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.arena import Arena
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.fit import fit
from nfc_gym.measured.owned import Data
from nfc_gym.measured.settle import settle
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.effects.base import Effect, Scales
from nfc_gym.physics.effects.friction import Coulomb
from nfc_gym.physics.effects.joint import DampingPoly, SpringOffset
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant

DT, NOISE = 0.005, {"pos": 0.002, "vel": 0.02}
MODEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 0 1" {physics}/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0.3 0" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
FRICTION = 'frictionloss="0.2" solreffriction="0.01 1" solimpfriction="0.99 0.99 0.001 0.5 2"'
LAGGING = 'damping="0.15"'
SCALES = Scales(np.full(1, 0.5), np.full(1, 4.0), np.full(1, 1.0), np.full(1, 1.0), DT)


def record(physics: str, seed: int) -> Log:
    """A swing under torques of several frequencies, with plain `mj_step` at a fifth of the step."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(MODEL.format(physics=f'stiffness="1.5" {physics}'))
    model.opt.timestep = DT / 5
    data = mujoco.MjData(model)
    t = DT * np.arange(600)
    torque = 0.8 * np.sin(rng.uniform(2, 12, (4, 1)) * t + rng.uniform(0, 6, (4, 1))).sum(0)
    rows = np.empty((600, 2))
    for k, u in enumerate(torque):
        rows[k] = data.qpos[0], data.qvel[0]
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 5)
    rows += rng.normal(size=rows.shape) * list(NOISE.values())
    channels = {f"joint:hinge:{q}": Channel(rows[:, i], noise=n) for i, (q, n) in enumerate(NOISE.items())}
    return Log(f"run_{seed}", t, {"ctrl:motor": torque}, channels)


def given() -> mujoco.MjModel:
    """The model, which knows neither spring nor friction."""
    return mujoco.MjModel.from_xml_string(MODEL.format(physics=""))


def problem(logs: list[Log]) -> RolloutProblem:
    layout = Layout(0.4, 0.0, (0.1, 0.2, 0.4), 0.4, DT)
    return RolloutProblem(given(), logs, [estimate_states(given(), log) for log in logs], layout)


def arena(physics: str, effects: list[tuple[Effect, NDArray[np.float64]]]) -> Arena:
    """The contest on a machine with a spring and those physics, the model to beat having those effects."""
    fitting, selecting = (problem([record(physics, s) for s in seeds]) for seeds in ((0, 1, 2), (3, 4)))
    plant = Plant(given(), ParameterSpace(given(), []), [e for e, _ in effects], nthread=1)
    x = np.concatenate([t for _, t in effects])
    sigma = [p.covariance(plant, x) for p in (fitting, selecting)]
    found, under, extra = settle(fitting, sigma[0], plant, x)
    data = [Data(p, s) for p, s in zip((fitting, selecting), sigma, strict=True)]
    rng = np.random.default_rng(0)
    start = fit(fitting, under, found.plant, found.x)
    return Arena(data[0], data[1], start, under, extra, rng, lambda text: None)


def pool() -> list[Effect]:
    return [e for kind in (Coulomb, DampingPoly, SpringOffset) for e in kind.propose(given(), SCALES)]


VISCOUS = ("damping_poly", "hinge", {"linear": 0.1, "quadratic": 0.0, "cubic": 0.0})
DRY = ("coulomb", "hinge", {"level": 0.1})
SPRING = ("spring_offset", "hinge", {"stiffness": 1.5, "rest": 0.0})
