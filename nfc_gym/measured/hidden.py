"""The effects that a stand-in machine may hide, by formulas of its own; the package's are not used."""

# ruff: noqa: D102  (hooks are documented once, in Hidden)

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEP = 0.002  # s, of the stand-in; the assets' own step is 0.005


class Hidden:
    """One hidden effect; the base class hides nothing.

    Attributes:
      family, where: what a right answer names.
      parameters: true values, by the names that reports use.
      text: what is hidden, in words with units.
    """

    family = "none"

    def __init__(
        self, where: tuple[str, ...] = (), parameters: Mapping[str, float] | None = None, text: str = "nothing"
    ) -> None:
        self.where, self.parameters, self.text = where, dict(parameters or {}), text

    def shape(self, spec: mujoco.MjSpec) -> None:
        """Change the machine before it is built."""

    def begin(self, model: mujoco.MjModel) -> None:
        """Get ready for a run from the start."""

    def command(self, u: Array) -> Array:
        """What the actuators receive in this step of what was commanded, (nu,)."""
        return u

    def push(self, data: mujoco.MjData) -> None:
        """Add forces to `qfrc_applied` and `xfrc_applied`, both zero before."""

    def read(self, columns: dict[str, Array]) -> dict[str, Array]:
        """What the sensors report of a log's columns (T,) each."""
        return columns


class Loss(Hidden):
    """One actuator makes only a share of its force."""

    family = "loss"

    def __init__(self, actuator: str, fraction: float) -> None:
        super().__init__((actuator,), {"fraction": fraction}, f"{actuator} has lost {fraction:.1%} of its force")

    def shape(self, spec: mujoco.MjSpec) -> None:
        actuator, left = spec.actuator(self.where[0]), 1 - self.parameters["fraction"]
        actuator.gainprm = [left * g for g in actuator.gainprm]
        actuator.biasprm = [left * b for b in actuator.biasprm]
        actuator.forcerange = [left * f for f in actuator.forcerange]


class Payload(Hidden):
    """A lump bolted onto a body, as a body of its own."""

    family = "payload"

    def __init__(self, body: str, mass: float, at: Array) -> None:
        values = {"mass": mass, **dict(zip("xyz", map(float, at), strict=True))}
        place = ", ".join(f"{a:.3f}" for a in at)
        super().__init__((body,), values, f"{mass:.3g} kg rides on {body} at ({place}) m")
        self.at = at

    def shape(self, spec: mujoco.MjSpec) -> None:
        lump = spec.body(self.where[0]).add_body(name="lump", pos=self.at)
        lump.explicitinertial = True
        lump.ipos = [0.0, 0.0, 0.0]  # unset, MuJoCo takes the body's own place for it once more
        lump.mass, lump.inertia = self.parameters["mass"], np.full(3, 1e-8)


class Delay(Hidden):
    """Commands arrive late by a fixed time; between two steps a mixture of both."""

    family = "delay"

    def __init__(self, actuators: tuple[str, ...], delay: float) -> None:
        super().__init__(actuators, {"delay": delay}, f"commands arrive {1e3 * delay:.1f} ms late")

    def begin(self, model: mujoco.MjModel) -> None:
        self.past: list[Array] = []
        self.step = float(model.opt.timestep)

    def command(self, u: Array) -> Array:
        self.past.append(u)
        whole, part = divmod(self.parameters["delay"] / self.step, 1.0)
        newest = len(self.past) - 1 - int(whole)
        return (1 - part) * self.past[max(newest, 0)] + part * self.past[max(newest - 1, 0)]


class Lag(Hidden):
    """Commands are followed at a rate that is the gap over a time constant."""

    family = "lag"

    def __init__(self, actuators: tuple[str, ...], tau: float) -> None:
        super().__init__(actuators, {"time_constant": tau}, f"commands are followed with a lag of {1e3 * tau:.1f} ms")

    def begin(self, model: mujoco.MjModel) -> None:
        self.reached: Array | None = None
        self.step = float(model.opt.timestep)

    def command(self, u: Array) -> Array:
        before = u if self.reached is None else self.reached
        made = before + (1 - np.exp(-self.step / self.parameters["time_constant"])) * (u - before)
        self.reached = made
        return made


class Coulomb(Hidden):
    """A joint drags with a constant torque, passing through zero within about 0.1 rad/s."""

    family = "coulomb"

    def __init__(self, joint: str, level: float) -> None:
        super().__init__((joint,), {"level": level}, f"{joint} drags with {level:.3g} N m of dry friction")

    def begin(self, model: mujoco.MjModel) -> None:
        self.dof = int(model.joint(self.where[0]).dofadr[0])

    def push(self, data: mujoco.MjData) -> None:
        data.qfrc_applied[self.dof] -= self.parameters["level"] * np.tanh(data.qvel[self.dof] / 0.1)


class Slope(Hidden):
    """The floor leans: its normal is the model's z, and gravity is not along it."""

    family = "slope"

    def __init__(self, roll: float, pitch: float) -> None:
        lean = np.degrees(np.hypot(roll, pitch))
        super().__init__(("world",), {"roll": roll, "pitch": pitch}, f"the floor leans by {lean:.2f} degrees")

    def shape(self, spec: mujoco.MjSpec) -> None:
        roll, pitch = self.parameters["roll"], self.parameters["pitch"]
        lean = np.hypot(roll, pitch)
        if lean > 0:
            spec.option.gravity = [
                -9.81 * np.sin(lean) * pitch / lean,
                9.81 * np.sin(lean) * roll / lean,
                -9.81 * np.cos(lean),
            ]


@dataclass(frozen=True)
class Kind:
    """An effect that may be drawn: from a generator and a size to a `Hidden`; sizes lie between low and high."""

    make: Callable[[np.random.Generator, float], Hidden]
    low: float
    high: float
    unit: str
