"""What blocks of data can tell: whitened columns of parameters and of effects at realistic sizes, and what they share.

A column is the change of the whitened residual that a parameter or an effect makes; the inner products of columns are
the Fisher information. What is left of a column when others have taken what they can imitate is all that the data know
of it: its squared length is the drop of chi-squared that finding it would bring.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import box
from nfc_gym.measured.fit import COARSE, FINE, jacobian
from nfc_gym.measured.metric import Metric, loss_weight
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.screen import probe_sets
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.physics.effects.base import Effect, overrides
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_EVERY = 3  # of the blocks one is begun at another start, to see what of a column repeats
_ALIKE = 0.01  # singular value of unit columns below which they span nothing new: a bend of the law, not another law


class Lens:
    """Data, seen from one model.

    Args:
      problem: S blocks of m numbers.
      under: its metric.
      plant, x: the model, with the effects that are accepted.
      weight: (S, m) of each number; None lets numbers far off the model count for less, as they do in a fit.

    Attributes:
      tangent: (S, m, f) columns of the free parameters, scaled as in a fit (`box`).
    """

    def __init__(self, problem: Problem, under: Metric, plant: Plant, x: Array, weight: Array | None = None) -> None:
        self.problem, self.under, self.plant, self.x = problem, under, plant, x
        residual = problem.residual(plant, x[None])
        self.base, self.stable = under.whiten(residual)[0], np.isfinite(residual[0]).all(-1)
        self.weight = loss_weight(self.base) if weight is None else weight
        limits, size = box(plant), COARSE if problem.rough else FINE
        free = np.arange(len(limits.scale))
        slopes = np.zeros((*self.base.shape, 0))
        if len(free):
            slopes = jacobian(problem, under, limits, x, self.base, free, size)
        self.tangent = np.where(self.stable[:, None, None], self.weight[..., None] * slopes, 0.0)

    def twin(self, seed: int = 0) -> "Lens | None":
        """Some of the data, begun at other starts; None where nothing touches and a column is what it is anywhere."""
        problem = self.problem
        if not (isinstance(problem, RolloutProblem) and problem.rough and problem.touches(self.plant, self.x)):
            return None
        index = self.shared
        problem = problem.take(index).redrawn(np.random.default_rng(seed))
        return Lens(problem, self.under.take(index), self.plant, self.x, self.weight[index])

    @property
    def shared(self) -> NDArray[np.intp]:
        """Blocks that the twin has."""
        return np.arange(0, len(self.problem), _EVERY)

    def columns(self, effect: Effect, thetas: Array) -> Array:
        """(S, m, r) change that a further effect makes at each of its parameter vectors (r, k).

        Blocks that such an effect makes unstable count as unchanged: how far off they are is arbitrary.
        """
        plant = self.plant.with_effects([*self.plant.effects, effect])
        return self.moved(plant, np.concatenate([np.repeat(self.x[None], len(thetas), 0), thetas], 1))

    def moved(self, plant: Plant, x: Array) -> Array:
        """(S, m, r) change to other models of the machine, x (r, size)."""
        residual = self.problem.residual(plant, x)
        usable = np.isfinite(residual).all(-1, keepdims=True) & self.stable[:, None]
        change = np.where(usable, self.weight * (self.under.whiten(residual) - self.base), 0.0)
        return np.moveaxis(change, 0, -1)

    def places(self, effect: Effect) -> slice:
        """Where an accepted effect's parameters stand in x."""
        at = len(self.plant.space)
        for e in self.plant.effects:
            if e is effect:
                break
            at += len(e.params)
        return slice(at, at + len(effect.params))

    def fitted(self, without: Effect | None = None) -> Array:
        """(S m, j) orthonormal basis of what the free parameters can imitate, all or less those of one effect."""
        columns = flat(self.tangent)
        if without is not None:
            own = self.places(without)
            anchored = int((~self.plant.space.free).sum())
            columns = np.delete(columns, np.arange(own.start, own.stop) - anchored, 1)
        return span(columns, 1e-4)


def flat(columns: Array) -> Array:
    """(S m, r) of columns (S, m, r)."""
    return columns.reshape(columns.shape[0] * columns.shape[1], columns.shape[2])


def free_names(plant: Plant) -> list[str]:
    """Names of a plant's free parameters, in the order in which a fit has them."""
    psi = [n for n, free in zip(plant.space.names, plant.space.free, strict=True) if free]
    return [*psi, *(f"{p.name.replace('_', ' ')} of {e.id}" for e in plant.effects for p in e.params)]


def realistic(effect: Effect, every_size: bool = True) -> list[tuple[Array, Array]]:
    """Sets of realistic sizes: (d, k) with all sizing parameters at once, and (r, k) parameter by parameter.

    The sets differ in the shape parameters and in size; a law has one shape at a time, so sets are not to be mixed.
    Without `every_size` each shape has its middle size only.
    """
    sets = probe_sets(effect, every_size)
    if overrides(effect, "chart"):
        ranks = max(len(p.probes) for p in effect.params)
        whole = np.array([[p.probes[min(r, len(p.probes) - 1)] for p in effect.params] for r in range(ranks)])
        return [(np.unique(whole, axis=0), sets[0])]
    out = []
    for rows in sets:
        whole = rows[0].copy()
        for row, i in zip(rows, [i for i, p in enumerate(effect.params) if not p.shape], strict=True):
            whole[i] = row[i]
        out.append((whole[None], rows if len(rows) > 1 else rows[:0]))
    return out


def span(columns: Array, floor: float = _ALIKE) -> Array:
    """(n, j) orthonormal basis of columns (n, r), less those that vanish or are nearly copies of others."""
    norms = np.linalg.norm(columns, axis=0)
    kept = columns[:, norms > 1e-9] / norms[norms > 1e-9]
    if not kept.shape[1]:
        return np.zeros((len(columns), 0))
    u, size, _ = np.linalg.svd(kept, full_matrices=False)
    return u[:, size > floor * size[0]]


def without(columns: Array, basis: Array) -> Array:
    """Columns (n,) or (n, r) less what an orthonormal basis (n, j) can imitate."""
    return columns - basis @ (basis.T @ columns)


def repeated(one: Array, other: Array) -> Array:
    """(r,) share of each column (n, r) that its twin (n, r) has too: their cosine, none where they disagree.

    Where bodies touch, much of what a small change does hangs on the very instant of an impact. Another start within
    the noise gives another such part, so that it tells nothing of the cause; a machine's own start is such another.
    """
    lengths = np.linalg.norm(one, axis=0) * np.linalg.norm(other, axis=0)
    return np.clip((one * other).sum(0) / np.maximum(lengths, 1e-12), 0.0, 1.0)


def left_over(gram: Array, of: int, others: Sequence[int]) -> float:
    """Squared length of one column of which the others imitate what they can, from inner products (c, c)."""
    own = float(gram[of, of])
    if own <= 0:
        return 0.0
    used = np.array([j for j in others if gram[j, j] > 1e-18], np.intp)
    if not len(used):
        return own
    scale = np.sqrt(np.diag(gram)[used])
    shared = gram[used, of] / scale
    among = gram[np.ix_(used, used)] / np.outer(scale, scale)
    inverse = np.linalg.pinv(among, rcond=1e-8, hermitian=True)
    return float(max(own - shared @ inverse @ shared, 0.0))
