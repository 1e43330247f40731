"""Looking closer where bodies may touch: sizes are climbed, and blocks with large errors are never left out."""

import copy
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.fisher import Lens, repeated
from nfc_gym.measured.fit import Fit, stand
from nfc_gym.measured.lookout import Lookout, _pursued
from nfc_gym.measured.metric import loss, metric
from nfc_gym.measured.screen import Screen, answer, ladder
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.effects import FAMILIES, build
from nfc_gym.physics.effects.each import split
from nfc_gym.physics.effects.inertial import ComShift, Payload
from nfc_gym.physics.effects.joint import SpringOffset
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant

DT, NOISE, REMOVED = 0.01, {"pos": 0.001, "vel": 0.01}, 0.3
MODEL = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <geom name="far" type="plane" size="1 1 1" pos="0 0 -9"/>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.1"/><geom name="bob" size="0.05" pos="0 0 -0.3"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
TWO = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="left"><joint name="a" axis="0 1 0" damping="0.1"/><geom size="0.05" pos="0 0 -0.3"/></body>
    <body pos="0 1 0"><joint name="b" axis="0 1 0" damping="0.1"/><geom size="0.05" pos="0 0 -0.3"/></body>
  </worldbody>
</mujoco>
"""


def record(model: mujoco.MjModel, seed: int, loud: bool) -> Log:
    """An arm whose motor gives up at 70 % of its range, which only a loud log asks for."""
    rng, data, rows = np.random.default_rng(seed), mujoco.MjData(model), []
    wish = np.sin(rng.uniform(3, 8) * DT * np.arange(300) + rng.uniform(0, 6)) * (0.9 if loud else 0.5)
    for u in wish:
        rows.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = np.clip(u, REMOVED - 1, 1 - REMOVED)
        mujoco.mj_step(model, data)
    rows = np.array(rows) + rng.normal(size=(len(wish), 2)) * list(NOISE.values())
    channels = {f"joint:hinge:{q}": Channel(rows[:, i], noise=n) for i, (q, n) in enumerate(NOISE.items())}
    return Log(f"run_{seed}", DT * np.arange(len(wish)), {"ctrl:motor": wish}, channels)


@pytest.fixture(scope="module")
def screen() -> Screen:
    model = mujoco.MjModel.from_xml_string(MODEL)
    logs = [record(model, s, s == 7) for s in range(9)]
    layout = Layout(0.4, 0.0, (0.1, 0.4), 0.4, DT)
    problem = RolloutProblem(model, logs, [estimate_states(model, log) for log in logs], layout)
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    under = metric(problem, problem.covariance(plant, plant.null))
    return Screen(problem, under, stand(problem, under, plant, plant.null))


def test_a_thinned_problem_keeps_the_blocks_with_the_largest_errors(screen: Screen) -> None:
    thin = Lookout(screen.problem, np.random.default_rng(0), lambda text: None)._thinned(screen)
    worst = np.sort(screen.current.losses)[-3:]
    assert len(thin.problem) < len(screen.problem) / 2
    assert set(worst) <= set(thin.current.losses)


def test_a_scout_finds_a_limit_that_few_blocks_reach(screen: Screen) -> None:
    law = build("saturation", "motor", {"removed": 0.0})[0]
    plant = screen.current.plant.with_effects([law])
    true = loss(screen.metric.whiten(screen.problem.residual(plant, np.array([[REMOVED]])))).sum()
    best = float(screen.current.losses.sum() - true)
    found = screen.scout(screen.try_one(law, every_size=False), np.random.default_rng(0))
    assert found.gain > 0.5 * best > 0
    assert found.theta[0] == pytest.approx(REMOVED, abs=0.1)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_ladder_keeps_to_bounds_and_to_the_side_that_was_found(side: float) -> None:
    law = build("compliance", "ground", {"softness": 0.0, "damping": 0.0})[0]
    rungs = ladder(law, np.array([side * 0.3, -side * 0.2]))
    assert (np.sign(rungs) == [side, -side]).all()
    assert ((rungs >= law.low) & (rungs <= law.high)).all()
    assert (np.diff(np.abs(rungs), axis=0) > 0).all()


def test_a_limit_is_met_by_some_rung_within_a_tenth() -> None:
    """Whatever it is, between an eighth of the realistic size and all of it: halving went over a limit of the knees."""
    law = build("saturation", "motor", {"removed": 0.0})[0]
    rungs = ladder(law, np.array([0.3]))[:, 0]
    whole = law.params[0].probes[1]
    for size in np.linspace(whole / 8, whole, 50):
        assert np.abs(rungs / size - 1).min() < 0.1


def test_what_repeats_is_what_two_columns_share() -> None:
    one = np.eye(3)
    np.testing.assert_allclose(repeated(one, np.array([[2.0, 0, 0], [0, -1.0, 1.0], [0, 0, 1.0]])), [1, 0, 0.5**0.5])


@pytest.mark.parametrize(("floor", "touches"), [("0 0 -9", False), ("0 0 -0.345", True)])
def test_only_what_touches_has_a_twin(screen: Screen, floor: str, touches: bool) -> None:
    model = mujoco.MjModel.from_xml_string(MODEL.replace("0 0 -9", floor))
    problem, plant = screen.problem, Plant(model, ParameterSpace(model, []), nthread=1)
    assert problem.touches(plant, plant.null) == touches
    assert (Lens(problem, screen.metric, plant, plant.null).twin() is not None) == touches


def test_a_twin_begins_elsewhere_on_some_of_the_blocks(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RolloutProblem, "touches", lambda *model: True)
    lens = Lens(screen.problem, screen.metric, screen.current.plant, screen.current.x)
    twin = lens.twin()
    assert twin is not None
    apart = twin.problem.segments.qpos - screen.problem.segments.qpos[lens.shared]
    assert np.std(apart) == pytest.approx(screen.problem._start_sd[0][lens.shared].mean(), rel=0.3)
    law = build("saturation", "motor", {"removed": 0.0})[0]
    here, there = (each.columns(law, np.array([[REMOVED]])) for each in (lens, twin))
    assert repeated(here[lens.shared].reshape(-1, 1), there.reshape(-1, 1))[0] > 0.95


def of_two(model: mujoco.MjModel, rows: np.ndarray, rng: np.random.Generator) -> Screen:
    """What two hinges did, (n, 4) positions and speeds, against their model."""
    noise = {"a:pos": 0.001, "b:pos": 0.001, "a:vel": 0.01, "b:vel": 0.01}
    seen = rows + rng.normal(size=rows.shape) * list(noise.values())
    channels = {f"joint:{n}": Channel(seen[:, i], noise=sd) for i, (n, sd) in enumerate(noise.items())}
    log = Log("run", DT * np.arange(len(rows)), {}, channels)
    problem = RolloutProblem(model, [log], [estimate_states(model, log)], Layout(0.3, 0.0, (0.1, 0.3), 0.3, DT))
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    under = metric(problem, problem.covariance(plant, plant.null))
    return Screen(problem, under, stand(problem, under, plant, plant.null))


def test_a_lump_is_screened_where_straight_lines_want_less_than_no_mass() -> None:
    """The first bob is lighter than its model and hangs off its place: a lump can do the second, and not the first."""
    model = mujoco.MjModel.from_xml_string(TWO)
    real = copy.copy(model)
    real.body_mass[1] *= 0.95
    real.body_inertia[1] *= 0.95
    real.body_ipos[1, 0] += 0.03
    rng, data, rows = np.random.default_rng(0), mujoco.MjData(real), []
    data.qpos[:] = 0.5, -0.4
    for _ in range(300):
        rows.append((*data.qpos, *data.qvel))
        mujoco.mj_step(real, data)
    screen = of_two(model, np.array(rows), rng)
    places = {axis: {"probes": (c, c + 0.05)} for axis, c in zip("xyz", (0.0, 0.0, -0.3), strict=True)}
    shift = screen.try_one(ComShift(("left",), ComShift.PARAMS))
    lump = screen.try_one(Payload(("left",), sized(Payload.PARAMS, mass={"probes": (0.08,)}, **places)))
    assert lump.theta[0] > 0
    assert lump.gain > 0.5 * shift.gain > 0


def test_springs_with_values_of_their_own_are_screened() -> None:
    """Two parameters a place, one of them a shape, and rows that span the coordinates of a chart."""
    model = mujoco.MjModel.from_xml_string(TWO)
    rng, data, rows = np.random.default_rng(0), mujoco.MjData(model), []
    data.qpos[:] = 0.5, -0.4
    for _ in range(300):
        rows.append((*data.qpos, *data.qvel))
        data.qfrc_applied[:] = -0.2 * (data.qpos - 0.3)  # the springs that the model lacks
        mujoco.mj_step(model, data)
    screen = of_two(model, np.array(rows), rng)
    sizes = {"stiffness": {"probes": (0.1, 0.4)}, "rest": {"probes": (0.0, 0.5)}}
    apart = split(SpringOffset(("a", "b"), sized(SpringOffset.PARAMS, **sizes)), screen.current.plant)
    assert apart is not None
    found = screen.try_one(apart[0])
    assert found.columns.shape[1] == 4
    assert found.gain > 0
    # Drives of one make on one battery follow it alike.
    assert split(FAMILIES["supply_sag"](("a", "b")), screen.current.plant) is None


def test_a_model_without_free_parameters_answers_nothing() -> None:
    """An anchored mass is all that a mapping may declare."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    bare = Fit(Plant(model, ParameterSpace(model, [])), np.zeros(0), np.ones((5, 3)), np.zeros((5, 3, 0)))
    assert answer(bare, np.ones((2, 5, 3))).shape == (2, 0)


def test_sets_of_places_and_the_best_of_each_family_are_pursued_whatever_straight_lines_say() -> None:
    of = lambda family, where, gain: SimpleNamespace(effect=SimpleNamespace(family=family, where=where), gain=gain)  # noqa: E731
    lead = [of("gain", (f"joint_{i}",), 100.0 - i) for i in range(45)]
    late = [
        of("inertia", ("knee",), 5.0), of("gain", ("a", "b"), 4.0), of("inertia", ("hip",), 3.0),
        of("inertia", ("l", "r"), 2.0), of("lag", ("l", "r"), 0.0),
    ]  # fmt: skip
    found: Any = [*lead, *late]
    assert _pursued(found) == [*lead[:40], late[0], late[1], late[3]]
