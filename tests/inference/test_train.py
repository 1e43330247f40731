"""The training loop: it learns what is known in closed form, goes on after a kill, and keeps what was good."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from problems import box, gaussian, killed, linear_windows, mix, motion_windows, network
from safetensors.torch import save_file

from nfc_gym.core import InputError
from nfc_gym.inference.config import NetworkConfig
from nfc_gym.inference.data import StoredWindows, TensorWindows
from nfc_gym.inference.progress import Quiet
from nfc_gym.inference.state import read
from nfc_gym.inference.train import TrainConfig, train

QUICK = TrainConfig(epochs=4, batch=64, rate=2e-3, warmup=10, average=0.98)


def divergence_from_truth(net: torch.nn.Module, size: int) -> float:
    """Mean of log p - log q over pairs, nats: KL of the network's posterior from the exact one."""
    x = linear_windows(50, size, seed=9).tensors["states"][:, 0]
    exact = gaussian(x)
    z = exact.sample((20,)).transpose(0, 1).contiguous()
    with torch.no_grad():
        kept = net.encode(x[:, None], torch.zeros(50, 0, 0))  # type: ignore[operator]
        return float((exact.log_prob(z.transpose(0, 1)).T - net.log_prob(z, kept)).mean())  # type: ignore[operator]


@pytest.mark.parametrize("density", ["score", "mixture", "flow"])
def test_each_density_learns_the_posterior_of_a_linear_gaussian(density: str) -> None:
    every = linear_windows(4000)
    windows, held_out = every.split(0.1)
    net = network(windows, density=density, components=1, depth=2, draws=2)
    before = divergence_from_truth(net, 3)
    out = train(net, windows, held_out, replace(QUICK, epochs=9, batch=128, rate=5e-3))
    after = divergence_from_truth(net, 3)
    assert after < 0.15 * before
    assert after < 0.12
    assert out.held_out[out.best - 1] < out.start


@pytest.mark.parametrize(
    ("density", "linear"), [("score", False), ("score", True), ("mixture", False), ("flow", False)]
)
def test_what_a_window_cannot_show_comes_back_as_wide_as_the_prior(density: str, linear: bool) -> None:
    """Of three parameters the second moves nothing: trained, all else is told and it is N(0, 1) in z, its prior."""
    a = mix(3)
    a[:, 1] = 0
    every = linear_windows(4000, a=a)
    net = network(every, density=density, components=1, draws=2, linear=linear)
    train(net, *every.split(0.1), replace(QUICK, epochs=9, batch=128, rate=5e-3))
    x = linear_windows(10, seed=9, a=a).tensors["states"]
    with torch.no_grad():
        z = net.sample(2000, net.encode(x, torch.zeros(10, 0, 0)))
    told = gaussian(x[:, 0], a)
    assert told.stddev[0, 1] == pytest.approx(1.0)
    assert told.stddev[0, [0, 2]].max() < 0.5
    torch.testing.assert_close(z.std(1).mean(0), told.stddev[0], rtol=0.1, atol=0.02)
    assert z[..., 1].mean(1).abs().max() < 0.2  # what moves the others does not move it


def test_on_the_linear_base_it_is_the_closed_form() -> None:
    every = linear_windows(4000)
    net = network(every, linear=True)
    train(net, *every.split(0.1), replace(QUICK, epochs=2))
    assert abs(divergence_from_truth(net, 3)) < 0.02  # 18 coefficients and covariances from 4000 pairs: 0.003 nats


def test_a_killed_run_ends_as_an_unbroken_one(tmp_path: Path) -> None:
    windows, held_out = linear_windows(1000).split(0.1)
    config = replace(QUICK, save_every=0.0)  # a state after every step
    whole = network(windows, dropout=0.1)
    expected = train(whole, windows, held_out, config)
    broken = network(windows, dropout=0.1)
    with pytest.raises(KeyboardInterrupt):
        train(broken, killed(windows, 27), held_out, config, folder=tmp_path)
    again = network(windows, dropout=0.1, seed=5)  # a new process: weights of its own
    out = train(again, windows, held_out, config, folder=tmp_path)
    assert (out.train, out.held_out, out.best) == (expected.train, expected.held_out, expected.best)
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, again.state_dict()[name]), name
    finished = train(network(windows, dropout=0.1), windows, held_out, config, folder=tmp_path)
    assert finished.held_out == out.held_out  # nothing is left to do


