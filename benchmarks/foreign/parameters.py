"""The model's own uncertain numbers: what the true machine has of them, and how a mapping file speaks of them."""

import re
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

_KINDS: dict[str, Callable[..., object]] = {"actuator": mujoco.MjModel.actuator, "geom": mujoco.MjModel.geom}


@dataclass(frozen=True)
class Parameter:
    """A number that the user is unsure of.

    Attributes:
      name, field, of, unit: as in a mapping file; several names in `of` share the value.
      spread: the true value is the model's times or over up to 1 + spread, log-uniform.
    """

    name: str
    field: str
    of: tuple[str, ...]
    unit: str
    spread: float = 0.15

    def nominal(self, model: mujoco.MjModel) -> float:
        """The user's model's value."""
        first = self.of[0]
        if self.field == "body_mass":
            return float(model.body_mass[model.body(first).id])
        if self.field in ("servo_kp", "servo_kv"):
            return float(model.actuator_gainprm[model.actuator(first).id, 0])
        values, index = self._array(model, first)
        return float(values[index])

    def draw(self, model: mujoco.MjModel, rng: np.random.Generator) -> float:
        """The true value."""
        return self.nominal(model) * float(np.exp(rng.uniform(-1, 1) * np.log1p(self.spread)))

    def write(self, model: mujoco.MjModel, value: float) -> None:
        """Make it the machine's; a mass brings its inertia along."""
        for name in self.of:
            if self.field == "body_mass":
                b = model.body(name).id
                model.body_inertia[b] *= value / model.body_mass[b]
                model.body_mass[b] = value
            elif self.field in ("servo_kp", "servo_kv"):
                i = model.actuator(name).id
                model.actuator_gainprm[i, 0] = value
                model.actuator_biasprm[i, 1 if self.field == "servo_kp" else 2] = -value
            else:
                values, index = self._array(model, name)
                values[index] = value

    def entry(self, model: mujoco.MjModel) -> str:
        """The line of the mapping file; bounds reach about twice as far as the spread."""
        nominal = self.nominal(model)
        low, high = nominal * (1 - 2 * self.spread), nominal * (1 + 2.2 * self.spread)
        tied = ", tied: true" if len(self.of) > 1 else ""
        return (
            f'  - {{name: {self.name}, field: "{self.field}", of: [{", ".join(self.of)}]{tied}, unit: {self.unit}, '
            f"low: {low:.6g}, high: {high:.6g}}}"
        )

    def _array(self, model: mujoco.MjModel, name: str) -> tuple[np.ndarray, tuple[int, ...]]:
        """The field's array and where in it the object's number is."""
        field, component = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", self.field).groups()  # type: ignore[union-attr]
        prefix = field.partition("_")[0]
        if prefix == "dof":
            row = int(model.joint(name).dofadr[0])
        elif prefix == "jnt":
            row = model.joint(name).id
        else:
            row = _KINDS[prefix](model, name).id  # type: ignore[attr-defined]
        return getattr(model, field), (row,) if component is None else (row, int(component))
