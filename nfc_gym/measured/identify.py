"""What the logs at hand could have shown: for each effect its smallest detectable size and its worst mimic.

What it takes to be found is the search's own price (`stakes`); the size at which it is paid follows from the effect's
column (`fisher`) by scaling, and is confirmed by a column at that size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import contains
from nfc_gym.measured.fisher import Lens, flat, free_names, realistic, repeated, span, without
from nfc_gym.measured.screen import sized
from nfc_gym.measured.stakes import Stakes
from nfc_gym.physics.effects.base import Effect

Array = NDArray[np.float64]
_TOLD = 3.92  # the contest's 2.5 % level (1.96) on a difference of gains d, which scatters by 2 sqrt(d)
_SAME = 0.95  # share of the gain beyond which the contest lists a rival as equivalent
_NUDGE = 0.1  # of an accepted effect's size, that is taken away to see what it does
_MOSTLY = 0.3  # share of a column left below which it is said who takes the rest: nine tenths of the gain
_GONE = 0.03  # share of a column left below which the fitted parameters can imitate the effect
_LEADING = 12  # effects whose sizes are confirmed
_TRIES = 4  # columns with which a size is confirmed, at most
_STRAIGHT = 1.25  # column over expected column, either way, up to which sizes scale


@dataclass(frozen=True)
class _View:
    """One effect as the data see it.

    Attributes:
      thetas: (d, k) realistic sizes, or the fitted one of an accepted effect.
      columns: (n, d) what they change; of an accepted effect, what a change of it does, taken for its whole size.
      steady: (d,) share of each column, beyond the fitted parameters, that repeats from other starts.
      spans: (n, r) changes each, one array a shape and size of the law: together they span what it can imitate.
      basis: (n, j) what the fitted parameters can imitate.
    """

    effect: Effect
    thetas: Array
    columns: Array
    steady: Array
    spans: list[Array]
    basis: Array
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
      `detectable_share`: what the fitted parameters leave of its column, and would again from starts a little off;
        `absorbed_by`: the one that takes most of it
        where little is left;
      `linear`: whether a column at that size was as long as proportion says; the size is corrected by it either way;
        None where it was not tried, as is done for what is accepted and for the effects that show best;
      `claimed`: whether the model has the effect.
    """
    taken, whole, twin = {e.id for e in lens.plant.effects}, lens.fitted(), lens.twin()
    again = None if twin is None else (twin, twin.fitted())
    views = [_accepted(lens, effect) for effect in lens.plant.effects]
    for effect in candidates:
        if effect.id not in taken and not effect.generic:
            tick(effect)
            views.append(_look(lens, effect, whole, again))
    rivals = [_imitations(v, whole) for v in views]
    found = [_steadied(lens, again, v, _detect(v, stakes)) for v in views]
    strength = [
        np.linalg.norm(d.column) / stakes.needed(len(v.effect.params)) for v, d in zip(views, found, strict=True)
    ]
    leading = set(np.argsort(strength)[::-1][:_LEADING])
    found = [
        _confirmed(lens, v, d, stakes) if v.claimed or i in leading else d
        for i, (v, d) in enumerate(zip(views, found, strict=True))
    ]
    return [_row(lens, v, d, views, rivals, stakes) for v, d in zip(views, found, strict=True)]


def _accepted(lens: Lens, effect: Effect) -> _View:
    """An accepted effect: seen from the fitted model, in which the motion is what it is with the effect."""
    theta = lens.x[lens.places(effect)]
    columns = _change(lens, effect, theta, _NUDGE, True) / _NUDGE
    return _View(effect, theta[None], columns, np.ones(1), [columns], lens.fitted(effect), True)


def _look(lens: Lens, effect: Effect, basis: Array, again: tuple[Lens, Array] | None) -> _View:
    """A candidate at its realistic sizes, whole and parameter by parameter, in one batch; again from other starts."""
    sets = realistic(effect, every_size=not lens.problem.costly)
    change = lens.columns(effect, np.concatenate([rows for pair in sets for rows in pair]))
    at, whole, spans = 0, [], []
    for thetas, rows in sets:
        count = len(thetas) + len(rows)
        whole += range(at, at + len(thetas))
        spans.append(flat(change[..., at : at + count]))
        at += count
    thetas, columns = np.concatenate([t for t, _ in sets]), change[..., whole]
    steady = np.ones(len(thetas)) if again is None else _steadiness(lens, again, effect, thetas, columns)
    return _View(effect, thetas, flat(columns), steady, spans, basis)


