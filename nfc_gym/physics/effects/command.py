"""What reaches the actuator in place of the command: offset, dead zone, saturation, sag of the supply."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import TIME, Array, Context, Effect, Scales
from nfc_gym.physics.effects.drive import (
    ENDLESS,
    actuator_places,
    command_unit,
    is_position,
    moves_length,
    plain,
    servos,
)
from nfc_gym.physics.effects.lookup import actuator_ids, actuator_names, index, limited
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import sized, with_units
from nfc_gym.physics.effects.ranges import mixes, narrow_ranges, shift_range, stretch_range
from nfc_gym.physics.effects.timing import command_limits
from nfc_gym.physics.effects.words import together, with_spread
from nfc_gym.physics.fields import ModelFields

_NONE, _AFFINE = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_FIXED_GAIN, _AFFINE_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
# Dynamics whose state goes where the command is, and stays there.
_FOLLOWS = tuple(
    int(d) for d in (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
)
_IDLE = 1e-9  # N or N m: a force that is none
_EMPTY = 1e-6  # of a drive's force, that the emptiest supply leaves: what it would take can still be asked


class _OnCommand(Effect):
    """What the laws share: some actuators' commands, each (..., n) in its own unit."""

    def bind(self, model: mujoco.MjModel) -> None:
        self.rows = index(actuator_ids(model, self.where))
        self.limits = command_limits(model, self.rows)

    def _received(self, ctrl: Array) -> Array:
        """(..., n) what a drive is given of commands: MuJoCo clips what lies beyond their range."""
        return limited(ctrl[..., self.rows], *self.limits)

    @classmethod
    def _spread(cls, model: mujoco.MjModel, scales: Scales, where: Sequence[str]) -> float:
        commands = scales.drive if cls.on_drive else scales.command
        return max(float(np.median(np.abs(commands[actuator_ids(model, where)]))), 1e-6)


class Offset(_OnCommand):
    """A constant added to the command: a badly zeroed position servo, a motor that pushes at zero."""

    family = "offset"
    summary = "Constant offset of the command"
    PARAMS = (Param("offset", "1", -1e3, 1e3, probes=(0.05,)),)

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        out = np.array(ctrl)
        out[..., self.rows] += theta[..., :1]
        return out, memory

    def demand(self, force: Array, theta: Array, ctx: Context) -> Array:
        out = np.array(force)
        out[..., self.rows] -= ctx.nominal("actuator_gainprm")[..., self.rows, 0] * theta[..., :1]
        return out

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        actuators, offset = [spec.actuator(n) for n in self.where], float(theta[0])
        # What integrates its command would integrate the offset, too: no constant force.
        if any(int(a.dyntype) not in _FOLLOWS or int(a.gaintype) not in (_FIXED_GAIN, _AFFINE_GAIN) for a in actuators):
            return False
        if any(int(a.biastype) not in (_NONE, _AFFINE) for a in actuators):
            return False
        for actuator in actuators:
            gain, bias = np.array(actuator.gainprm), np.array(actuator.biasprm)
            terms = 3 if int(actuator.gaintype) == _AFFINE_GAIN else 1
            if int(actuator.biastype) == _NONE:
                bias[:3] = 0
            bias[:terms] += gain[:terms] * offset
            actuator.biastype, actuator.biasprm = mujoco.mjtBias.mjBIAS_AFFINE, bias
            # clip(u + offset, low, high) = clip(u, low - offset, high - offset) + offset, and so of the state of a
            # filter, which is lower by the offset and begins as if it had settled under it.
            for kind in ("ctrl", "act"):
                shift_range(actuator, kind, offset)
        return True

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        known = actuator_names(model)
        out: list[Effect] = []
        for where in actuator_places(model, plain(model)):
            size = cls._spread(model, scales, where)
            change = {"probes": (0.15 * size,), "low": -3 * size, "high": 3 * size, "resolution": 2e-3 * size}
            unit = command_unit(model, known.index(where[0]))
            out.append(cls(where, with_units(sized(cls.PARAMS, offset=change), {"offset": unit})))
        return out


class CommandGain(_OnCommand):
    """A servo's command times `gain`: a gear, a wheel or a drum of another size than the model's, a goal rescaled.

    Of a motor, which answers commands with a force, it would be its `gain`; of a servo, whose stiffness or damping
    stays what it was, it is another law.
    """

    family = "command_gain"
    summary = "Servo command scaled"
    kin = ("gain",)
    PARAMS = (Param("gain", "1", 0.2, 3.0, null=1.0, probes=(1.1, 0.9), resolution=0.002),)

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        out = np.array(ctrl)
        out[..., self.rows] *= theta[..., :1]
        return out, memory

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        actuators, gain = [spec.actuator(n) for n in self.where], float(theta[0])
        # What integrates its command has no gain between the two.
        if any(int(a.dyntype) not in _FOLLOWS or int(a.gaintype) not in (_FIXED_GAIN, _AFFINE_GAIN) for a in actuators):
            return False
        for actuator in actuators:
            actuator.gainprm = np.asarray(actuator.gainprm) * gain
            # clip(gain u, low, high) = gain clip(u, low / gain, high / gain), and so of the state of a filter.
            for kind in ("ctrl", "act"):
                stretch_range(actuator, kind, 1 / gain)
        return True

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        return [cls(where, cls.PARAMS) for where in actuator_places(model, servos(model))]


