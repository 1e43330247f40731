"""What the logs at hand could have shown: for each effect its smallest detectable size and its worst mimic.

Detection is the search's own: the gain that a candidate brings must exceed the price that the contest charges it
(`Stakes`), and it must do so in 99.5 % of repetitions. A gain of expectation g scatters by 2 sqrt(g), so the size at
which an effect is sure to be found follows from its column (`fisher`) by scaling. Currie (1968), Analytical Chemistry
40, 586, calls this the detection limit, as against the decision limit that a lucky draw may pass.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import contains
from nfc_gym.measured.contest import price
from nfc_gym.measured.fisher import Lens, realistic, sized, span, without
from nfc_gym.physics.effects.base import Effect

Array = NDArray[np.float64]
_SURE = 2.576  # standard deviations: 99.5 %, one-sided
_TOLD = 3.92  # the contest's 2.5 % level (1.96) on a difference of gains d, which scatters by 2 sqrt(d)
_SAME = 0.95  # share of the gain beyond which the contest lists a rival as equivalent
_GONE = 0.03  # share of a column left below which the fitted parameters can imitate the effect
_STRAIGHT = 1.25  # column over expected column, either way, up to which sizes scale


@dataclass(frozen=True)
class Stakes:
    """What the search charges a candidate.

    Attributes:
      count: numbers that it compares, on fit and selection logs.
      dispersion: loss per number of the model to beat.
      worth: share of the whole loss that an effect must explain to be named.
      repeats: how many times the blocks looked at here the search's own blocks are.
    """

    count: int
    dispersion: float
    worth: float
    repeats: float = 1.0

    def needed(self, extra: int) -> float:
        """Length of a column, on the blocks looked at, from which an effect of `extra` parameters is sure to be found.

        The gain's 0.5 % quantile, g - 2 z sqrt(g), must reach the price.
        """
        least = price(self.count, extra, self.dispersion) + self.worth * self.count * self.dispersion
        return float((_SURE + np.sqrt(_SURE**2 + least)) / np.sqrt(self.repeats))


@dataclass(frozen=True)
class _View:
    """One effect as the data see it.

    Attributes:
      thetas: (d, k) realistic sizes, or the fitted one of an accepted effect.
      columns: (n, d) what they change.
      spans: (n, r) changes each, one array a shape and size of the law: together they span what it can imitate.
    """

    effect: Effect
    thetas: Array
    columns: Array
    spans: list[Array]
    claimed: bool = False


def table(
    lens: Lens, candidates: Sequence[Effect], stakes: Stakes, tick: Callable[[Effect], None] = lambda e: None
) -> list[dict[str, Any]]:
    """Rows of `report.json`'s `identifiability`: for every candidate, and first for what was accepted.

    Args:
      lens: the data, seen from the fitted model.
      candidates: what the search could have named.
      stakes: what it charges.
      tick: called before each candidate is rolled out.

    Returns:
      Rows with `id`; `unit`;
      `smallest_detectable`: the first size parameter at the smallest size that is sure to be found, the others in
        proportion (`at`); None where no plausible size would show;
      `worst_mimic`: the other effect that imitates it best once the fitted parameters have taken their share;
        `similarity`: the cosine between the two, `angle`: in degrees;
      `distinguishable`: whether the contest could tell the two apart at that size, or at the size that is claimed;
      `detectable_share`: what the fitted parameters leave of its column; `absorbed_by`: the one that takes most of it
        where next to nothing is left;
      `linear`: whether a column at that size was as long as proportion says; the size is corrected by it either way;
      `claimed`: whether the effect is accepted.
    """
    taken = {e.id for e in lens.plant.effects}
    views = _accepted(lens)
    for effect in candidates:
        if effect.id not in taken and not effect.generic:
            tick(effect)
            views.append(_look(lens, effect))
    flat = lens.tangent.reshape(-1, lens.tangent.shape[-1])
    names = _names(lens)
    whole = span(flat, 1e-4)
    bases = {v.effect.id: span(flat[:, [n[0] is not v.effect for n in names]], 1e-4) for v in views if v.claimed}
    found = [_detect(lens, v, bases.get(v.effect.id, whole), stakes) for v in views]
    rivals = [_imitations(v, whole) for v in views]
    return [
        _row(v, d, flat, names, views, rivals, bases.get(v.effect.id), stakes)
        for v, d in zip(views, found, strict=True)
    ]


def _accepted(lens: Lens) -> list[_View]:
    """Accepted effects: what they change at the size that was fitted."""
    out, at = [], len(lens.plant.space)
    for effect in lens.plant.effects:
        k = len(effect.params)
        gone = lens.x.copy()
        gone[at : at + k] = sized(effect, lens.x[at : at + k], 0.0)
        change = -lens.moved(lens.plant, gone[None])
        columns = change.reshape(-1, 1)
        out.append(_View(effect, lens.x[None, at : at + k], columns, [columns], True))
        at += k
    return out


def _look(lens: Lens, effect: Effect) -> _View:
    """A candidate at all its realistic sizes, whole and parameter by parameter, in one batch."""
    sets = realistic(effect)
    change = lens.columns(effect, np.concatenate([rows for pair in sets for rows in pair]))
    flat, at, columns, spans = change.reshape(-1, change.shape[-1]), 0, [], []
    for whole, rows in sets:
        count = len(whole) + len(rows)
        columns.append(flat[:, at : at + len(whole)])
        spans.append(flat[:, at : at + count])
        at += count
    return _View(effect, np.concatenate([whole for whole, _ in sets]), np.concatenate(columns, 1), spans)


def _names(lens: Lens) -> list[tuple[Effect | None, str]]:
    """(effect or None for psi, name) of each free parameter, in the order of the tangent's columns."""
    space = lens.plant.space
    psi = [(None, n) for n, free in zip(space.names, space.free, strict=True) if free]
    return [*psi, *((e, f"{p.name} of {e.id}") for e in lens.plant.effects for p in e.params)]


