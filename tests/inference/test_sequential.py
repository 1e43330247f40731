"""Proposals of later rounds on a posterior that is known."""

from copy import deepcopy

import numpy as np
import pytest
import torch
from problems import NOISE, box, gaussian, linear_windows, mix, network
from scipy.special import gamma
from scipy.stats import chi2, kstest, norm

from nfc_gym.core import Fidelity, InputError
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Quiet
from nfc_gym.inference.proposals import Corrected, Proposed, SequentialConfig, TruncatedPrior, told
from nfc_gym.inference.sequential import _renew, sequential
from nfc_gym.inference.train import TrainConfig, train

X = torch.tensor([[0.8, -0.5, 0.3]])
OBSERVED = Window(X, np.zeros((0, 0)))


def given() -> NeuralPosterior:
    """Close to exact, without training: the linear base; a mixture of one, whose density costs little."""
    return NeuralPosterior(network(linear_windows(5000), linear=True, density="mixture", components=1)).given(OBSERVED)


def simulate(psi: np.ndarray, rng: np.random.Generator) -> dict[str, torch.Tensor]:
    z = box(3).to_z(psi)
    x = z @ mix(3).numpy().T + NOISE * rng.normal(size=z.shape)
    return {"states": torch.as_tensor(x[:, None], dtype=torch.float32), "actions": torch.zeros(len(x), 0, 0)}


@pytest.mark.parametrize("way", ["_rejected", "_resampled"])
def test_proposals_are_the_prior_where_the_posterior_has_mass(way: str) -> None:
    proposal = TruncatedPrior(given(), SequentialConfig(oversampling=64), np.random.default_rng(0))
    psi = getattr(proposal, way)(400, np.random.default_rng(1))
    assert psi.shape == (400, 3)
    # all above the threshold
    assert (told(proposal.posterior, psi) > proposal.threshold).all()
    # and as the prior is there: the same means and spreads as brute rejection from it
    rng, prior = np.random.default_rng(2), given().prior
    brute = prior.psi_of(rng.uniform(size=(40000, 3)))
    brute = brute[told(proposal.posterior, brute) > proposal.threshold]
    assert proposal.kept == pytest.approx(len(brute) / 40000, rel=0.2)
    u, v = prior.u_of(psi), prior.u_of(brute)
    np.testing.assert_allclose(u.mean(0), v.mean(0), atol=0.02)
    np.testing.assert_allclose(u.std(0), v.std(0), atol=0.02)


class Together:
    """A posterior of some parameters that go together: a normal in probit space, so narrow that the prior is flat."""

    def __init__(self, size: int, rho: float) -> None:
        self.prior, self.size = box(size), size
        self.root = np.linalg.cholesky(1e-4 * (rho * np.ones((size, size)) + (1 - rho) * np.eye(size)))

    def away(self, psi: np.ndarray) -> np.ndarray:
        """(n,) how many spreads psi (n, size) is from the middle."""
        return np.linalg.norm(np.linalg.solve(self.root, self.prior.to_z(psi).T), axis=0)

    def log_prob(self, x: Fidelity) -> np.ndarray:
        z, least = self.prior.to_z(x.psi), np.log(self.root.diagonal()).sum()
        return (z**2).sum(1) / 2 - self.away(x.psi) ** 2 / 2 - least - self.prior.log_volume

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        return Fidelity(self.prior.from_z(rng.normal(size=(n, self.size)) @ self.root.T))


@pytest.mark.parametrize(("size", "rho"), [(2, 0.0), (5, 0.0), (3, 0.99), (6, 0.99), (9, 0.99), (17, 0.95)])
def test_proposals_fill_the_region_of_a_narrow_posterior(size: int, rho: float) -> None:
    """An ellipsoid in which the prior is flat: its volume lies near its edge, where draws of the posterior do not."""
    posterior, config = Together(size, rho), SequentialConfig(oversampling=8)
    proposal = TruncatedPrior(posterior, config, np.random.default_rng(0))
    at = np.zeros((1, size))
    edge = np.sqrt(2 * (told(posterior, posterior.prior.from_z(at))[0] - proposal.threshold))
    away = posterior.away(proposal.sample(3000, np.random.default_rng(1))) / edge
    assert away.max() < 1.01
    assert (away**2).mean() == pytest.approx(size / (size + 2), rel=0.06)  # of a ball of that many dimensions
    volume = np.pi ** (size / 2) / gamma(size / 2 + 1) * edge**size
    share = volume * np.prod(posterior.root.diagonal()) * (2 * np.pi) ** (-size / 2)
    assert proposal.kept == pytest.approx(share, rel=0.15)


