"""Windows of machines each with a fault, of a kind and a size that are drawn: what detectors learn faults from."""

import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from time import monotonic
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.windows import Batch
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.simulate.fault_kinds import KINDS, Acting, Scaled, fault_kinds
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.pool import unordered
from nfc_gym.simulate.trials import trials

Array = NDArray[np.float64]
_ROWS = 500  # windows that a process makes at once: a second or two


def faulty(machine: Machine, psi: Array, seed: int, *, noise: float = 1.0, nthread: int = 1) -> Batch:
    """One window on a plane for each row of psi, with sensor noise and one fault.

    Kinds are drawn alike; see `fault_kinds`.

    Args:
      machine: the robot, on a plane.
      psi: (n, d) physical units, of the machines before their fault.
      seed: of faults, motion and noise.
      noise: what multiplies the robot's sensor noise.
      nthread: threads.

    Returns:
      As of `trials`, and `kind` (m,), the fault's place in `KINDS`: fewer windows than rows where faults throw the
      robot at once.

    Raises:
      InputError: the machine stands on rough ground, or psi has another shape.
    """
    psi, rng = np.array(psi, float), np.random.default_rng(seed)
    if psi.ndim != 2 or psi.shape[1] != len(machine.space) or not len(psi):
        raise InputError(f"faulty: psi has shape {psi.shape}, want (n, {len(machine.space)}) with n of 1 or more")
    kinds = fault_kinds(machine)
    kind = np.array([KINDS.index(k) for k in kinds])[rng.integers(len(kinds), size=len(psi))]
    off = np.zeros(len(psi), bool)
    for row, k in enumerate(kind):
        if isinstance(drawn := kinds[KINDS[k]], Scaled):
            psi[row], off[row] = psi[row] * drawn.factors(rng), True
    scaled, first = np.flatnonzero(off), int(rng.integers(2**31))
    how = {"noise": noise, "nthread": nthread}
    parts = [_of(scaled, trials(machine, psi[scaled], first, **how))] if len(scaled) else []
    for name, acting in kinds.items():
        rest = np.flatnonzero(kind == KINDS.index(name))
        if not isinstance(acting, Acting) or not len(rest):
            continue
        together = acting.together or len(rest)
        for i in range(0, len(rest), together):
            rows, effect = rest[i : i + together], acting.effects[rng.integers(len(acting.effects))]
            theta = acting.theta(effect, len(rows), rng)
            effect.bind(machine.model)
            found = trials(machine, psi[rows], int(rng.integers(2**31)), effect=effect, theta=theta, **how)
            parts.append(_of(rows, found))
    out = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    return out | {"kind": kind[out["row"]]}


def lessons(
    environment: str, psi: Array, seed: int, *, jobs: int = 1, folder: Path | None = None, report: Report = quiet
) -> Batch:  # fmt: skip
    """Windows without sensor noise, of which every other machine has a fault: what a `FaultClassifier` learns from.

    Args:
      environment: id of a flat one.
      psi: (n, d) physical units, of the machines before their fault: draws of what is believed.
      seed: of faults and motion; the same bits for any `jobs`.
      jobs: processes.
      folder: where parts of 500 are kept, so that a run that was stopped goes on; None keeps none.
      report: is told of parts as steps.

    Returns:
      `states` (m, H+1, s), `actions` (m, H, a) and `psi` (m, d) in [0, 1] of the prior's box, float32; `family` (m,),
      place in `KINDS`.

    Raises:
      InputError: see `faulty`.
    """
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        told = hashlib.sha256(f"{environment} {seed} {psi.shape} ".encode() + np.ascontiguousarray(psi).tobytes())
        folder = folder / f"lessons_{told.hexdigest()[:16]}"
    return _together(_lesson, [(environment, psi[i : i + _ROWS], seed, i, folder) for i in _starts(psi)], jobs, report)


