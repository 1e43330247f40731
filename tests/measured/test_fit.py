"""A fit finds the truth from logs, keeps to its box, and is never worse than where it began."""

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.fit import Fit, box, differs, fit, fit_last, jacobian, uncertainty
from nfc_gym.measured.metric import Metric, loss, metric
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.effects import build as build_effect
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

DT, SD_Q, SD_V = 0.005, 0.001, 0.01
TRUTH = np.array([0.6, 0.12])  # kg, N m s
XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="bob">
      <joint name="hinge" axis="0 1 0" damping="{damping}"/>
      <geom name="ball" size="0.03" pos="0 0 -0.3" mass="{mass}"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""


def log_of(model: mujoco.MjModel, seed: int) -> Log:
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    t = np.arange(300) * 0.01
    a, b = rng.uniform(0, 6, 2)
    u, q, v = 0.8 * np.sin(3 * t + a) + 0.4 * np.sin(7 * t + b), np.empty(300), np.empty(300)
    for k in range(300):
        q[k], v[k] = data.qpos[0], data.qvel[0]
        data.ctrl[0] = u[k]
        mujoco.mj_step(model, data, 2)
    q, v = q + SD_Q * rng.normal(size=300), v + SD_V * rng.normal(size=300)
    channels = {"joint:hinge:pos": Channel(q, "rad", SD_Q), "joint:hinge:vel": Channel(v, "rad/s", SD_V)}
    return Log(f"run_{seed}", t, {"ctrl:motor": u}, channels)


def parameters(**change: dict) -> list[Parameter]:
    given = {
        "mass": {"field": "body_mass", "of": ("bob",), "unit": "kg", "low": 0.2, "high": 1.0},
        "damping": {"field": "dof_damping", "of": ("hinge",), "unit": "N m s", "low": 0.0, "high": 0.5},
    }
    return [Parameter(name, **{**entry, **change.get(name, {})}) for name, entry in given.items()]


def build(**change: dict) -> tuple[RolloutProblem, Plant, Metric]:
    """The model as its maker has it (0.5 kg, 0.05 N m s) and three runs of the machine."""
    model = mujoco.MjModel.from_xml_string(XML.format(damping=0.05, mass=0.5))
    plant = Plant(model, ParameterSpace(model, parameters(**change)), nthread=1)
    mass, damping = TRUTH
    real = mujoco.MjModel.from_xml_string(XML.format(damping=damping, mass=mass))
    logs = [log_of(real, seed) for seed in range(3)]
    states = [estimate_states(model, log) for log in logs]
    problem = RolloutProblem(model, logs, states, Layout(0.4, 0.0, (0.1, 0.2, 0.4), 0.4, DT))
    return problem, plant, metric(problem, problem.covariance(plant, plant.null))


@pytest.fixture(scope="module")
def fitted() -> tuple[RolloutProblem, Metric, Fit]:
    problem, plant, under = build()
    return problem, under, fit(problem, under, plant, plant.null, rounds=12)


def total(problem: RolloutProblem, under: Metric, plant: Plant, x: np.ndarray) -> float:
    return float(loss(under.whiten(problem.residual(plant, x[None]))).sum())


def test_mass_and_damping_are_recovered(fitted: tuple[RolloutProblem, Metric, Fit]) -> None:
    problem, under, result = fitted
    np.testing.assert_allclose(result.x, TRUTH, rtol=0.01)
    assert total(problem, under, result.plant, result.x) <= 1.02 * total(problem, under, result.plant, TRUTH)
    white = under.whiten(problem.residual(result.plant, result.x[None]))[0]
    np.testing.assert_allclose(result.white, white, atol=1e-9)


def test_the_truth_lies_within_the_uncertainty(fitted: tuple[RolloutProblem, Metric, Fit]) -> None:
    problem, _, result = fitted
    sd = uncertainty(result, np.arange(len(problem)))
    assert (sd > 0).all()
    assert (sd < 0.01 * TRUTH).all()
    assert (np.abs(result.x - TRUTH) < 4 * sd).all()


def test_more_data_narrow_the_uncertainty(fitted: tuple[RolloutProblem, Metric, Fit]) -> None:
    """Four copies of every block, each a cluster of its own, halve the standard deviation."""
    problem, _, result = fitted
    n = len(problem)
    four = Fit(result.plant, result.x, np.tile(result.white, (4, 1)), np.tile(result.jacobian, (4, 1, 1)))
    np.testing.assert_allclose(uncertainty(four, np.arange(4 * n)), uncertainty(result, np.arange(n)) / 2, rtol=0.02)


