"""Calibrated values that an environment has no psi for, put into its model: by parameter, or field by field.

Both are effects whose only hook edits the model, so that they go where effects go: after psi, before any other effect.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.adaptation.extended import Calibrated
from nfc_gym.core.errors import InputError
from nfc_gym.measured.model import compile_model, read_spec
from nfc_gym.physics.effects.base import Array, Effect
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.fields import ModelFields, names_of, rows_of
from nfc_gym.physics.names import names
from nfc_gym.physics.parameters import Parameter, ParameterSpace

_ANY = 1e30
# Fields that calibration and effects write, by the kind of object whose names say which rows belong together.
_FIELDS: Mapping[str, tuple[str, ...]] = {
    "body": ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_gravcomp"),
    "joint": (
        "jnt_stiffness", "jnt_range", "qpos_spring", "dof_damping", "dof_armature", "dof_frictionloss",
    ),
    "geom": ("geom_friction", "geom_solref", "geom_solimp"),
    "actuator": (
        "actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_dynprm", "actuator_ctrlrange",
        "actuator_forcerange",
    ),
}  # fmt: skip
_OPTIONS = ("opt.gravity", "opt.wind")


class Parameters(Effect):
    """Calibrated parameters that are no psi of the environment."""

    family: ClassVar[str] = "calibrated_parameters"
    summary: ClassVar[str] = "Calibrated parameters"

    def __init__(self, given: Sequence[Calibrated]) -> None:
        self.given = tuple(given)
        params = [Param(p.name, p.unit, -_ANY, _ANY) for p in given]
        super().__init__([w for p in given for w in p.of] or ["world"], params)

    @property
    def low(self) -> Array:
        """(k,) the least that nature allows: intervals are no bounds, as draws may be wider. Of a bound effect."""
        return self.space.least

    @property
    def high(self) -> Array:
        """(k,) the most that nature allows."""
        return self.space.most

    def bind(self, model: mujoco.MjModel) -> None:
        """See `Effect`."""
        least = {p.name: 1e-9 if p.field == "body_mass" else -_ANY for p in self.given}
        self.space = ParameterSpace(
            model,
            [
                Parameter(p.name, p.field, p.of, p.unit, least[p.name], _ANY, max(p.value, least[p.name]))
                for p in self.given
            ],
        )

    def model(self, fields: ModelFields, theta: Array) -> None:
        """See `Effect`."""
        self.space.write(fields, theta)


class Fields(Effect):
    """Rows of model fields with the values of a corrected model of the same robot.

    Attributes:
      values: field -> (rows, values), of the model that it is bound to.
    """

    family: ClassVar[str] = "corrected_model"
    summary: ClassVar[str] = "The fields of a corrected model"

    def __init__(self, theirs: mujoco.MjModel) -> None:
        self.theirs = theirs
        self.values: dict[str, tuple[NDArray[np.intp], Array]] = {}
        super().__init__(["world"], ())

    def bind(self, model: mujoco.MjModel) -> None:
        """See `Effect`."""
        self.values = differing(self.theirs, model)

    def model(self, fields: ModelFields, theta: Array) -> None:
        """See `Effect`."""
        for name, (rows, values) in self.values.items():
            fields[name][(..., rows) if values.ndim == 1 else (..., rows, slice(None))] = values


def value_in(model: mujoco.MjModel, p: Parameter | Calibrated) -> float:
    """The value that a model has where a parameter goes."""
    least = 1e-12 if p.field == "body_mass" else -_ANY
    return float(ParameterSpace(model, [Parameter(p.name, p.field, p.of, p.unit, least, _ANY)]).nominal[0])


def model_like(file: Path, mine: mujoco.MjModel, environment: str) -> mujoco.MjModel:
    """A corrected model, compiled.

    Raises:
      InputError: it cannot be read, is of another robot than the environment's, or has drives of another kind.
    """
    theirs = compile_model(read_spec(file.name, file.parent), str(file))
    a, b = names(theirs), names(mine)
    for kind, have, want in (
        ("body", a.bodies, b.bodies), ("joint", a.joints, b.joints), ("actuator", a.actuators, b.actuators),
    ):  # fmt: skip
        odd = [n for n in have if n not in want]
        lacking = [n for n in want if n not in have] if kind != "body" else []
        if odd or lacking:
            says = f"has the {kind} {odd[0]!r}" if odd else f"lacks the {kind} {lacking[0]!r}"
            raise InputError(f"{file}: is no model of {environment}: it {says}; that has: {', '.join(want)}")
    changed = [
        n for i, n in enumerate(a.actuators)
        if int(theirs.actuator_dyntype[i]) != int(mine.actuator_dyntype[b.actuators.index(n)])
    ]  # fmt: skip
    if theirs.na != mine.na or changed:
        raise InputError(
            f"{file}: gives {changed[0] if changed else 'a drive'!r} a lag or a delay of MuJoCo's own, which a running "
            "environment cannot take over; keep the report.json of the same run beside it, which says what that is"
        )
    return theirs


def differing(theirs: mujoco.MjModel, mine: mujoco.MjModel) -> dict[str, tuple[NDArray[np.intp], Array]]:
    """Rows of `mine` in which a corrected model of the same robot differs, with its values."""
    found: dict[str, tuple[NDArray[np.intp], Array]] = {}
    for kind, fields in _FIELDS.items():
        known = [n for n in _names(theirs, kind) if n and n in _names(mine, kind)]
        for name in fields:
            a, b = getattr(theirs, name), getattr(mine, name)
            of, to = ([rows_of(m, name, (n,)) for n in known] for m in (theirs, mine))
            off = [not np.allclose(a[x], b[y], rtol=1e-6, atol=1e-12) for x, y in zip(of, to, strict=True)]
            if any(off):
                rows = np.concatenate([y for y, o in zip(to, off, strict=True) if o])
                found[name] = (rows, np.concatenate([a[x] for x, o in zip(of, off, strict=True) if o]))
    for name in _OPTIONS:
        a, b = (np.asarray(getattr(m.opt, name[4:]), float) for m in (theirs, mine))
        if not np.allclose(a, b, rtol=1e-6, atol=1e-12):
            found[name] = (np.arange(len(a)), a.copy())
    return found


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    obj = {
        "body": (mujoco.mjtObj.mjOBJ_BODY, model.nbody), "joint": (mujoco.mjtObj.mjOBJ_JOINT, model.njnt),
        "geom": (mujoco.mjtObj.mjOBJ_GEOM, model.ngeom), "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, model.nu),
    }[kind]  # fmt: skip
    return names_of(model, *obj)
