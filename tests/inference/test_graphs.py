"""The training step as one piece of work on the device: its law, its losses, its clock, and its replays on a GPU."""

import importlib
import math
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from problems import killed, linear_windows, motion_windows, network

from nfc_gym.core import InputError
from nfc_gym.inference.data import StoredWindows, TensorWindows, resident
from nfc_gym.inference.graphs import Graphs
from nfc_gym.inference.random import mixed, seeded
from nfc_gym.inference.train import TrainConfig, train

module = importlib.import_module("nfc_gym.inference.train")  # the package has a function of that name
QUICK = TrainConfig(epochs=3, batch=64, rate=2e-3, warmup=10, average=0.98)
CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")


def by_hand(net: torch.nn.Module, windows: TensorWindows, config: TrainConfig) -> tuple[list[float], torch.nn.Module]:
    """Each epoch's mean loss and the averaged weights, by the plain optimiser, one step after the other."""
    net, average = net.train(), deepcopy(net)
    optimiser = torch.optim.AdamW(net.parameters(), lr=config.rate, weight_decay=config.decay)
    each = math.ceil(len(windows) / config.batch)
    total, losses, k = each * config.epochs, [], 0
    for epoch in range(config.epochs):
        for batch in windows.batches(config.batch, mixed(config.seed, epoch)):
            rise = min(1, (k + 1) / config.warmup)
            optimiser.param_groups[0]["lr"] = config.rate * rise * (1 + math.cos(math.pi * k / total)) / 2
            torch.manual_seed(mixed(config.seed, 0, k))
            loss = torch.stack(list(net.losses(batch).values())).sum()  # type: ignore[operator]
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip)
            optimiser.step()
            k += 1
            keep = min(config.average, (1 + k) / (10 + k))
            with torch.no_grad():
                for a, p in zip(average.parameters(), net.parameters(), strict=True):
                    a.copy_(keep * a + (1 - keep) * p)
            losses.append(loss.item())
    return [float(np.mean(losses[i : i + each])) for i in range(0, total, each)], average


