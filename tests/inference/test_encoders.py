"""Encoders: causality, scales, closed forms of the kernels and of the regressions."""

import math
from typing import cast

import numpy as np
import pytest
import torch
from scipy.special import hyp1f1

from nfc_gym.core import InputError
from nfc_gym.inference.encoders import ENCODERS, Joined, Regressions, Summaries
from nfc_gym.inference.encoders.base import Tamed
from nfc_gym.inference.encoders.kernels import FKS, RFF, chi_quantiles
from nfc_gym.inference.encoders.resnet import ResNet18
from nfc_gym.inference.encoders.tcn import TCN, Reached

S, A, H = 3, 2, 8


def windows(n: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    return 5 + 2 * torch.randn(n, H + 1, S), torch.randn(n, H, A)


def test_tails_are_tamed_and_come_back() -> None:
    x = torch.randn(5000, 2).double() * torch.tensor([0.01, 3.0])
    x[::2, 0] = 0  # half of the windows have no residual
    x[7] = torch.tensor([5.0, -900.0])
    tamed = Tamed(2).double()
    tamed.fit(x)
    y = tamed(x)
    torch.testing.assert_close(tamed.inverse(y), x)
    torch.testing.assert_close(y.std(0), torch.ones(2).double(), atol=0.02, rtol=0)
    assert y.abs().max() < 12
    slope = (tamed(x + 1e-6) - tamed(x - 1e-6)) / 2e-6
    torch.testing.assert_close(slope.log(), tamed.log_slope(x), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize("summaries", [False, True])
def test_one_interface(name: str, summaries: bool) -> None:
    states, actions = windows()
    encoder = Joined(name, H, S, A, summaries=summaries)
    encoder.fit(states, actions, None)
    out = encoder(states, actions)
    assert out.shape == (64, encoder.features)
    assert torch.isfinite(out).all()
    assert (out.std(0) > 0).any()
    # units of the log do not matter once the scales are taken
    other = Joined(name, H, S, A, summaries=summaries)
    other.load_state_dict(encoder.state_dict())
    other.fit(1000 * states - 7, actions, None)
    torch.testing.assert_close(other(1000 * states - 7, actions), out, atol=2e-2, rtol=2e-2)


def test_the_tcn_is_causal_and_its_last_step_sees_all() -> None:
    tcn = TCN(50, S, A).eval()
    assert tcn.features == 16 * 51
    x = torch.randn(1, 51, tcn.channels, requires_grad=True)
    tcn.embed(x).view(16, 51)[:, 30].sum().backward()
    seen = x.grad[0].abs().sum(1) > 0  # type: ignore[index]
    assert seen[:31].all()
    assert not seen[31:].any()
    x.grad = None
    tcn.embed(x).view(16, 51)[:, 50].sum().backward()
    assert (x.grad[0].abs().sum(1) > 0).all()  # type: ignore[index]


@pytest.mark.parametrize(("width", "dilation", "length"), [(3, 1, 7), (3, 2, 7), (3, 4, 7), (2, 8, 5), (1, 3, 4)])
def test_causal_convolutions_and_their_slopes_are_torchs(width: int, dilation: int, length: int) -> None:
    conv = torch.nn.Conv1d(4, 5, width, dilation=dilation).double()
    x = torch.randn(2, length, 4, dtype=torch.float64, requires_grad=True)
    laid = cast(torch.Tensor, Reached.apply(x, width, dilation))
    found = torch.nn.functional.linear(laid, conv.weight.mT.flatten(1), conv.bias)
    expected = conv(torch.nn.functional.pad(x.mT, ((width - 1) * dilation, 0))).mT
    torch.testing.assert_close(found, expected)
    along = torch.randn_like(expected)
    ours, theirs = (torch.autograd.grad(y, x, along, retain_graph=True)[0] for y in (found, expected))
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("kind", [RFF, FKS])
def test_kernel_features_are_the_gaussian_kernel(kind: type) -> None:
    states, actions = windows(200)
    encoder = kind(H, S, A)
    encoder.fit(states, actions, None)
    x = encoder.signals(states, actions).flatten(1)
    gram = encoder(states, actions) @ encoder(states, actions).T / 1024
    exact = torch.exp(-torch.cdist(x, x).square() / (2 * encoder.width**2))
    off = ~torch.eye(200, dtype=torch.bool)
    assert (gram - exact)[off].abs().mean() < 0.03
    assert (exact[off].min(), exact[off].max()) > (0.01, 0.5)  # a kernel that tells windows apart
    assert not any(p.requires_grad for p in encoder.parameters())


def test_kernel_features_tell_x_from_its_mirror_image() -> None:
    for kind in (RFF, FKS):
        encoder = kind(H, S, A)
        x = torch.randn(4, encoder.length, encoder.channels)
        even, odd = encoder.embed(x).chunk(2, 1)
        mirrored = encoder.embed(-x).chunk(2, 1)
        torch.testing.assert_close(mirrored, (even, -odd), atol=1e-5, rtol=1e-4)
        assert odd.abs().mean() > 0.1


def test_the_slices_are_the_hypergeometric_function() -> None:
    t = np.linspace(0, 1.5, 20)
    mean = np.cos(t[:, None] * chi_quantiles(10, 32)).mean(1)
    np.testing.assert_allclose(mean, hyp1f1(5, 0.5, -(t**2) / 2), atol=0.01)


def test_summaries_recover_the_coefficients_of_a_joint() -> None:
    """v' = v + a action - b v - c q of each of 40 windows: the regression's weights, undone of their scales."""
    n, h = 40, 60
    a, b, c = 0.5 + torch.rand(n), 0.1 * torch.rand(n), 0.3 * torch.rand(n)
    q, v, rows = torch.randn(n), torch.randn(n), []
    actions = torch.randn(n, h, 1)
    for t in range(h):
        rows.append(torch.stack([q, v], 1))
        q, v = q + 0.1 * v, v + a * actions[:, t, 0] - b * v - c * q
    states = torch.stack([*rows, torch.stack([q, v], 1)], 1)
    encoder = Summaries(h, 2, 1, Regressions.of({"velocity": [1], "position": [0], "action": [0]}, 2, 1))
    encoder.fit(states, actions, None)
    weights = encoder.raw(states, actions)[:, :3].sinh()  # velocity, position, action
    scale = encoder.outputs.spread[1] / encoder.inputs.spread[[1, 0, 2]]
    found = weights * scale
    for column, truth in zip(found.T, (-b, -c, a), strict=True):
        assert torch.corrcoef(torch.stack([column, truth]))[0, 1] > 0.98
    assert (found[:, 2] - a).abs().max() < 0.05


def test_the_map_is_seen_where_it_is_switched_on() -> None:
    net = ResNet18().eval()
    maps = torch.randn(2, 128, 128)
    net.fit(*windows(2), maps)
    with torch.no_grad():
        out = net(*windows(2), maps)
    assert out.shape == (2, 1024)
    assert not torch.allclose(out[0], out[1])
    both = Joined("nn", H, S, A, width=16, elevation=True)
    with pytest.raises(InputError, match="trained with an elevation map"):
        both(*windows(2))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("lstm", {}, "no encoder named 'lstm'; there are: tcn, nn"),
        ("qmc-rff", {"elevation": True}, "sees no map"),
        ("none", {}, "needs summaries"),
    ],
)
def test_what_makes_no_encoder_is_refused(name: str, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Joined(name, H, S, A, **options)


def test_a_layout_that_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match="velocity 9 does not exist; there are 3"):
        Regressions.of({"velocity": [9]}, S, A)
    with pytest.raises(InputError, match="one velocity, position and action a joint"):
        Regressions.of({"velocity": [0, 1], "action": [0]}, S, A)