@pytest.mark.parametrize("wider", [1.0, 2.0])
def test_a_region_is_some_times_as_wide_as_a_posterior_reaches(wider: float) -> None:
    posterior = Together(6, 0.9)
    # what the farthest of a few draws are differs from time to time, the tenth of many does not
    config = SequentialConfig(samples=4000, quantile=0.1, wider=wider)
    threshold = TruncatedPrior(posterior, config, np.random.default_rng(0)).threshold
    edge = np.sqrt(2 * (told(posterior, posterior.prior.from_z(np.zeros((1, 6))))[0] - threshold))
    assert edge == pytest.approx(wider * np.sqrt(chi2(6).ppf(0.9)), rel=0.03)


class Partly(Together):
    """Some parameters that go together, and others of which nothing is told."""

    def __init__(self, size: int, of: int) -> None:
        super().__init__(size, 0.95)
        self.prior, self.of = box(of), of

    def log_prob(self, x: Fidelity) -> np.ndarray:
        z = self.prior.to_z(x.psi)[:, : self.size]
        own = np.linalg.norm(np.linalg.solve(self.root, z.T), axis=0)
        return (z**2).sum(1) / 2 - own**2 / 2 - np.log(self.root.diagonal()).sum() - self.prior.log_volume

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        z = rng.normal(size=(n, self.of))
        z[:, : self.size] = z[:, : self.size] @ self.root.T
        return Fidelity(self.prior.from_z(z))


def test_what_was_not_told_of_is_proposed_as_the_prior_has_it() -> None:
    """Of candidates wider than the prior in fourteen parameters hardly any would be left to choose from."""
    posterior, config = Partly(3, 17), SequentialConfig(oversampling=8)
    proposal = TruncatedPrior(posterior, config, np.random.default_rng(0))
    z = posterior.prior.to_z(proposal.sample(3000, np.random.default_rng(1)))
    np.testing.assert_allclose(z[:, 3:].std(0), 1, atol=0.06)
    away = np.linalg.norm(np.linalg.solve(posterior.root, z[:, :3].T), axis=0)
    # evenly in a ball of radius R, whose mean square is 3/5 R^2 and of which half lies within 0.5^(1/3) R
    assert (away**2).mean() / np.median(away) ** 2 == pytest.approx(0.6 / 0.5 ** (2 / 3), rel=0.05)


def test_the_truth_is_hardly_ever_cut_off() -> None:
    proposal = TruncatedPrior(given(), SequentialConfig(), np.random.default_rng(0))
    truths = gaussian(X[0]).sample((4000,)).double().numpy()
    inside = told(proposal.posterior, box(3).from_z(truths)) > proposal.threshold
    assert inside.mean() > 0.995


def test_rounds_close_in_and_end_where_they_no_longer_narrow() -> None:
    net = network(linear_windows(200), linear=True)
    heard: list[str] = []

    class Heard(Quiet):
        def message(self, text: str) -> None:
            heard.append(text)

    out = sequential(
        net, simulate, OBSERVED, SequentialConfig(rounds=2, simulations=400, samples=150, oversampling=4, wider=1),
        TrainConfig(epochs=3, batch=64, rate=2e-3, warmup=10, average=0.95), report=Heard(),
    )  # fmt: skip
    assert len(out.entropy) == len(out.outcomes) == len(out.kept) >= 2
    assert out.entropy[-1] < out.entropy[0] < 0
    assert out.kept[0] == 1
    assert out.kept[-1] < 0.8
    assert len(out.windows) == 400 * len(out.entropy)
    assert sum(t.startswith("round") for t in heard) == len(out.entropy)
    if out.stopped == "no longer narrows":
        assert out.entropy[-2] - out.entropy[-1] < 0.05
    exact = gaussian(X[0])
    z = box(3).to_z(out.posterior.sample(4000, np.random.default_rng(0)).psi)
    sd = exact.covariance_matrix.diagonal().sqrt().numpy()
    assert np.abs((z.mean(0) - exact.mean.numpy()) / sd).max() < 0.5
    assert np.isfinite(out.posterior.log_prob(Fidelity(box(3).from_z(z[:5])))).all()


