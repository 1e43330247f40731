"""The residual heads: delta_s, delta_e and the structure head of one network, on windows that it was not trained on."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Report
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.windows import Windows
from nfc_gym.simulate.ceiling import replayed
from nfc_gym.simulate.machine import MOTOR, Machine
from posteriors import metrics
from posteriors.fit import Plan, fit_network
from posteriors.methods import METHODS, OURS, network_config
from posteriors.sets import Sets

Array = NDArray[np.float64]
SIZES = ((0, 2), (2, 5), (5, np.inf))  # of X / X_null
_REPLAYS = 16


def heads(
    env: str, sets: Sets, prior: PriorBox, plan: Plan, folder: Path, device: torch.device, samples: int, few: int,
    report: Report,
) -> tuple[Network, dict[str, Any]]:  # fmt: skip
    """Train SDE + TCN with all heads, or without delta_e where the windows have no maps, and what is measured of them.

    Args:
      env: its id.
      sets: windows, part of them with effects; on flat ground delta_e is the camera's error.
      prior, plan, folder, device, report: see `fit`.
      samples: draws a window.
      few: windows that are replayed, or whose maps are drawn.
    """
    judged, batch = sets.judged, sets.judges.noisy()
    config = replace(
        network_config(METHODS[OURS], "map" if sets.maps else "window", plan.small),
        delta_s=True, delta_e=sets.maps, families=tuple(judged.manifest.families), draws=1 if plan.small else 4,
    )  # fmt: skip
    done = fit_network(config, sets.windows, prior, plan, 0, folder, device, report)
    network = done.fitted.network
    trained = done.outcome
    out: dict[str, Any] = {"seconds": trained.seconds, "epochs": len(trained.held_out), "best": trained.best}
    out |= dynamics(network, batch, samples)
    sizes = strengths(env, judged, batch, len(judged) if few >= len(judged) else 4 * few)
    out |= structure(network, batch, sizes)
    out |= replays(env, network, judged, batch, few)
    if sets.maps:
        out |= terrain(network, batch, min(samples, 64), few)
    return network, out


@torch.no_grad()
def dynamics(network: Network, batch: dict[str, torch.Tensor], samples: int) -> dict[str, Any]:
    """Energy score of delta_s on the scale that training sees, against a normal with the draws' mean and covariance."""
    scores, normal, prior = [], [], []
    rng = np.random.default_rng(0)
    varies = network.varies.cpu().numpy()
    scaled = network.delta_scale(batch["delta_s"]).double().cpu().numpy()[:, varies]
    for at in range(0, len(scaled), 32):
        part = {k: t[at : at + 32] for k, t in batch.items()}
        given = network.encode(part["states"], part["actions"], part.get("map"))
        with torch.random.fork_rng():
            torch.manual_seed(at)
            y = network.sample(samples, given, 2)[..., network.prior.size :]
        drawn, truth = y.double().cpu().numpy()[..., varies], scaled[at : at + 32]
        scores.append(metrics.energy_score(drawn, truth))
        normal.append(metrics.energy_score(metrics.normal_like(drawn, samples, rng), truth))
        anyone = scaled[rng.integers(len(scaled), size=(len(truth), samples))]
        prior.append(metrics.energy_score(anyone, truth))
    score, bell, before = (np.concatenate(s) for s in (scores, normal, prior))
    return {
        "delta_s: energy score": metrics.mean(score),
        "delta_s: of a normal with the draws' mean and covariance": metrics.mean(bell),
        "delta_s: ours less the normal's": metrics.mean(score - bell),
        "delta_s: ours less that of other windows' delta_s (the prior)": metrics.mean(score - before),
    }


def strengths(env: str, judged: Windows, batch: dict[str, torch.Tensor], most: int) -> Array:
    """(windows,) X: mean square error, whitened, of a replay under the true psi without the effect; nan where not made.

    Whitened by the sensors' noise and by what the motors' noise spreads, so that it is near 1 without an effect.
    """
    machine, rng = Machine(env), np.random.default_rng(0)
    told = machine.noise > 0
    states = batch["states"].double().cpu().numpy()
    out = np.full(len(judged), np.nan)
    for i in range(min(most, len(judged))):
        one = judged.take(np.array([i]))
        h, a = one["actions"].shape[1:]
        jitter = MOTOR * rng.standard_normal((_REPLAYS, h, a))
        made = replayed(machine, one, np.repeat(one["psi"].astype(float), _REPLAYS, 0), jitter, 1)
        made = made.reshape(_REPLAYS, h, -1)[..., told]
        seen = np.array(states[i])
        seen[:, machine.angles] = np.unwrap(seen[:, machine.angles], axis=0)
        wrong = (seen[1:, told] - made.mean(0)) ** 2 / (
            machine.noise[told] ** 2 + made.var(0, ddof=1) * (1 + 1 / _REPLAYS)
        )
        out[i] = wrong.mean()
    return out


@torch.no_grad()
def structure(network: Network, batch: dict[str, torch.Tensor], x: Array) -> dict[str, Any]:
    """Area under the curve of 1 - P(none), effects against none, by X / X_null; X_null is the median without effect."""
    none = []
    for at in range(0, len(batch["psi"]), 256):
        part = {k: t[at : at + 256] for k, t in batch.items()}
        given = network.encode(part["states"], part["actions"], part.get("map"))
        none.append(network.structure(given.features)[:, 0].cpu().numpy())  # type: ignore[misc]
    score, family = 1 - np.concatenate(none), batch["family"].cpu().numpy()
    known = np.isfinite(x)
    null = np.median(x[known & (family == 0)]) if (known & (family == 0)).any() else np.nan
    out: dict[str, Any] = {
        "structure: area under the curve, all effects": metrics.area(score, family > 0),
        "structure: X_null": float(null),
    }
    for low, high in SIZES:
        chosen = known & ((family == 0) | ((x / null >= low) & (x / null < high)))
        count = int((family[chosen] > 0).sum())
        out[f"structure: area, X / X_null {low:g} to {high:g} ({count} windows with one)"] = metrics.area(
            score[chosen], family[chosen] > 0
        )
    return out