@dataclass(frozen=True)
class _Detected:
    """The direction in which a candidate shows first: which, its column, the share left, its size, and a check."""

    theta: Array
    column: Array
    share: float
    size: float
    ratio: float


def _detect(lens: Lens, view: _View, basis: Array, stakes: Stakes) -> _Detected:
    """The smallest size that is sure to be found, as a share of `theta`; infinite where bounds or psi forbid it."""
    left = without(view.columns, basis)
    lengths, whole = np.linalg.norm(left, axis=0), np.linalg.norm(view.columns, axis=0)
    needed = stakes.needed(len(view.effect.params))
    first = _first(view.effect)
    sizes = np.array([needed / max(v, 1e-12) for v in lengths])
    within = [_fits(view.effect, t, s) for t, s in zip(view.thetas, sizes, strict=True)]
    away = np.abs(view.thetas[:, first] - view.effect.null[first]) * sizes
    # Of several realistic sizes the one nearest to the threshold extrapolates least.
    order = sorted(range(len(sizes)), key=lambda i: (not within[i], abs(np.log(sizes[i])) > 1.5, away[i]))
    i = order[0]
    share = float(lengths[i] / max(whole[i], 1e-12))
    theta, column = view.thetas[i], left[:, i]
    if not within[i] or share < _GONE:
        return _Detected(theta, column, share, np.inf, np.nan)
    size, ratio = _checked(lens, view, theta, float(sizes[i]), basis, needed, float(lengths[i]))
    return _Detected(theta, column, share, size, ratio)


def _checked(
    lens: Lens, view: _View, theta: Array, size: float, basis: Array, needed: float, length: float
) -> tuple[float, float]:
    """One more column at the size found: the size corrected by it, and its length over the one that was expected.

    Laws that bend (a dead zone, dry friction) make columns that grow with some other power of their size.
    """
    try_at = sized(view.effect, theta, size)
    if view.claimed:
        at = lens.x.copy()
        start = len(lens.plant.space)
        for e in lens.plant.effects:
            if e is view.effect:
                at[start : start + len(e.params)] = try_at
            start += len(e.params)
        both = np.stack([at, _less(lens, view.effect)])
        moved = lens.moved(lens.plant, both)
        column = (moved[..., 0] - moved[..., 1]).reshape(-1)
    else:
        column = lens.columns(view.effect, try_at[None]).reshape(-1)
    seen = float(np.linalg.norm(without(column, basis)))
    ratio = seen / needed
    power = np.log(seen / length) / np.log(size) if seen > 0 and abs(np.log(size)) > 0.1 else 1.0
    corrected = size * (1 / max(ratio, 1e-3)) ** (1 / np.clip(power, 0.5, 2.0))
    return (float(corrected) if _fits(view.effect, theta, corrected) else np.inf), ratio