def test_a_state_of_something_else_is_refused(tmp_path: Path) -> None:
    windows, held_out = linear_windows(300).split(0.1)
    train(network(windows), windows, held_out, replace(QUICK, epochs=1), folder=tmp_path)
    with pytest.raises(InputError, match=r"of another run \(epochs 1, now \d+\)"):
        train(network(windows), windows, held_out, QUICK, folder=tmp_path)
    file = tmp_path / "training.safetensors"
    file.write_bytes(file.read_bytes()[:-1000])
    with pytest.raises(InputError, match="truncated"):
        train(network(windows), windows, held_out, replace(QUICK, epochs=1), folder=tmp_path)


@pytest.mark.parametrize(
    "change", [{"step": None}, {"step": -1}, {"of": []}, {"outcome": None}, {"outcome": {"best": 1, "odd": 2}},
               {"loss_sum": "x"}],
)  # fmt: skip
def test_a_damaged_state_says_what_to_do(tmp_path: Path, change: dict[str, object]) -> None:
    windows, once = motion_windows(32), TrainConfig(epochs=1, batch=16)
    train(network(windows), *windows.split(0.1), once, folder=tmp_path)
    file = tmp_path / "training.safetensors"
    tensors, metadata = read(file)
    plain = json.loads(metadata["state"])
    for state in (plain | change, {k: v for k, v in plain.items() if k not in change}):
        save_file(tensors, file, {**metadata, "state": json.dumps(state)})
        with pytest.raises(InputError, match=r"training\.safetensors: damaged.*: remove it to train anew"):
            train(network(windows), *windows.split(0.1), once, folder=tmp_path)


def test_a_state_of_other_windows_of_the_same_sizes_is_refused(tmp_path: Path) -> None:
    once = replace(QUICK, epochs=1)
    windows, held_out = motion_windows(200).split(0.1)
    done = train(network(windows), windows, held_out, once, folder=tmp_path)
    assert train(network(windows), windows, held_out, once, folder=tmp_path).held_out == done.held_out
    others = motion_windows(200, seed=1).split(0.1)
    with pytest.raises(InputError, match=r"is of another run \(contents of the windows '\w{16}', now '\w{16}'\)"):
        train(network(windows), *others, once, folder=tmp_path)
    named = [TensorWindows(w.tensors, told={"seed": 1}) for w in others]  # who says what they are is believed
    train(network(windows), *named, once, folder=tmp_path / "named")
    train(network(windows), *(TensorWindows(w.tensors, told={"seed": 1}) for w in (windows, held_out)), once,
          folder=tmp_path / "named")  # fmt: skip


def test_a_state_of_windows_of_another_length_is_refused(tmp_path: Path) -> None:
    once, told = replace(QUICK, epochs=1), {"seed": 1}
    whole = motion_windows(200).tensors
    short = {**whole, "states": whole["states"][:, 2:], "actions": whole["actions"][:, 2:]}
    windows, held_out = TensorWindows(whole, told=told).split(0.1)
    train(network(windows), windows, held_out, once, folder=tmp_path)
    windows, held_out = TensorWindows(short, told=told).split(0.1)
    with pytest.raises(InputError, match="is of windows of other sizes: remove it to train anew"):
        train(network(windows), windows, held_out, once, folder=tmp_path)


