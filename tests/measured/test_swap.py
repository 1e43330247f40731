"""An earlier law gives way to the one that does better beside the others."""

from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.arena import Arena
from nfc_gym.measured.fit import fit
from nfc_gym.measured.lookout import Lookout
from nfc_gym.measured.owned import Data
from nfc_gym.measured.rounds import Round
from nfc_gym.measured.search import Options, Search
from nfc_gym.measured.segments import Layout
from nfc_gym.measured.settle import settle
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.measured.swap import Swap, swapped
from nfc_gym.physics.effects import build
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
    scales = Scales(np.full(1, 0.5), np.full(1, 4.0), np.full(1, 1.0), np.full(1, 1.0), DT)
    return [e for kind in (Coulomb, DampingPoly, SpringOffset) for e in kind.propose(given(), scales)]


VISCOUS = ("damping_poly", "hinge", {"linear": 0.1, "quadratic": 0.0, "cubic": 0.0})
DRY = ("coulomb", "hinge", {"level": 0.1})
SPRING = ("spring_offset", "hinge", {"stiffness": 1.5, "rest": 0.0})


@pytest.mark.parametrize(
    ("physics", "first", "right"),
    [(FRICTION, VISCOUS, "coulomb:hinge"), (LAGGING, DRY, "damping_poly:hinge"), (FRICTION, DRY, None)],
    ids=["dry for viscous", "viscous for dry", "right from the start"],
)
def test_the_wrong_law_beside_a_right_one_is_exchanged(physics: str, first: tuple, right: str | None) -> None:
    contest = arena(physics, [build(*first), build(*SPRING)])
    lookout = Lookout(contest.fit_data.problem, np.random.default_rng(0), lambda text: None)
    said: list[str] = []
    found = swapped(contest, lookout, pool(), 0.02, said.append)
    if right is None:
        assert found.better is None
        assert not found.alike
        return
    assert found.better is not None
    assert {e.id for e in found.better.plant.effects} == {right, "spring_offset:hinge"}
    assert said == [f"{right} in place of {first[0]}:hinge: together they explain more"]


class Twin(DampingPoly):
    """Damping by another name."""

    family = "twin"


@pytest.mark.parametrize("leads", [True, False], ids=["leads the screening", "does what the law does"])
def test_what_does_as_well_in_an_earlier_laws_place_is_its_equivalent(
    leads: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not leads:
        monkeypatch.setattr("nfc_gym.measured.swap.shortlist", lambda *_: [])
    contest = arena(LAGGING, [build(*VISCOUS), build(*SPRING)])
    lookout = Lookout(contest.fit_data.problem, np.random.default_rng(0), lambda text: None)
    twins = Twin.propose(given(), Scales(np.full(1, 0.5), np.full(1, 4.0), np.full(1, 1.0), np.full(1, 1.0), DT))
    found = swapped(contest, lookout, [*pool(), *twins], 0.02, lambda text: None)
    assert found.better is None
    assert found.alike == {"damping_poly:hinge": ["twin:hinge"]}


def test_equivalents_in_the_last_model_join_those_of_the_round(monkeypatch: pytest.MonkeyPatch) -> None:
    """A law that did worse while another was missing may do as well beside it."""
    search: Any = object.__new__(Search)
    search.options, search.lookout, search.named, search.say = Options(), None, [], None
    rounds = [Round(["a:x"], 0.5, equivalents=["b:x"]), Round(["d:x"], 0.1), Round([], 0.0)]
    monkeypatch.setattr("nfc_gym.measured.search.swapped", lambda *_: Swap(alike={"a:x": ["b:x", "c:x"]}))
    assert search._exchange(None, rounds) is None
    assert [r.equivalents for r in rounds] == [["b:x", "c:x"], [], []]
