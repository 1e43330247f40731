"""delta_e beside (psi, delta_s): the joint diffusion of vector and map."""

from pathlib import Path

import numpy as np
import pytest
import torch
from problems import motion_windows, network

from nfc_gym.core import Fidelity, InputError
from nfc_gym.inference.config import NetworkConfig
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.heads.score import Score
from nfc_gym.inference.heads.terrain import Terrain
from nfc_gym.inference.heads.waves import LEAST, Waves
from nfc_gym.inference.posterior import NeuralPosterior, Window, load


def with_maps(n: int) -> TensorWindows:
    """delta_e is a bump whose height is the first of psi; the map is a slope."""
    windows = motion_windows(n)
    line = torch.linspace(-1, 1, 128)
    bump = torch.exp(-4 * (line[:, None] ** 2 + line[None] ** 2))
    height = windows.tensors["psi"][:, 0] - 0.5
    slope = torch.randn(n, 1, 1, generator=torch.Generator().manual_seed(1)) * line[None, :, None].expand(n, 128, 128)
    return TensorWindows({**windows.tensors, "delta_e": height[:, None, None] * bump, "map": slope})


def test_untrained_it_is_the_prior_of_both() -> None:
    score, terrain = Score((2, 2), 4, 16, 1), Terrain(4, 4, 16)
    with torch.no_grad():
        y, m = terrain.sample(6, torch.randn(1, 4), torch.randn(1, 128, 128), score, steps=3)
    assert (y.shape, m.shape) == ((6, 4), (6, 128, 128))
    assert float(m.mean()) == pytest.approx(0, abs=0.02)
    assert float(m.std()) == pytest.approx(1, abs=0.02)


def hills(n: int) -> torch.Tensor:
    """Maps (n, 128, 128) whose power falls by four orders, about a slope that all of them have."""
    k = torch.arange(128)
    strength = 1 / (1 + k[:, None] ** 2 + k[None] ** 2)
    rough = Waves(128).inverse(strength * torch.randn(n, 128, 128, generator=torch.Generator().manual_seed(0)))
    return rough + torch.linspace(-1, 1, 128)


def test_waves_are_white_and_come_back() -> None:
    maps, waves = hills(400), Waves(128)
    waves.fit(maps)
    white = waves(maps)
    torch.testing.assert_close(waves.inverse(white), maps, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(white.mean(0), torch.zeros(128, 128), atol=1e-3, rtol=0)
    strong = waves.spread > 1.01 * LEAST * waves.spread.mean()
    torch.testing.assert_close(white.std(0, correction=0)[strong], torch.ones(int(strong.sum())), atol=1e-3, rtol=0)
    assert float(waves.colour(white).square().mean()) == pytest.approx(1, rel=0.05)  # of unit size as a map too


def test_untrained_its_maps_have_the_training_sets_mean_and_spectrum() -> None:
    maps, score, terrain = hills(400), Score((1,), 4, 16, 1), Terrain(4, 1, 16)
    terrain.waves.fit(maps)
    with torch.no_grad():
        drawn = terrain.sample(100, torch.randn(1, 4), torch.randn(1, 128, 128), score, steps=1)[1]
    torch.testing.assert_close(drawn.mean((0, 1)), maps.mean((0, 1)), atol=0.1, rtol=0)  # the slope
    bare = Waves(128)
    spectra = [bare(m - m.mean(0)).square().mean(0) for m in (drawn, maps)]
    for low, high in ((1, 2), (2, 4), (4, 16), (16, 64), (64, 128)):
        power = [s[low:high, low:high].mean() for s in spectra]
        assert float(power[0] / power[1]) == pytest.approx(1, abs=0.3)


def test_each_block_sees_the_others_noise() -> None:
    score, terrain = Score((2,), 4, 16, 1), Terrain(4, 2, 16)
    with torch.no_grad():
        for p in (*score.parameters(), *terrain.parameters()):
            p.add_(0.1 * torch.randn_like(p))
    phi, features, elevation = torch.tensor([0.5]), torch.randn(1, 4), torch.randn(1, 128, 128)
    y, m = torch.randn(1, 2), torch.randn(1, 128, 128)
    of_y, of_m = terrain.v((y, m), phi, features, elevation, score)
    other_y, _ = terrain.v((y, m + 1), phi, features, elevation, score)
    _, other_m = terrain.v((y + 1, m), phi, features, elevation, score)
    assert not torch.allclose(of_y, other_y)
    assert not torch.allclose(of_m, other_m)


def test_it_learns() -> None:
    """The same map every time: v is then known from the noised map alone."""
    score, terrain = Score((1,), 1, 16, 1), Terrain(1, 1, 16)
    line = torch.linspace(-1, 1, 128)
    bump = 2 * torch.exp(-4 * (line[:, None] ** 2 + line[None] ** 2)).expand(2, 128, 128)
    optimiser = torch.optim.Adam([*score.parameters(), *terrain.parameters()], 2e-3)
    losses = []
    for i in range(24):
        torch.manual_seed(i % 4)  # the same noise again
        loss = terrain.loss(torch.zeros(2, 1), bump, torch.ones(2, 1), torch.zeros(2, 128, 128), score).mean()
        losses.append(loss.item())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert sum(losses[-4:]) < 0.7 * sum(losses[:4]), losses


def test_draws_are_fidelities_and_go_through_files(tmp_path: Path) -> None:
    windows = with_maps(6)
    net = network(windows, delta_s=True, elevation=True, delta_e=True)
    t = windows.tensors
    given = NeuralPosterior(net).given(Window(t["states"][0], t["actions"][0], t["map"][0]))
    drawn = given.sample(2, np.random.default_rng(0), steps=3)
    assert drawn.given == ("psi", "delta_s", "delta_e")
    assert drawn.delta_e.shape == (2, 128, 128)
    # untrained: the training set's own spread, in m
    assert drawn.delta_e.std() == pytest.approx(float(t["delta_e"].std()), rel=0.1)
    assert given.of("psi").sample(3, np.random.default_rng(0)).given == ("psi",)
    assert given.log_prob(Fidelity(drawn.psi, drawn.delta_s)).shape == (2,)
    given.save(tmp_path / "p.safetensors")
    again = load(tmp_path / "p.safetensors").sample(2, np.random.default_rng(0), steps=3)
    np.testing.assert_array_equal(again.delta_e, drawn.delta_e)
    with pytest.raises(InputError, match="give `elevation`"):
        NeuralPosterior(net).given(Window(t["states"][0], t["actions"][0]))
    with pytest.raises(InputError, match="parts are psi and others of psi, delta_s, delta_e"):
        given.of("delta_e")


def test_it_needs_a_map_and_the_score_model() -> None:
    with pytest.raises(InputError, match="want elevation=True, density='score'"):
        NetworkConfig(delta_e=True)
    with pytest.raises(InputError, match="needs 'map'"):
        network(motion_windows(10), elevation=True)
