"""Effects as plain data, and the corrected model as MJCF that plain MuJoCo loads."""

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.measured.fit import Fit
from nfc_gym.physics.effects.air import hull, hull_mark
from nfc_gym.physics.effects.base import Effect, overrides
from nfc_gym.physics.effects.inertial import Moved
from nfc_gym.physics.effects.places import body_ids
from nfc_gym.physics.effects.saved import from_row, to_row
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_HOOKS_OUTSIDE_MJCF = ("action", "friction", "force", "sense", "unsense")


def pack(fitted: Fit) -> dict[str, Any]:
    """Psi and effects of a fit as JSON-able data; `unpack` reads it back."""
    psi, thetas = fitted.plant.split(fitted.x)
    return {
        "psi": dict(zip(fitted.plant.space.names, map(float, psi), strict=True)),
        "effects": [to_row(e, t) for e, t in zip(fitted.plant.effects, thetas, strict=True)],
    }


def unpack(data: dict[str, Any], plant: Plant) -> tuple[Plant, Array]:
    """The plant with its effects, and the full parameter vector (size,).

    Raises:
      InputError: the data are not what `pack` makes, or of another model.
    """
    psi, rows = (data.get(k) for k in ("psi", "effects")) if isinstance(data, dict) else (None, None)
    if not isinstance(psi, dict) or not isinstance(rows, list):
        raise InputError("a fitted model has the keys psi (a mapping of names to numbers) and effects (a list)")
    for name, value in psi.items():
        if not isinstance(value, int | float) or not np.isfinite(float(value)):
            raise InputError(f"psi: {name} is {str(value)[:40]!r}; it must be a finite number")
    pairs = [from_row(row) for row in rows]
    whole = plant.with_effects([e for e, _ in pairs])
    return whole, np.concatenate([plant.space.vector(psi), *(theta for _, theta in pairs)])


def corrected(spec: mujoco.MjSpec, plant: Plant, x: Array) -> tuple[str, list[Effect]]:
    """MJCF text with psi and every effect that MJCF can say, and the effects that it cannot.

    Effects that only edit model fields are carried through those fields; effects with a structural edit of their own
    (delay, lag, dry friction) are carried by it; all others stay outside.
    """
    spec = spec.copy()
    model = spec.compile()
    hulls = {
        b: hull(model, b) for e in plant.effects if isinstance(e, Moved) for b in body_ids(model, e.where).tolist()
    }
    fields = ModelFields(model, copy.copy(model))
    psi, thetas = plant.split(x)
    plant.space.write(fields, psi)
    pairs = list(zip(plant.effects, thetas, strict=True))
    for effect, theta in pairs:
        if overrides(effect, "model") and not overrides(effect, "spec") and not _outside(effect):
            effect.model(fields, theta)
    fields.commit()
    spec.copy_back(model)
    outside = [e for e, theta in pairs if not _carried(e, theta, spec)]
    for body, at in hulls.items():  # what is not in the model finds them here, as it found them in the nominal one
        mark = hull_mark(model.body(body).name)
        numeric = next((n for n in spec.numerics if n.name == mark), None) or spec.add_numeric(name=mark, size=3)
        numeric.data = at
    try:
        spec.compile()
    except ValueError:
        # Motion about one axis does not show the other two: let MuJoCo make such an inertia physical.
        spec.compiler.balanceinertia = 1
        spec.compile()
    return spec.to_xml(), outside


def _outside(effect: Effect) -> bool:
    return any(overrides(effect, hook) for hook in _HOOKS_OUTSIDE_MJCF)


def _carried(effect: Effect, theta: Array, spec: mujoco.MjSpec) -> bool:
    if overrides(effect, "spec"):
        return effect.spec(spec, theta)
    return overrides(effect, "model") and not _outside(effect)


def effects_of(plant: Plant, x: Array, which: Sequence[Effect] | None = None) -> list[tuple[Effect, Array]]:
    """(effect, theta) pairs of a fitted vector, all or some."""
    return [(e, t) for e, t in zip(plant.effects, plant.split(x)[1], strict=True) if which is None or e in which]
