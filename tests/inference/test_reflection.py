"""Windows in a mirror: a network that sees the parts of one side learns of the other's."""

from pathlib import Path

import numpy as np
import pytest
import torch
from problems import NOISE, network

from nfc_gym.core import InputError
from nfc_gym.envs.mirror import Mirror, Signed
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.gains import gains
from nfc_gym.inference.reflection import Reflection
from nfc_gym.inference.train import TrainConfig, train

# A sum and a difference of two sides, and what each of them does: in the mirror the difference turns its sign.
STATES = Signed(np.array([0, 1]), np.array([1.0, -1.0]))
SWAP = np.array([1, 0])
ACTION = Signed(np.array([0]), np.array([-1.0]))


def sides(n: int, seed: int, first: bool) -> TensorWindows:
    """Two parameters, one larger than the other: the first where `first`, else the second."""
    g = torch.Generator().manual_seed(seed)
    z = torch.randn(n, 2, generator=g).sort(1, descending=first).values
    seen = torch.stack([z.sum(1), (z[:, 0] - z[:, 1]).sinh()], 1)
    states = seen + 0.2 * NOISE * torch.randn(n, 2, generator=g)
    return TensorWindows({"states": states[:, None], "actions": torch.zeros(n, 0, 0), "psi": torch.special.ndtr(z)})


def test_what_was_seen_of_one_side_is_known_of_the_other() -> None:
    windows, held_out = sides(3000, 0, True).split(0.1)
    other = sides(500, 1, False).tensors
    mirror = Reflection([Mirror(STATES, Signed(np.zeros(0, int), np.zeros(0)), SWAP)])
    told = []
    for given in (None, mirror):
        net = network(windows, density="mixture", components=2)
        train(net, windows, held_out, TrainConfig(epochs=4, batch=64, rate=5e-3, warmup=10), mirror=given)
        told.append(float(gains(net, other).mean()))
    assert told[0] < 0 < told[1]  # without, it is sure of what it never saw


def test_half_of_a_batch_is_shown_in_the_mirror_and_belongs_together() -> None:
    torch.manual_seed(0)
    n, mirror = 2000, Reflection([Mirror(STATES, ACTION, SWAP)])
    batch = {
        "states": torch.randn(n, 4, 2), "actions": torch.randn(n, 3, 1), "psi": torch.rand(n, 2),
        "delta_s": torch.randn(n, 2), "family": torch.arange(n),
    }  # fmt: skip
    shown = mirror(batch)
    changed = (shown["psi"] != batch["psi"]).any(1)
    assert 0.45 < changed.float().mean() < 0.55
    for name, image in (
        ("states", batch["states"] * torch.tensor([1.0, -1.0])), ("actions", -batch["actions"]),
        ("psi", batch["psi"].flip(1)), ("delta_s", batch["delta_s"] * torch.tensor([1.0, -1.0])),
    ):  # fmt: skip
        assert torch.equal(shown[name][changed], image[changed])
        assert torch.equal(shown[name][~changed], batch[name][~changed])
    assert torch.equal(shown["family"], batch["family"])


def test_of_two_mirrors_a_quarter_is_shown_in_each_way() -> None:
    torch.manual_seed(0)
    turned, kept = Signed(np.array([0, 1]), np.array([-1.0, 1.0])), Signed(np.array([0]), np.array([1.0]))
    mirrors = [Mirror(STATES, ACTION, SWAP), Mirror(turned, kept, np.array([0, 1]))]
    batch = {"states": torch.ones(4000, 1, 2), "actions": torch.ones(4000, 1, 1), "psi": torch.rand(4000, 2)}
    shown = Reflection(mirrors)(batch)
    swapped = (shown["psi"] != batch["psi"]).any(1)
    for first, second in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):  # signs of the two states
        chosen = (shown["states"][:, 0] == torch.tensor([first, second])).all(1)
        assert 0.22 < chosen.float().mean() < 0.28
        assert swapped[chosen].all() if second < 0 else not swapped[chosen].any()
        assert (shown["actions"][chosen] == second).all()


def test_a_state_of_fewer_mirrors_is_refused(tmp_path: Path) -> None:
    windows, held_out = sides(60, 0, True).split(0.1)
    image = Mirror(STATES, Signed(np.zeros(0, int), np.zeros(0)), SWAP)
    once = TrainConfig(epochs=1, batch=16)
    train(network(windows), windows, held_out, once, folder=tmp_path, mirror=Reflection([image]))
    with pytest.raises(InputError, match=r"of another run \(mirror 1, now 2\)"):
        train(network(windows), windows, held_out, once, folder=tmp_path, mirror=Reflection([image, image]))


def test_maps_are_refused() -> None:
    mirror = Reflection([Mirror(STATES, ACTION, SWAP)])
    with pytest.raises(InputError, match="elevation maps are not shown in a mirror"):
        mirror({"psi": torch.rand(2, 2), "map": torch.zeros(2, 128, 128)})
