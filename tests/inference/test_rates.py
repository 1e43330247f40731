"""Thresholds and rates: against counting, order statistics and closed forms."""

import numpy as np
import pytest
from scipy.special import ndtr

from nfc_gym.core import InputError
from nfc_gym.inference.rates import auroc, rate_above, threshold_at, wanted


def test_the_false_positive_rate_holds_on_windows_to_come() -> None:
    """Averaged over sets, new scores reach the threshold at k / (n + 1); the 90 % interval holds the truth as often."""
    rng = np.random.default_rng(0)
    found = [threshold_at(rng.standard_normal(320), 0.01) for _ in range(2000)]
    true = np.array([1 - ndtr(t.value) for t in found])
    assert true.mean() == pytest.approx(3 / 321, rel=0.05)
    inside = np.mean([t.low <= p <= t.high for t, p in zip(found, true, strict=True)])
    assert inside == pytest.approx(0.9, abs=0.025)


def test_a_rate_beyond_what_the_windows_show_is_refused() -> None:
    assert wanted(0.001) == 3000
    with pytest.raises(InputError, match=r"2999 held-out windows.*3000 or more.*0\.001"):
        threshold_at(np.zeros(2999), 0.001)
    assert threshold_at(np.arange(3000), 0.001).value == 2997
    with pytest.raises(InputError, match=r"3 held-out trajectories cannot show .* false alarms among them\)$"):
        threshold_at(np.zeros(3), 0.05, "trajectories")  # of which no rate can be told
    with pytest.raises(InputError, match="between 0 and 1"):
        wanted(0)
    with pytest.raises(InputError, match="NaN"):
        threshold_at([np.nan] * 400, 0.01)


def test_auroc_counts_pairs() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 5, 40), rng.integers(1, 6, 30)
    counted = np.mean((b[:, None] > a) + 0.5 * (b[:, None] == a))
    assert auroc(a, b)[0] == pytest.approx(counted, rel=1e-12)


def test_auroc_of_shifted_gaussians_and_its_error() -> None:
    """ndtr(shift / sqrt 2); the error is that of many repetitions, within a tenth."""
    rng = np.random.default_rng(2)
    found = np.array([auroc(rng.standard_normal(100), 1 + rng.standard_normal(80)) for _ in range(600)])
    assert found[:, 0].mean() == pytest.approx(ndtr(1 / np.sqrt(2)), abs=0.005)
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.1)


def test_rate_above() -> None:
    rate, error = rate_above([0.0, 1.0, 2.0, 3.0], 2.0)
    assert rate == 0.5
    assert error == pytest.approx(0.25)
    assert rate_above(np.zeros(10), 1.0)[1] > 0
