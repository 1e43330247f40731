"""psi: named, bounded numbers with units, each bound to fields of an `MjModel`.

The same `write` serves one model and a batch of simulations (`ModelFields`). Values are physical; `normalise` maps the
prior's box to [-1, 1].
"""

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.contact import restitution_solref
from nfc_gym.physics.fields import ModelFields, rows_of

Array = NDArray[np.float64]


def numbers(value: Any, name: str) -> Array:
    """A number, or numbers, as an array; anything else raises `InputError` with the value's name.

    A text that reads like a number is none, nor is a flag: whoever gives one has mistaken something.
    """
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "USbc":
            return given.astype(float)
    except (TypeError, ValueError):
        pass
    text = repr(value)
    shown = text if len(text) <= 80 else f"{text[:77]}..."
    raise InputError(f"{name} is {shown}, want a number or an array of numbers")


@dataclass(frozen=True)
class Parameter:
    """One number of psi.

    Attributes:
      name: unique in its space.
      field: an `MjModel` field, with a component in brackets where it has several (`geom_friction[0]`), an option
        (`opt.gravity[2]`, `opt.density`), or one of the compound fields in `COMPOUND`.
      of: the named objects that take the value, all the same.
      unit: of the value.
      low, high: the prior's bounds.
      nominal: None reads it from the model.
      anchored: known from a scale or a ruler; it stays at its nominal value and fixes the gauge of the others.
    """

    name: str
    field: str
    of: tuple[str, ...] = ()
    unit: str = "1"
    low: float = 0.0
    high: float = 1.0
    nominal: float | None = None
    anchored: bool = False
    reason: str = ""


def _write_mass(fields: ModelFields, rows: NDArray[np.intp], value: Array) -> None:
    """A body's mass; its inertia scales with it, as for a body of the same shape and another density."""
    mass, inertia = fields["body_mass"], fields["body_inertia"]
    nominal = fields.nominal("body_mass")[rows]
    mass[..., rows] = value
    inertia[..., rows, :] = fields.nominal("body_inertia")[rows] * (value / nominal)[..., None]


def _write_servo_kv(fields: ModelFields, rows: NDArray[np.intp], value: Array) -> None:
    """Gain of a `velocity` servo: force = kv (ctrl - velocity)."""
    fields["actuator_gainprm"][..., rows, 0] = value
    fields["actuator_biasprm"][..., rows, 2] = -value


def _write_servo_kp(fields: ModelFields, rows: NDArray[np.intp], value: Array) -> None:
    """Gain of a `position` servo: force = kp (ctrl - position) - kv velocity."""
    fields["actuator_gainprm"][..., rows, 0] = value
    fields["actuator_biasprm"][..., rows, 1] = -value


def _write_restitution(fields: ModelFields, rows: NDArray[np.intp], value: Array) -> None:
    """Coefficient of restitution of a geom, through a direct `solref` (see `contact.restitution_solref`)."""
    fields["geom_solref"][..., rows, :] = restitution_solref(value)


# Compound fields: several model fields that one physical number moves together -> (field that names its rows, writer).
COMPOUND = {
    "body_mass": ("body_mass", _write_mass),
    "servo_kv": ("actuator_gainprm", _write_servo_kv),
    "servo_kp": ("actuator_gainprm", _write_servo_kp),
    "geom_restitution": ("geom_solref", _write_restitution),
}
# What they set alone: of a body's inertia, which follows its mass, one moment may be a parameter of its own.
_CELLS: dict[str, tuple[tuple[str, int | None], ...]] = {
    "servo_kv": (("actuator_gainprm", 0), ("actuator_biasprm", 2)),
    "servo_kp": (("actuator_gainprm", 0), ("actuator_biasprm", 1)),
    "geom_restitution": (("geom_solref", 0), ("geom_solref", 1)),
}
_MEDIUM = ("opt.density", "opt.viscosity")  # options that are plain numbers: all that MuJoCo knows of air or water
_READ = {"servo_kv": ("actuator_gainprm", 0), "servo_kp": ("actuator_gainprm", 0)}
_WIDE = 100  # characters of a `repr` on one line
_ANY, _AT_LEAST_0 = (-np.inf, np.inf), (0.0, np.inf)
_SOLID = (np.nextafter(0.0, 1.0), np.inf)  # a mass: more than 0
# Field -> (least, most) that nature allows, masses apart.
_POSSIBLE = {
    "geom_restitution": (0.0, 1.0),
    **dict.fromkeys(
        (
            "geom_friction", "jnt_stiffness", "dof_damping", "dof_armature", "dof_frictionloss",
            "tendon_stiffness", "tendon_damping", "tendon_frictionloss", "servo_kp", "servo_kv", *_MEDIUM,
        ),
        _AT_LEAST_0,
    ),
}  # fmt: skip
_FIELD = re.compile(r"^([\w.]+?)(?:\[(\d+)\])?$")


