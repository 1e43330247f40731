"""Where bodies touch: the noise that impacts make of starts and steps, and psi near by."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.metric import metric
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.measured.steps import finer
from nfc_gym.physics.effects import build
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

DT, BALLS = 0.005, 4
LAYOUT = Layout(0.4, 0.0, (0.1, 0.2, 0.4), 0.4, DT)
BOUNCY = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    {balls}
  </worldbody>
</mujoco>
"""
BALL = """
    <body name="ball{i}" pos="{i} 0 0.3">
      <joint name="up{i}" type="slide" axis="0 0 1"/>
      <geom name="shell{i}" size="0.05" mass="0.2" solref="-4000 -1"/>
    </body>
"""


def chi2(problem: RolloutProblem, plant: Plant, x: np.ndarray) -> np.ndarray:
    return metric(problem, problem.covariance(plant, x)).whiten(problem.residual(plant, x[None]))[0] ** 2


def bouncy(step: float) -> mujoco.MjModel:
    balls = "".join(BALL.format(i=i) for i in range(BALLS))
    return mujoco.MjModel.from_xml_string(BOUNCY.format(step=step, balls=balls))


def bounce(step: float, seconds: float, rng: np.random.Generator) -> Log:
    """Balls that were dropped, simulated at a step, seen at 200 Hz with noise."""
    model, rows = bouncy(step), []
    data = mujoco.MjData(model)
    data.qpos[:] = rng.uniform(-0.2, 0.2, BALLS)
    for _ in range(round(seconds / DT)):
        rows.append((data.qpos.copy(), data.qvel.copy()))
        mujoco.mj_step(model, data, round(DT / step))
    q, v = np.swapaxes(rows, 0, 1)
    q, v = q + 0.001 * rng.normal(size=q.shape), v + 0.02 * rng.normal(size=v.shape)
    channels = {f"joint:up{i}:pos": Channel(q[:, i], "m", 0.001) for i in range(BALLS)}
    channels |= {f"joint:up{i}:vel": Channel(v[:, i], "m/s", 0.02) for i in range(BALLS)}
    return Log(str(rng.integers(1 << 30)), np.arange(len(q)) * DT, {}, channels)


def test_the_noise_of_impacts_is_drawn_from_starts() -> None:
    """A bounce at a coarse step is off in a direction that depends on when it falls between two steps."""
    rng = np.random.default_rng(3)
    logs, model = [bounce(0.0005, 2.1, rng) for _ in range(8)], bouncy(DT)
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    states = [estimate_states(model, log) for log in logs]
    problem = RolloutProblem(model, logs, states, LAYOUT)
    assert problem.rough
    drawn = chi2(problem, plant, plant.null)
    problem.rough = False  # one direction for the discretisation, as where nothing touches
    straight = chi2(problem, plant, plant.null)
    print(straight.mean(), np.median(straight.mean(1)), drawn.mean(), np.median(drawn.mean(1)), drawn.mean(1).max())
    assert 0.7 < drawn.mean() < 1.1 < straight.mean()


def test_at_half_the_step_the_noise_of_impacts_is_told_by_the_whole_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    logs, model = [bounce(0.0005, 2.1, rng) for _ in range(8)], bouncy(DT)
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    states = [estimate_states(model, log) for log in logs]
    problem = RolloutProblem(model, logs, states, LAYOUT).halved()
    steps: list[float] = []
    shoot = Plant.shoot
    monkeypatch.setattr(Plant, "shoot", lambda self, x, s, **kw: steps.append(s.dt) or shoot(self, x, s, **kw))
    assert 0.7 < chi2(problem, finer(plant), plant.null).mean() < 1.3
    assert set(steps) == {DT / 2, DT}  # and not a quarter


def test_the_noise_of_impacts_is_that_of_several_psi_near_by(monkeypatch: pytest.MonkeyPatch) -> None:
    """Balls that are slowed down a little more or less: on average what each of those expects by itself."""
    rng = np.random.default_rng(5)
    logs, model = [bounce(0.0005, 2.1, rng) for _ in range(8)], bouncy(DT)
    joints = tuple(f"up{i}" for i in range(BALLS))
    plant = Plant(
        model, ParameterSpace(model, [Parameter("damping", "dof_damping", joints, low=0.0, high=2.0)]), nthread=1
    )
    problem = RolloutProblem(model, logs, [estimate_states(model, log) for log in logs], LAYOUT)
    x = np.array([0.4])

    def noise(at: np.ndarray) -> np.ndarray:
        anew = problem.take(np.arange(len(problem)))  # which knows of no psi yet
        return np.einsum("sii->i", anew.covariance(plant, at)) / len(problem)

    monkeypatch.setattr("nfc_gym.measured.draws._OFF", 1.0)
    rows = problem._near(plant, x, problem.residual(plant, x[None])[0], 4)[0]
    together = noise(x)
    assert rows[0] == x
    assert np.ptp(rows) > 0.3
    monkeypatch.setattr("nfc_gym.measured.draws._OFF", 0.0)
    alone = np.stack([noise(row) for row in rows])
    assert (np.abs(np.log(alone / alone[0])) > 0.1).any(), "else this would test nothing"
    np.testing.assert_allclose(together, alone.mean(0), rtol=0.15)


