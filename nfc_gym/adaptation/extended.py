"""What `nfc-gym close-loop` found, as a policy is to be adapted to it: calibrated parameters and named effects.

Its folder holds `effects.yaml` (what `model.xml` does not carry), `model.xml` (all the rest) and `report.json` (every
effect with the interval of its sizes, every parameter). Parts of that will do: a hand-written `effects.yaml`, which may
have `psi` too, or a `model.xml` that was sent alone.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.saved import from_row
from nfc_gym.wrappers.effects_file import psi_said, read_effects

Array = NDArray[np.float64]
REPORT, EFFECTS, MODEL = "report.json", "effects.yaml", "model.xml"


@dataclass(frozen=True)
class Calibrated:
    """A calibrated parameter: its place in the model, its value and the 95 % interval."""

    name: str
    unit: str
    field: str
    of: tuple[str, ...]
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Named:
    """A named effect.

    Attributes:
      id: `family:place`.
      sentence: what it is, in words.
      effect: not bound to a model.
      theta, low, high: (k,) its values and their 95 % intervals.
    """

    id: str
    sentence: str
    effect: Effect
    theta: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Found:
    """What was found in a file or folder.

    Attributes:
      source: the path that was given.
      effects: in the order in which they act.
      parameters: calibrated psi by its places in the model.
      psi: by the names of the environment, from a hand-written file.
      model: a corrected model that is to be read field by field, as there is no report of what it carries.
      verdict: of the report; None without one.
    """

    source: Path
    effects: tuple[Named, ...] = ()
    parameters: tuple[Calibrated, ...] = ()
    psi: Mapping[str, float] = field(default_factory=dict)
    model: Path | None = None
    verdict: str | None = None

    @property
    def digest(self) -> str:
        """What tells it from another finding."""
        told = {
            "effects": [[n.id, *(a.tolist() for a in (n.theta, n.low, n.high))] for n in self.effects],
            "parameters": [[p.name, p.field, list(p.of), p.value, p.low, p.high] for p in self.parameters],
            "psi": dict(self.psi),
        }
        sha = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
        if self.model is not None:
            sha.update(self.model.read_bytes())
        return sha.hexdigest()[:16]


def read_found(path: str | Path) -> Found:
    """Read what close-loop wrote, or a part of it.

    Args:
      path: its folder, or an `effects.yaml`, `report.json` or `model.xml`. Of a folder and of an `effects.yaml` that
        lies in one the whole folder counts; a `model.xml` counts alone.

    Raises:
      InputError: no such file, nothing of this in a folder, the summary over folds, or a damaged file; with the entry.
      MissingExtra: YAML cannot be read for want of the extra `measured`.
    """
    path = Path(path)
    if path.is_dir():
        there = {name: path / name for name in (EFFECTS, REPORT, MODEL) if (path / name).is_file()}
        if not there:
            holds = ", ".join(sorted(p.name for p in path.iterdir())[:8]) or "nothing"
            raise InputError(
                f"{path}: want a folder of `nfc-gym close-loop` with {EFFECTS}, {REPORT} or {MODEL}; it has: {holds}"
            )
        return _folder(path, there)
    if not path.is_file():
        raise InputError(f"{path}: no such file or folder; want what `nfc-gym close-loop --out` wrote")
    if path.suffix == ".xml":
        return Found(path, model=path)
    if path.name == REPORT:
        return _folder(path, {REPORT: path})
    beside = {name: path.with_name(name) for name in (REPORT, MODEL) if path.with_name(name).is_file()}
    return _folder(path, {EFFECTS: path} | beside)


def _folder(source: Path, there: Mapping[str, Path]) -> Found:
    """Of the files that there are: a report says all; without one effects.yaml and model.xml share it."""
    report = _report(there[REPORT]) if REPORT in there else None
    if EFFECTS not in there:
        if report is None:
            return Found(source, model=there[MODEL])
        effects = _effects(there[REPORT], _claimed(report))
        return Found(source, effects, _parameters(there[REPORT], report), verdict=report.get("verdict"))
    file, data = there[EFFECTS], read_effects(there[EFFECTS])
    rows, carried = list(data["effects"]), [str(i) for i in data.get("carried_by_model") or []]
    psi = psi_said(file, data)
    if report is None:
        if carried and MODEL not in there:
            raise InputError(
                f"{file}: the {MODEL} that was written with it carries {', '.join(carried)}, and neither that nor "
                f"{REPORT} lies beside it: give the whole folder"
            )
        return Found(source, _effects(file, rows), (), psi, there.get(MODEL))
    known = {r["id"]: r for r in _claimed(report)}
    missing = [i for i in carried if i not in known]
    if missing:
        raise InputError(f"{file} and {there[REPORT]} are of two runs: {missing[0]!r} is in the first alone")
    rows += [known[i] for i in carried]
    order = {i: k for k, i in enumerate(known)}
    rows.sort(key=lambda r: order.get(r.get("id", ""), len(order)) if isinstance(r, Mapping) else -1)  # as in the fit
    return Found(source, _effects(file, rows), _parameters(there[REPORT], report), psi, verdict=report.get("verdict"))


def _claimed(report: Mapping[str, Any]) -> list[Any]:
    return [*report["effects"], *report.get("proposals", [])]


def _report(file: Path) -> dict[str, Any]:
    try:
        report = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise InputError(f"{file}: is no report of `nfc-gym close-loop` ({str(e).splitlines()[0]})") from None
    if isinstance(report, dict) and "folds" in report:
        raise InputError(f"{file} is the summary over folds; give the folder of one: {', '.join(report['folds'])}")
    if not isinstance(report, dict) or not {"effects", "parameters"} <= set(report):
        raise InputError(f"{file}: is no report of `nfc-gym close-loop`: it has no `effects` and `parameters`")
    return report


def _parameters(file: Path, report: Mapping[str, Any]) -> tuple[Calibrated, ...]:
    found = []
    for row in report["parameters"]:
        name = row.get("name")
        if "field" not in row:
            raise InputError(
                f"{file}: does not say where parameter {name!r} goes in the model (`field`, `of`): an earlier version "
                "wrote it; run `nfc-gym close-loop` again"
            )
        value, low, high = (_finite(file, f"parameter {name} {k}", row.get(k)) for k in ("estimate", "low", "high"))
        _ordered(file, f"parameter {name}", low, value, high)
        found.append(Calibrated(name, row["unit"], row["field"], tuple(row["of"]), value, low, high))
    return tuple(found)


def _effects(file: Path, rows: list[Any]) -> tuple[Named, ...]:
    found = []
    for row in rows:
        try:
            effect, theta = from_row(row)
        except InputError as e:
            raise InputError(f"{file}: {e}") from None
        given, values = row["parameters"], zip(effect.params, theta.tolist(), strict=True)
        bounds = [_interval(file, effect.id, p.name, given.get(p.name), v) for p, v in values]
        low, high = (np.array([b[i] for b in bounds], float) for i in (0, 1))
        sentence = str(row.get("sentence") or effect.say(theta))
        found.append(Named(effect.id, sentence, effect, theta, low, high))
    twice = [n.id for i, n in enumerate(found) if n.id in {m.id for m in found[:i]}]
    if twice:
        raise InputError(f"{file}: {twice[0]!r} is there twice")
    return tuple(found)


def _interval(file: Path, effect: str, name: str, entry: Any, value: float) -> tuple[float, float]:
    """The interval of a value; one that is not given is the value alone."""
    given = entry if isinstance(entry, Mapping) else {}
    low, high = (_finite(file, f"effect {effect} {name} {k}", given.get(k, value)) for k in ("low", "high"))
    _ordered(file, f"effect {effect} {name}", low, value, high)
    return low, high


def _finite(file: Path, what: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{file}: {what} is {value!r}; it must be a finite number")
    return float(value)


def _ordered(file: Path, what: str, low: float, value: float, high: float) -> None:
    slack = 1e-9 * max(abs(low), abs(value), abs(high))
    if not low - slack <= value <= high + slack:
        raise InputError(f"{file}: {what} is {value:g}, outside its interval from {low:g} to {high:g}")