@pytest.mark.parametrize(("sizes", "shown"), [((0.02, 0.0), True), ((0.0, 0.0), False), ((1e-6, 0.0), False)])
def test_sizes_differ_from_nothing_together(sizes: tuple[float, float], shown: bool) -> None:
    """Two numbers that can stand in for each other: each is uncertain, their sum is not."""
    _, plant, _ = build()
    law = build_effect("damping_poly", "hinge", {"linear": 0.0, "quadratic": 0.0, "cubic": 0.0})[0]
    plant = plant.with_effects([law])
    rng = np.random.default_rng(2)
    slopes = rng.normal(size=(40, 6, 5)) * [100.0, 100.0, 30.0, 0.01, 0.0]
    slopes[..., 3] += slopes[..., 2]
    x = np.concatenate([plant.space.nominal, sizes, [0.0]])
    white = rng.normal(size=(40, 6))
    fitted = Fit(plant, x, white, slopes)
    assert differs(fitted, np.arange(40), law) == shown
    assert not (np.abs(x[3:4]) > 2 * uncertainty(fitted, np.arange(40))[2:4]).any()


def test_sizes_differ_though_clusters_are_fewer_than_they() -> None:
    """A law of three sizes is not judged by two clusters: here they scatter in no direction at all."""
    _, plant, _ = build()
    law = build_effect("damping_poly", "hinge", {"linear": 0.0, "quadratic": 0.0, "cubic": 0.0})[0]
    plant = plant.with_effects([law])
    rng = np.random.default_rng(4)
    x = np.concatenate([plant.space.nominal, [0.02, 0.02, 0.02]])
    fitted = Fit(plant, x, np.zeros((40, 6)), 100 * rng.normal(size=(40, 6, 5)))
    assert differs(fitted, np.arange(40) % 2, law)


@pytest.mark.parametrize("start", [[0.25, 0.0], [0.95, 0.45], [0.5, 0.05]])
def test_never_worse_than_the_start(fitted: tuple[RolloutProblem, Metric, Fit], start: list[float]) -> None:
    problem, under, result = fitted
    x = np.array(start)
    for rounds in (1, 2, 8):
        after = fit(problem, under, result.plant, x, rounds=rounds)
        assert total(problem, under, result.plant, after.x) <= total(problem, under, result.plant, x) * (1 + 1e-6)


def test_starting_at_the_best_stays_there(fitted: tuple[RolloutProblem, Metric, Fit]) -> None:
    problem, under, result = fitted
    again = fit(problem, under, result.plant, result.x, rounds=4)
    np.testing.assert_allclose(again.x, result.x, rtol=1e-3)


def test_bounds_hold_where_the_truth_lies_beyond() -> None:
    problem, plant, under = build(mass={"low": 0.3, "high": 0.55})
    x = fit(problem, under, plant, plant.null, rounds=8).x
    assert 0.3 <= x[0] <= 0.55
    assert x[0] == pytest.approx(0.55, abs=0.003)


def test_an_anchored_parameter_stays() -> None:
    problem, plant, under = build(mass={"anchored": True, "nominal": 0.55})
    result = fit(problem, under, plant, plant.null, rounds=8)
    assert result.x[0] == 0.55
    assert result.x[1] != plant.null[1]
    assert result.jacobian.shape[-1] == 1
    sd = uncertainty(result, np.arange(len(problem)))
    assert sd[0] == 0
    assert sd[1] > 0
    np.testing.assert_array_equal(box(plant).free, [False, True])


def test_the_jacobian_is_the_residuals_slope(fitted: tuple[RolloutProblem, Metric, Fit]) -> None:
    """Against central differences of a third size, by the parameters' own scales."""
    problem, under, result = fitted
    limits, x = box(result.plant), TRUTH.copy()
    base = under.whiten(problem.residual(result.plant, x[None]))[0]
    found = jacobian(problem, under, limits, x, base, np.array([0, 1]))
    for i in range(2):
        step = np.eye(2)[i] * 1e-5 * limits.scale
        pair = under.whiten(problem.residual(result.plant, np.stack([x + step, x - step])))
        slope = (pair[0] - pair[1]) / 2e-5
        np.testing.assert_allclose(found[..., i], slope, atol=5e-3 * np.abs(slope).max())


def test_the_last_parameters_are_fitted_with_the_others_held() -> None:
    problem, plant, under = build()
    start = np.array([TRUTH[0], plant.null[1]])
    found = fit_last(problem, under, plant, start, 1)
    assert found[0] == start[0]
    assert found[1] == pytest.approx(TRUTH[1], abs=0.01)  # its null is 0.05
    assert total(problem, under, plant, found) < total(problem, under, plant, start)
    # with a wrong mass it is the best that damping alone can do
    wrong = fit_last(problem, under, plant, plant.null, 1)
    near = np.array([[wrong[0], wrong[1] + d] for d in (-0.01, 0.0, 0.01)])
    left = [total(problem, under, plant, x) for x in near]
    assert left[1] <= min(left) * 1.01  # robust weights that change make the last per cent slow
    assert left[1] < 0.6 * total(problem, under, plant, plant.null)
