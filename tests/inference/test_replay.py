"""`Passes`: what is replayed on a GPU is what the network computes; the same tests run on a processor, unreplayed."""

from contextlib import nullcontext, suppress

import numpy as np
import pytest
import torch
from problems import SMALL, box, motion_windows, network

from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.random import seeded
from nfc_gym.inference.replay import tensor_cores

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


def direct(net: Network, window: Window, n: int, seed: int, **how: int) -> np.ndarray:
    """(n, d) draws of psi by the network itself, with no `Passes` between."""
    device = next(net.parameters()).device
    row = lambda x: torch.as_tensor(np.asarray(x), dtype=torch.float32, device=device)[None]  # noqa: E731
    with torch.no_grad(), tensor_cores() if device.type == "cuda" else nullcontext():
        given = net.encode(row(window.states), row(window.actions))
        with seeded(np.random.default_rng(seed), device):
            z = net.sample(n, given, len(net.blocks), **how)[0, :, : net.prior.size]
    return net.prior.from_z(z.double().cpu().numpy())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_every_turn_draws_what_the_network_draws(device: str, config: dict[str, object]) -> None:
    """The first turn is never replayed; the later ones are, on a GPU."""
    ours, windows = posterior(**config)
    kept = ours.to(device)
    for seed, window in enumerate(windows * 2):
        got = kept.given(window).sample(7, np.random.default_rng(seed)).psi
        # TF32 has ten bits behind the point, and a GPU may choose other kernels for a product the next time.
        rtol = 1e-4 if device == "cpu" else 1e-3
        np.testing.assert_allclose(got, direct(kept.network, window, 7, seed), rtol=rtol)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("joints", [3, 20])
def test_robots_of_many_joints_have_turns_too(device: str, joints: int) -> None:
    """Regressions on more than sixteen actions are solved by a library that no graph can hold."""
    sizes, box_ = Sizes(10, joints, joints), box(2)
    ours = NeuralPosterior(Network(NetworkConfig(**SMALL, summaries=True), sizes, box_)).to(device)
    assert ours.network.encoder.waits == (joints == 20)
    rng = np.random.default_rng(0)
    for seed in range(3):
        window = Window(rng.standard_normal((11, joints)), rng.standard_normal((10, joints)))
        got = ours.given(window).sample(5, np.random.default_rng(seed)).psi
        np.testing.assert_allclose(got, direct(ours.network, window, 5, seed), rtol=1e-3)


@pytest.mark.parametrize("device", DEVICES)
def test_other_numbers_of_draws_and_steps_are_passes_of_their_own(device: str) -> None:
    kept = posterior()[0].to(device)
    window = posterior()[1][0]
    given = kept.given(window)
    for n, steps in ((5, 4), (9, 4), (9, 8), (5, 4), (9, 4), (9, 8)):
        got = given.sample(n, np.random.default_rng(n), steps=steps).psi
        assert got.shape == (n, 2)
        np.testing.assert_allclose(got, direct(kept.network, window, n, n, steps=steps), rtol=1e-4)


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
    assert not np.allclose(after, before, rtol=1e-3)
    np.testing.assert_allclose(after, direct(kept.network, window, 7, 0), rtol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_draws_differ_from_turn_to_turn(device: str) -> None:
    kept, windows = posterior()
    given, rng = kept.to(device).given(windows[0]), np.random.default_rng(0)
    drawn = [given.sample(7, rng).psi for _ in range(4)]
    assert len({d.tobytes() for d in drawn}) == 4


def test_tensor_cores_leave_no_trace() -> None:
    before = torch.get_float32_matmul_precision()
    with tensor_cores():
        assert torch.get_float32_matmul_precision() == "high"
    with suppress(RuntimeError), tensor_cores():
        raise RuntimeError
    assert torch.get_float32_matmul_precision() == before