def _less(lens: Lens, effect: Effect) -> Array:
    """The fitted parameter vector with one effect at null."""
    out, at = lens.x.copy(), len(lens.plant.space)
    for e in lens.plant.effects:
        if e is effect:
            out[at : at + len(e.params)] = sized(e, lens.x[at : at + len(e.params)], 0.0)
        at += len(e.params)
    return out


def _first(effect: Effect) -> int:
    """The parameter that tells an effect's size."""
    return next(i for i, p in enumerate(effect.params) if not p.shape)


def _fits(effect: Effect, theta: Array, share: float) -> bool:
    """Whether a size lies within the bounds of the effect's parameters."""
    if not np.isfinite(share) or share > 1e4:
        return False
    at, room = sized(effect, theta, share), 1e-9 * (effect.high - effect.low)
    return bool(((at >= effect.low - room) & (at <= effect.high + room)).all())


def _imitations(view: _View, basis: Array) -> list[Array]:
    """(n, j) orthonormal bases of what an effect can imitate beyond the fitted parameters, one a shape of its law."""
    return [span(without(columns, basis)) for columns in view.spans]


def _row(
    view: _View,
    found: _Detected,
    tangent: Array,
    names: Sequence[tuple[Effect | None, str]],
    views: Sequence[_View],
    rivals: Sequence[list[Array]],
    own: Array | None,
    stakes: Stakes,
) -> dict[str, Any]:
    effect, first = view.effect, _first(view.effect)
    length = float(np.linalg.norm(found.column))
    mimic, like = None, 0.0
    for other, reaches in zip(views, rivals, strict=True):
        # A law that has this one as its special case imitates it by being it: no alternative.
        if other is view or contains(other.effect, effect) or length < 1e-9 or found.share < _GONE:
            continue
        reaches = reaches if own is None else _imitations(other, own)
        cosine = max(float(np.linalg.norm(reach.T @ found.column)) for reach in reaches) / length
        if cosine > like:
            mimic, like = other.effect.id, cosine
    like = min(like, 1.0)
    seen = np.isfinite(found.size)
    at = sized(effect, found.theta, found.size) if seen else found.theta
    needed = stakes.needed(len(effect.params))
    needed = (max(needed, length) if view.claimed else needed) * np.sqrt(stakes.repeats)
    told = like**2 <= _SAME or needed * np.sqrt(1 - like**2) > _TOLD
    return {
        "id": effect.id,
        "smallest_detectable": float(abs(at[first] - effect.params[first].null)) if seen else None,
        "unit": effect.params[first].unit,
        "worst_mimic": mimic,
        "distinguishable": bool(seen and told),
        "detectable_share": found.share,
        "similarity": like,
        "angle": float(np.degrees(np.arccos(like))),
        "absorbed_by": _absorber(view, tangent, names) if found.share < _GONE and length > 0 else None,
        "at": {p.name: float(v) for p, v in zip(effect.params, at, strict=True)} if seen else {},
        "linear": bool(1 / _STRAIGHT < found.ratio < _STRAIGHT) if seen else None,
        "claimed": view.claimed,
    }


def _absorber(view: _View, tangent: Array, names: Sequence[tuple[Effect | None, str]]) -> str | None:
    """The fitted parameter that alone imitates an effect best."""
    column = view.columns[:, int(np.linalg.norm(view.columns, axis=0).argmax())]
    if not np.linalg.norm(column) > 1e-9 or not tangent.shape[1]:
        return None
    sizes = np.maximum(np.linalg.norm(tangent, axis=0), 1e-12)
    cosines = np.abs(tangent.T @ column) / sizes
    cosines[[n[0] is view.effect for n in names]] = -1.0
    return names[int(cosines.argmax())][1]