def test_windows_of_the_prior_that_were_learned_before_are_the_first_round() -> None:
    begun = linear_windows(400)
    net = network(begun, linear=True, density="mixture", components=3)
    training = TrainConfig(epochs=3, batch=64, rate=2e-3, warmup=10, average=0.95)
    train(net, *begun.split(0.1), training)
    weights = {k: t.clone() for k, t in net.state_dict().items()}
    first = NeuralPosterior(deepcopy(net)).given(OBSERVED)

    config = SequentialConfig(rounds=1, samples=150)
    alone = sequential(net, simulate, OBSERVED, config, training, begun=begun)
    assert not alone.outcomes
    assert len(alone.windows) == 400
    assert all(torch.equal(t, weights[k]) for k, t in net.state_dict().items())

    config = SequentialConfig(rounds=2, simulations=300, samples=150, oversampling=4, narrows=-np.inf)
    out = sequential(net, simulate, OBSERVED, config, training, begun=begun, scales=False)
    assert len(out.outcomes) == 1
    assert len(out.windows) == 700
    proposal = TruncatedPrior(first, config, np.random.default_rng(config.seed))
    fresh = box(3).psi_of(out.windows.tensors["psi"].double().numpy())
    gains = first.log_prob(Fidelity(fresh)) + first.prior.log_volume
    # of the second round's windows all lie where the first network's posterior of this window has its mass
    assert (gains > proposal.threshold - 1e-3).sum() >= 300
    assert (gains > proposal.threshold).mean() < 1


def test_a_later_round_may_train_new_weights() -> None:
    begun = linear_windows(400)
    learned = network(begun, linear=True, density="mixture", components=3)
    train(learned, *begun.split(0.1), TrainConfig(epochs=3, batch=64, rate=2e-3, warmup=10, average=0.95))
    of = {"rounds": 2, "simulations": 300, "samples": 150, "oversampling": 4, "narrows": -np.inf}
    untrained = TrainConfig(epochs=1, batch=64, rate=1e-12, warmup=10, average=0.95)
    before = [w.clone() for w in learned.parameters()]
    apart = [
        max(
            float((w - b).detach().abs().max()) for w, b in zip(out.posterior.network.parameters(), before, strict=True)
        )
        for out in (
            sequential(deepcopy(learned), simulate, OBSERVED, SequentialConfig(anew=anew, **of), untrained, begun=begun)
            for anew in (False, True)
        )
    ]
    assert apart[0] < 1e-6 < apart[1]


def test_new_weights_begin_at_the_width_of_a_new_network() -> None:
    windows = linear_windows(200)
    net = network(windows, density="flow", linear=True)
    fresh = network(windows, density="flow", linear=True, seed=3)
    net.calibrate({**windows.tensors, "states": 3 * windows.tensors["states"]})
    calibrated = {k: t.clone() for k, t in net.state_dict().items() if k.endswith("base.scale")}
    assert all((t > 1.5).all() for t in calibrated.values())
    _renew(net, 3)
    for name, tensor in net.state_dict().items():
        assert torch.equal(tensor, fresh.state_dict()[name]), name


def test_flows_learned_in_rounds_are_as_wide_as_held_out_windows_have_them() -> None:
    net = network(linear_windows(200), density="flow", linear=True)
    config, training = SequentialConfig(1, 300, samples=150), TrainConfig(30, batch=32, rate=3e-3, average=0.5)
    out = sequential(net, simulate, OBSERVED, config, training)
    _, held_out = out.windows.split(config.held_out)
    (flow,) = net.density.links
    with torch.no_grad():
        given = net.encode(held_out.tensors["states"], held_out.tensors["actions"])
        x = net.base.whiten(net.targets(held_out.tensors), given.mean)
        latent = flow.flow(flow.context(given.features)).transform(x)
    spread = float(latent.square().mean().sqrt())
    assert abs(spread - 1) > 0.01  # where the flow begins
    np.testing.assert_allclose(flow.flow.base.scale, spread, rtol=1e-4)


