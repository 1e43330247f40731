"""What is asked of posteriors for worlds to be made of it."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from nfc_gym.adaptation.beliefs import Fixed, require_spoken, width
from nfc_gym.adaptation.imagined import imagined
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior
from nfc_gym.inference.space import PriorBox
from nfc_gym.wrappers import VectorResidualTerrain


def jackals(**more: bool) -> NeuralPosterior:
    """Untrained, of windows that are noise: it believes the prior, and draws of their spread."""
    g = torch.Generator().manual_seed(0)
    with gymnasium.make("nfc_gym/JackalFlat-v0", context=["psi"]) as env:
        prior = PriorBox.of(env.unwrapped.psi_space, "jackal")
    network = Network(NetworkConfig(features=8, hidden=8, depth=1, elevation=True, **more), Sizes(8, 15, 2), prior)
    shapes = {"states": (9, 15), "actions": (8, 2), "delta_s": (15,), "map": (128, 128), "delta_e": (1, 1)}
    windows = {k: torch.randn(20, *shape, generator=g) for k, shape in shapes.items()}
    windows["delta_s"] *= 1e-3
    windows["delta_e"] = 0.05 * windows["delta_e"].expand(20, 128, 128)
    network.fit_scales(windows | {"psi": torch.rand(20, len(prior), generator=g)})
    return NeuralPosterior(network)


def seen(steps: int = 8) -> Trajectory:
    return Trajectory(
        np.zeros((steps + 1, 15)), np.zeros((steps, 2)), np.zeros(steps), np.zeros(steps), 1.0,
        np.zeros((steps + 1, 0)), np.zeros((128, 128)),
    )  # fmt: skip


@pytest.mark.parametrize("delta_s", [False, True])
def test_a_networks_belief_speaks_of_all_that_it_infers(delta_s: bool) -> None:
    posterior = jackals(delta_s=delta_s, delta_e=True)
    belief: Any = Fixed(posterior).infer(seen())
    drawn = belief.sample(2, np.random.default_rng(0))
    assert drawn.given == (("psi", "delta_s", "delta_e") if delta_s else ("psi", "delta_e"))
    require_spoken(posterior, ("delta_e",))
    with pytest.raises(InputError, match="speaks of psi, not of delta_e"):
        require_spoken(jackals(), ("delta_e",))


def test_how_wide_a_belief_is_takes_no_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    belief: Any = Fixed(jackals(delta_e=True)).infer(seen())
    monkeypatch.setattr(Network, "sample_terrain", None)
    with gymnasium.make("nfc_gym/JackalFlat-v0", context=["psi"]) as env:
        assert 0.8 < width(belief, env.unwrapped.psi_space) < 1.2


@pytest.mark.parametrize("hallucinate", [False, True])
def test_worlds_have_the_ground_that_a_network_believes(hallucinate: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each simulation a draw of its own, laid around its start; drawn once, whatever is reset."""
    n, drawn, draw = 3, [], Network.sample_terrain
    monkeypatch.setattr(Network, "sample_terrain", lambda *a, **how: drawn.append(a[1]) or draw(*a, **how))
    belief: Any = Fixed(jackals(delta_s=True, delta_e=True)).infer(seen())
    settings = {"terrain_pool": 2, "difficulty": 0.3}
    worlds: Any = imagined(
        "nfc_gym/JackalRough-v0", belief, n, hallucinate=hallucinate, parts=("psi", "delta_s", "delta_e"), beta=1.0,
        episode=20, threads=1, seed=0, settings=settings,
    )  # fmt: skip
    assert worlds.single_action_space.shape == ((2 + 17 + 15,) if hallucinate else (2,))
    ground = worlds
    while not isinstance(ground, VectorResidualTerrain):
        ground = ground.env
    for seed in (0, 1):
        worlds.reset(seed=seed)
        base = worlds.unwrapped
        assert len({d.tobytes() for d in ground.delta_e}) > 1
        for i, (true, seen_) in enumerate(zip(base.heightfield, base.perceived, strict=True)):
            qpos = base.batch.bind("qpos")[i]
            rise = true.height(qpos[:2]) - seen_.height(qpos[:2])
            assert rise == pytest.approx(ground.delta_e[i, 60:68, 60:68].mean(), abs=1e-3)
            assert rise != 0
        for _ in range(4):
            step = worlds.step(np.zeros((n, *worlds.single_action_space.shape)))
            assert np.isfinite(step[0]["observation"]).all()
    assert drawn == [n], "as many maps as simulations, once"
    worlds.close()


def test_a_flat_world_takes_the_rest_of_a_belief() -> None:
    belief: Any = Fixed(jackals(delta_e=True)).infer(seen())
    worlds: Any = imagined("nfc_gym/JackalFlat-v0", belief, 2, hallucinate=False, parts=("psi", "delta_e"), beta=1.0,
                           episode=20, threads=1, seed=0)  # fmt: skip
    worlds.reset(seed=0)
    assert (worlds.unwrapped.psi[0] != worlds.unwrapped.psi[1]).any()
    worlds.close()
