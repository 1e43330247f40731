"""Effects of drives: weak, late, slow to follow, deaf to small commands, short of speed or of volts."""

from collections.abc import Sequence

import mujoco
import numpy as np

from .effect import Array, Effect, Form, Signals


class AtDrives(Effect):
    """An effect of some actuators; `self.ids` are their places in ctrl, `self.step` is the physics step, s."""

    def __init__(
        self, family: str, drives: Sequence[str], places: Sequence[str], parameters: dict[str, float], text: str,
        others: Sequence[Form] = (),
    ) -> None:  # fmt: skip
        said = f"{', '.join(drives)}: {text}"
        super().__init__((Form(family, tuple(drives), parameters), *others), places, said)
        self.drives = tuple(drives)

    def begin(self, model: mujoco.MjModel, signals: Signals) -> None:
        self.ids = [model.actuator(d).id for d in self.drives]
        self.step = float(model.opt.timestep)


class Loss(AtDrives):
    """A drive that makes only a share of its force, its servo loop and its limit included."""

    def __init__(self, drive: str, fraction: float, places: Sequence[str]) -> None:
        gain = Form("gain", (drive,), {"gain": 1 - fraction})
        super().__init__("loss", (drive,), places, {"fraction": fraction}, f"lost {fraction:.1%} of its force", (gain,))
        self.left = 1 - fraction

    def build(self, model: mujoco.MjModel) -> None:
        i = model.actuator(self.drives[0]).id
        model.actuator_gainprm[i] *= self.left
        model.actuator_biasprm[i] *= self.left
        model.actuator_forcerange[i] *= self.left


class Lag(AtDrives):
    """Commands are followed at a rate that is the gap over a time constant."""

    def __init__(self, drives: Sequence[str], tau: float, places: Sequence[str]) -> None:
        values = {"time_constant": tau}
        super().__init__("lag", drives, places, values, f"commands are followed with a lag of {1e3 * tau:.1f} ms")
        self.tau = tau

    def begin(self, model: mujoco.MjModel, signals: Signals) -> None:
        super().begin(model, signals)
        self.reached: Array | None = None

    def command(self, u: Array, data: mujoco.MjData, t: float) -> Array:
        wanted = u[self.ids]
        before = wanted if self.reached is None else self.reached
        self.reached = before + (1 - np.exp(-self.step / self.tau)) * (wanted - before)
        u[self.ids] = self.reached
        return u


class Delay(AtDrives):
    """Commands arrive late by a whole number of the truth's physics steps."""

    def __init__(self, drives: Sequence[str], delay: float, step: float, places: Sequence[str]) -> None:
        self.late = max(round(delay / step), 1)
        values = {"delay": self.late * step}
        super().__init__("delay", drives, places, values, f"commands arrive {1e3 * self.late * step:.1f} ms late")

    def begin(self, model: mujoco.MjModel, signals: Signals) -> None:
        super().begin(model, signals)
        self.past: list[Array] = []

    def command(self, u: Array, data: mujoco.MjData, t: float) -> Array:
        self.past.append(u[self.ids].copy())
        u[self.ids] = self.past[max(len(self.past) - 1 - self.late, 0)]
        return u


class DeadZone(AtDrives):
    """Commands below a width do nothing, and the others lack it."""

    def __init__(self, drive: str, width: float, places: Sequence[str]) -> None:
        super().__init__("dead_zone", (drive,), places, {"width": width}, f"deaf to commands below {width:.3g}")
        self.width = width

    def command(self, u: Array, data: mujoco.MjData, t: float) -> Array:
        given = u[self.ids]
        u[self.ids] = np.sign(given) * np.maximum(np.abs(given) - self.width, 0.0)
        return u


class TorqueSpeed(AtDrives):
    """A motor whose greatest force `peak` falls with its speed, by a share of `fall` a rad/s."""

    def __init__(self, drive: str, joint: str, peak: float, fall: float) -> None:
        super().__init__("torque_speed", (drive,), (joint,), {"fall": fall}, f"limit falls by {fall:.2%} a rad/s")
        self.joint, self.peak, self.fall = joint, peak, fall

    def command(self, u: Array, data: mujoco.MjData, t: float) -> Array:
        v = float(data.joint(self.joint).qvel[0])
        most = max(self.peak * (1 - self.fall * max(v, 0.0)), 0.0)
        least = -max(self.peak * (1 - self.fall * max(-v, 0.0)), 0.0)
        u[self.ids] = np.clip(u[self.ids], least, most)
        return u


class SupplySag(AtDrives):
    """A drive that follows its supply: force times (volts / reference) to a power."""

    def __init__(self, drive: str, exponent: float, reference: float, places: Sequence[str]) -> None:
        # A reference and a gain of the drive are the same thing, so the program keeps the reference: it is not scored.
        text = f"force goes with the supply's power {exponent:.3g}, all of it at {reference:.3g} V"
        super().__init__("supply_sag", (drive,), places, {"exponent": exponent}, text)
        self.exponent, self.reference = exponent, reference

    def begin(self, model: mujoco.MjModel, signals: Signals) -> None:
        super().begin(model, signals)
        self.volts = signals["supply"]

    def command(self, u: Array, data: mujoco.MjData, t: float) -> Array:
        u[self.ids] *= (self.volts(max(t, 0.0)) / self.reference) ** self.exponent
        return u
