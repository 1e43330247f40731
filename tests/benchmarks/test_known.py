"""The exact posteriors that benchmarks/inference.py compares with: ranks of truths among their draws are uniform."""

import numpy as np
import pytest
from scipy.stats import kstest, multivariate_normal

pytest.importorskip("torch", reason="the tasks' priors are those of nfc_gym.inference")


@pytest.mark.parametrize("name", ["LinearGaussian", "TwoMoons"])
def test_truths_rank_evenly_among_exact_draws(name: str) -> None:
    from known import tasks

    task = tasks.LinearGaussian(3) if name == "LinearGaussian" else tasks.TwoMoons()
    rng = np.random.default_rng(0)
    truths = task.box.psi_of(rng.uniform(size=(60, len(task.box))))
    ranks = []
    for truth, x in zip(truths, task.simulate(truths, rng), strict=True):
        drawn = task.posterior(x, 50, rng)
        assert ((drawn >= task.box.low) & (drawn <= task.box.high)).all()
        ranks.append(((drawn < truth).sum(0) + rng.uniform(size=len(truth))) / 51)
    for column in np.transpose(ranks):
        assert kstest(column, "uniform").pvalue > 0.002


def test_the_weights_of_slcp_are_likelihood_over_proposal() -> None:
    from known.tasks import SLCP

    task, rng = SLCP(), np.random.default_rng(1)
    x = task.simulate(task.box.psi_of(rng.uniform(size=(1, 5))), rng)[0]
    points = x.reshape(4, 2)
    psi, weight = task.proposed(points, 50, rng)
    inside = np.isfinite(weight)
    assert (inside == (np.abs(psi) <= 3).all(1)).all()
    a, b, c = task.spread(psi)
    away = []
    for p, w, s0, s1, r in zip(psi, weight, a, b, c, strict=True):
        covariance = np.array([[s0**2, r * s0 * s1], [r * s0 * s1, s1**2]])
        likelihood = multivariate_normal(p[:2], covariance, allow_singular=True).logpdf(points).sum()
        away.append(
            w - likelihood + multivariate_normal(points.mean(0), covariance / 4, allow_singular=True).logpdf(p[:2])
        )
    usual = inside & (a * b * np.sqrt(1 - c**2) > 1e-3)
    assert usual.sum() > 10
    np.testing.assert_allclose(np.array(away)[usual], np.array(away)[usual][0], atol=1e-4)


def test_the_closed_form_is_normalised() -> None:
    from known.tasks import LinearGaussian

    task, rng = LinearGaussian(2), np.random.default_rng(1)
    x = task.simulate(np.full((1, 2), 0.3), rng)[0]
    everywhere = rng.uniform(size=(200_000, 2))  # the box has volume 1
    assert np.exp(task.log_prob(everywhere, x)).mean() == pytest.approx(1, rel=0.03)


def test_slcp_is_as_likely_in_each_of_its_mirrors() -> None:
    from known.tasks import SLCP

    task, rng = SLCP(), np.random.default_rng(2)
    psi = task.box.psi_of(rng.uniform(size=(1, 5)))
    x = task.simulate(psi, rng)[0]
    a, b, c = (float(s[0]) for s in task.spread(psi))
    law = multivariate_normal(psi[0, :2], [[a * a, a * b * c], [a * b * c, b * b]], allow_singular=True)
    assert len({tuple(mirror.states(np.arange(8.0))) for mirror in task.mirrors}) == 6
    for mirror in task.mirrors:
        np.testing.assert_array_equal(mirror.psi, np.arange(5))
        seen = mirror.states(x)
        assert not np.array_equal(seen, x)
        assert law.logpdf(seen.reshape(4, 2)).sum() == pytest.approx(law.logpdf(x.reshape(4, 2)).sum())
