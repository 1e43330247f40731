"""Muon beside torch's own, and both optimisers as one."""

from copy import deepcopy

import pytest
import torch
from torch import nn

from nfc_gym.inference.optimiser import Muon, Optimiser, orthogonal


def a_network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(12, 30), nn.Tanh(), nn.Linear(30, 30), nn.Tanh(), nn.Linear(30, 5))


def descend(net: nn.Module, optimiser: torch.optim.Optimizer | Optimiser, steps: int = 8) -> None:
    torch.manual_seed(1)
    for _ in range(steps):
        x = torch.randn(64, 12)
        optimiser.zero_grad()
        (net(x) - x[:, :5].square()).square().mean().backward()
        optimiser.step()


@pytest.mark.parametrize("shape", [(1, 30, 30), (2, 8, 50), (1, 50, 8), (3, 20, 20)])
def test_singular_values_come_near_one_in_their_directions(shape: tuple[int, ...]) -> None:
    matrices = torch.randn(shape, generator=torch.Generator().manual_seed(2))
    u, _, vt = torch.linalg.svd(matrices, full_matrices=False)
    among = u.mT @ orthogonal(matrices) @ vt.mT
    values = among.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(among, torch.diag_embed(values), rtol=0, atol=1e-4)
    assert values.max() < 1.3
    assert values.quantile(0.1) > 0.5  # a square matrix of noise has one near 0, which five rounds do not bring up


def test_a_step_is_as_of_torchs_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the rounds themselves, which torch does in bfloat16."""
    monkeypatch.setattr("torch.optim._muon._zeropower_via_newtonschulz", lambda matrix, *_: orthogonal(matrix[None])[0])
    ours, theirs = a_network(), a_network()
    begin = [p.detach().clone() for p in ours.parameters()]
    matrices = [p for p in ours.parameters() if p.ndim > 1]
    descend(ours, Muon(matrices, torch.tensor(1e-3), 0.3, torch.tensor(0.0)))  # a step is three times as large
    descend(theirs, torch.optim.Muon([p for p in theirs.parameters() if p.ndim > 1], 3e-3, 0.1,
                                     adjust_lr_fn="match_rms_adamw"))  # fmt: skip
    for before, a, b in zip(begin, ours.parameters(), theirs.parameters(), strict=True):
        if a.ndim > 1:
            assert (a - b).norm() < 1e-4 * (b - before).norm()
            assert (b - before).norm() > 0


def test_a_kernel_of_a_convolution_is_a_matrix_of_outputs() -> None:
    kernel = nn.Parameter(torch.randn(6, 5, 3, generator=torch.Generator().manual_seed(3)))
    flat = nn.Parameter(kernel.detach().flatten(1).clone())
    for p in (kernel, flat):
        p.grad = torch.arange(90.0).sin().view_as(p)
        Muon([p], torch.tensor(0.1), 0.0, torch.tensor(0.0)).step()
    assert torch.equal(kernel.flatten(1), flat)


def test_wide_matrices_and_biases_are_left_to_adamw() -> None:
    net = nn.Sequential(nn.Linear(2000, 600), nn.Linear(600, 40))
    for p in net.parameters():
        p.grad = torch.ones_like(p)
    optimiser = Optimiser(net, 1e-3, 0.0, torch.tensor(0.0))
    optimiser.step()
    moments = [name for name in optimiser.tensors() if name.endswith("/momentum")]
    second = [t.shape for name, t in optimiser.tensors().items() if name.endswith("/exp_avg_sq")]
    assert len(moments) == 1
    assert second == [(600, 2000), (600,), (40,)]


def test_nothing_is_changed_once_it_is_lost() -> None:
    lost = torch.tensor(0.0)
    net = a_network()
    optimiser = Optimiser(net, 1e-2, 1e-2, lost)
    descend(net, optimiser)
    kept = deepcopy([*net.parameters(), *optimiser.tensors().values()])
    lost.fill_(1.0)
    for p in net.parameters():
        assert p.grad is not None
        p.grad.fill_(torch.nan)
    optimiser.step()
    assert all(torch.equal(a, b) for a, b in zip(kept, [*net.parameters(), *optimiser.tensors().values()], strict=True))


def test_what_was_saved_goes_on_as_if_it_had_not_been() -> None:
    whole = a_network()
    first = Optimiser(whole, 1e-2, 1e-2, torch.tensor(0.0))
    descend(whole, first)
    again = deepcopy(whole)
    second = Optimiser(again, 0.5, 1e-2, torch.tensor(0.0))
    second.load(deepcopy(first.tensors()))
    second.rate.fill_(1e-2)
    for net, optimiser in ((whole, first), (again, second)):
        descend(net, optimiser)
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), again.parameters(), strict=True))