def nominal(environment: str, psi: Array, seed: int, *, jobs: int = 1, report: Report = quiet) -> Batch:
    """Noisy windows of machines as they are believed to be, from which a detector's threshold is taken.

    Args:
      environment, psi, seed, jobs, report: see `lessons`.

    Returns:
      `states` (n, H+1, s) and `actions` (n, H, a).
    """
    return _together(_nominal, [(environment, psi[i : i + _ROWS], seed, i) for i in _starts(psi)], jobs, report)


def about_nominal(space: ParameterSpace, width: float, n: int, rng: np.random.Generator) -> Array:
    """(n, d) psi in physical units, even within a share `width` of the prior's range about nominal, inside its box."""
    spread = width * (space.high - space.low)
    return np.clip(space.nominal + spread * rng.uniform(-1, 1, (n, len(space))), space.low, space.high)


def _starts(psi: Array) -> range:
    if psi.ndim != 2 or not len(psi):
        raise InputError(f"faulty: psi has shape {psi.shape}, want (n, d) with n of 1 or more")
    return range(0, len(psi), _ROWS)


def _together(function: Callable[..., Batch], tasks: list[tuple], jobs: int, report: Report) -> Batch:
    """What processes make of the tasks, in their order."""
    found: list[Batch] = [{}] * len(tasks)
    began = monotonic()
    made = unordered(function, tasks, jobs) if jobs > 1 else enumerate(function(*task) for task in tasks)
    for done, (number, part) in enumerate(made, 1):
        found[number] = part
        report.step(done, len(tasks), monotonic() - began)
    return {name: np.concatenate([p[name] for p in found]) for name in found[0]}


@lru_cache(maxsize=1)
def _machine(environment: str) -> Machine:
    return Machine(environment)


def _nominal(environment: str, psi: Array, seed: int, at: int) -> Batch:
    """Of some rows."""
    made = trials(_machine(environment), psi, int(np.random.default_rng([seed, at]).integers(2**31)))
    return {name: made[name] for name in ("states", "actions")}


def _lesson(environment: str, psi: Array, seed: int, at: int, folder: Path | None) -> Batch:
    """Of some rows, which may be kept already."""
    if folder is None:
        return _made(environment, psi, seed, at)
    file = folder.with_name(f"{folder.name}_{at}.npz")
    if file.is_file():
        try:
            with np.load(file) as kept:
                return dict(kept)
        except (OSError, ValueError, EOFError, BadZipFile) as e:
            raise InputError(f"{file}: damaged ({e}): remove it, and it is made anew") from None
    made = _made(environment, psi, seed, at)
    with replacing(file) as part, part.open("wb") as to:
        np.savez(to, allow_pickle=False, **made)
    return made


def _made(environment: str, psi: Array, seed: int, at: int) -> Batch:
    """Of some rows, in an order that is drawn."""
    machine, rng = _machine(environment), np.random.default_rng([seed, at])
    sound, broken = (int(rng.integers(2**31)) for _ in range(2))
    parts = [trials(machine, psi[::2], sound, noise=0.0)]
    parts[0]["kind"] = np.zeros(len(parts[0]["row"]), int)
    parts += [faulty(machine, psi[1::2], broken, noise=0.0)] if len(psi) > 1 else []
    whole = {name: np.concatenate([p[name] for p in parts]) for name in ("states", "actions", "psi", "kind")}
    order, space = rng.permutation(len(whole["kind"])), machine.space
    inside = np.clip((whole["psi"] - space.low) / (space.high - space.low), 0, 1)
    plain = {"states": whole["states"], "actions": whole["actions"], "psi": inside}
    return {k: v[order].astype(np.float32) for k, v in plain.items()} | {"family": whole["kind"][order]}


def _of(rows: NDArray[np.intp], found: Batch) -> Batch:
    """Windows of some rows, whose rows are told among all."""
    return found | {"row": rows[found["row"]]}