class Normal:
    """A posterior of one parameter in [-1, 0], normal in probit space."""

    prior = box(1)

    def __init__(self, mean: float, sd: float) -> None:
        self.mean, self.sd = mean, sd

    def log_prob(self, x: Fidelity) -> np.ndarray:
        z = self.prior.to_z(np.atleast_2d(x.psi))[:, 0]
        change = (z**2 + np.log(2 * np.pi)) / 2 - self.prior.log_volume
        return norm.logpdf(z, self.mean, self.sd) + change

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        return Fidelity(self.prior.from_z(self.mean + self.sd * rng.normal(size=(n, 1))))


class Tilted(Normal):
    """What is learned if half of the windows are draws of `proposed`: times (1 + proposed / prior) / 2."""

    def __init__(self, mean: float, sd: float, proposed: Normal) -> None:
        super().__init__(mean, sd)
        self.proposed, self.grid = proposed, np.linspace(-6, 6, 40001)
        at = Fidelity(self.prior.from_z(self.grid[:, None]))
        change = (self.grid**2 + np.log(2 * np.pi)) / 2 - self.prior.log_volume
        weight = np.exp(super().log_prob(at) - change) * (1 + np.exp(told(proposed, at.psi))) / 2
        self.total = weight.sum() * (self.grid[1] - self.grid[0])
        self.share = np.cumsum(weight) / weight.sum()

    def log_prob(self, x: Fidelity) -> np.ndarray:
        return super().log_prob(x) + np.log((1 + np.exp(told(self.proposed, x.psi))) / 2) - np.log(self.total)

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        return Fidelity(self.prior.from_z(np.interp(rng.uniform(size=(n, 1)), self.share, self.grid)))


# near the posterior, and far beside it
@pytest.mark.parametrize("proposed", [Normal(0.5, 0.3), Normal(-0.3, 0.2)])
def test_what_was_learned_from_a_posteriors_draws_is_corrected(proposed: Normal) -> None:
    truth = Normal(0.6, 0.3)
    config = SequentialConfig(samples=20000, oversampling=16)
    corrected = Corrected(Tilted(0.6, 0.3, proposed), [(proposed, 300)], 300, config, np.random.default_rng(0))
    at = truth.sample(200, np.random.default_rng(1))
    np.testing.assert_allclose(corrected.log_prob(at), truth.log_prob(at), atol=0.03)
    z = box(1).to_z(corrected.sample(2000, np.random.default_rng(2)).psi)[:, 0]
    assert kstest(z, norm(0.6, 0.3).cdf).statistic < 0.05
    # without the correction it is another one
    assert np.abs(corrected.learned.log_prob(at) - truth.log_prob(at)).max() > 0.2


class Normals(Normal):
    """`Normal` in each of ten parameters."""

    prior = box(10)

    def log_prob(self, x: Fidelity) -> np.ndarray:
        z = self.prior.to_z(x.psi)
        return (norm.logpdf(z, self.mean, self.sd) - norm.logpdf(z)).sum(1) - self.prior.log_volume

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        return Fidelity(self.prior.from_z(self.mean + self.sd * rng.normal(size=(n, 10))))


class Learned(Normals):
    """What is learned if half of the windows are draws of `proposed`: in closed form, two normals."""

    def __init__(self, mean: float, sd: float, proposed: Normals) -> None:
        super().__init__(mean, sd)
        self.proposed = proposed
        precision = sd**-2 + proposed.sd**-2 - 1
        middle = (mean / sd**2 + proposed.mean / proposed.sd**2) / precision
        self.narrow = Normals(middle, precision**-0.5)  # what `proposed` / prior makes of the posterior, normalised
        at = Fidelity(self.prior.from_z(np.full((1, 10), middle)))
        self.gain = (super().log_prob(at) + told(proposed, at.psi) - self.narrow.log_prob(at)).item()

    def log_prob(self, x: Fidelity) -> np.ndarray:
        tilt = np.logaddexp(0, told(self.proposed, x.psi)) - np.logaddexp(0, self.gain)
        return super().log_prob(x) + tilt

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        whose = rng.uniform(size=(n, 1)) < np.exp(-np.logaddexp(0, self.gain))
        return Fidelity(np.where(whose, super().sample(n, rng).psi, self.narrow.sample(n, rng).psi))


