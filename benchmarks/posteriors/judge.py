"""What is reported of a posterior on windows that it was not trained on."""

import math
from typing import Any

import numpy as np
import torch

from nfc_gym.inference.space import PriorBox
from posteriors import metrics
from posteriors.fitted import Fitted
from posteriors.sets import Held

LEVELS = (0.5, 0.9, 0.95)


def groups(names: tuple[str, ...]) -> dict[str, list[int]]:
    """Parameters of one kind, by the last word of their names: mass, damping, friction, ..."""
    out: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        out.setdefault(name.rsplit("_", 1)[-1], []).append(i)
    return out


def judge(fitted: Fitted, judges: Held, prior: PriorBox, samples: int, most: int | None = None) -> dict[str, Any]:
    """Figures as plain values, each (mean, standard error over windows) unless it says otherwise.

    Args:
      fitted: what is judged.
      judges: windows that nothing was trained on; every method sees the same noise.
      prior: psi's box.
      samples: draws a window.
      most: windows that are looked at; default all.
    """
    batch = {k: t[:most] for k, t in judges.noisy().items()}
    free = np.array(prior.free)
    names = tuple(n for n, f in zip(prior.names, free, strict=True) if f)
    truth = batch["psi"].double().cpu().numpy()[:, free]
    clean = batch["family"].cpu().numpy() == 0  # windows without an effect, which the ceiling is of
    gain = fitted.gain(batch).cpu().numpy()
    draws = fitted.draws(batch, samples, seed=0).cpu().numpy()
    own = metrics.marginal_gain(draws, truth)
    d = len(names)
    rank, near = metrics.ranks(draws, truth), metrics.tarp(draws, truth, np.random.default_rng(0))
    halves = metrics.halved(draws)
    ends = {level: metrics.shortest(*halves, level) for level in LEVELS}
    low, high = ends[0.9]
    return {
        "windows": len(truth),
        "samples": samples,
        "gain": metrics.mean(gain / d),
        "gains": [round(float(g) / d, 5) for g in gain],  # of each window: methods are compared window by window
        "gain_without_effect": metrics.mean(gain[clean] / d),
        "log_posterior": metrics.mean(gain - d * math.log(2)),
        "worst": float(gain.min() / d),
        "marginal": {name: metrics.mean(own[clean][:, at].mean(1)) for name, at in groups(names).items()},
        "coverage": {str(level): metrics.mean(metrics.held(*ends[level], truth)) for level in LEVELS},
        "width": metrics.mean((high - low).mean(1)),
        "ranks": max(metrics.farthest(rank[:, i]) for i in range(d)),
        "tarp": metrics.farthest(near),
        "distance_95": critical(len(truth)),
    }


def critical(n: int, tests: int = 1) -> float:
    """Distance from uniform that n right numbers exceed in one of twenty cases, for the worst of some tests."""
    return math.sqrt(-math.log(0.05 / tests / 2) / (2 * n))


@torch.no_grad()
def latency(fitted: Fitted, judges: Held, turns: int = 20) -> float:
    """Median milliseconds from one window to 100 draws of psi."""
    from statistics import median
    from time import perf_counter

    one = {k: t[:1] for k, t in judges.noisy().items()}
    device, seconds = one["psi"].device, []
    for turn in range(turns + 2):
        if device.type == "cuda":
            torch.cuda.synchronize()
        began = perf_counter()
        fitted.draws(one, 100, turn).cpu()
        seconds.append(perf_counter() - began)
        if sum(seconds) > 10 and len(seconds) > 3:
            break
    return 1e3 * median(seconds[2:])