def falling(conditions: bool = False) -> tuple[RolloutProblem, Plant]:
    """Two logs of falling balls, under psi: the first ball's mass."""
    rng, model = np.random.default_rng(5), bouncy(DT)
    logs = [bounce(DT / 5, 1.7, rng) for _ in range(2)]
    if conditions:
        logs = [replace(log, condition=label) for log, label in zip(logs, "ab", strict=True)]
    problem = RolloutProblem(model, logs, [estimate_states(model, log) for log in logs], LAYOUT)
    space = ParameterSpace(model, [Parameter("mass", "body_mass", ("ball0",), "kg", 0.1, 0.4)])
    return problem, Plant(model, space, nthread=1)


@pytest.mark.parametrize("conditions", [False, True])
def test_each_block_under_its_own_parameters_is_rolled_out_under_these_alone(
    conditions: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, plant = falling(conditions)
    push = build("external_force", "ball0", {"x": 0.0, "y": 0.0, "z": 1.0})[0]
    plant = plant.with_effects([Conditioned(push, ["a", "b"]) if conditions else push])
    rows = np.repeat(plant.null[None], 3, 0)
    rows[:, -1] = 0.1, 0.2, 0.3
    of = np.arange(len(problem)) % 3
    expected = falling(conditions)[0].residual(plant, rows)[of, np.arange(len(problem))]
    rolled, shoot = list[int](), Plant.shoot
    count = lambda self, x, seg, **kw: rolled.append(len(x) * len(seg)) or shoot(self, x, seg, **kw)  # noqa: E731
    monkeypatch.setattr(Plant, "shoot", count)
    np.testing.assert_array_equal(problem.each(plant, rows[of]), expected)
    assert sum(rolled) == len(problem)
    np.testing.assert_array_equal(problem.each(plant, rows[of]), expected)
    np.testing.assert_array_equal(problem.part(np.array([1, 4])).residual(plant, rows[1:2])[0], expected[[1, 4]])
    assert sum(rolled) == len(problem)


def test_noise_where_bodies_touch_is_that_of_each_condition() -> None:
    """An effect with values of its own in each condition is at work in the drawn starts too."""
    problem, plant = falling(conditions=True)
    push = build("external_force", "ball0", {"x": 0.0, "y": 0.0, "z": 1.0})[0]
    alike, apart = plant.with_effects([push]), plant.with_effects([Conditioned(push, ["a", "b"])])
    theta = np.array([0.0, 0.0, 1.0])
    x = [np.concatenate([plant.null, t]) for t in (theta, np.tile(theta, 2))]
    np.testing.assert_allclose(problem.covariance(apart, x[1]), problem.covariance(alike, x[0]), atol=1e-12)


def test_noise_of_impacts_is_told_once_and_of_some_blocks_as_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who asks some of the blocks first, all then, and half the step at last has each roll-out made once."""
    problem, plant = falling()
    expected, half = falling()[0].covariance(plant, plant.null), falling()[0].halved()
    rolled, shoot = list[int](), Plant.shoot
    count = lambda self, x, seg, **kw: rolled.append(len(x) * len(seg)) or shoot(self, x, seg, **kw)  # noqa: E731
    monkeypatch.setattr(Plant, "shoot", count)
    some = np.arange(0, len(problem), 3)
    np.testing.assert_array_equal(problem.part(some).covariance(plant, plant.null), expected[some])
    np.testing.assert_array_equal(problem.covariance(plant, plant.null), expected)
    once = sum(rolled)
    np.testing.assert_array_equal(problem.covariance(plant, plant.null), expected)
    fine = problem.halved().covariance(finer(plant), plant.null)
    assert sum(rolled) == once
    np.testing.assert_array_equal(half.covariance(finer(plant), plant.null), fine)
    assert sum(rolled) == 2 * once
    part = problem.halved().part(some)
    np.testing.assert_array_equal(part.covariance(finer(plant), plant.null), fine[some])
    assert sum(rolled) == 2 * once


def test_half_the_step_leaves_a_quarter_of_its_errors_variance() -> None:
    """What starts carry stays: the noise at half the step lies between that and the noise at the whole one."""
    problem, plant = falling()
    carried, error = problem._impacts(plant, plant.null)
    alike, less = problem.halved()._impacts(finer(plant), plant.null)
    np.testing.assert_array_equal(alike, carried)
    np.testing.assert_array_equal(less, 0.5 * error)  # implicitfast is of first order
    assert (np.einsum("dsm,dsm->sm", error, error) > 0).any()