def split_field(field: str) -> tuple[str, int | None]:
    """`geom_friction[0]` -> (`geom_friction`, 0); without brackets the component is None."""
    match = _FIELD.match(field)
    if match is None:
        raise InputError(
            f"field {field!r}: want a name of MjModel, with one component in brackets where it has several"
        )
    return match[1], None if match[2] is None else int(match[2])


@dataclass(frozen=True)
class _Bound:
    """A field resolved against a model: where a value of a parameter goes."""

    name: str
    component: int | None
    rows: NDArray[np.intp] | None


def resolve(model: mujoco.MjModel, field: str, of: Sequence[str]) -> _Bound:
    """Resolve a field and its objects' names against a model; raises `InputError` naming what does not exist."""
    name, component = split_field(field)
    if name in _MEDIUM:
        if component is not None:
            raise InputError(f"field {field!r}: {name} is one number and has no components: leave the brackets out")
        return _Bound(name, None, None)
    if name.startswith("opt."):
        owner, key = model.opt, name[4:]
    else:
        owner, key = model, COMPOUND.get(name, (name,))[0]
    array = getattr(owner, key, None)
    if not isinstance(array, np.ndarray):
        raise InputError(
            f"field {field!r} is not an array field of MjModel (or one of {', '.join((*COMPOUND, *_MEDIUM))})"
        )
    if array.dtype.kind == "i":
        raise InputError(f"field {field!r} holds whole numbers, by which the model is built: they cannot be written")
    if name.startswith("opt."):
        if component is None or component >= len(array):
            raise InputError(f"field {field!r}: name one of its {len(array)} components, for instance {name}[0]")
        return _Bound(name, component, None)
    if not of:
        raise InputError(f"field {field!r}: `of` must name at least one object")
    rows = rows_of(model, name, tuple(of))
    if name not in COMPOUND and array.ndim == 2 and component is None:
        raise InputError(f"field {field!r} has {array.shape[1]} components: name one, for instance {field}[0]")
    if component is not None and (array.ndim != 2 or component >= array.shape[1]):
        size = array.shape[1] if array.ndim == 2 else 1
        raise InputError(f"field {field!r}: component {component} does not exist, the field has {size}")
    return _Bound(name, component, rows)


def write_field(fields: ModelFields, bound: _Bound, value: Array) -> None:
    """Write `value` (...,) to every row of a resolved field, over the fields' own batch shape."""
    value = np.asarray(value, float)
    if bound.rows is None and bound.component is None:
        fields[bound.name][...] = value
    elif bound.rows is None:
        fields[bound.name][..., bound.component] = value
    elif bound.name in COMPOUND:
        COMPOUND[bound.name][1](fields, bound.rows, np.broadcast_to(value[..., None], (*value.shape, len(bound.rows))))
    elif bound.component is None:
        fields[bound.name][..., bound.rows] = value[..., None]
    else:
        fields[bound.name][..., bound.rows, bound.component] = value[..., None]


def _require_mass(model: mujoco.MjModel, p: Parameter, bound: _Bound) -> None:
    if p.low <= 0:
        raise InputError(f"parameter {p.name!r}: low is {p.low:g} {p.unit}; a mass must be positive")
    for body in np.arange(model.nbody)[bound.rows]:
        if model.body_mass[body] <= 0:
            raise InputError(
                f"parameter {p.name!r}: body {model.body(body).name!r} has no mass in the model, and so no "
                "inertia that could grow with it; name a body with a mass"
            )