def _steadiness(lens: Lens, again: tuple[Lens, Array], effect: Effect, thetas: Array, columns: Array) -> Array:
    """(d,) share of columns (S, m, d), beyond the fitted parameters, that repeats from the twin's starts."""
    twin, basis = again
    here = without(flat(columns[lens.shared]), basis)
    return repeated(here, without(flat(twin.columns(effect, thetas)), basis))


def _change(lens: Lens, effect: Effect, theta: Array, share: float, claimed: bool) -> Array:
    """(n, 1) what a share of the size theta changes: added to the model, or taken from what is in it."""
    if not claimed:
        return flat(lens.columns(effect, sized(effect, theta, share)[None]))
    x = lens.x.copy()
    x[lens.places(effect)] = sized(effect, theta, 1 - share)
    return -flat(lens.moved(lens.plant, x[None]))


def _imitations(view: _View, basis: Array) -> list[Array]:
    """(n, j) orthonormal bases of what an effect can imitate beyond the fitted parameters, one a shape of its law."""
    return [span(without(columns, basis)) for columns in view.spans]


@dataclass(frozen=True)
class _Detected:
    """The direction in which an effect shows first.

    Attributes:
      theta: (k,) its realistic size; column: (n,) what is left of its column; share: how much that is.
      steady: the part of that share that is for what repeats.
      size: smallest size that is sure to be found, as a share of theta; infinite where bounds or psi forbid it.
      ratio: length of a column at that size over the expected one; None where none was rolled out.
    """

    theta: Array
    column: Array
    share: float
    steady: float
    size: float
    ratio: float | None


def _detect(view: _View, stakes: Stakes) -> _Detected:
    """By proportion, from realistic sizes."""
    left = without(view.columns, view.basis) * view.steady
    lengths, whole = np.linalg.norm(left, axis=0), np.linalg.norm(view.columns, axis=0)
    needed, first = stakes.needed(len(view.effect.params)), _first(view.effect)
    sizes = needed / np.maximum(lengths, 1e-12)
    within = [_fits(view.effect, t, s) for t, s in zip(view.thetas, sizes, strict=True)]
    away = np.abs(view.thetas[:, first] - view.effect.null[first]) * sizes
    # Of several realistic sizes those near the threshold extrapolate least; of these the one that shows first.
    far = np.abs(np.log(sizes)) > 1.5
    i = min(range(len(sizes)), key=lambda i: (not within[i], far[i], away[i]))
    share = float(lengths[i] / max(whole[i], 1e-12))
    hidden = not within[i] or share < _GONE
    size = np.inf if hidden else float(sizes[i])
    return _Detected(view.thetas[i], left[:, i], share, float(view.steady[i]), size, None)


def _steadied(lens: Lens, again: tuple[Lens, Array] | None, view: _View, found: _Detected) -> _Detected:
    """The same where the smallest size is asked whether it repeats: the smaller an effect, the less of it does."""
    if again is None or view.claimed or not np.isfinite(found.size):
        return found
    theta = sized(view.effect, found.theta, found.size)[None]
    steady = float(_steadiness(lens, again, view.effect, theta, lens.columns(view.effect, theta))[0])
    steady = min(max(steady, 1e-3), found.steady)
    less = steady / found.steady
    size = found.size / less if _fits(view.effect, found.theta, found.size / less) else np.inf
    return replace(found, column=less * found.column, share=less * found.share, steady=steady, size=size)


def _confirmed(lens: Lens, view: _View, found: _Detected, stakes: Stakes) -> _Detected:
    if not np.isfinite(found.size):
        return found
    needed, length = stakes.needed(len(view.effect.params)), float(np.linalg.norm(found.column))
    size, ratio = _checked(lens, view, found, needed, length)
    return replace(found, size=size, ratio=ratio)


