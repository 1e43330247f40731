"""Psi as plain data, and the probit coordinates."""

import json

import numpy as np
import pytest
from scipy.stats import kstest

from nfc_gym.core import InputError
from nfc_gym.inference.space import PriorBox

BOX = PriorBox(
    "cart", ("mass", "gain", "radius"), ("kg", "1", "m"), (1, 0, 0.1), (3, 10, 0.3), (2, 5, 0.25), (True, True, False)
)


def test_coordinates_are_inverse_and_stay_inside() -> None:
    z = np.random.default_rng(0).normal(size=(1000, 2))
    psi = BOX.from_z(z)
    assert psi.shape == (1000, 3)
    assert ((psi >= BOX.low) & (psi <= BOX.high)).all()
    np.testing.assert_array_equal(psi[:, 2], 0.25)  # known, and so nominal
    np.testing.assert_allclose(BOX.to_z(psi), z, rtol=1e-9)
    np.testing.assert_allclose(BOX.psi_of(BOX.u_of(psi)), psi, rtol=1e-12)
    extreme = BOX.from_z(np.full((1, 2), 40.0))
    np.testing.assert_array_equal(extreme[0, :2], [3, 10])
    assert np.isfinite(BOX.to_z(extreme)).all()
    assert BOX.log_volume == pytest.approx(np.log(2 * 10))


def test_a_standard_normal_is_the_uniform_prior() -> None:
    psi = BOX.from_z(np.random.default_rng(1).normal(size=(5000, 2)))
    assert kstest((psi[:, 0] - 1) / 2, "uniform").pvalue > 0.01
    assert kstest(psi[:, 1] / 10, "uniform").pvalue > 0.01


def test_it_goes_through_json() -> None:
    assert PriorBox.from_dict(json.loads(json.dumps(BOX.to_dict()))) == BOX
    with pytest.raises(InputError, match="no description"):
        PriorBox.from_dict({"robot": "cart", "colour": ["red"]})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"high": (1, 10, 0.3)}, "'mass' needs finite bounds"),
        ({"low": (1, np.nan, 0.1)}, "'gain' needs finite bounds"),
        ({"names": ("mass", "mass", "radius")}, "named twice: mass"),
        ({"units": ("kg",)}, "different length"),
        ({"free": (False, False, False)}, "nothing to infer"),
    ],
)
def test_what_is_no_prior_is_refused(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PriorBox.from_dict({**BOX.to_dict(), **change})


def test_another_robots_box_is_told_apart() -> None:
    BOX.require_same(PriorBox.from_dict(BOX.to_dict()), "it")
    for change, message in (
        ({"robot": "arm"}, "of the robot 'arm', not of 'cart'"),
        ({"names": ("mass", "drag", "radius")}, r"other parameters .*drag"),
        ({"high": (4, 10, 0.3)}, r"high of 'mass' = 4.0, here it is 3.0"),
    ):
        with pytest.raises(InputError, match=message):
            BOX.require_same(PriorBox.from_dict({**BOX.to_dict(), **change}), "it")
    with pytest.raises(InputError, match="must end in 3 values"):
        BOX.to_z(np.zeros(2))
