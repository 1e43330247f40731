"""Truncated proposals on a posterior that is known."""

from copy import deepcopy

import numpy as np
import pytest
import torch
from problems import NOISE, box, gaussian, linear_windows, mix, network

from nfc_gym.core import Fidelity, InputError
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.sequential import SequentialConfig, TruncatedPrior, sequential
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
    assert (proposal._gain(psi) > proposal.threshold).all()
    # and as the prior is there: the same means and spreads as brute rejection from it
    rng, prior = np.random.default_rng(2), given().prior
    brute = prior.psi_of(rng.uniform(size=(40000, 3)))
    brute = brute[proposal._gain(brute) > proposal.threshold]
    assert proposal.kept == pytest.approx(len(brute) / 40000, rel=0.2)
    u, v = prior.u_of(psi), prior.u_of(brute)
    tolerance = 0.02 if way == "_rejected" else 0.05  # resampled draws thin out at the edge
    np.testing.assert_allclose(u.mean(0), v.mean(0), atol=tolerance)
    np.testing.assert_allclose(u.std(0), v.std(0), atol=tolerance)


def test_the_truth_is_hardly_ever_cut_off() -> None:
    proposal = TruncatedPrior(given(), SequentialConfig(), np.random.default_rng(0))
    truths = gaussian(X[0]).sample((4000,)).double().numpy()
    inside = proposal._gain(box(3).from_z(truths)) > proposal.threshold
    assert inside.mean() > 0.995


def test_rounds_close_in_and_end_where_they_no_longer_narrow() -> None:
    net = network(linear_windows(200), linear=True)
    heard: list[str] = []

    class Heard:
        def epoch(self, *args: object) -> None: ...

        def message(self, text: str) -> None:
            heard.append(text)

    out = sequential(
        net, simulate, OBSERVED, SequentialConfig(rounds=2, simulations=400, samples=150, oversampling=4),
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
    net = network(begun, linear=True)
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


def test_a_later_round_may_train_new_weights_and_leave_out_what_it_could_not_draw() -> None:
    begun = linear_windows(400)
    training = TrainConfig(epochs=3, batch=64, rate=2e-3, warmup=10, average=0.95)
    learned = network(begun, linear=True)
    train(learned, *begun.split(0.1), training)
    of = {"rounds": 2, "simulations": 300, "samples": 150, "oversampling": 4, "narrows": -np.inf}
    untrained = TrainConfig(epochs=1, batch=64, rate=1e-12, warmup=10, average=0.95)
    before = [w.clone() for w in learned.parameters()]
    same, new = (
        sequential(net, simulate, OBSERVED, SequentialConfig(anew=anew, inside=anew, **of), untrained, begun=begun)
        for net, anew in ((deepcopy(learned), False), (deepcopy(learned), True))
    )
    apart = [
        max(
            float((w - b).detach().abs().max()) for w, b in zip(out.posterior.network.parameters(), before, strict=True)
        )
        for out in (same, new)
    ]
    assert apart[0] < 1e-6 < apart[1]
    assert len(same.windows) == 700
    # All that is drawn lies inside what the proposal can draw, and so does what is left of the prior's windows.
    assert 310 < len(new.windows) < 690
    old = new.windows.tensors["psi"].shape[0] - 300
    spread = [w.tensors["psi"].std(0).mean() for w in (begun, new.windows)]
    assert spread[1] < 0.8 * spread[0], old


def test_bad_settings_are_refused() -> None:
    with pytest.raises(InputError, match="rounds >= 1"):
        SequentialConfig(rounds=0)
    with pytest.raises(InputError, match="quantile"):
        SequentialConfig(quantile=0.0)
