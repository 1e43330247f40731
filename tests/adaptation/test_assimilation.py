"""Bayes' rule for a linear model against the closed form, and psi of a rover from how it drives."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rounds import fewer

from nfc_gym import InputError
from nfc_gym.adaptation.assimilated import Box
from nfc_gym.adaptation.assimilation import Assimilation
from nfc_gym.adaptation.linear import linear_posterior
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.terrain import Heightfield


def test_the_linear_posterior_is_the_exact_one() -> None:
    """One unknown, two observations: precisions add, and the mean is weighted by them."""
    mean, covariance = linear_posterior(np.array([[2.0], [1.0]]), np.array([3.0, -1.0]), np.array([0.5, 4.0]))
    precision = 1 + 2**2 / 0.5 + 1 / 4.0
    np.testing.assert_allclose(covariance, [[1 / precision]])
    np.testing.assert_allclose(mean, [(2 * 3 / 0.5 - 1 / 4.0) / precision])


def test_a_slope_of_errors_alone_tells_nothing() -> None:
    rng, n, d, k = np.random.default_rng(0), 40, 3, 5000
    z, y = rng.standard_normal((n, d)), rng.standard_normal((n, k))
    z -= z.mean(0)
    slope = np.linalg.lstsq(z, y, rcond=None)[0].T
    plain = linear_posterior(slope, np.zeros(k), np.ones(k))[1]
    honest = linear_posterior(slope, np.zeros(k), np.ones(k), k * np.linalg.inv(z.T @ z))[1]
    assert np.linalg.eigvalsh(plain).max() < 0.02
    assert np.linalg.eigvalsh(honest).max() > 0.5


def test_psi_in_the_box_and_its_coordinates_are_inverse() -> None:
    box = Box(np.array([0.0, 5.0]), np.array([1.0, 9.0]))
    psi = np.array([[0.1, 6.0], [0.9, 8.9]])
    np.testing.assert_allclose(box.psi(box.z(psi)), psi, rtol=1e-9)
    np.testing.assert_allclose(box.psi(np.zeros(2)), [0.5, 7.0])


def driven(psi: dict[str, float], steps: int = 100) -> Trajectory:
    """A rover with some psi, commanded at random."""
    return driven_in(gym.make("nfc_gym/JackalFlat-v0", context=["psi"]), psi, steps)


def driven_in(env: Any, psi: dict[str, float], steps: int, seed: int = 1) -> Trajectory:
    """The same in an environment."""
    observation, _ = env.reset(seed=0, options={"psi": psi})
    rng, action, data = np.random.default_rng(seed), np.zeros(2), env.unwrapped.data
    states, estimate, actions = [observation["proprio"]], [np.concatenate([data.qpos, data.qvel])], []
    for _ in range(steps):
        action = np.clip(0.9 * action + 0.3 * rng.standard_normal(2), -1, 1)
        observation, *_ = env.step(action)
        states.append(observation["proprio"])
        estimate.append(np.concatenate([data.qpos, data.qvel]))
        actions.append(action)
    zero = np.zeros(steps)
    parts = (np.array(states, float), np.array(actions), zero, zero, 1.0, np.array(estimate), np.zeros((0, 0)))
    return Trajectory(*parts)


def test_a_heavy_rover_with_a_lost_axle_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    fewer(monkeypatch, 0.4, 0.4, 0.2, 0.05)
    truth = {"base_mass": 28.0, "front_left_wheel_damping": 0.0}
    q = Assimilation("nfc_gym/JackalFlat-v0", effects=False)
    belief = q.infer(driven(truth, 160))
    psi = belief.sample(2000, np.random.default_rng(0)).psi
    names, space = list(q.machine.space.names), q.machine.space
    low, high = np.quantile(psi, [0.02, 0.98], 0)
    mass, axle, other = (names.index(n) for n in ("base_mass", "front_left_wheel_damping", "rear_left_wheel_damping"))
    assert low[mass] < 28 < high[mass]
    assert abs(psi[:, mass].mean() - 28) < 0.6 * (28 - space.nominal[mass])
    assert psi[:, mass].std() < 0.8 * (space.high - space.low)[mass] / 12**0.5, "of the prior"
    assert np.median(psi[:, axle]) < 1.0 < np.median(psi[:, other])
    drawn = belief.sample(10, np.random.default_rng(0))
    assert drawn.delta_s is not None
    assert np.abs(drawn.delta_s / np.maximum(q.machine.noise, 1e-9)).max() < 1.0, "psi explains it all"


def test_a_trajectory_of_another_robot_is_refused() -> None:
    with pytest.raises(InputError, match="not of nfc_gym/AntFlat-v0"):
        Assimilation("nfc_gym/AntFlat-v0").infer(driven({}, 20))
    with pytest.raises(InputError, match="not of nfc_gym/AntFlat-v0"):
        Assimilation("nfc_gym/AntFlat-v0").infer(driven({}, 5))
    with pytest.raises(InputError, match="at least 10"):
        Assimilation("nfc_gym/JackalFlat-v0").segments(driven({}, 7))
    with pytest.raises(InputError, match="is a plane and has no `ground`"):
        Assimilation("nfc_gym/JackalFlat-v0", ground=Heightfield(np.zeros((256, 256))))
    with pytest.raises(InputError, match="map_error is -1"):
        Assimilation("nfc_gym/JackalRough-v0", map_error=-1)
    with pytest.raises(
        InputError, match=r"holds no elevation maps: make the world with context=\['psi', 'elevation'\]"
    ):
        Assimilation("nfc_gym/JackalRough-v0").infer(driven({}, 20))


@pytest.mark.parametrize("place", ["AntFlat", "QuadrupedFlat", "HumanoidFlat", "QuadcopterFlat", "JackalRough"])
def test_however_far_beyond_the_prior_all_that_is_believed_is_possible(place: str) -> None:
    """A ball never bounces higher than it fell, and no mass is negative: no draw stops a mission at a reset."""
    q = Assimilation(f"nfc_gym/{place}-v0", reach=2.0)
    space = q.machine.space
    assert (q.box.high > space.high).any()
    z = np.random.default_rng(0).standard_normal((200, len(space))) * 4
    space.require_possible(q.box.psi(z))


def test_of_a_robot_that_fell_at_once_the_prior_is_believed() -> None:
    infers = Assimilation("JackalFlat", delta_s=False, effects=False)
    fell = driven({}, 6)
    belief = infers.infer(fell)
    space = infers.machine.space
    drawn = belief.sample(4000, np.random.default_rng(0)).psi
    assert drawn is not None
    np.testing.assert_allclose(drawn.mean(0), (space.low + space.high) / 2, atol=0.02 * (space.high - space.low).max())
    assert belief.effects(3, np.random.default_rng(0)) == []
    assert belief.noise is None


def test_what_is_too_short_to_be_replayed_changes_no_belief(monkeypatch: pytest.MonkeyPatch) -> None:
    fewer(monkeypatch, 0.4)
    infers = Assimilation("JackalFlat", delta_s=False, effects=False)
    whole, fell = driven({"base_mass": 25.0}, 40), driven({}, 6)
    want = infers.infer(whole)
    np.testing.assert_array_equal(infers.updated(fell, want).infer(whole).mean, want.mean)