def _require_possible(p: Parameter, bound: _Bound, value: Array) -> None:
    """Refuse values (...,) of a parameter that nature does not allow."""
    if bound.name == "body_mass" and (value <= 0).any():
        raise InputError(f"parameter {p.name!r}: a mass must be positive, got {float(value.min()):g} {p.unit}")
    least, most = _POSSIBLE.get(bound.name, _ANY)
    wrong = value[(value < least) | (value > most)]
    if wrong.size:
        unit = "" if p.unit == "1" else f" {p.unit}"
        want = "0 or more" if most == np.inf else f"a number from {least:g} to {most:g}"
        raise InputError(f"parameter {p.name!r} is {float(wrong[0]):g}{unit}, want {want}")


def _require_apart(parameters: Sequence[Parameter], bounds: Sequence[_Bound]) -> None:
    """Refuse two parameters that write the same number."""
    first: dict[tuple[str, int, int | None], str] = {}
    for p, bound in zip(parameters, bounds, strict=True):
        rows = [0] if bound.rows is None else bound.rows.tolist()
        cells = _CELLS.get(bound.name, ((bound.name, bound.component),))
        for cell in ((name, row, component) for name, component in cells for row in rows):
            other = first.setdefault(cell, p.name)
            if other != p.name:
                raise InputError(
                    f"parameters {other!r} and {p.name!r} write the same number, of {p.field}: leave one out"
                )


