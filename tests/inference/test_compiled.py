"""Compiled training steps: the same losses and the same random numbers; where they cannot be, that is said."""

import importlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from problems import linear_windows, motion_windows, network

from nfc_gym.inference.progress import Quiet
from nfc_gym.inference.train import Outcome, TrainConfig, train

module = importlib.import_module("nfc_gym.inference.compiled")
WHOLE = 64
QUICK = TrainConfig(epochs=2, batch=WHOLE, rate=2e-3, warmup=10, average=0.98, mixed=False)
COMPILE = torch.compile


class Heard(Quiet):
    """Keeps the messages."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def message(self, text: str) -> None:
        self.said.append(text)


def trained(compiled: bool, device: str = "cpu", **of: Any) -> tuple[Outcome, torch.nn.Module, list[str]]:
    windows, held_out = (motion_windows if of else linear_windows)(300).split(0.1)
    net, heard = network(windows, **of), Heard()
    out = train(net, windows, held_out, replace(QUICK, compiled=compiled), device=device, report=heard)
    return out, net, heard.said


def same(one: tuple[Outcome, torch.nn.Module, list[str]], other: tuple[Outcome, torch.nn.Module, list[str]]) -> None:
    assert one[0].train == pytest.approx(other[0].train, rel=1e-4)
    assert one[0].held_out == pytest.approx(other[0].held_out, rel=1e-4)


def test_whole_batches_alone_are_compiled_and_nothing_else_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Traced, differentiated and run as they come: what the compiler makes of kernels takes minutes here."""
    seen: list[int] = []

    def traced(losses: Callable[..., Any], **how: Any) -> Callable[..., Any]:
        assert how["options"] == {"fallback_random": True}
        fused = COMPILE(losses, dynamic=how["dynamic"], backend="aot_eager", fullgraph=True)

        def run(batch: dict[str, torch.Tensor]) -> Any:
            seen.append(len(batch["psi"]))
            return fused(batch)

        return run

    monkeypatch.setattr(module.torch, "compile", traced)
    fused = trained(True)
    assert seen == [WHOLE] * (1 + 2 * 4)  # once to compile, then four of the five batches of each epoch
    assert len(fused[2]) == 1
    same(fused, trained(False))


def test_a_compiler_that_fails_backwards_is_said_and_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    class Fails(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
            torch.rand(7)  # which the plain steps must not miss
            return x.clone()

        @staticmethod
        def backward(ctx: Any, slope: torch.Tensor) -> None:  # type: ignore[override]
            raise RuntimeError("no C compiler\nmore of it")

    def broken(losses: Callable[..., Any], **how: Any) -> Callable[..., Any]:
        return lambda batch: {name: Fails.apply(value) for name, value in losses(batch).items()}

    monkeypatch.setattr(module.torch, "compile", broken)
    out, net, said = trained(True)
    plain = trained(False)
    assert said[1:] == ["goes on without: no C compiler"]
    assert out.held_out == plain[0].held_out
    assert all(torch.equal(a, b) for a, b in zip(net.parameters(), plain[1].parameters(), strict=True))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("of", [{"density": "score", "summaries": True}, {"density": "flow", "delta_s": True}])
def test_compiled_steps_on_a_gpu_are_those_that_are_not(of: dict[str, Any]) -> None:
    fused, plain = (trained(compiled, "cuda", **of) for compiled in (True, False))
    assert len(fused[2]) == 1, fused[2]
    assert fused[0].train == pytest.approx(plain[0].train, rel=1e-3)
    assert fused[0].held_out == pytest.approx(plain[0].held_out, rel=1e-3)