@pytest.mark.parametrize(("sd", "wider"), [(0.2, 1.1), (0.5, 1.1), (0.2, 1.5)])
def test_corrected_draws_of_many_parameters_are_as_wide_as_the_posterior(sd: float, wider: float) -> None:
    """Those of what was learned alone lie in its tails too seldom: chosen among, they were 2 to 7 % too narrow."""
    truth, proposed = Normals(0.4, sd), Normals(0.4, wider * sd)
    learned, config = Learned(0.4, sd, proposed), SequentialConfig(samples=2000, oversampling=16)
    corrected = Corrected(learned, [(proposed, 300)], 300, config, np.random.default_rng(0))
    z = corrected.prior.to_z(corrected.sample(3000, np.random.default_rng(1)).psi)
    assert (z.std(0) / sd).mean() == pytest.approx(1, abs=0.02)  # ten spreads, each to 0.013
    at = truth.sample(300, np.random.default_rng(2))
    np.testing.assert_allclose(corrected.log_prob(at), truth.log_prob(at), atol=0.05)


@pytest.mark.parametrize("oversampling", [1, 3])
def test_a_single_corrected_draw(oversampling: int) -> None:
    config = SequentialConfig(samples=200, oversampling=oversampling)
    proposed = Normal(0.5, 0.3)
    corrected = Corrected(Tilted(0.6, 0.3, proposed), [(proposed, 300)], 300, config, np.random.default_rng(0))
    assert corrected.sample(1, np.random.default_rng(1)).psi.shape == (1, 1)


def test_draws_of_a_posterior_are_proposed() -> None:
    proposal = Proposed(Normal(0.5, 0.3), SequentialConfig(), np.random.default_rng(0))
    assert kstest(box(1).to_z(proposal.sample(2000, np.random.default_rng(1)))[:, 0], norm(0.5, 0.3).cdf).pvalue > 0.01
    # e to the entropy relative to the prior, which is a standard normal there
    gain = -np.log(0.3) - 0.5 + (0.5**2 + 0.3**2) / 2
    assert proposal.kept == pytest.approx(np.exp(-gain), rel=0.05)


def test_rounds_of_a_posteriors_draws_come_to_the_posterior() -> None:
    net = network(linear_windows(300), linear=True, density="mixture", components=3)
    config = SequentialConfig(rounds=3, simulations=300, samples=500, proposal="posterior", narrows=-np.inf)
    training = TrainConfig(epochs=20, batch=64, rate=2e-3, warmup=10, average=0.95)
    out = sequential(net, simulate, OBSERVED, config, training)
    assert isinstance(out.posterior, Corrected)
    assert [n for _, n in out.posterior.proposals] == [300, 300]
    assert len(out.windows) == 900
    exact = gaussian(X[0])
    z = box(3).to_z(out.posterior.sample(3000, np.random.default_rng(0)).psi)
    sd = exact.covariance_matrix.diagonal().sqrt().numpy()
    assert np.abs((z.mean(0) - exact.mean.numpy()) / sd).max() < 0.3
    assert np.abs(np.log(z.std(0) / sd)).max() < 0.25
    # The third round's draws come of the second's posterior, which is kept as it was then.
    second = out.posterior.proposals[1][0]
    assert second.network is not net
    assert isinstance(second, Corrected)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(InputError, match="rounds is 0, want a whole number, 1 or more"):
        SequentialConfig(rounds=0)
    with pytest.raises(InputError, match="quantile"):
        SequentialConfig(quantile=0.0)
    with pytest.raises(InputError, match="truncated, posterior, got 'prior'"):
        SequentialConfig(proposal="prior")
    for wrong in ({"rounds": 1.5}, {"simulations": 19}, {"samples": 99}, {"oversampling": 0}, {"seed": -1}):
        ((name, value),) = wrong.items()
        with pytest.raises(InputError, match=f"sequential: {name} is {value}, want a whole number"):
            SequentialConfig(**wrong)  # type: ignore[arg-type]
    for wider in (0.9, np.nan, np.inf):
        with pytest.raises(InputError, match=f"sequential: wider is {wider}, want a number of 1 or more"):
            SequentialConfig(wider=wider)
    with pytest.raises(InputError, match="narrows is nan"):
        SequentialConfig(narrows=np.nan)