class DeadZone(_OnCommand):
    """Commands within +- width do nothing, larger ones lose it. Not for position servos: their zero is no rest."""

    on_drive = True
    family = "dead_zone"
    summary = "Dead zone of the command"
    PARAMS = (Param("width", "1", 0.0, 1e3, probes=(0.05,)),)

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        out, width, given = np.array(ctrl), theta[..., :1], self._received(ctrl)
        out[..., self.rows] = given - limited(given, -width, width)
        return out, memory

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        known = actuator_names(model)
        out: list[Effect] = []
        for where in actuator_places(model, [n for n in plain(model) if not is_position(model, known.index(n))]):
            size = cls._spread(model, scales, where)
            change = {"probes": (0.1 * size, 0.3 * size), "high": 2 * size, "resolution": 2e-3 * size}
            unit = command_unit(model, known.index(where[0]))
            out.append(cls(where, with_units(sized(cls.PARAMS, width=change), {"width": unit})))
        return out


class Saturation(_OnCommand):
    """A limit that the model lacks, in one of two forms.

    `removed`: the share of the command range that is out of reach, half at each end (actuators with a command range).
    `inverse_limit`: one over the largest force (position servos, and actuators without a command range); its null 0 is
    no limit, and a limit above every force that occurs changes nothing.
    """

    on_drive = True
    family = "saturation"
    summary = "Saturation below the model's limits"
    PARAMS = (Param("removed", "1", 0.0, 0.95, probes=(0.2, 0.5), resolution=0.005, natural=True),)
    ON_FORCE = (Param("inverse_limit", "1/(N m)", 0.0, 1e6, probes=(1.0,)),)

    @classmethod
    def declare(cls, names: Sequence[str]) -> tuple[Param, ...]:
        return cls.ON_FORCE if tuple(names) == ("inverse_limit",) else super().declare(names)

    @property
    def on_force(self) -> bool:
        """Whether the force is limited rather than the command."""
        return self.params[0].name == "inverse_limit"

    @property
    def on_command(self) -> bool:
        return not self.on_force

    def bind(self, model: mujoco.MjModel) -> None:
        super().bind(model)
        if not self.on_force and not model.actuator_ctrllimited[self.rows].all():
            raise InputError(
                f"saturation of {self.place}: `removed` is a share of a command range, which the model does not give"
            )
        self.range_low, self.range_high = model.actuator_ctrlrange[self.rows].T.copy()

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        if self.on_force:
            return ctrl, memory
        out = np.array(ctrl)
        out[..., self.rows] = limited(ctrl[..., self.rows], *self._limits(theta))
        return out, memory

    def _limits(self, theta: Array) -> tuple[Array, Array]:
        """(low, high) of the commands, (..., n) each."""
        cut = theta[..., :1] * (self.range_high - self.range_low) / 2
        return self.range_low + cut, self.range_high - cut

    def model(self, fields: ModelFields, theta: Array) -> None:
        if not self.on_force:
            return
        limit = 1 / np.maximum(theta[..., :1], 1 / ENDLESS)
        bounded, ranges = fields["actuator_forcelimited"], fields["actuator_forcerange"]
        free = bounded[..., self.rows] == 0
        low = np.where(free, -ENDLESS, ranges[..., self.rows, 0])
        high = np.where(free, ENDLESS, ranges[..., self.rows, 1])
        ranges[..., self.rows, 0], ranges[..., self.rows, 1] = limited(low, -limit, limit), limited(high, -limit, limit)
        bounded[..., self.rows] = True

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        kind, low, high = "ctrl", *self._limits(theta)
        if self.on_force:
            high = np.full(len(self.where), 1 / max(float(theta[0]), 1 / ENDLESS))
            kind, low = "force", -high
        elif any(mixes(spec, spec.actuator(n)) for n in self.where):  # a delay after it, which is carried before it
            return False
        return narrow_ranges(spec, self.where, kind, low, high)

    def say(self, theta: Array, sd: Array | None = None) -> str:
        if not self.on_force:
            return super().say(theta, sd)
        inverse, unit = max(float(theta[0]), 1 / ENDLESS), self.params[0].unit.removeprefix("1/").strip("()")
        size = with_spread(1 / inverse, None if sd is None else sd[0] / inverse**2)
        what, unit = ("torque" if unit == "N m" else "force"), (f" {unit}" if unit != "1" else "")
        return f"{self.summary} at {together(self.where)}: {what} limited to {size}{unit}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        known = actuator_names(model)
        ranged = [
            n for n in plain(model) if model.actuator_ctrllimited[i := known.index(n)] and not is_position(model, i)
        ]
        out: list[Effect] = [cls(where, cls.PARAMS) for where in actuator_places(model, ranged)]
        for where in actuator_places(model, [n for n in plain(model) if n not in ranged]):
            force = float(np.median(np.abs(scales.actuation[actuator_ids(model, where)])))
            if force < _IDLE:
                continue  # no limit bites on what pushes nothing
            # The scale is a root mean square: forces reach two or three times as high, where a limit begins to bite.
            change = {"probes": (0.4 / force, 0.7 / force, 1.2 / force), "high": 20 / force, "resolution": 2e-3 / force}
            unit = {True: "1/N", False: "1/(N m)", None: "1"}[moves_length(model, known.index(where[0]))]
            out.append(cls(where, with_units(sized(cls.ON_FORCE, inverse_limit=change), {"inverse_limit": unit})))
        return out


