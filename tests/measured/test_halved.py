"""What makes up for the error of a coarse step is no finding; what the machine does is one at any step."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured import halved
from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import clusters
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.fit import fit, uncertainty
from nfc_gym.measured.halved import artefacts, step_error
from nfc_gym.measured.owned import Data
from nfc_gym.measured.settle import settle
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.measured.steps import finer
from nfc_gym.measured.verdict import Open, bounds
from nfc_gym.physics.effects import build
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant

DT, SAMPLE, NOISE = 0.01, 0.01, {"pos": 0.001, "vel": 0.01}
MODEL = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast"/>
  <worldbody>
    <body name="rim"><joint name="wheel" axis="0 1 0" armature="0.01"/><geom size="0.05" mass="0.1"/></body>
  </worldbody>
  <actuator><velocity name="servo" joint="wheel" kv="{gain}"/></actuator>
</mujoco>
"""


def record(gain: float, seed: int, noise: float = 1.0) -> Log:
    """A wheel's speed that follows sines, with plain `mj_step` at a step of 0.5 ms."""
    rng, step = np.random.default_rng(seed), SAMPLE / 20
    model = mujoco.MjModel.from_xml_string(MODEL.format(step=step, gain=gain))
    data, rows = mujoco.MjData(model), []
    wish = 3 * np.sin(rng.uniform(2, 8, (3, 1)) * SAMPLE * np.arange(300) + rng.uniform(0, 6, (3, 1))).sum(0)
    for u in wish:
        rows.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 20)
    rows = np.array(rows) + noise * rng.normal(size=(len(wish), 2)) * list(NOISE.values())
    channels = {f"joint:wheel:{q}": Channel(rows[:, i], noise=n) for i, (q, n) in enumerate(NOISE.items())}
    return Log(f"run_{seed}", SAMPLE * np.arange(len(wish)), {"ctrl:servo": wish}, channels)


def arena(gain: float) -> Arena:
    """A model with the effect `gain` fitted to a machine of that servo gain; 0.5 is what the model has without it."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(step=DT, gain=0.5))
    layout = Layout(0.3, 0.0, (0.04, 0.1, 0.3), 0.3, DT)
    problems = []
    for seeds in (range(8), range(8, 12)):
        logs = [record(gain, s) for s in seeds]
        problems.append(RolloutProblem(model, logs, [estimate_states(model, log) for log in logs], layout))
    plant = Plant(model, ParameterSpace(model, []), [build("gain", "servo", {"gain": 1.0})[0]], nthread=1)
    # Without the discretisation's own noise a contest at the whole step takes its error for an effect.
    sigma = [np.broadcast_to(np.diag(np.repeat(list(NOISE.values()), 3) ** 2 * 4), (len(p), 6, 6)) for p in problems]
    found, under, extra = settle(problems[0], sigma[0], plant, plant.null)
    data = [Data(p, s) for p, s in zip(problems, sigma, strict=True)]
    start = fit(problems[0], under, found.plant, found.x)
    return Arena(data[0], data[1], start, under, extra, np.random.default_rng(0), lambda text: None)


@pytest.mark.parametrize(("gain", "real"), [(0.5, False), (0.6, True)])
def test_an_effect_must_outlive_half_the_step(gain: float, real: bool) -> None:
    contest = arena(gain)
    bare = contest.without(contest.current.plant.effects[0])
    assert bare.worth(bare.judge(contest.current), 0.02)
    assert bool(artefacts(contest, 0.02)) != real


@pytest.mark.parametrize("gain", [0.5, 0.6])
def test_the_step_widens_the_interval_until_it_holds_the_truth(gain: float) -> None:
    contest = arena(gain)
    problem, fitted = contest.fit_data.problem, contest.current
    sd, step = uncertainty(fitted, clusters(problem)), step_error(problem, contest.under, fitted)
    off, (low, high) = np.abs(fitted.x - gain / 0.5), bounds(fitted, problem, Open(np.zeros_like(sd), step))
    assert off > 1.96 * sd
    assert low < gain / 0.5 < high
    assert np.ptp(step) < 1.5 * off
    assert 0.0 in step, "a first-order step errs to one side"


def test_what_a_quarter_of_the_step_shows_counts_where_half_of_it_shows_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    contest = arena(0.6)
    ends = {DT: 1.0, DT / 2: 1.1, DT / 4: 0.7}
    said = lambda problem, under, plant, *_, **__: SimpleNamespace(x=np.array([ends[plant.model.opt.timestep]]))  # noqa: E731
    monkeypatch.setattr(halved, "fit", said)
    below, above = step_error(contest.fit_data.problem, contest.under, contest.current)
    assert below[0] == pytest.approx(-0.3 * 4 / 3)
    assert above[0] == pytest.approx(0.1 * 2)


def test_a_halved_problem_is_the_same_experiment_at_half_the_step() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL.format(step=DT, gain=0.5))
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    logs = [record(0.5, 0, noise=0.0)]
    layout = Layout(0.3, 0.0, (0.04, 0.1, 0.3), 0.3, DT)
    problem = RolloutProblem(model, logs, [estimate_states(model, log) for log in logs], layout)
    fine = problem.halved()
    assert finer(plant).model.opt.timestep == DT / 2 == fine.segments.dt
    assert fine.segments.steps == 2 * problem.segments.steps
    coarse, exact = problem.residual(plant, plant.null[None]), fine.residual(finer(plant), plant.null[None])
    assert np.linalg.norm(exact) / np.linalg.norm(coarse) == pytest.approx(0.5, abs=0.1)  # a first-order integrator