def replays(env: str, network: Network, judged: Windows, batch: dict[str, torch.Tensor], few: int) -> dict[str, Any]:
    """Error of the window replayed under draws of psi from its start, with their delta_s and without.

    Root mean square over states, steps and draws, in standard deviations of the sensors, against the states as they
    were. A draw's delta_s is added to the physical state after each control step; a draw that comes apart in either is
    left out of both, and a window of which none holds is counted.
    """
    machine = Machine(env)
    told = machine.noise > 0
    family = batch["family"].cpu().numpy()
    rng = np.random.default_rng(0)
    given = NeuralPosterior(network)
    pairs, means, scores, apart = [], [], [], 0
    for i in np.flatnonzero(family > 0)[:few]:
        part = {k: batch[k][i].cpu().numpy() for k in ("states", "actions", "map") if k in batch}
        of = given.given(Window(part["states"], part["actions"], part.get("map"))).of("psi", "delta_s")
        drawn = of.sample(_REPLAYS, rng)
        u = network.prior.u_of(np.asarray(drawn.psi))
        one = judged.take(np.array([i]))
        h, a = one["actions"].shape[1:]
        jitter = np.zeros((_REPLAYS, h, a))
        with np.errstate(all="ignore"):
            made = [replayed(machine, one, u, jitter, 1, d) for d in (None, np.asarray(drawn.delta_s))]
        truth = one["states"][0].astype(float)
        truth[:, machine.angles] = np.unwrap(truth[:, machine.angles], axis=0)
        off = [((m.reshape(_REPLAYS, h, -1) - truth[1:])[..., told] / machine.noise[told]) for m in made]
        fine = np.isfinite(off[0]).all((1, 2)) & np.isfinite(off[1]).all((1, 2))
        if fine.sum() < 2:
            apart += 1
            continue
        held = [o[fine] for o in off]
        pairs.append([np.sqrt((o**2).mean()) for o in held])
        means.append([np.sqrt((o.mean(0) ** 2).mean()) for o in held])
        flat = [o.reshape(1, len(o), -1) for o in held]
        scores.append([metrics.energy_score(f, np.zeros((1, f.shape[-1])))[0] for f in flat])
    if not pairs:
        raise InputError(f"{env}: no window with an effect can be replayed")
    without, with_ = np.array(pairs).T
    mean_without, mean_with = np.array(means).T
    score_without, score_with = np.array(scores).T
    return {
        "replay: error without delta_s [sd]": metrics.mean(without),
        "replay: error with sampled delta_s [sd]": metrics.mean(with_),
        "replay: log of with over without": metrics.mean(np.log(with_ / without)),
        "replay: log of with over without, of the draws' mean": metrics.mean(np.log(mean_with / mean_without)),
        "replay: log of with over without, energy score": metrics.mean(np.log(score_with / score_without)),
        "replay: windows left out": apart,
    }


@torch.no_grad()
def terrain(network: Network, batch: dict[str, torch.Tensor], samples: int, few: int) -> dict[str, Any]:
    """delta_e against a normal with the draws' mean and covariance, and power by octave of the wave number."""
    ours, normal, vario, vario_normal, drawn_power, true_power = [], [], [], [], [], []
    rng = np.random.default_rng(0)
    for i in range(min(few, len(batch["psi"]))):
        part = {k: t[i : i + 1] for k, t in batch.items()}
        maps = maps_of(network, part, samples, seed=i)[None]
        truth = part["delta_e"].double().cpu().numpy()
        flat = maps.reshape(1, samples, -1)
        bell = metrics.normal_like(flat, samples, rng)
        ours.append(metrics.energy_score(flat, truth.reshape(1, -1))[0])
        normal.append(metrics.energy_score(bell, truth.reshape(1, -1))[0])
        vario.append(metrics.variogram_score(maps, truth)[0])
        vario_normal.append(metrics.variogram_score(bell.reshape(maps.shape), truth)[0])
        drawn_power.append(metrics.spectrum(maps[0]).mean(0))
        true_power.append(metrics.spectrum(truth[0]))
    a, b, c, d = (np.array(v) for v in (ours, normal, vario, vario_normal))
    ratio = np.mean(drawn_power, 0) / np.maximum(np.mean(true_power, 0), 1e-300)
    return {
        "delta_e: energy score [m]": metrics.mean(a),
        "delta_e: less that of a normal with the draws' mean and covariance": metrics.mean(a - b),
        "delta_e: variogram score": metrics.mean(c),
        "delta_e: the same less the normal's": metrics.mean(c - d),
        "delta_e: power over the truth's by octave, longest first": [round(float(r), 3) for r in ratio],
        "delta_e: farthest from 1": float(np.abs(ratio - 1).max()),
    }


@torch.no_grad()
def maps_of(network: Network, part: dict[str, torch.Tensor], n: int, seed: int) -> Array:
    """(n, 128, 128) draws of delta_e [m] given one window."""
    given = network.encode(part["states"], part["actions"], part["map"])
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return network.sample_terrain(n, given)[1].double().cpu().numpy()