def find_supply(names: Iterable[str]) -> str | None:
    """The exogenous signal that is a supply voltage, by its name: `exo:supply` first, else one that speaks of volts."""
    names = list(names)
    if "exo:supply" in names:
        return "exo:supply"
    return next((n for n in names if any(w in n.lower() for w in ("supply", "volt", "vbat", "batt", "vbus"))), None)


class SupplySag(_OnCommand):
    """Commands times (V / reference)^exponent, V the measured supply: a drive that follows its battery.

    The exponent is 0 for a regulated drive, 1 for a motor on the bare battery, 2 for the thrust of such a rotor.

    With `rate` in place of both, commands times max(1 - rate t, 0), t the time since the log or the episode began: what
    a battery that falls evenly and that nobody measured leaves of a drive's force. Whatever else changes as time goes
    by looks like it, so it is a candidate only where the family is asked for by name and no log has a voltage.
    """

    family = "supply_sag"
    summary = "Drive follows the supply voltage"
    remark = "by `rate` evenly as time goes by; a run looks for that only if a mapping's `only` names it, without volts"
    PARAMS = (
        Param("exponent", "1", -1.0, 4.0, probes=(1.0, 2.0), resolution=0.02),
        Param("reference", "V", 1e-3, 1e4, probes=(12.0,), shape=True),
    )
    BY_TIME = (Param("rate", "1/s", 0.0, 1.0, probes=(0.003, 0.02), resolution=1e-4),)
    on_drive = True
    divisible = False  # drives of one make on one battery; one that gives less than the others has lost force
    SETTINGS = ("signal",)
    signal = "exo:supply"

    @property
    def timed(self) -> bool:
        """Whether it goes by time and not by a voltage."""
        return self.params[0].name == "rate"

    @property
    def signals(self) -> tuple[str, ...]:
        return (TIME,) if self.timed else (self.signal,)

    @property
    def settings(self) -> dict[str, Any]:
        return {} if self.timed else super().settings

    @classmethod
    def declare(cls, names: Sequence[str]) -> tuple[Param, ...]:
        """By a voltage or by time."""
        return cls.BY_TIME if tuple(names) == ("rate",) else super().declare(names)

    def _factor(self, theta: Array, exogenous: Mapping[str, Array]) -> Array:
        if self.timed:
            return np.maximum(1 - theta[..., 0] * exogenous[TIME], _EMPTY)[..., None]
        name = self.signal if self.signal in exogenous else find_supply(exogenous)
        if name is None:
            raise InputError(
                f"supply_sag reads the supply voltage {self.signal!r}; the log has: {', '.join(exogenous) or 'none'}"
            )
        return np.power(np.maximum(exogenous[name] / theta[..., 1], _EMPTY), theta[..., 0])[..., None]

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        out = np.array(ctrl)
        out[..., self.rows] = self._received(ctrl) * self._factor(theta, exogenous)
        return out, memory

    def demand(self, force: Array, theta: Array, ctx: Context) -> Array:
        out = np.array(force)
        out[..., self.rows] /= self._factor(theta, ctx.exogenous)
        return out

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        signal = find_supply(scales.exogenous)
        if signal is None:
            return []
        volts = float(scales.exogenous[signal])
        # The reference only names the voltage at which nothing changes: free, it would be a gain under another name.
        change = {"probes": (volts,), "low": volts * (1 - 1e-3), "high": volts * (1 + 1e-3)}
        out: list[Effect] = []
        for where in cls._places(model):
            effect = cls(where, sized(cls.PARAMS, reference=change))
            effect.signal = signal
            out.append(effect)
        return out

    @classmethod
    def asked(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        return [cls(where, cls.BY_TIME) for where in cls._places(model)]

    @classmethod
    def _places(cls, model: mujoco.MjModel) -> list[tuple[str, ...]]:
        """One battery feeds all the drives; a drive with a battery of its own would have a signal of its own."""
        known = actuator_names(model)
        names = tuple(n for n in plain(model) if not is_position(model, known.index(n)))
        return [names] if names else []
