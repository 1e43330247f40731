"""Two cases of their own: a Jackal that lost an axle, and sequential rounds against one."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray

from nfc_gym.core.fidelity import Fidelity
from nfc_gym.inference import checkpoint
from nfc_gym.inference.config import Sizes
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.network import Network
from nfc_gym.inference.normal import NormalPosterior
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.proposals import Believed, SequentialConfig
from nfc_gym.inference.random import mixed
from nfc_gym.inference.sequential import sequential
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig, train
from nfc_gym.simulate import Simulator, starts
from nfc_gym.simulate.ceiling import ceiling
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.refined import refined
from posteriors import metrics
from posteriors.fitted import Ours
from posteriors.methods import METHODS, OURS, network_config

FIRST, ONE = "first", "one"  # networks of the first round, and of one round of twice as many
HELD_OUT = 0.1  # of each round's windows
SAMPLES = 2000  # of a posterior, for its intervals
GROUND = ("terrain_kind", "terrain_seed", "terrain_difficulty")
REFINED = "refined"  # in place of a second round that trains, `simulate.refined`
# How a second round trains: see `SequentialConfig`.
WAYS = {
    "on": {}, "anew": {"anew": True}, "posterior": {"proposal": "posterior"},
    "anew posterior": {"anew": True, "proposal": "posterior"}, REFINED: {},
}  # fmt: skip
AXLE = "front_left_wheel_damping"  # the gain kv of its servo: 0 is a lost axle


def axle(network: Network, env: str, windows: int, samples: int, jobs: int) -> dict[str, Any]:
    """Jackals whose front-left servo has gain 0, all else drawn from the prior: what is told of that gain."""
    prior, rng = network.prior, np.random.default_rng(2)
    at = prior.names.index(AXLE)
    u = rng.uniform(size=(windows, len(prior)))
    u[:, at] = (0 - prior.low[at]) / (prior.high[at] - prior.low[at])
    batch = Simulator(env, effects=0, jobs=jobs)(prior.psi_of(u), rng)
    device = next(network.parameters()).device
    batch = {k: t.to(device) for k, t in batch.items()} | {"psi": torch.as_tensor(u, dtype=torch.float32).to(device)}
    draws = Ours(network).draws(batch, samples, seed=0).cpu().numpy()[..., at : at + 1]
    truth = u[:, at : at + 1]
    low, high = metrics.intervals(draws, 0.9)
    return {
        "windows": windows,
        "90 % interval holds the truth": metrics.mean(((low <= truth) & (truth <= high))[:, 0]),
        "its width over the prior's": metrics.mean((high - low)[:, 0]),
        "width under a quarter": metrics.mean((high - low)[:, 0] < 0.25),
        "median of the gain over the prior's highest": metrics.mean(np.median(draws, 1)[:, 0]),
    }


def before(
    env: str, prior: PriorBox, size: int, training: TrainConfig, small: bool, jobs: int, device: torch.device,
    folder: Path,
) -> None:  # fmt: skip
    """What all truths share: networks trained on `size` simulations from the prior and on twice as many, drawn apart.

    No round from the prior knows what was observed, so that it need not be made for each truth anew. What is in the
    folder already is not made again.
    """
    for name, count in ((FIRST, size), (ONE, 2 * size)):
        file = folder / f"{name}.safetensors"
        if file.is_file():
            continue
        rng = np.random.default_rng([4, count])
        batch = Simulator(env, effects=0, jobs=jobs, names=("states", "actions", "start")).draw(count, rng)
        config = network_config(METHODS[OURS], "summaries", small)
        network = Network(config, Sizes.of(batch, place=place_of(Machine(env).state_names)), prior, count)
        train(network, *TensorWindows(batch).split(HELD_OUT), training, device=device)
        folder.mkdir(parents=True, exist_ok=True)
        if name == FIRST:  # the second round learns from them too
            safetensors.torch.save_file(batch, folder / f"{name}_windows.safetensors")
        checkpoint.save(file, network)


def rounds(
    env: str, truth: int, size: int, training: TrainConfig, ways: Sequence[str], jobs: int, device: torch.device,
    folder: Path,
) -> dict[str, Any]:  # fmt: skip
    """One truth: two rounds of `size` simulations against one of twice as many; gain of the true psi, nats a parameter.

    `REFINED` begins with the first round too, and then simulates the window's own commands `size` times at most.

    Args:
      env: id.
      truth: its seed.
      size: simulations a round.
      training: of the second round.
      ways: of WAYS, in which it trains, each after the same first round.
      jobs: processes of the simulation.
      device: to train on.
      folder: what `before` wrote.
    """
    first, one = (checkpoint.load(folder / f"{name}.safetensors")[0].to(device) for name in (FIRST, ONE))
    known = safetensors.torch.load_file(folder / f"{FIRST}_windows.safetensors")
    begun = TensorWindows({k: t for k, t in known.items() if k != "start"})
    prior, rng = first.prior, np.random.default_rng([3, truth])
    simulate = Simulator(env, effects=0, jobs=jobs, names=("states", "actions"))
    psi = prior.psi_of(rng.uniform(size=(1, len(prior))))
    seen = replace(simulate, names=("states", "actions", "start", *GROUND))(psi, rng)
    window = Window(seen["states"][0].numpy(), seen["actions"][0].numpy())

    def gain(given: Believed | NormalPosterior) -> float:
        return float(given.log_prob(Fidelity(psi))[0] + prior.log_volume) / prior.size

    alone, once = gain(NeuralPosterior(one).given(window)), gain(NeuralPosterior(first).given(window))
    out: dict[str, Any] = {"one": alone, "first": once}
    for way in ways:
        if way == REFINED:
            own = refined(
                NeuralPosterior(first), window, environment=env, simulations=size, seed=mixed(truth, 2), jobs=jobs
            )
            out |= {way: gain(own)} | {f"{k} ({way})": v for k, v in _held(own, psi, rng).items()}
            continue
        how = SequentialConfig(2, size, narrows=-np.inf, held_out=HELD_OUT, seed=mixed(truth, 2), **WAYS[way])
        two = sequential(deepcopy(first), simulate, window, how, training, begun=begun, device=device, scales=False)
        out |= {way: gain(two.posterior), f"kept ({way})": two.kept[-1]}
    if REFINED in ways:
        asked = {k: t.numpy() for k, t in seen.items()} | {"psi": prior.u_of(psi)}
        most = ceiling(env, asked, before=starts.spread(Machine(env), {"start": known["start"].numpy()}))
        out["ceiling"] = float(most.joint[0]) / prior.size
    return out


def _held(own: NormalPosterior, psi: NDArray[np.float64], rng: np.random.Generator) -> dict[str, float]:
    """Share of the true parameters psi (1, d) that a posterior's 90 % intervals hold, and their mean width."""
    low, high = metrics.intervals(own.prior.u_of(np.asarray(own.sample(SAMPLES, rng).psi))[None], 0.9)
    u = own.prior.u_of(psi)
    return {"held": float(((low <= u) & (u <= high)).mean()), "width": float((high - low).mean())}


def summed(found: list[dict[str, Any]]) -> dict[str, Any]:
    """The truths together."""
    one, first = (np.array([f[k] for f in found]) for k in ("one", "first"))
    out = {
        "truths": len(found),
        "the first round alone, gain a parameter": metrics.mean(first),
        "one round of twice as many": metrics.mean(one),
    }
    for way in (w for w in WAYS if w in found[0]):
        two = np.array([f[way] for f in found])
        title = "the first round, refined" if way == REFINED else f"two rounds, trained {way}"
        out |= {title: metrics.mean(two), f"... less one ({way})": metrics.mean(two - one)}
        for name, said in {"held": "90 % interval holds the truth", "width": "its width over the prior's"}.items():
            if (key := f"{name} ({way})") in found[0]:
                out[f"... {said} ({way})"] = metrics.mean(np.array([f[key] for f in found]))
    if "ceiling" in found[0]:
        out["what these windows tell at most, gain a parameter"] = metrics.mean(np.array([f["ceiling"] for f in found]))
    return out
