"""A posterior of all heads, in a file with its window, is a source for every wrapper; it draws its windows' spread."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from problems import SMALL

import nfc_gym  # noqa: F401 (registers the loader and the environments)
from nfc_gym import terrain
from nfc_gym.core import load_source
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.space import PriorBox
from nfc_gym.physics.state import yaw
from nfc_gym.terrain import Heightfield
from nfc_gym.wrappers import (
    Hallucinate,
    RandomizePsi,
    ResidualDynamics,
    ResidualTerrain,
    VectorRandomizePsi,
    VectorResidualDynamics,
    VectorResidualTerrain,
)

ID = "nfc_gym/JackalRough-v0"
ROUGH: dict[str, Any] = {"terrain_pool": 2, "difficulty": 0.3, "context": ["psi"]}


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Windows are noise; delta_e is a bump 1 m ahead, 0.3 m wide, whose height is normal about 0.2 m."""
    torch.manual_seed(0)
    n, along = 20, (torch.arange(128) - 63.5) / 10
    bump = torch.exp(-((along[:, None] - 1) ** 2 + along[None] ** 2) / (2 * 0.3**2))
    with gym.make("nfc_gym/JackalFlat-v0", context=["psi"]) as env:
        prior = PriorBox.of(env.unwrapped.psi_space, "jackal")
    windows = TensorWindows({
        "states": torch.randn(n, 9, 15), "actions": torch.randn(n, 8, 2), "psi": torch.rand(n, len(prior)),
        "delta_s": 1e-3 * torch.randn(n, 15), "map": 0.1 * torch.randn(n, 128, 128),
        "delta_e": (0.2 + 0.05 * torch.randn(n, 1, 1)) * bump,
    })  # fmt: skip
    config = NetworkConfig(**{**SMALL, "depth": 1, "hidden": 8}, elevation=True, delta_s=True, delta_e=True)
    net = Network(config, Sizes.of(windows.tensors), prior)
    net.fit_scales(t := windows.tensors)
    path = tmp_path_factory.mktemp("posterior") / "today.safetensors"
    NeuralPosterior(net).given(Window(t["states"][0], t["actions"][0], t["map"][0])).save(path)
    assert load_source(path).sample(1, np.random.default_rng(0)).given == ("psi", "delta_s", "delta_e")
    return path


def residual(env: Any) -> Heightfield:
    base = env.unwrapped
    return Heightfield(base.heightfield.heights - base.perceived.heights)


def test_residual_terrain_lies_before_the_robot(source: Path) -> None:
    env = ResidualTerrain(gym.make(ID, **ROUGH), source)
    drawn = []
    for seed in range(3):
        env.reset(seed=seed)
        qpos = env.unwrapped.data.qpos
        seen = terrain.elevation(residual(env), (*qpos[:2], 0.0), yaw(qpos[3:7]))
        at = np.unravel_index(seen.argmax(), seen.shape)
        assert np.hypot((at[0] - 63.5) / 10 - 1, (at[1] - 63.5) / 10) < 0.2
        assert 0.05 < seen.max() < 0.4
        drawn.append(env.delta_e)
        assert np.isfinite(env.step(np.ones(2))[0]["proprio"]).all()
    assert (drawn[0] != drawn[1]).any()


@pytest.mark.parametrize("wrapper", [RandomizePsi, ResidualDynamics])
def test_psi_and_delta_s_are_drawn_without_maps(source: Path, wrapper: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Network, "sample_terrain", None)
    env = wrapper(gym.make(ID, **ROUGH), source)
    drawn = []
    for seed in range(2):
        env.reset(seed=seed)
        drawn.append(env.psi if wrapper is RandomizePsi else env.delta_s)
        env.step(np.ones(2))
    assert (drawn[0] != drawn[1]).any()


def test_hallucinate_moves_all_three(source: Path) -> None:
    env = Hallucinate(gym.make(ID, **ROUGH), source, modes=2, samples=8)
    assert env.belief.psi_size == 17
    assert env.belief.mode_count == 2
    assert env.belief.step_size == 15
    worlds = []
    for h in (-1.0, 1.0):
        env.reset(seed=0)
        start = env.unwrapped.data.qpos.copy()
        env.step(np.r_[0.0, 0.0, np.full(env.belief.size, h)])
        wanted = env.fidelity.delta_e
        assert wanted is not None
        seen = terrain.elevation(residual(env), (*start[:2], 0.0), yaw(start[3:7]))
        within = 2 * 2 * 0.1**2 / 8 * wanted.max() / 0.3**2  # twice bilinear, at a bump of 0.3 m
        assert np.abs(seen - wanted)[10:-10, 10:-10].max() < 1.5 * within
        worlds.append((env.unwrapped.psi, wanted))
    assert (worlds[0][0] != worlds[1][0]).any()
    assert np.abs(worlds[0][1] - worlds[1][1]).max() > 1e-3


def test_all_of_it_around_a_batch(source: Path) -> None:
    made = gym.make_vec(ID, num_envs=2, autoreset_mode="SameStep", max_episode_steps=4, **ROUGH)
    envs: Any = VectorResidualDynamics(VectorRandomizePsi(VectorResidualTerrain(made, source), source), source)
    envs.reset(seed=0)
    grounds, psi = [m.heights for m in made.unwrapped.heightfield], made.unwrapped.psi
    qpos = made.unwrapped.batch.bind("qpos").copy()
    for i in range(2):
        delta = Heightfield(grounds[i] - made.unwrapped.perceived[i].heights)
        seen = terrain.elevation(delta, (*qpos[i, :2], 0.0), yaw(qpos[i, 3:7]))
        assert np.hypot(*(np.array(np.unravel_index(seen.argmax(), seen.shape)) - (73.5, 63.5))) < 2
    for _ in range(6):
        assert np.isfinite(envs.step(np.ones((2, 2)))[0]["proprio"]).all()
    assert (made.unwrapped.psi != psi).any(), "another episode"
    np.testing.assert_array_equal([m.heights for m in made.unwrapped.heightfield], grounds)
