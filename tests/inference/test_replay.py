"""`Passes`: what is replayed on a GPU is what the network computes; the same tests run on a processor, unreplayed."""

import numpy as np
import pytest
import torch
from problems import motion_windows, network

from nfc_gym.inference.posterior import NeuralPosterior, Window

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")),
]
CONFIGS = [
    {},
    {"summaries": True, "linear": True},
    {"encoder": "nn", "delta_s": True},
    {"encoder": "qmc-rff", "linear": True},
    {"encoder": "qmc-fks"},
    {"density": "mixture"},
    {"density": "flow"},
]


def posterior(**config: object) -> tuple[NeuralPosterior, list[Window]]:
    windows = motion_windows(200)
    net = network(windows, **config)
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.1 * torch.randn_like(p))
    t = windows.tensors
    return NeuralPosterior(net), [Window(t["states"][i].numpy(), t["actions"][i].numpy()) for i in range(3)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_turns_after_the_first_agree_with_a_posterior_of_its_own(device: str, config: dict[str, object]) -> None:
    """The first turn of each is never replayed; the later ones of `kept` are, on a GPU."""
    ours, windows = posterior(**config)
    kept = ours.to(device)
    for seed, window in enumerate(windows * 2):
        fresh = NeuralPosterior(kept.network)
        got = kept.given(window).sample(7, np.random.default_rng(seed))
        want = fresh.given(window).sample(7, np.random.default_rng(seed))
        np.testing.assert_allclose(got.psi, want.psi, rtol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_other_numbers_of_draws_and_steps_are_passes_of_their_own(device: str) -> None:
    kept = posterior()[0].to(device)
    window = posterior()[1][0]
    given = kept.given(window)
    for n, steps in ((5, 4), (9, 4), (9, 8), (5, 4), (9, 4), (9, 8)):
        got = given.sample(n, np.random.default_rng(n), steps=steps).psi
        want = NeuralPosterior(kept.network).given(window).sample(n, np.random.default_rng(n), steps=steps).psi
        assert got.shape == (n, 2)
        np.testing.assert_allclose(got, want, rtol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_new_weights_count(device: str) -> None:
    kept = posterior()[0].to(device)
    window = posterior()[1][0]
    for _ in range(3):
        before = kept.given(window).sample(7, np.random.default_rng(0)).psi
    with torch.no_grad():
        for p in kept.network.parameters():
            p.add_(0.1 * torch.randn_like(p))
    after = kept.given(window).sample(7, np.random.default_rng(0)).psi
    want = NeuralPosterior(kept.network).given(window).sample(7, np.random.default_rng(0)).psi
    assert not np.allclose(after, before, rtol=1e-3)
    np.testing.assert_allclose(after, want, rtol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_draws_differ_from_turn_to_turn(device: str) -> None:
    kept, windows = posterior()
    given, rng = kept.to(device).given(windows[0]), np.random.default_rng(0)
    drawn = [given.sample(7, rng).psi for _ in range(4)]
    assert len({d.tobytes() for d in drawn}) == 4
