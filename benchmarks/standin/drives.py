"""Drives that a stand-in may hide: a command of another scale, and motors that fade as they warm up."""

from collections.abc import Sequence

import mujoco

from nfc_gym.measured.hidden import Array, Hidden

from .faults import OnCommand


class CommandGain(OnCommand):
    """Servos are sent to another goal than was asked for, in proportion: a gear or a wheel of another size."""

    family = "command_gain"

    def __init__(self, actuators: Sequence[str], gain: float) -> None:
        super().__init__(tuple(actuators), {"gain": gain}, f"{'+'.join(actuators)} take {gain:.4g} of their command")

    def received(self, u: Array) -> Array:
        return self.parameters["gain"] * u


class Thermal(Hidden):
    """A motor heated by its winding: what it makes falls by a share `fade` of itself at the heat of a steady reference.

    dh/dt = ((F / reference)^2 - h) / time_constant, where F is the force that a cold motor would make of its command.
    Before the log, where the simulation's clock is below 0, it is as warm as if it had long gone on like that.
    """

    family = "thermal"

    def __init__(self, actuator: str, fade: float, time_constant: float, reference: float) -> None:
        values = {"fade": fade, "time_constant": time_constant, "reference": reference}
        text = f"{actuator} fades by {fade:.2%} at a steady {reference:.3g}, within {time_constant:.2g} s"
        super().__init__((actuator,), values, text)

    def begin(self, model: mujoco.MjModel) -> None:
        self.model, self.id = model, model.actuator(self.where[0]).id
        self.gain, self.step = model.actuator_gainprm[self.id].copy(), model.opt.timestep
        self.heat, self.left = 0.0, 1.0

    def push(self, data: mujoco.MjData) -> None:
        p, cold = self.parameters, data.actuator_force[self.id] / self.left
        share = self.step / p["time_constant"] if data.time >= 0 else 1.0
        self.heat += share * ((cold / p["reference"]) ** 2 - self.heat)
        self.left = 1 - p["fade"] * self.heat
        self.model.actuator_gainprm[self.id] = self.left * self.gain
