"""Misfit maps: the misfit on the verification logs over the place in the world and over joints' positions and speeds.

Over time and over the compared quantities it is in `details`; here it is laid over the state at each block's start.
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.instant import InstantProblem
from nfc_gym.measured.laws import Scanned
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.verdict import Verified
from nfc_gym.physics.effects.base import Array
from nfc_gym.physics.effects.law import degrees, turns

_BINS = 12
_MOST = 3  # degrees of freedom that are drawn: those whose laws explain most


def maps(v: Verified, model: mujoco.MjModel, scanned: Scanned | None, stages: Sequence[str]) -> dict[str, Any]:
    """Everything that the maps need, JSON-able; empty where the problem's states are not known.

    Returns:
      `degrees`: {place: share of the misfit that a law there takes away}; `lines`: a list of {title, label, unit, x,
      <stage>: mean square misfit in each bin}; `grid`: None or {x, y: bin edges in m, <stage>: (rows of y)}.
    """
    states = _states(v.problem, model)
    places = dict(list(scanned.places.items())[:_BINS]) if scanned else {}
    if states is None:
        return {"degrees": places, "lines": [], "grid": None}
    q, speed = states
    misfit = {s: _per_block(v, s) for s in stages}
    known = degrees(model)
    names = list(dict.fromkeys(p.removesuffix("@body") for p in places)) or list(known)
    lines = []
    for name in names[:_MOST]:
        dof, at = known[name]
        unit = "rad" if turns(model, dof) else "m"
        if at is not None:
            x = q[:, at]
            if unit == "rad" and np.ptp(x) > 4 * np.pi:  # a wheel: its place in the turn
                x = np.mod(x, 2 * np.pi)
            lines.append(_line(f"over the position of {name}", unit, x, misfit))
        lines.append(_line(f"over the speed of {name}", f"{unit}/s", speed[:, dof], misfit))
    return {"degrees": places, "lines": lines, "grid": _grid(model, q, misfit)}


def _states(problem: Problem, model: mujoco.MjModel) -> tuple[Array, Array] | None:
    """(S, nq), (S, nv) where each block starts."""
    if isinstance(problem, RolloutProblem):
        return problem.segments.qpos, problem.segments.qvel
    if isinstance(problem, InstantProblem):
        motion = problem.motion(model)
        return motion.q[:, 0], motion.v[:, 0]
    return None


def _per_block(v: Verified, stage: str) -> Array:
    return v.squares(stage).sum(1) / np.maximum(v.problem.mask.sum(1), 1)


def _line(title: str, unit: str, x: Array, misfit: dict[str, Array]) -> dict[str, Any]:
    edges = np.linspace(x.min(), max(x.max(), x.min() + 1e-9), _BINS + 1)
    bins = np.clip(np.digitize(x, edges) - 1, 0, _BINS - 1)
    means = {s: _means(values, bins, _BINS) for s, values in misfit.items()}
    return {"title": title, "unit": unit, "x": ((edges[1:] + edges[:-1]) / 2).tolist(), **means}


def _means(values: Array, bins: NDArray[np.intp], count: int) -> list[float | None]:
    """Mean of the values in each bin, None where there is none."""
    sums, n = np.bincount(bins, values, count), np.bincount(bins, minlength=count)
    return [float(s / k) if k else None for s, k in zip(sums, n, strict=True)]


def _grid(model: mujoco.MjModel, q: Array, misfit: dict[str, Array]) -> dict[str, Any] | None:
    """Over the ground: the first free base's x and y, or those of two slides along them."""
    at = _ground(model)
    if at is None or min(np.ptp(q[:, i]) for i in at) < 1e-6:
        return None
    x, y = (np.linspace(q[:, i].min(), q[:, i].max(), _BINS + 1) for i in at)
    column, row = (np.clip(np.digitize(q[:, i], e) - 1, 0, _BINS - 1) for i, e in zip(at, (x, y), strict=True))
    values = {s: _means(m, row * _BINS + column, _BINS**2) for s, m in misfit.items()}
    rows = {s: [m[i : i + _BINS] for i in range(0, _BINS**2, _BINS)] for s, m in values.items()}
    return {"x": x.tolist(), "y": y.tolist(), **rows}


def _ground(model: mujoco.MjModel) -> tuple[int, int] | None:
    """Addresses of the world's x and y in the state."""
    free, slide = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    along: dict[int, int] = {}
    carriers = {0}  # the world, and what slides over it
    for j in range(model.njnt):
        body, address, kind = int(model.jnt_bodyid[j]), int(model.jnt_qposadr[j]), int(model.jnt_type[j])
        if kind == free:
            return address, address + 1
        if kind == slide and ({body, int(model.body_parentid[body])} & carriers):
            carriers.add(body)
            along.setdefault(int(np.argmax(np.abs(model.jnt_axis[j]))), address)
    return (along[0], along[1]) if 0 in along and 1 in along else None
