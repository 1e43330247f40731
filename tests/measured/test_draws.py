"""Draws at right angles: few of them, and the covariance that a linear map makes of their noise is exact."""

import numpy as np
import pytest

from nfc_gym.measured.draws import across


@pytest.mark.parametrize(("dim", "most", "count"), [(6, 6, 6), (6, 20, 18), (1, 5, 5), (30, 24, 24)])
def test_whole_sets_have_the_covariance_of_standard_noise(dim: int, most: int, count: int) -> None:
    found = across(np.random.default_rng(0), 7, dim, most)
    assert found.shape == (count, 7, dim)
    for draws in np.swapaxes(found, 0, 1):
        if count >= dim:
            np.testing.assert_allclose(draws.T @ draws / count, np.eye(dim), atol=1e-12)
        else:  # at right angles still
            np.testing.assert_allclose(draws @ draws.T, dim * np.eye(count), atol=1e-12)


def test_blocks_draw_for_themselves() -> None:
    found = across(np.random.default_rng(0), 2, 4, 4)
    assert abs(found[:, 0] - found[:, 1]).max() > 0.1