NAMES = (
    "body:base:quat.w", "body:base:quat.x", "body:base:quat.y", "body:base:quat.z", "body:base:pos.x",
    "body:base:pos.y",
    "body:base:pos.z", "body:base:linvel.x", "body:base:linvel.y", "body:base:linvel@body.x", "obs",
)  # fmt: skip


def moved(states: torch.Tensor, heading: float, by: tuple[float, float]) -> torch.Tensor:
    """The same motion elsewhere, facing elsewhere."""
    out, half = states.clone(), heading / 2
    c, s = math.cos(half), math.sin(half)
    w, x, y, z = states[..., :4].unbind(-1)
    out[..., :4] = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)
    c, s = math.cos(heading), math.sin(heading)
    for i, shift in ((4, by), (7, (0.0, 0.0))):
        a, b = states[..., i], states[..., i + 1]
        out[..., i], out[..., i + 1] = c * a - s * b + shift[0], s * a + c * b + shift[1]
    return out


def test_a_window_looks_the_same_wherever_it_happens() -> None:
    from nfc_gym.inference.encoders.place import Place, place_of

    entries = place_of(NAMES)
    assert entries == {"quat": [0, 1, 2, 3], "pos": [4, 5], "turned": [[7, 8]]}
    place, states = Place(entries), torch.randn(5, 7, len(NAMES), dtype=torch.float64)
    states[..., :4] = torch.nn.functional.normalize(states[..., :4], dim=-1)
    seen = place(states)
    for heading, by in ((2.0, (3.0, -1.0)), (-0.7, (0.0, 5.0))):
        torch.testing.assert_close(place(moved(states, heading, by)), seen)
    torch.testing.assert_close(place(seen), seen)  # nothing is left to take out
    assert seen[:, 0, 4:6].abs().max() < 1e-12
    kept = [6, 9, 10]
    assert torch.equal(seen[..., kept], states[..., kept])
    torch.testing.assert_close(seen[..., :4].norm(dim=-1), torch.ones(5, 7, dtype=torch.float64))
    torch.testing.assert_close(seen[..., 7:9].norm(dim=-1), states[..., 7:9].norm(dim=-1))


def test_changes_of_states_turn_as_the_window_does_and_back() -> None:
    from nfc_gym.inference.encoders.place import Place, place_of

    place = Place(place_of(NAMES))
    states = torch.randn(5, 1, len(NAMES), dtype=torch.float64) + 0.01 * torch.randn(5, 7, len(NAMES))
    states[..., :4] = torch.nn.functional.normalize(states[..., :4], dim=-1)
    states[2] = moved(states[2], 3.0, (1.0, 0.0))
    facing, change = place.facing(states), states[:, 3] - states[:, 2]
    turned = place.turned(change, facing)
    seen = place(states)
    torch.testing.assert_close(turned, seen[:, 3] - seen[:, 2])
    torch.testing.assert_close(place.turned(turned, facing, back=True), change)
    elsewhere = moved(states, 2.0, (3.0, -1.0))
    again = place.turned(elsewhere[:, 3] - elsewhere[:, 2], place.facing(elsewhere))
    torch.testing.assert_close(again, turned)


def test_states_without_a_place_have_none() -> None:
    from nfc_gym.inference.encoders.place import place_of

    assert place_of(("body:base:quat.w", "body:base:linvel.x")) is None
    assert place_of(("joint:hip:pos",)) is None
