"""Two cases of their own: a Jackal that lost an axle, and sequential rounds against one."""

from typing import Any

import numpy as np
import torch

from nfc_gym.core.fidelity import Fidelity
from nfc_gym.inference.config import Sizes
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.random import mixed
from nfc_gym.inference.sequential import SequentialConfig, sequential
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig, train
from nfc_gym.simulate import Simulator
from nfc_gym.simulate.machine import Machine
from posteriors import metrics
from posteriors.fitted import Ours
from posteriors.methods import METHODS, OURS, network_config

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


def rounds(
    env: str, prior: PriorBox, truth: int, size: int, training: TrainConfig, small: bool, jobs: int,
    device: torch.device,
) -> dict[str, Any]:  # fmt: skip
    """One truth: two rounds of `size` simulations against one of twice as many; gain of the true psi, nats a parameter.

    The two of them draw their simulations apart, with seeds of their own.
    """
    simulate = Simulator(env, effects=0, jobs=jobs, names=("states", "actions"))
    rng = np.random.default_rng([3, truth])
    psi = prior.psi_of(rng.uniform(size=(1, len(prior))))
    seen = simulate(psi, rng)
    window = Window(seen["states"][0].numpy(), seen["actions"][0].numpy())
    config = network_config(METHODS[OURS], "summaries", small)
    sizes = Sizes.of(seen, place=place_of(Machine(env).state_names))

    def gain(given: NeuralPosterior) -> float:
        return float(given.log_prob(Fidelity(psi))[0] + prior.log_volume) / prior.size

    how = SequentialConfig(rounds=2, simulations=size, narrows=-np.inf, seed=mixed(truth, 2))
    two = sequential(Network(config, sizes, prior, truth), simulate, window, how, training, device=device)
    alone = np.random.default_rng([4, truth])
    u = alone.uniform(size=(2 * size, len(prior)))
    batch = dict(simulate(prior.psi_of(u), alone)) | {"psi": torch.as_tensor(u, dtype=torch.float32)}
    one = Network(config, sizes, prior, truth)
    train(one, *TensorWindows(batch).split(how.held_out), training, device=device)
    return {"two": gain(two.posterior), "one": gain(NeuralPosterior(one).given(window)), "kept": two.kept}


def summed(found: list[dict[str, Any]]) -> dict[str, Any]:
    """The truths together."""
    two, one = (np.array([f[k] for f in found]) for k in ("two", "one"))
    return {
        "truths": len(found),
        "two rounds, gain a parameter": metrics.mean(two),
        "one round of twice as many": metrics.mean(one),
        "two less one": metrics.mean(two - one),
    }
