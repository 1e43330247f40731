"""Box-constrained least squares of psi and effects' parameters on whitened residuals; Jacobians from batched runs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from nfc_gym.measured.metric import TURN, Metric, loss
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
# Steps of the differences, in scaled parameters. Contact makes residuals rough, and only a coarse step sees past that;
# the curved valleys of coupled parameters (a payload's mass and place) need a fine one. A fit goes from the first to
# the second.
COARSE, FINE = 1e-1, 2e-4
_PRIOR = 0.5  # of the prior's range: standard deviation of the weak pull towards nominal psi


@dataclass(frozen=True)
class Box:
    """Bounds, typical sizes and free entries of a full parameter vector (n,)."""

    low: Array
    high: Array
    scale: Array
    free: NDArray[np.bool_]
    centre: Array
    prior: Array


def box(plant: Plant) -> Box:
    """Bounds and scales of psi followed by every effect's parameters."""
    space = plant.space
    low, high = [space.low], [space.high]
    scale, free, prior = [(space.high - space.low) / 4], [space.free], [_PRIOR * (space.high - space.low)]
    for effect in plant.effects:
        low.append(effect.low)
        high.append(effect.high)
        sizes = [
            max((abs(p - q.null) for p in q.probes), default=q.high - q.low) or q.high - q.low for q in effect.params
        ]
        scale.append(np.array(sizes, float))
        free.append(np.ones(len(effect.params), bool))
        prior.append(np.full(len(effect.params), np.inf))
    join = np.concatenate
    return Box(join(low), join(high), join(scale), join(free), plant.null, join(prior))


def jacobian(
    problem: Problem,
    metric: Metric,
    plant: Plant,
    x: Array,
    base: Array,
    which: NDArray[np.intp],
    limits: Box,
    size: float = FINE,
) -> Array:
    """(S, m, len(which)) derivative of the whitened residual by scaled parameters, forward differences, one batch.

    `size` is the step in scaled parameters.
    """
    step = size * limits.scale[which]
    step = np.where(x[which] + step > limits.high[which], -step, step)
    rows = np.repeat(x[None], len(which), 0)
    rows[np.arange(len(which)), which] += step
    moved = metric.whiten(problem.residual(plant, rows))
    return np.moveaxis((moved - base) / (step / limits.scale[which])[:, None, None], 0, -1)


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes:
      plant: the machine with the effects that were fitted.
      x: (size,) parameters.
      white: (S, m) whitened residual at x.
      jacobian: (S, m, n free) by scaled free parameters, at x or near it.
    """

    plant: Plant
    x: Array
    white: Array
    jacobian: Array

    @property
    def losses(self) -> Array:
        """(S,) loss of each block."""
        return loss(self.white)


def fit(
    problem: Problem,
    metric: Metric,
    plant: Plant,
    start: Array,
    rounds: int = 15,
    known: Array | None = None,
    tick: Callable[[], None] = lambda: None,
) -> Fit:
    """Minimise the robust loss over free parameters within their box.

    Args:
      start: (size,) full parameter vector to start from.
      rounds: iterations at most.
      known: (S, m, j) Jacobian of the first j free parameters to reuse as it is: the chord method, for refits in which
        psi moves little.
      tick: called at every iteration.

    Returns:
      The fit; never worse than the start under the loss.
    """
    limits = box(plant)
    free = np.flatnonzero(limits.free)
    kept = 0 if known is None else known.shape[-1]
    shape = (len(problem), len(problem.columns))

    def full(z: Array) -> Array:
        x = start.copy()
        x[free] = z * limits.scale[free]
        return np.clip(x, limits.low, limits.high)

    def pull(x: Array) -> Array:
        return (x - limits.centre)[free] / limits.prior[free]

    def residual(z: Array) -> Array:
        x = full(z)
        return np.concatenate([metric.whiten(problem.residual(plant, x[None]))[0].ravel(), pull(x)])

    last: dict[str, Array] = {}

    def derivative(z: Array, size: float) -> Array:
        tick()
        x = full(z)
        base = metric.whiten(problem.residual(plant, x[None]))[0]
        fresh = jacobian(problem, metric, plant, x, base, free[kept:], limits, size)
        last["jacobian"] = fresh if known is None else np.concatenate([known, fresh], -1)
        return np.concatenate(
            [last["jacobian"].reshape(-1, len(free)), np.diag(limits.scale[free] / limits.prior[free])]
        )

    low, high = limits.low[free] / limits.scale[free], limits.high[free] / limits.scale[free]
    x = start.copy()
    stages = ((COARSE, rounds // 2), (FINE, rounds - rounds // 2)) if problem.rough else ((FINE, rounds),)
    for size, share in stages if len(free) else ():
        z0 = np.clip(x[free] / limits.scale[free], low + 1e-6 * (high - low), high - 1e-6 * (high - low))
        solved = least_squares(
            residual, z0, lambda z, size=size: derivative(z, size),  # pyright: ignore[reportArgumentType] (no stubs)
            (low, high), loss="soft_l1", f_scale=TURN, x_scale="jac",
            max_nfev=max(share, 1), ftol=1e-5, xtol=1e-5, gtol=1e-8,
        )  # fmt: skip
        x = full(solved.x)
    white = metric.whiten(problem.residual(plant, x[None]))[0]
    jac = last.get("jacobian", np.zeros((*shape, 0)))
    return Fit(plant, x, white, jac)


def uncertainty(result: Fit, blocks: NDArray[np.intp]) -> Array:
    """(size,) standard deviations of the parameters, robust to a model that does not fit: clustered by block.

    Args:
      blocks: (S,) cluster of each block of numbers (neighbouring segments share one).

    Anchored parameters get 0; directions that the data do not show keep the prior's spread.
    """
    from nfc_gym.measured.metric import loss_weight

    limits = box(result.plant)
    free = np.flatnonzero(limits.free)
    weight = loss_weight(result.white) ** 2
    jac = result.jacobian
    pull = limits.scale[free] / limits.prior[free]
    hessian = np.einsum("smi,sm,smj->ij", jac, weight, jac) + np.diag(pull**2)
    scores = np.einsum("smi,sm->si", jac, weight * result.white)
    clustered = np.zeros((int(blocks.max()) + 1, len(free)))
    np.add.at(clustered, blocks, scores)
    inverse = np.linalg.pinv(hessian, rcond=1e-12, hermitian=True)
    meat = clustered.T @ clustered
    plain = np.diag(inverse)
    robust = np.diag(inverse @ meat @ inverse)
    out = np.zeros(len(limits.free))
    out[free] = np.sqrt(np.maximum(plain, robust)) * limits.scale[free]
    return out
