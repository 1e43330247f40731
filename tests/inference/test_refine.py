"""One window of a cart whose dynamics are linear in its state: what its own commands teach."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from problems import SMALL, box
from scipy.stats import kstest

from nfc_gym.core import Fidelity, InputError
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window, load
from nfc_gym.inference.proposals import SequentialConfig
from nfc_gym.inference.refine import refine
from nfc_gym.inference.sequential import Rounds
from nfc_gym.inference.train import TrainConfig, train

PRIOR = box(2, "cart")
SENSED = 0.02


def driven(u: torch.Tensor, actions: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """(n, 11, 2) position and velocity of carts of a mass and a damping, pushed; without noise."""
    states, mass, damping = [start.expand(len(u), 2)], 0.5 + u[:, 0], 2 * u[:, 1]
    for t in range(10):
        position, velocity = states[-1].unbind(1)
        speed = velocity + 0.1 * (actions[:, t, 0] - damping * velocity) / mass
        states.append(torch.stack([position + 0.1 * speed, speed], 1))
    return torch.stack(states, 1)


class Own:
    """The commands of one window again; its start is known."""

    def __init__(self, window: Window) -> None:
        self.actions, self.start = torch.as_tensor(window.actions), torch.as_tensor(window.states)[0]
        self.noise = np.full((11, 2), SENSED)
        self.noise[0] = 0

    def __call__(self, psi: np.ndarray, rng: np.random.Generator) -> dict[str, torch.Tensor]:
        u = torch.as_tensor(PRIOR.u_of(psi), dtype=torch.float32)
        actions = self.actions.expand(len(u), *self.actions.shape)
        return {"states": driven(u, actions, self.start), "actions": actions.clone()}


def seen(u: list[float]) -> Window:
    """A cart that is pushed, as it is seen."""
    g = torch.Generator().manual_seed(5)
    actions, start = torch.randn(1, 10, 1, generator=g), torch.tensor([0.0, 1.5])
    states = driven(torch.tensor([u]), actions, start)
    states[:, 1:] += SENSED * torch.randn(1, 10, 2, generator=g)
    return Window(states[0].numpy(), actions[0].numpy())


def exact(window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of u, by quadrature on a grid."""
    axis = torch.linspace(0.0025, 0.9975, 200)
    u = torch.cartesian_prod(axis, axis)
    actions, start = torch.as_tensor(window.actions), torch.as_tensor(window.states)[0]
    away = driven(u, actions.expand(len(u), 10, 1), start) - torch.as_tensor(window.states)
    weight = torch.softmax(-0.5 * (away / SENSED).square().sum((1, 2)).double(), 0)[:, None]
    mean = (weight * u).sum(0)
    return mean.numpy(), (weight * (u - mean) ** 2).sum(0).sqrt().numpy()


def coarse() -> NeuralPosterior:
    """Trained a little on windows of any motion."""
    g = torch.Generator().manual_seed(0)
    u, actions, start = (torch.rand(600, 2, generator=g), *(torch.randn(600, *k, generator=g) for k in ((10, 1), (2,))))
    states = driven(u, actions, start)
    states += SENSED * torch.randn(states.shape, generator=g)
    kept = TensorWindows({"states": states, "actions": actions, "psi": u})
    network = Network(NetworkConfig(**SMALL | {"density": "mixture"}, components=2), Sizes.of(kept.tensors), PRIOR)
    train(network, *kept.split(0.1), TrainConfig(epochs=8, batch=64, rate=3e-3, warmup=10, average=0.9))
    return NeuralPosterior(network)


NETWORK = NetworkConfig(**SMALL | {"density": "mixture"}, components=2, aligned=True, linear=True)
TRAINING = TrainConfig(epochs=20, batch=64, rate=2e-3, warmup=10, average=0.95)
HOW = SequentialConfig(1, 3000, samples=300, oversampling=4)


@pytest.fixture(scope="module")
def learned() -> tuple[NeuralPosterior, Window, Rounds]:
    """A posterior of any motion, a window, and what its own commands taught."""
    posterior, window = coarse(), seen([0.4, 0.55])
    return posterior, window, refine(posterior, window, Own(window), HOW, TRAINING, network=NETWORK)


def test_a_windows_own_commands_teach_what_it_tells(learned: tuple[NeuralPosterior, Window, Rounds]) -> None:
    posterior, window, out = learned
    mean, sd = exact(window)
    u = PRIOR.u_of(out.posterior.sample(4000, np.random.default_rng(0)).psi)
    before = PRIOR.u_of(posterior.given(window).sample(4000, np.random.default_rng(0)).psi)
    assert (np.abs(u.mean(0) - mean) < 0.8 * sd).all()
    np.testing.assert_allclose(u.std(0), sd, rtol=0.4)
    assert (u.std(0) < 0.7 * before.std(0)).all()
    assert 0.1 < out.kept[0] <= 1
    assert len(out.windows) == 3000


def test_what_is_learned_is_right_on_the_average(learned: tuple[NeuralPosterior, Window, Rounds]) -> None:
    """Ranks of truths drawn from the prior, among draws of one posterior each, all of the same commands."""
    _, window, out = learned
    assert out.kept[0] > 0.9  # so that the network has learned of nearly all that the prior allows
    own, rng, ranks = Own(window), np.random.default_rng(1), []
    truths = rng.uniform(size=(80, 2))
    states = own(PRIOR.psi_of(truths), rng)["states"]
    states[:, 1:] += SENSED * torch.randn(80, 10, 2, generator=torch.Generator().manual_seed(2))
    for u, each in zip(truths, states.numpy(), strict=True):
        given = NeuralPosterior(out.posterior.network).given(Window(each, own.actions.numpy()))
        drawn = PRIOR.u_of(given.sample(400, rng).psi)
        ranks.append((drawn < u).mean(0))
    for i in range(2):
        assert kstest(np.array(ranks)[:, i], "uniform").pvalue > 1e-3


def test_it_is_this_windows_alone(learned: tuple[NeuralPosterior, Window, Rounds], tmp_path: Path) -> None:
    _, window, out = learned
    file = tmp_path / "own.safetensors"
    out.posterior.save(file)
    opened = load(file)
    psi = out.posterior.sample(5, np.random.default_rng(0)).psi
    np.testing.assert_allclose(opened.log_prob(Fidelity(psi)), out.posterior.log_prob(Fidelity(psi)), atol=1e-4)
    other = Window(window.states, np.asarray(window.actions) + 0.1)
    with pytest.raises(InputError, match="these are others"):
        opened.given(other)
    opened.given(window)


def test_maps_and_residuals_are_refused(learned: tuple[NeuralPosterior, Window, Rounds]) -> None:
    posterior, window, _ = learned
    with pytest.raises(InputError, match="it is psi that is learned anew"):
        refine(posterior, window, Own(window), HOW, network=replace(NETWORK, delta_s=True))