def test_numbers_of_other_kinds_are_taken_as_float32() -> None:
    single = motion_windows(100)
    double = TensorWindows({k: t.double() if t.is_floating_point() else t for k, t in single.tensors.items()})
    arrays = TensorWindows({k: t.numpy() for k, t in single.tensors.items()})  # type: ignore[misc]
    expected = train(network(single), *single.split(0.2), replace(QUICK, epochs=1))
    for other in (double, arrays):
        assert other.contents == single.contents
        assert train(network(other), *other.split(0.2), replace(QUICK, epochs=1)).held_out == expected.held_out
    assert all(TensorWindows(single.tensors).tensors[k] is t for k, t in single.tensors.items())  # nothing is copied


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"epochs": 1.5}, r"training: epochs is 1\.5, want a whole number, 1 or more"),
        ({"batch": True}, "training: batch is True, want a whole number"),
        ({"seed": -1}, "training: seed is -1, want a whole number, 0 or more"),
        ({"warmup": -1}, "training: warmup is -1"),
        ({"clip": 0.0}, "training: clip above 0 and decay 0 or more, got 0, 0.0001"),
        ({"decay": -1.0}, "training: clip above 0 and decay 0 or more, got 1, -1"),
        ({"rate": float("nan")}, "training: rate in"),
    ],
)
def test_settings_that_would_not_train_are_refused(change: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        TrainConfig(**change)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"width": 0}, "network: width is 0, want a whole number, 1 or more"),
        ({"hidden": 1.5}, r"network: hidden is 1\.5, want a whole number"),
        ({"features": -1}, "network: features is -1, want a whole number, 0 or more"),
        ({"dropout": 1.0}, r"network: dropout is a share in \[0, 1\), got 1"),
        ({"families": "none"}, "families is a tuple of names, got 'none'"),
        ({"families": ("none", "drag", "drag")}, "families named twice: none, drag, drag"),
    ],
)
def test_networks_that_cannot_be_are_refused(change: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        NetworkConfig(**change)  # type: ignore[arg-type]


def test_a_run_that_diverges_keeps_its_last_good_weights() -> None:
    class Poisoned(TensorWindows):
        """From the third epoch on, its states are beyond float32's squares."""

        epochs = 0

        def batches(self, size: int, seed: int | None) -> Iterator[dict[str, torch.Tensor]]:
            Poisoned.epochs += 1
            for batch in super().batches(size, seed):
                yield {**batch, "delta_s": batch["delta_s"] * (torch.inf if Poisoned.epochs > 3 else 1)}

    said: list[str] = []

    class Heard(Quiet):
        def message(self, text: str) -> None:
            said.append(text)

    windows, held_out = motion_windows(400).split(0.2)
    net = network(windows, delta_s=True, density="mixture")
    out = train(net, Poisoned(windows.tensors), held_out, QUICK, report=Heard())
    assert out.stopped == "diverged"
    assert len(out.train) == 2  # the first pass over the windows took the scales
    assert "diverged" in said[-1]
    assert f"epoch {out.best} are kept" in said[-1]
    assert all(torch.isfinite(t).all() for t in net.state_dict().values())
    assert out.best > 0
    with torch.no_grad():  # a mixture's loss has no noise: these are the weights of the best epoch
        assert float(net.losses(held_out.tensors)["density"]) == pytest.approx(out.held_out[out.best - 1], rel=1e-5)


def test_it_stops_where_nothing_more_generalises() -> None:
    windows, held_out = linear_windows(60).split(0.5)
    out = train(network(windows), windows, held_out, TrainConfig(epochs=500, batch=30, rate=2e-2, warmup=1, patience=5,
                                                                 average=0.5))  # fmt: skip
    assert out.stopped == "patience"
    assert len(out.train) - out.best == 5
    assert min([out.start, *out.held_out]) == ([out.start, *out.held_out][out.best])


def test_all_heads_learn_together() -> None:
    every = motion_windows(3000)
    windows, held_out = every.split(0.2)
    net = network(windows, summaries=True, delta_s=True, families=("none", "force"))
    before = {k: float(v.detach()) for k, v in net.losses(held_out.tensors).items()}
    train(net, windows, held_out, replace(QUICK, epochs=8, rate=5e-3))
    after = {k: float(v.detach()) for k, v in net.losses(held_out.tensors).items()}
    assert set(before) == {"density", "structure"}
    assert after["density"] < 0.9 * before["density"]
    assert after["structure"] < 0.6


@pytest.mark.parametrize("encoder", ["tcn", "qmc-rff", "qmc-fks"])
def test_mixed_precision_loses_little_and_the_base_nothing(encoder: str) -> None:
    t = motion_windows(300).tensors
    net = network(TensorWindows(t), encoder=encoder, summaries=True, linear=True)
    exact, expected = net.encode(t["states"], t["actions"]), net.losses(t)
    with torch.autocast("cpu", torch.bfloat16):
        rough = net.encode(t["states"], t["actions"])
        torch.manual_seed(0)
        losses = net.losses(t)
    torch.testing.assert_close(rough.mean, exact.mean)
    assert (rough.features - exact.features).abs().mean() < 0.02 * exact.features.abs().mean()
    assert float(losses["density"].detach()) == pytest.approx(float(expected["density"].detach()), rel=0.1)


def test_no_memory_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    windows, held_out = linear_windows(300).split(0.2)
    net = network(windows)

    def full(batch: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    net.losses = full  # type: ignore[method-assign]
    with pytest.raises(InputError, match=r"no memory for 64 windows a step on cpu: use batch=32; it goes on from"):
        train(net, windows, held_out, QUICK, folder=tmp_path)


def test_bad_windows_are_refused() -> None:
    good = motion_windows(50)
    net = network(good, delta_s=True)
    for change, message in (
        ({"psi": good.tensors["psi"] + 1}, r"in \[0, 1\]"),
        ({"states": good.tensors["states"] * torch.nan}, "states holds NaN"),
        ({"states": good.tensors["states"][:, :5]}, r"H \+ 1 states go with H actions, got 5 and 10"),
        ({"family": good.tensors["family"][:7]}, "different numbers"),
    ):
        with pytest.raises(InputError, match=message):
            TensorWindows({**good.tensors, **change})
    short = {**good.tensors, "states": good.tensors["states"][:, :5], "actions": good.tensors["actions"][:, :4]}
    with pytest.raises(InputError, match="horizon is 4, the network's is 10"):
        train(net, TensorWindows(short), good)
    without = {k: v for k, v in good.tensors.items() if k != "delta_s"}
    with pytest.raises(InputError, match="needs 'delta_s'"):
        train(net, TensorWindows(without), good)
    with pytest.raises(InputError, match="psi has 2 entries; the prior of 'toy' has 3"):
        network(good, box(3))
    with pytest.raises(InputError, match="held out"):
        train(net, good, StoredWindows(Stored(good), rows=good.tensors["family"][:0].numpy()))


class Stored:
    """A stored set: numpy batches of the rows asked for."""

    def __init__(self, windows: TensorWindows) -> None:
        self.arrays = {k: t.numpy() for k, t in windows.tensors.items()}
        self.names, self.manifest = (*self.arrays, "pose"), {"robot": "toy"}

    def __len__(self) -> int:
        return len(self.arrays["psi"])

    def batches(self, size, seed, rows, names, noise):
        order = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed % 2**60)).numpy()]
        for i in range(0, len(order), size):
            yield {n: self.arrays[n][order[i : i + size]] for n in names}