@pytest.mark.parametrize("density", ["score", "mixture"])
def test_a_step_is_adamw_clipped_and_averaged(density: str) -> None:
    windows, held_out = motion_windows(300).split(0.2)
    net = network(windows, density=density, delta_s=True)
    config = replace(QUICK, muon=False)
    expected, average = by_hand(deepcopy(net), windows, config)
    out = train(net, windows, held_out, config, scales=False)
    assert out.best == QUICK.epochs  # else other weights are kept
    assert out.train == pytest.approx(expected, rel=1e-5)
    for a, b in zip(net.parameters(), average.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


class Poisoned(TensorWindows):
    """The loss of one batch is infinite; the next ones are as good as the first."""

    at = 13

    def batches(self, size: int, seed: int | None) -> Iterator[dict[str, torch.Tensor]]:
        for i, batch in enumerate(super().batches(size, seed)):
            yield {**batch, "delta_s": batch["delta_s"] * torch.inf} if i == self.at else batch


def test_after_a_loss_that_is_not_finite_no_step_changes_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    windows, held_out = motion_windows(64 * 30).split(0.1)
    net = network(windows, density="mixture", delta_s=True)
    kept = []
    for poisoned, look in ((Poisoned(windows.tensors), {"cpu": 1}), (Poisoned(windows.tensors), {"cpu": 8})):
        monkeypatch.setattr(module, "_LOOK", look)
        run = module._Run(deepcopy(net), poisoned, held_out, QUICK, torch.device("cpu"))
        with seeded(0):
            run.loop(None, module.quiet)
        assert run.outcome.stopped == "diverged"
        assert run.step == Poisoned.at
        kept.append([*run.network.parameters(), *run.average.parameters(),
                     *run.optimiser.tensors().values()])  # fmt: skip
    assert all(torch.equal(a, b) for a, b in zip(*kept, strict=True))
    assert all(torch.isfinite(t).all() for t in kept[0])
    steps = {float(t) for name, t in run.optimiser.tensors().items() if name.endswith("/step")}
    assert steps == {float(Poisoned.at)}


def test_how_often_it_is_looked_makes_no_difference(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    windows, held_out = motion_windows(700).split(0.1)
    config = replace(QUICK, save_every=0.0)
    found = []
    for look in (1, 4):
        monkeypatch.setattr(module, "_LOOK", {"cpu": look})
        net = network(windows)
        found.append((train(net, windows, held_out, config, folder=tmp_path / str(look)), net))
    (one, first), (other, second) = found
    assert (one.train, one.held_out, one.best) == (other.train, other.held_out, other.best)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


class Clock:
    """Seconds that pass as batches are read: from a point on each takes four times as long."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, slow_from: float = math.inf) -> None:
        self.now, self.slow_from = 100.0, slow_from
        monkeypatch.setattr(module, "monotonic", lambda: self.now)

    def timed(self, windows: TensorWindows) -> TensorWindows:
        clock = self

        class Timed(TensorWindows):
            def batches(self, size: int, seed: int | None) -> Iterator[dict[str, torch.Tensor]]:
                for batch in super().batches(size, seed):
                    clock.now += 4.0 if clock.now - 100 > clock.slow_from else 1.0
                    yield batch

        return Timed(windows.tensors)


def rates_of(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Step sizes as they are set."""
    said: list[float] = []
    rate = module._Run.rate
    monkeypatch.setattr(module._Run, "rate", lambda run: said.append(rate(run)) or said[-1])
    return said


@pytest.mark.parametrize("slow_from", [math.inf, 20.0])
def test_a_budget_is_used_up_and_the_step_size_ends_with_it(monkeypatch: pytest.MonkeyPatch, slow_from: float) -> None:
    windows, held_out = linear_windows(1000).split(0.1)
    clock, rates = Clock(monkeypatch, slow_from), rates_of(monkeypatch)
    out = train(network(windows), clock.timed(windows), held_out, replace(QUICK, epochs=100, budget=60, warmup=0))
    assert out.stopped == "budget"
    assert 60 <= out.seconds < 60 + 4
    steps = 60 if slow_from == math.inf else 30  # 20 fast ones, then ten of four seconds
    assert len(rates) == steps
    assert len(out.train) == len(out.held_out) == math.ceil(steps / 15)  # the last epoch counts as far as it came
    assert rates == sorted(rates, reverse=True)
    assert rates[0] == pytest.approx(QUICK.rate)
    assert rates[-1] < 0.05 * QUICK.rate
    half = next(i for i, r in enumerate(rates) if r <= QUICK.rate / 2 * (1 + 1e-9))
    assert half == (30 if slow_from == math.inf else 23)  # at half of the seconds, not of the steps


def test_where_epochs_end_first_a_budget_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    windows, held_out = linear_windows(300).split(0.1)
    free, bound = network(windows), network(windows)
    expected = train(free, windows, held_out, QUICK)
    clock = Clock(monkeypatch)
    out = train(bound, clock.timed(windows), held_out, replace(QUICK, budget=1000))
    assert out.stopped == "epochs"
    assert out.held_out == expected.held_out


def test_a_budget_counts_the_time_before_an_interruption(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    windows, held_out = linear_windows(1000).split(0.1)
    clock = Clock(monkeypatch)
    config = replace(QUICK, epochs=100, budget=60, save_every=0.0)
    with pytest.raises(KeyboardInterrupt):  # reading the scales took one of the forty that were read
        train(network(windows), killed(clock.timed(windows), 41), held_out, config, folder=tmp_path)
    clock.now += 10_000  # until somebody looked
    out = train(network(windows), clock.timed(windows), held_out, config, folder=tmp_path)
    assert out.stopped == "budget"
    assert 60 <= out.seconds < 62
    with pytest.raises(InputError, match="of another run"):
        train(network(windows), windows, held_out, replace(config, budget=70), folder=tmp_path)


@pytest.mark.parametrize("budget", [-1.0, math.inf, math.nan])
def test_a_budget_that_is_none_is_refused(budget: float) -> None:
    with pytest.raises(InputError, match="training: budget is"):
        TrainConfig(budget=budget)


def test_on_a_processor_work_is_done_each_time_and_windows_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu, done = torch.device("cpu"), torch.zeros(())
    graphs = Graphs(cpu)

    def count(batch: dict[str, torch.Tensor]) -> None:
        done.add_(batch["x"].sum())

    for k in range(6):
        graphs(count, {"x": torch.full((2,), float(k))})
    assert done == 2 * sum(range(6))
    windows = motion_windows(20)
    assert resident(windows, cpu) is windows


def test_stored_windows_are_held_with_noise_like_their_own() -> None:
    whole = motion_windows(50).tensors

    class Stored:
        manifest = SimpleNamespace(state_noise=(0.0, 0.2), environment="toy", seed=0, settings={})
        names = tuple(whole)

        def __len__(self) -> int:
            return 50

        def batches(self, size, seed, rows, names, noise):  # type: ignore[no-untyped-def]
            order = np.random.default_rng(seed).permutation(rows)
            for i in range(0, len(order), size):
                batch = {n: whole[n][order[i : i + size]].numpy().copy() for n in names}
                batch["states"] += noise * np.float32(0.2) * np.array([0, 1], np.float32)  # would be seen
                yield batch

    stored = StoredWindows(Stored(), np.arange(10, 40), noise=0.5)
    held = stored.held("cpu")
    assert len(held) == 30
    assert held.told == stored.told
    order = [int((whole["psi"] == u).all(1).nonzero()[0, 0]) for u in held.tensors["psi"]]
    assert sorted(order) == list(range(10, 40))
    for name, tensor in held.tensors.items():
        assert torch.equal(tensor, whole[name][order])
    added = next(held.batches(30, None))["states"] - held.tensors["states"]
    assert (added[..., 0] == 0).all()
    assert float(added[..., 1].std()) == pytest.approx(0.1, rel=0.2)


@CUDA
@pytest.mark.parametrize(
    "config", [{"density": "score", "summaries": True}, {"density": "mixture"}, {"density": "flow"}]
)
def test_replayed_steps_are_those_that_are_told_kernel_by_kernel(config: dict[str, object]) -> None:
    windows, held_out = motion_windows(1000).split(0.1)
    found = []
    for graph in (True, False):
        net = network(windows, **config)
        training = replace(QUICK, epochs=8, graph=graph, mixed=False)
        run = module._Run(net, windows, held_out, training, torch.device("cuda"))
        with seeded(0):
            run.loop(None, module.quiet)
        assert not run.graphs.waiting
        assert bool(run.graphs._captured) == graph
        found.append(run.outcome)
    assert found[0].train == pytest.approx(found[1].train, rel=1e-3)
    assert found[0].held_out == pytest.approx(found[1].held_out, rel=1e-3)


@CUDA
def test_what_goes_on_in_the_middle_of_an_epoch_ends_as_an_unbroken_run(tmp_path: Path) -> None:
    """Both runs replay: the second captures its own graphs, from where the first one's state was saved.

    On a processor, see `test_a_killed_run_ends_as_an_unbroken_one`.
    """
    windows, held_out = linear_windows(2200).split(0.1)
    config, device = replace(QUICK, epochs=4, save_every=0.0, mixed=False), "cuda"
    whole, again = network(windows), network(windows, seed=5)
    expected = train(whole, windows, held_out, config, device=device)
    at = 1 + 31 + 25  # the scales, an epoch, and most of another
    with pytest.raises(KeyboardInterrupt):
        train(network(windows), killed(windows, at), held_out, config, folder=tmp_path, device=device)
    out = train(again, windows, held_out, config, folder=tmp_path, device=device)
    assert out.train == pytest.approx(expected.train, rel=1e-6)
    for name, tensor in whole.state_dict().items():
        torch.testing.assert_close(tensor, again.state_dict()[name], msg=name)


@CUDA
def test_work_that_waits_is_called_each_time() -> None:
    graphs, done = Graphs(torch.device("cuda")), torch.zeros((), device="cuda")

    def asks(batch: dict[str, torch.Tensor]) -> None:
        done.add_(float(batch["x"].sum()))

    for k in range(8):
        graphs(asks, {"x": torch.full((2,), float(k), device="cuda")})
    assert done == 2 * sum(range(8))
    assert graphs.waiting == {"asks"}
