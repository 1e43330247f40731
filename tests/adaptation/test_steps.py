"""The noise of control steps: what `ResidualDynamics` put in comes out of the window's own residuals."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.adaptation.steps import step_covariance
from nfc_gym.core import InputError
from nfc_gym.wrappers import ResidualDynamics

ID = "nfc_gym/QuadcopterFlat-v0"
SPEED = slice(7, 10)  # m/s, entries of `proprio`
N = 300


def flight(covariance: Any, bias: np.ndarray, seed: int = 0) -> tuple[np.ndarray, ...]:
    """A window of flight in which each step is kicked: states, actions, estimate, psi."""
    env = ResidualDynamics(gym.make(ID, context=["psi"], max_episode_steps=10 * N), bias, covariance=covariance)
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)  # level, and with one thrust for all rotors it stays so
    base, states, actions, estimate = env.unwrapped, [observation["proprio"]], [], []

    def now() -> np.ndarray:
        return np.concatenate([base.data.qpos, base.data.qvel, base.data.act])

    estimate.append(now())
    most = base.model.actuator_ctrlrange[:, 1].sum()  # N
    up = 2.1 * base.model.body_subtreemass[1] * 9.81 / most - 1  # a little more than hovering
    for _ in range(N):
        actions.append(np.full(4, up + 0.02 * rng.standard_normal()))
        observation = env.step(actions[-1])[0]
        states.append(observation["proprio"])
        estimate.append(now())
    return np.array(states), np.array(actions), np.array(estimate), base.psi


def kicks() -> np.ndarray:
    """Of velocity: along x and y together, and less along z."""
    covariance = np.zeros((21, 21))
    covariance[SPEED, SPEED] = np.array([[4.0, 2.0, 0.0], [2.0, 3.0, 0.0], [0.0, 0.0, 1.0]]) * 1e-4
    return covariance


def test_the_kicks_of_each_step_are_found() -> None:
    """300 steps tell a variance to 8 % (one standard deviation); no step without a kick has any."""
    states, actions, estimate, psi = flight(kicks(), np.zeros(21))
    found = step_covariance(ID, states, actions, estimate, psi)[SPEED, SPEED]
    error = (found - kicks()[SPEED, SPEED]) / np.sqrt(np.outer(*2 * [np.diag(kicks()[SPEED, SPEED])]))
    assert np.abs(error).max() < 4 * 0.08
    still = step_covariance(ID, *flight(None, np.zeros(21))[:3], psi)
    assert np.abs(still).max() < 1e-3 * kicks().max()


def test_a_bias_is_no_noise_and_the_sensors_is_left_out() -> None:
    bias = np.zeros(21)
    bias[SPEED] = (0.01, -0.02, 0.005)
    states, actions, estimate, psi = flight(kicks(), bias)
    own = step_covariance(ID, states, actions, estimate, psi)
    told = step_covariance(ID, states, actions, estimate, psi, delta_s=bias)
    without = step_covariance(ID, states, actions, estimate, psi, delta_s=np.zeros(21))
    variance = np.diag(kicks())[SPEED]
    np.testing.assert_allclose(np.diag(own)[SPEED], variance, rtol=0.32)
    np.testing.assert_allclose(np.diag(told)[SPEED], variance, rtol=0.32)
    np.testing.assert_allclose(np.diag(without)[SPEED], variance + bias[SPEED] ** 2, rtol=0.32)
    noise = 0.02 * (np.arange(21) == 7)
    noisy = states + noise * np.random.default_rng(1).standard_normal(states.shape)
    seen, corrected = (step_covariance(ID, noisy, actions, estimate, psi, sensed=sd)[7, 7] for sd in (0.0, noise))
    assert seen - corrected == pytest.approx(0.02**2, rel=0.05)
    assert corrected == pytest.approx(variance[0], rel=0.6)


def test_it_is_a_covariance_that_residual_dynamics_takes() -> None:
    states, actions, estimate, psi = flight(kicks(), np.zeros(21))
    found = step_covariance(ID, states, actions, estimate, psi, sensed=0.03)
    env = ResidualDynamics(gym.make(ID, context=["psi"]), np.zeros(21), covariance=found)
    env.reset(seed=0)
    env.step(np.zeros(4))


def test_what_does_not_fit_is_refused_by_name() -> None:
    states, actions, estimate, psi = np.zeros((12, 21)), np.zeros((11, 4)), np.zeros((12, 3)), np.zeros(9)
    for given, message in (
        ((states[:, :3], actions, estimate, psi), r"states is of shape \(12, 3\); want finite numbers \(12, 21\)"),
        ((states, actions, estimate, psi), r"estimate is of shape \(12, 3\)"),
        ((states * np.nan, actions, estimate, psi), "not finite"),
    ):
        with pytest.raises(InputError, match=message):
            step_covariance(ID, *given)
    with pytest.raises(InputError, match="needs its `ground`"):
        step_covariance("nfc_gym/QuadcopterRough-v0", states, actions, estimate, psi)