def _checked(lens: Lens, view: _View, found: _Detected, needed: float, length: float) -> tuple[float, float]:
    """Columns at the size found, which correct it until one is as long as needed; and how far off the first one was.

    Laws that bend (a dead zone, dry friction) make columns that grow with some other power of their size.
    """
    theta, size = found.theta, found.size
    first, before = np.nan, (1.0, length)
    for _ in range(_TRIES):
        if not _fits(view.effect, theta, size):
            return np.inf, first
        column = _change(lens, view.effect, theta, size, view.claimed)[:, 0]
        seen = max(found.steady * float(np.linalg.norm(without(column, view.basis))), 1e-3 * needed)
        ratio = seen / needed
        first = ratio if np.isnan(first) else first
        step = np.log(size / before[0])
        power = np.log(seen / before[1]) / step if abs(step) > 0.1 else 1.0
        before, size = (size, seen), float(size * ratio ** (-1 / np.clip(power, 0.5, 2.0)))
        if 1 / _STRAIGHT < ratio < _STRAIGHT:
            break
    return (size if _fits(view.effect, theta, size) else np.inf), first


def _first(effect: Effect) -> int:
    """The parameter that tells an effect's size."""
    return next(i for i, p in enumerate(effect.params) if not p.shape)


def _fits(effect: Effect, theta: Array, share: float) -> bool:
    """Whether a size lies within the bounds of the effect's parameters."""
    if not share < 1e4:
        return False
    at, room = sized(effect, theta, share), 1e-9 * (effect.high - effect.low)
    return bool(((at >= effect.low - room) & (at <= effect.high + room)).all())


def _worst_mimic(
    view: _View, column: Array, views: Sequence[_View], rivals: Sequence[list[Array]]
) -> tuple[str | None, float]:
    """Who imitates a column (n,) best, and the cosine; a law that has this one as its special case is no rival."""
    mimic, like, length = None, 0.0, float(np.linalg.norm(column))
    for other, reaches in zip(views, rivals, strict=True):
        if other is view or contains(other.effect, view.effect):
            continue
        reaches = _imitations(other, view.basis) if view.claimed else reaches
        cosine = max(float(np.linalg.norm(reach.T @ column)) for reach in reaches) / length
        if cosine > like:
            mimic, like = other.effect.id, min(cosine, 1.0)
    return mimic, like


def _row(
    lens: Lens,
    view: _View,
    found: _Detected,
    views: Sequence[_View],
    rivals: Sequence[list[Array]],
    stakes: Stakes,
) -> dict[str, Any]:
    effect, first = view.effect, _first(view.effect)
    shown = float(np.linalg.norm(found.column)) > 1e-9
    seen, gone = np.isfinite(found.size), found.share < _GONE
    mimic, like = _worst_mimic(view, found.column, views, rivals) if shown and not gone else (None, 0.0)
    at = sized(effect, found.theta, found.size) if seen else found.theta
    length = stakes.needed(len(effect.params))
    length = (max(length, float(np.linalg.norm(found.column))) if view.claimed else length) * np.sqrt(stakes.repeats)
    told = like**2 <= _SAME or length * np.sqrt(1 - like**2) > _TOLD
    return {
        "id": effect.id,
        "smallest_detectable": float(abs(at[first] - effect.params[first].null)) if seen else None,
        "unit": effect.params[first].unit,
        "worst_mimic": mimic,
        "distinguishable": bool(seen and told),
        "detectable_share": found.share,
        "similarity": like,
        "angle": float(np.degrees(np.arccos(like))),
        "absorbed_by": _absorber(lens, view) if shown and found.share < _MOSTLY else None,
        "at": {p.name: float(v) for p, v in zip(effect.params, at, strict=True)} if seen else {},
        "linear": bool(1 / _STRAIGHT < found.ratio < _STRAIGHT) if seen and found.ratio is not None else None,
        "claimed": view.claimed,
    }


def _absorber(lens: Lens, view: _View) -> str | None:
    """The fitted parameter that alone imitates an effect best."""
    column, tangent = view.columns[:, int(np.linalg.norm(view.columns, axis=0).argmax())], flat(lens.tangent)
    if not tangent.shape[1]:
        return None
    cosines = np.abs(tangent.T @ column) / np.maximum(np.linalg.norm(tangent, axis=0), 1e-12)
    own = lens.places(view.effect) if view.claimed else slice(0, 0)
    anchored = int((~lens.plant.space.free).sum())
    cosines[own.start - anchored * view.claimed : own.stop - anchored * view.claimed] = -1.0
    return free_names(lens.plant)[int(cosines.argmax())]