class ParameterSpace:
    """An ordered box of parameters bound to one model.

    Args:
      model: the nominal model, from which omitted nominal values are read.
      parameters: in the order of the psi vector.

    Attributes:
      low, high, nominal: (d,) of the prior.
      least, most: (d,) what nature allows, wherever the prior's bounds are.

    Raises:
      InputError: a field, an object or a component does not exist; bounds are not ordered; the nominal lies outside; a
        mass may become zero, or is that of a body without any.
    """

    def __init__(self, model: mujoco.MjModel, parameters: Sequence[Parameter]) -> None:
        self.parameters = tuple(parameters)
        self._bound = [resolve(model, p.field, p.of) for p in parameters]
        # Compound fields first: a mass scales all of an inertia, of which one moment may be a parameter of its own.
        self._order = sorted(range(len(self._bound)), key=lambda i: self._bound[i].name not in COMPOUND)
        self.names = tuple(p.name for p in parameters)
        self.units = tuple(p.unit for p in parameters)
        twice = {n for n in self.names if self.names.count(n) > 1}
        if twice:
            raise InputError(f"parameters named twice: {', '.join(sorted(twice))}")
        _require_apart(parameters, self._bound)
        possible = [_SOLID if b.name == "body_mass" else _POSSIBLE.get(b.name, _ANY) for b in self._bound]
        self.least, self.most = np.reshape(np.array(possible, float), (-1, 2)).T
        self.low = np.array([p.low for p in parameters], float)
        self.high = np.array([p.high for p in parameters], float)
        self.nominal = np.array(
            [
                self._read(model, b) if p.nominal is None else p.nominal
                for p, b in zip(parameters, self._bound, strict=True)
            ],
            float,
        )
        for p, value, bound in zip(parameters, self.nominal, self._bound, strict=True):
            if bound.name == "body_mass":
                _require_mass(model, p, bound)
            if not p.low < p.high:
                raise InputError(f"parameter {p.name!r}: low {p.low:g} must be below high {p.high:g}")
            if not p.low <= value <= p.high:
                raise InputError(
                    f"parameter {p.name!r}: nominal {value:g} {p.unit} lies outside [{p.low:g}, {p.high:g}]"
                )

    def __len__(self) -> int:
        return len(self.parameters)

    def __repr__(self) -> str:
        rows = [f"{p.name} {p.low:g}..{p.high:g}{'' if p.unit == '1' else f' {p.unit}'}" for p in self.parameters]
        line = f"{type(self).__name__}({', '.join(rows)})"
        return line if len(line) <= _WIDE else "\n".join([f"{type(self).__name__}(", *(f"  {r}," for r in rows), ")"])

    @property
    def free(self) -> NDArray[np.bool_]:
        """(d,) which parameters are not anchored."""
        return np.array([not p.anchored for p in self.parameters], bool)

    def tied(self, model: mujoco.MjModel, i: int) -> Array:
        """(n,) what a model has of the i-th parameter at each of the objects that share it."""
        return self._values(model, self._bound[i])

    def _read(self, model: mujoco.MjModel, bound: _Bound) -> float:
        if bound.name == "geom_restitution":
            raise InputError("geom_restitution has no single nominal value in the model: give `nominal`")
        return float(self._values(model, bound)[0])

    @staticmethod
    def _values(model: mujoco.MjModel, bound: _Bound) -> Array:
        name, component = _READ.get(bound.name, (bound.name, bound.component))
        array = np.asarray(getattr(model.opt, name[4:]))[None] if name.startswith("opt.") else getattr(model, name)
        rows = array if bound.rows is None else array[bound.rows]
        return rows if component is None else rows[:, component]

    def write(self, fields: ModelFields, psi: ArrayLike) -> None:
        """Write psi (d,) to one model, or (nsim, d) to a batch. Call `fields.commit()` once everything is written.

        Raises:
          InputError: a value is not finite, or a mass is not positive.
        """
        psi = np.asarray(psi, float)
        if psi.shape[-1:] != (len(self),):
            raise InputError(f"psi must end in {len(self)} values ({', '.join(self.names)}), got shape {psi.shape}")
        for i in self._order:
            p, bound, value = self.parameters[i], self._bound[i], psi[..., i]
            if not np.isfinite(value).all():
                raise InputError(f"parameter {p.name!r} is not finite")
            if bound.name == "body_mass":
                _require_possible(p, bound, value)
            write_field(fields, bound, value)

    def require_possible(self, psi: ArrayLike) -> None:
        """Refuse psi (..., d) that nature does not allow, such as negative friction; it may leave the prior's box.

        `write` asks it of masses alone: bounds that a fit was given may reach further.

        Raises:
          InputError: naming the parameter and what it can be.
        """
        psi = np.asarray(psi, float)
        if not ((psi < self.least) | (psi > self.most)).any():  # at every reset: all parameters at once
            return
        for i, (p, bound) in enumerate(zip(self.parameters, self._bound, strict=True)):
            _require_possible(p, bound, psi[..., i])

    def normalise(self, psi: ArrayLike) -> Array:
        """Physical values (..., d) to [-1, 1] by the prior's bounds, not clipped."""
        return 2 * (np.asarray(psi, float) - self.low) / (self.high - self.low) - 1

    def denormalise(self, unit_box: ArrayLike) -> Array:
        """Inverse of `normalise`."""
        return self.low + (np.asarray(unit_box, float) + 1) / 2 * (self.high - self.low)

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """(size, d) uniform draws from the prior's box; anchored parameters stay nominal."""
        draws = rng.uniform(self.low, self.high, (size, len(self)))
        return np.where(self.free, draws, self.nominal)

    def vector(self, values: "dict[str, float] | ArrayLike") -> Array:
        """(d,) from a dict of names (the rest nominal) or a vector.

        Raises:
          InputError: an unknown name, or a value that is no number.
        """
        if not isinstance(values, dict):
            return numbers(values, "psi")
        unknown = sorted(set(values) - set(self.names))
        if unknown:
            raise InputError(f"no parameter named {unknown[0]!r}; there are: {', '.join(self.names)}")
        given = {n: numbers(v, f"psi[{n!r}]") for n, v in values.items()}
        for name, value in given.items():
            if value.ndim:
                raise InputError(f"psi[{name!r}] has shape {value.shape}, want one number")
        return np.array([given.get(n, v) for n, v in zip(self.names, self.nominal, strict=True)], float)


def parameters_from_toml(path: Path) -> list[Parameter]:
    """The psi of a robot from its `psi.toml`: an array of tables `[[parameter]]` with the attributes of `Parameter`."""
    rows = tomllib.loads(path.read_text())["parameter"]
    return [Parameter(**{**row, "of": tuple(row.get("of", ()))}) for row in rows]
