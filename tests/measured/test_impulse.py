"""The impulse tensor against what it stands for: the change of the residual when a small law is at work."""

import mujoco
import numpy as np
import pytest
from hidden_laws import CRAFT, STEP, WHEEL, Machine, hover, nothing, record, swing

from nfc_gym.core.log import Channel, Log
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.impulse import Tensor, impulse
from nfc_gym.measured.inverse import InverseProblem
from nfc_gym.measured.metric import Metric, metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import States, estimate_states
from nfc_gym.physics.effects import Scales, propose
from nfc_gym.physics.effects.law import Law
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant


def laws_of(model: mujoco.MjModel) -> dict[str, Law]:
    ones = np.ones(model.nv)
    scales = Scales(0.1 * ones, ones, np.ones(model.nu), np.ones(model.nu), 0.01)
    laws = {e.id: e for e in propose(model, scales) if isinstance(e, Law)}
    for law in laws.values():
        law.bind(model)
    return laws


def bare(problem: Problem, model: mujoco.MjModel) -> tuple[Fit, Metric]:
    """The nominal model as a fit of nothing."""
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    under = metric(problem, problem.covariance(plant, np.zeros(0)))
    white = under.whiten(problem.residual(plant, np.zeros((1, 0))))[0]
    return Fit(plant, np.zeros(0), white, np.zeros((*white.shape, 0))), under


def change(problem: Problem, current: Fit, under: Metric, law: Law, theta: np.ndarray) -> np.ndarray:
    """(S, m) whitened change that a law makes."""
    plant = current.plant.with_effects([law])
    return under.whiten(problem.residual(plant, theta[None]))[0] - current.white


def rolled(machine: Machine) -> tuple[RolloutProblem, mujoco.MjModel]:
    model = machine.model()
    logs = [record(machine, seed, 1.5) for seed in (1, 2)]
    layout = Layout(0.3, 0.0, (0.1, 0.2, 0.3), 0.3, STEP)
    return RolloutProblem(model, logs, [estimate_states(model, log) for log in logs], layout), model


@pytest.mark.parametrize(
    ("machine", "ids"),
    [
        (Machine(WHEEL, 0.01, 0.01, swing(0.1), nothing), ("law_harmonic:wheel", "law_power:wheel")),
        (
            Machine(CRAFT, 1.0, 1.0, hover, nothing),
            ("law_height:flight[2]", "law_height:flight[2]@body", "law_cross:flight[3]+flight[1]"),
        ),
    ],
    ids=["wheel", "craft"],
)
def test_columns_are_the_change_that_a_small_law_makes(machine: Machine, ids: tuple[str, ...]) -> None:
    problem, model = rolled(machine)
    current, under = bare(problem, model)
    laws = laws_of(model)
    tensor = impulse(problem, under, current, dict.fromkeys(range(model.nv), 1e-3))
    assert isinstance(tensor, Tensor)
    np.testing.assert_array_equal(tensor.index, np.arange(len(problem)))
    for i in ids:
        law = laws[i]
        shape = law.grid(tensor.context)[1:2] if len(law.params) > law.terms else np.zeros((1, 0))
        columns = tensor.columns(law, shape)[0]
        for k, column in enumerate(columns):
            theta = np.concatenate([1e-4 * np.eye(law.terms)[k], shape[0]])
            truth = change(problem, current, under, law, theta) / 1e-4
            # The force is averaged over eighths of a segment, and the motion drawn to the measured one.
            assert np.linalg.norm(column - truth) < 0.1 * np.linalg.norm(truth), i


def test_large_problems_are_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nfc_gym.measured.impulse._WORK", 1)
    monkeypatch.setattr("nfc_gym.measured.impulse._LEAST", 4)
    problem, model = rolled(Machine(WHEEL, 0.01, 0.01, swing(0.1), nothing))
    current, under = bare(problem, model)
    tensor = impulse(problem, under, current, {0: 1e-3})
    assert tensor is not None
    np.testing.assert_array_equal(tensor.index, np.linspace(0, len(problem) - 1, 4).round())
    assert tensor.answer.shape == (4, 1, 8, len(problem.columns))


def test_in_an_inverse_problem_the_residual_is_the_force() -> None:
    """A force that the model lacks is missing from what the actuator is thought to do, at the same sample."""
    model = Machine(WHEEL, 0.01, 0.01, swing(0.1), nothing).model()
    time = np.arange(200) * 0.01
    angle, speed = 3 * np.sin(2 * time), 6 * np.cos(2 * time)
    log = Log("run", time, {}, {"force:motor": Channel(np.zeros(200), "N m", 0.01)})
    states = States(
        angle[:, None], speed[:, None], -12 * np.sin(2 * time)[:, None],
        np.zeros((200, 1)), np.zeros((200, 1)), np.ones(1, bool),
    )  # fmt: skip
    problem = InverseProblem(model, [log], [states], 0.2)
    current, under = bare(problem, model)
    tensor = impulse(problem, under, current, {0: 1e-3})
    assert tensor is not None
    law = laws_of(model)["law_harmonic:wheel"]
    shape = np.array([[3.0]])
    for k, column in enumerate(tensor.columns(law, shape)[0]):
        theta = np.concatenate([np.eye(2)[k], shape[0]])
        np.testing.assert_allclose(column, change(problem, current, under, law, theta), atol=1e-6 / 0.01)
        wave = (np.cos, np.sin)[k](3 * angle)[problem.rows]
        np.testing.assert_allclose(column, wave / 0.01, rtol=1e-6, atol=1e-4)
