"""A posterior that is normal in probit coordinates."""

from pathlib import Path

import numpy as np
import pytest

from nfc_gym.core import Fidelity, InputError, Posterior, kinds, load_source
from nfc_gym.inference import checkpoint
from nfc_gym.inference.normal import Normal, NormalPosterior
from nfc_gym.inference.space import PriorBox

PRIOR = PriorBox(
    "cart", ("mass", "drag", "known"), ("kg", "N s/m", "m"), (1, 0, 0), (3, 0.5, 1), (2, 0.2, 0.4), (True, True, False)
)
MEAN, COVARIANCE = np.array([0.4, -0.2]), np.array([[0.04, 0.01], [0.01, 0.5]])


def posterior(doubt: float = 0.0, before: Normal | None = None) -> NormalPosterior:
    return NormalPosterior(PRIOR, Normal(MEAN, COVARIANCE), {"environment": "cart"}, doubt, before)


@pytest.mark.parametrize("doubt", [0.0, 0.3])
def test_draws_and_density_agree(doubt: float) -> None:
    given, rng = posterior(doubt), np.random.default_rng(0)
    assert isinstance(given, Posterior)
    psi = given.sample(40_000, rng).psi
    assert psi is not None
    assert (psi[:, 2] == 0.4).all()  # known: it stays nominal
    z = PRIOR.to_z(psi)
    np.testing.assert_allclose(z.mean(0), (1 - doubt) * MEAN, atol=0.015)
    apart = doubt * (1 - doubt) * np.outer(MEAN, MEAN)  # of a mixture's two means
    np.testing.assert_allclose(np.cov(z.T), (1 - doubt) * COVARIANCE + doubt * np.eye(2) + apart, atol=0.015)
    # The density of the free parameters integrates to 1 over the box.
    mass, drag = (np.linspace(low, high, 402)[1:-1] for low, high in ((1, 3), (0, 0.5)))
    grid = np.stack([*(g.ravel() for g in np.meshgrid(mass, drag)), np.full(160_000, 0.4)], 1)
    density = np.exp(given.log_prob(Fidelity(grid)))
    assert density.sum() * (mass[1] - mass[0]) * (drag[1] - drag[0]) == pytest.approx(1, abs=0.01)
    assert given.log_prob(Fidelity(np.array([[5.0, 0.1, 0.4]])))[0] == -np.inf


def test_what_was_not_told_is_the_prior() -> None:
    blank = NormalPosterior(PRIOR, Normal.prior(2))
    psi = blank.sample(5, np.random.default_rng(0)).psi
    assert psi is not None
    np.testing.assert_allclose(blank.log_prob(Fidelity(psi)), -PRIOR.log_volume, atol=1e-9)


def test_doubt_bounds_what_a_wrong_normal_costs() -> None:
    far = PRIOR.from_z(np.array([[-3.0, 3.0]]))
    sure, doubting = (posterior(doubt).log_prob(Fidelity(far))[0] + PRIOR.log_volume for doubt in (0.0, 0.02))
    assert sure < -50
    assert doubting == pytest.approx(np.log(0.02))
    told = posterior(0.02, Normal(np.array([-3.0, 3.0]), 0.01 * np.eye(2)))  # who believed it before loses little
    after = told.log_prob(Fidelity(far))[0] + PRIOR.log_volume
    assert after == pytest.approx(np.log(0.02) + told.otherwise.gain(np.array([[-3.0, 3.0]]))[0], abs=1e-3)
    z = PRIOR.to_z(told.sample(4000, np.random.default_rng(0)).psi)
    assert 0.01 < (np.abs(z - [-3, 3]).max(1) < 1).mean() < 0.03
    with pytest.raises(InputError, match="doubt"):
        posterior(1.5)


def test_its_file_is_a_source(tmp_path: Path) -> None:
    file = tmp_path / "today.safetensors"
    before = Normal(MEAN + 1, 2 * COVARIANCE)
    posterior(0.1, before).save(file)
    assert kinds.kind_of(file) == kinds.POSTERIOR
    again = load_source(file)
    assert isinstance(again, NormalPosterior)
    assert (again.prior, again.notes, again.doubt) == (PRIOR, {"environment": "cart"}, 0.1)
    np.testing.assert_array_equal(again.normal.covariance, COVARIANCE)
    np.testing.assert_array_equal(again.otherwise.mean, before.mean)
    np.testing.assert_array_equal(again.otherwise.covariance, before.covariance)
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(InputError, match="truncated"):
        load_source(file)


def test_it_is_no_network_for_another_window(tmp_path: Path) -> None:
    posterior().save(tmp_path / "today.safetensors")
    with pytest.raises(InputError, match=r"today\.safetensors: the posterior of one window"):
        checkpoint.load(tmp_path / "today.safetensors")


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"wants a mean of \(2,\)"):
        NormalPosterior(PRIOR, Normal.prior(3))
    with pytest.raises(InputError, match="positive definite"):
        NormalPosterior(PRIOR, Normal(MEAN, np.diag([1.0, -1.0])))
    given = posterior()
    with pytest.raises(InputError, match="its only part is psi"):
        given.of("psi", "delta_s")
    with pytest.raises(InputError, match="of psi and of nothing else"):
        given.log_prob(Fidelity(delta_s=np.zeros((1, 3))))
    with pytest.raises(InputError, match=r"ends in \.safetensors"):
        given.save(tmp_path / "today.npz")
    with pytest.raises(InputError, match="n is"):
        given.sample(0, np.random.default_rng(0))
