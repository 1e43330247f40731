"""What the first observation leaves open of the velocities: against a regression in closed form, and on a Jackal."""

import numpy as np

from nfc_gym.simulate import starts
from nfc_gym.simulate.ceiling import ceiling, replayed
from nfc_gym.simulate.machine import Machine


def test_what_is_left_open_is_the_posterior_of_a_linear_gaussian() -> None:
    """v ~ N(0, S), y = H v + noise: the covariance of v given y is S - S H' (H S H' + R)^-1 H S."""
    rng = np.random.default_rng(0)
    h, root = rng.standard_normal((3, 4)), rng.standard_normal((4, 4))
    s, noise = root @ root.T, np.array([0.1, 0.5, 0.0])  # the last entry is the task's: it tells nothing
    seen = np.concatenate([np.zeros((1, 3)), starts.STEP * h.T])
    found = starts.left_open(seen, noise, s)
    told = h[:2]
    wanted = s - s @ told.T @ np.linalg.solve(told @ s @ told.T + np.diag(noise[:2] ** 2), told @ s)
    np.testing.assert_allclose(found @ found.T, wanted, rtol=1e-6, atol=1e-9)


def test_a_rolling_jackals_wheels_go_with_its_speed(jackal: dict[str, np.ndarray]) -> None:
    machine = Machine("nfc_gym/JackalFlat-v0")
    found = starts.speeds(machine, jackal["start"])
    np.testing.assert_allclose(found[:, :3], jackal["states"][:, 0, 4:7], atol=1e-5)  # its observation has them too
    covariance = starts.spread(machine, jackal)
    wheels = covariance[6:, 0] / np.sqrt(covariance[0, 0] * covariance.diagonal()[6:])
    assert (wheels > 0.5).all()


def test_forwards_of_a_body_that_has_turned_left_is_the_worlds_y() -> None:
    own = np.array([[1.0, 0, 0, 0.1, 0.2, 0.3, 5.0]])
    quat = np.array([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])
    np.testing.assert_allclose(starts.world(own, quat), [[0, 1, 0, 0.1, 0.2, 0.3, 5]], atol=1e-12)


def test_nothing_added_changes_nothing(jackal: dict[str, np.ndarray]) -> None:
    machine = Machine("nfc_gym/JackalFlat-v0")
    one = {k: v[:1] for k, v in jackal.items()} | {"actions": jackal["actions"][:1, :2]}
    u, still = one["psi"].astype(float), np.zeros((1, 2, 2))
    bare, nothing, something = (
        replayed(machine, one, u, still, 1, off=off)
        for off in (None, np.zeros((1, machine.model.nv)), np.full((1, machine.model.nv), 0.1))
    )
    assert np.array_equal(bare, nothing)
    assert np.abs(something - bare).max() > 0.01


def test_an_unknown_start_lowers_the_ceiling(jackal: dict[str, np.ndarray]) -> None:
    machine = Machine("nfc_gym/JackalFlat-v0")
    some = {k: v[:2] for k, v in jackal.items()}
    known, unknown = (
        ceiling(machine.environment, some, cloud=48, pairs=4, before=b) for b in (None, starts.spread(machine, jackal))
    )
    assert (unknown.joint < known.joint).all()