def test_windows_in_any_layout_are_the_same() -> None:
    plain = {k: t.numpy() for k, t in motion_windows(8).tensors.items()}
    for made in (lambda x: x[::-1].copy()[::-1], lambda x: x.astype(x.dtype.newbyteorder(">"))):
        found = TensorWindows({k: made(x) for k, x in plain.items()})
        for name, x in plain.items():
            np.testing.assert_array_equal(found.tensors[name].numpy(), x)
    with pytest.raises(InputError, match="windows: psi must be an array of numbers"):
        TensorWindows({**plain, "psi": [["a", "b"]] * 8})


@pytest.mark.parametrize("share", [1.0, 2.0, -0.5, float("nan")])
def test_a_share_that_leaves_nothing_is_refused(share: float) -> None:
    with pytest.raises(InputError, match=r"the share held out|none is left to train on"):
        motion_windows(8).split(share)


@pytest.mark.parametrize("family", [-1, 2])
def test_a_family_that_the_network_has_not_is_refused(family: int) -> None:
    windows = motion_windows(32)
    net = network(windows, families=("none", "push"), density="mixture")
    tensors = {**windows.tensors, "family": torch.full((32,), family)}
    with pytest.raises(InputError, match=f"family {family}, and the network has 2, 0 to 1: none, push"):
        train(net, *TensorWindows(tensors).split(0.1), TrainConfig(epochs=1))


def test_stored_maps_are_read_where_they_are_asked_for() -> None:
    seen = torch.randn(8, 128, 128)
    stored = Stored(motion_windows(8, map=seen, delta_e=0.1 * seen))
    (batch,) = StoredWindows(stored, maps=True).batches(8, None)
    torch.testing.assert_close(batch["delta_e"], 0.1 * batch["map"])
    assert not {"map", "delta_e"} & set(next(StoredWindows(stored).batches(8, None)))
    with pytest.raises(InputError, match="the set holds no maps"):
        StoredWindows(Stored(motion_windows(8)), maps=True)


def test_windows_on_disk_train_as_those_in_memory_do() -> None:
    stored = StoredWindows(Stored(motion_windows(500)))
    windows, held_out = stored.split(0.2)
    assert (len(windows), len(held_out), windows.manifest["robot"]) == (400, 100, "toy")
    net = network(motion_windows(500), delta_s=True)
    out = train(net, windows, held_out, replace(QUICK, epochs=3))
    assert out.held_out[-1] < out.start


def test_noise_is_drawn_anew_in_each_pass_and_is_the_same_for_a_seed() -> None:
    windows = motion_windows(40)
    noise = torch.zeros(11, 2)
    noise[1:, 0] = 0.1
    noisy = TensorWindows(windows.tensors, noise=noise)
    clean, one, again, other = (
        next(w.batches(40, s))["states"] for w, s in ((windows, 3), (noisy, 3), (noisy, 3), (noisy, 4))
    )
    assert torch.equal(one, again)
    added = one - clean
    assert (added[:, 0] == 0).all()
    assert (added[:, :, 1] == 0).all()
    assert 0.08 < added[:, 1:, 0].std() < 0.12
    order = next(windows.batches(40, 4))["states"]
    assert not torch.equal(other - order, added)
    first, last = noisy.split(0.25)
    assert first.noise is last.noise is first.append(last).noise is noise
    assert not torch.equal(next(first.batches(5, None))["states"], first.tensors["states"][:5])
