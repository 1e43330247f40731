"""The ceiling: against linear systems, limits in closed form, and brute force."""

import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.simulate.ceiling import ceiling, replayed
from nfc_gym.simulate.fisher import bounds, gain, information, variance
from nfc_gym.simulate.machine import Machine


def test_information_of_a_linear_system_is_its_own() -> None:
    """y = A u: I = A' R^-1 A, whatever the step; noise-free outputs are left out."""
    rng = np.random.default_rng(0)
    a, noise = rng.standard_normal((7, 3)), np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.0])
    found = information(lambda u, _: u @ a.T, rng.random(3), noise, 0.1)
    white = a[:6] / noise[:6, None]
    np.testing.assert_allclose(found, white.T @ white, rtol=1e-10)


def test_information_on_the_mass_of_a_pushed_block() -> None:
    """x = F t^2 / (2 m), m = 1 + u: dx/du = -F t^2 / (2 m^2)."""
    time, force, sd = np.linspace(0.1, 1, 10), 3.0, 0.01
    for u in (0.2, 0.7):
        found = information(lambda u, _: force * time**2 / 2 / (1 + u), np.array([u]), np.full(10, sd), 1e-3)
        np.testing.assert_allclose(found, ((force * time**2 / 2 / (1 + u) ** 2) ** 2).sum() / sd**2, rtol=1e-5)


def test_noise_that_was_not_seen_counts_as_noise() -> None:
    """y = A u + B e + noise, e standard normal: I = A' (R + B B')^-1 A; what B covers whole tells nothing."""
    rng = np.random.default_rng(1)
    a, b, noise = rng.standard_normal((9, 2)), rng.standard_normal((9, 3)), rng.uniform(0.1, 0.3, 9)
    e = rng.standard_normal((1100, 3))
    found = information(lambda u, draw: u @ a.T + e[draw] @ b.T, np.full(2, 0.5), noise, 0.1, 1000, 100)
    truth = a.T @ np.linalg.solve(np.diag(noise**2) + b @ b.T, a)
    np.testing.assert_allclose(found, truth, rtol=0.1, atol=0.02 * truth.max())


def test_chatter_that_differs_with_psi_is_no_information() -> None:
    """Slopes made of noise alone, anew at each u: the two halves have nothing in common."""
    rng = np.random.default_rng(2)
    found = [
        information(lambda u, _: rng.standard_normal((len(u), 20)), np.full(3, 0.5), np.full(20, 0.1), 0.05, 400, 8)
        for _ in range(20)
    ]
    naive = 20 * 2 / (8 * (2 * 0.05) ** 2)  # what the squares of these slopes come to, over the noise's variance
    assert np.mean([np.diag(i).mean() for i in found]) < 0.35 * naive


@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.0])
def test_one_number_through_noise_against_brute_force(sigma: float) -> None:
    u = np.linspace(0, 1, 401)
    y = np.linspace(-8 * sigma, 1 + 8 * sigma, 801)
    like = np.exp(-(((y[:, None] - u) / sigma) ** 2) / 2) / sigma / np.sqrt(2 * np.pi)
    mass = np.trapezoid(like, u)
    mean = np.trapezoid(like * u, u) / mass
    spread = np.trapezoid(like * u * u, u) / mass - mean**2
    np.testing.assert_allclose(variance(np.array(sigma)), np.trapezoid(mass * spread, y), rtol=1e-4)
    entropy = -np.trapezoid(mass * np.log(np.maximum(mass, 1e-300)), y)
    np.testing.assert_allclose(gain(np.array(sigma)), entropy - np.log(sigma * np.sqrt(2 * np.pi * np.e)), atol=1e-4)


def test_limits_of_much_and_of_no_information() -> None:
    """Seen sharply, a number has the noise's own variance; not seen at all, the prior's, and nothing is gained."""
    sharp = np.array([1e-3])
    np.testing.assert_allclose(variance(sharp), sharp**2, rtol=0.01)
    np.testing.assert_allclose(gain(sharp), -np.log(sharp) - 0.5 * np.log(2 * np.pi * np.e), atol=0.01)
    blind = bounds(np.zeros((1, 4, 4)))
    np.testing.assert_allclose(blind.variance, 1 / 12, rtol=1e-5)
    np.testing.assert_allclose(np.append(blind.gain, blind.joint), 0, atol=1e-6)


def test_independent_parameters_add_up_and_a_shared_one_is_told_by_neither() -> None:
    apart = bounds(np.diag([100.0, 400.0])[None])
    np.testing.assert_allclose(apart.gain[0], gain(np.array([0.1, 0.05])))
    np.testing.assert_allclose(apart.joint, apart.gain.sum())
    together = bounds(np.full((1, 2, 2), 1e6))  # the sum alone is seen
    assert (together.gain < 0.5).all()
    assert together.joint[0] > 5


def test_noise_of_motors_lowers_a_jackals_ceiling(jackal: dict[str, np.ndarray]) -> None:
    found = ceiling("nfc_gym/JackalFlat-v0", {k: v[:2] for k, v in jackal.items()}, cloud=32, pairs=4)
    assert np.isfinite(found.information).all()
    assert (found.variance > 0).all()
    assert (found.variance <= 1 / 12 + 1e-12).all()
    assert (found.joint >= found.gain.sum(1) - 0.05).all()
    still = ceiling("nfc_gym/JackalFlat-v0", {k: v[:2] for k, v in jackal.items()}, motor=0.0)
    assert (still.joint > found.joint).all()


def test_noise_of_another_robot_is_refused(jackal: dict[str, np.ndarray]) -> None:
    with pytest.raises(InputError, match="want \\(15,\\)"):
        ceiling("nfc_gym/JackalFlat-v0", jackal, noise=np.ones(52))


def test_windows_of_another_robot_are_refused(jackal: dict[str, np.ndarray]) -> None:
    with pytest.raises(InputError, match="windows of 17 parameters and 2 actions; nfc_gym/AntFlat-v0 has 21 and 8"):
        ceiling("nfc_gym/AntFlat-v0", jackal)


def test_a_residual_is_added_after_each_control_step(jackal: dict[str, np.ndarray]) -> None:
    machine = Machine("nfc_gym/JackalFlat-v0")
    one = {k: v[:1] for k, v in jackal.items()} | {"actions": jackal["actions"][:1, :2]}
    u, still = np.tile(one["psi"].astype(float), (2, 1)), np.zeros((2, 2, 2))
    forward = machine.state_names.index("body:base:linvel@body.x")
    delta = np.zeros((2, len(machine.state_names)))
    delta[1, forward] = 0.03
    without = replayed(machine, one, u, still, 1).reshape(2, 2, -1)
    with_ = replayed(machine, one, u, still, 1, delta).reshape(2, 2, -1)
    np.testing.assert_allclose(with_[0], without[0], atol=1e-9)
    assert with_[1, 0, forward] - without[1, 0, forward] == pytest.approx(0.03, abs=1e-9)
    assert with_[1, 1, forward] > with_[0, 1, forward] + 0.03  # what the first step was given is still there
