"""Faults of drives, joints and sensors that a stand-in may hide, by formulas of their own, not the package's."""

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array, Hidden

VOLTS = 11.9  # of the battery at which drives make what the model says


class Sag(Hidden):
    """Commands are worth (volts / 11.9) ** exponent; whoever steps the machine sets `volts`."""

    family = "supply_sag"
    volts = VOLTS

    def __init__(self, actuators: Sequence[str], exponent: float) -> None:
        values = {"exponent": exponent, "reference": VOLTS}
        super().__init__(tuple(actuators), values, f"force goes with the supply to the power {exponent:.3g}")
        self.exponent = exponent

    def command(self, u: Array) -> Array:
        return u * (self.volts / VOLTS) ** self.exponent


class Gain(Hidden):
    """Some actuators make another force than the model says, all of them by the same factor."""

    family = "gain"

    def __init__(self, actuators: Sequence[str], gain: float) -> None:
        super().__init__(tuple(actuators), {"gain": gain}, f"{'+'.join(actuators)} make {gain:.3g} of their force")

    def shape(self, spec: mujoco.MjSpec) -> None:
        for name in self.where:
            actuator = spec.actuator(name)
            for key in ("gainprm", "biasprm", "forcerange"):
                setattr(actuator, key, [self.parameters["gain"] * v for v in getattr(actuator, key)])


class OnCommand(Hidden):
    """What changes the commands of some actuators without memory."""

    def begin(self, model: mujoco.MjModel) -> None:
        self.rows = [model.actuator(n).id for n in self.where]
        self.ranges = model.actuator_ctrlrange[self.rows].copy()

    def command(self, u: Array) -> Array:
        out = np.array(u)
        out[self.rows] = self.received(out[self.rows])
        return out

    def received(self, u: Array) -> Array:
        """(n,) what arrives of (n,) what was sent."""
        raise NotImplementedError


class Offset(OnCommand):
    """A command that arrives with a constant added."""

    family = "offset"

    def __init__(self, actuator: str, offset: float) -> None:
        super().__init__((actuator,), {"offset": offset}, f"{actuator} is off by {offset:.3g}")

    def received(self, u: Array) -> Array:
        return u + self.parameters["offset"]


class DeadZone(OnCommand):
    """Small commands do nothing, larger ones lose as much."""

    family = "dead_zone"

    def __init__(self, actuators: Sequence[str], width: float) -> None:
        super().__init__(tuple(actuators), {"width": width}, f"{'+'.join(actuators)} ignore commands below {width:.3g}")

    def received(self, u: Array) -> Array:
        return np.sign(u) * np.maximum(np.abs(u) - self.parameters["width"], 0)


class Saturation(OnCommand):
    """A share of the command range is out of reach, half at each end."""

    family = "saturation"

    def __init__(self, actuators: Sequence[str], removed: float) -> None:
        text = f"{'+'.join(actuators)} reach {1 - removed:.1%} of their command range"
        super().__init__(tuple(actuators), {"removed": removed}, text)

    def received(self, u: Array) -> Array:
        low, high = self.ranges.T
        middle, half = (low + high) / 2, (1 - self.parameters["removed"]) * (high - low) / 2
        return middle + np.clip(u - middle, -half, half)


class Weak(Hidden):
    """Some position servos push no harder than a limit, N m."""

    family = "saturation"

    def __init__(self, actuators: Sequence[str], limit: float) -> None:
        super().__init__(
            tuple(actuators), {"inverse_limit": 1 / limit}, f"{'+'.join(actuators)} give up at {limit:.3g} N m"
        )
        self.limit = limit

    def shape(self, spec: mujoco.MjSpec) -> None:
        for name in self.where:
            spec.actuator(name).forcerange = [-self.limit, self.limit]


class OnJoint(Hidden):
    """What acts along hinges, each by its own angle q and speed v."""

    def begin(self, model: mujoco.MjModel) -> None:
        joints = [model.joint(n) for n in self.where]
        self.q, self.v = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]

    def push(self, data: mujoco.MjData) -> None:
        data.qfrc_applied[self.v] += self.torque(data.qpos[self.q], data.qvel[self.v])

    def torque(self, q: Array, v: Array) -> Array:
        """(n,) N m."""
        raise NotImplementedError


class Spring(OnJoint):
    """A spring towards an angle that the model lacks."""

    family = "spring_offset"

    def __init__(self, joints: Sequence[str], stiffness: float, rest: float) -> None:
        text = f"{'+'.join(joints)} pulled by {stiffness:.3g} N m/rad towards {rest:.2f} rad"
        super().__init__(tuple(joints), {"stiffness": stiffness, "rest": rest}, text)

    def torque(self, q: Array, v: Array) -> Array:
        return self.parameters["stiffness"] * (self.parameters["rest"] - q)


class Stribeck(OnJoint):
    """Dry friction that is higher at rest.

    As a torque it could only pass through zero over a width of level dt / inertia, here 0.1 rad/s, which takes a
    quarter of a rise within 1 rad/s away. So MuJoCo's constraint makes it, with a level that is set anew each step.
    """

    family = "stribeck"

    def __init__(self, joint: str, level: float, rise: float, speed: float) -> None:
        values = {"level": level, "rise": rise, "speed": speed}
        super().__init__(
            (joint,), values, f"{joint} drags with {level:.3g} N m, and {rise:.3g} more below {speed:.2g} rad/s"
        )

    def begin(self, model: mujoco.MjModel) -> None:
        super().begin(model)
        self.model = model
        model.dof_solref[self.v] = (2 * model.opt.timestep, 1.0)

    def push(self, data: mujoco.MjData) -> None:
        p, v = self.parameters, data.qvel[self.v]
        self.model.dof_frictionloss[self.v] = p["level"] + p["rise"] * np.exp(-((v / p["speed"]) ** 2))


class Damping(Hidden):
    """Joints drag in proportion to their speed, beyond what the model has."""

    family = "damping_poly"

    def __init__(self, joints: Sequence[str], linear: float) -> None:
        values = {"linear": linear, "quadratic": 0.0, "cubic": 0.0}
        super().__init__(tuple(joints), values, f"{'+'.join(joints)} damped by {linear:.3g} N m s/rad more")

    def shape(self, spec: mujoco.MjSpec) -> None:
        for name in self.where:
            spec.joint(name).damping[0] += self.parameters["linear"]


class Rotor(Hidden):
    """Inertia of rotors behind gears, seen at the joints."""

    family = "armature"

    def __init__(self, joints: Sequence[str], inertia: float) -> None:
        super().__init__(tuple(joints), {"inertia": inertia}, f"{'+'.join(joints)} turn {inertia:.3g} kg m^2 more")

    def shape(self, spec: mujoco.MjSpec) -> None:
        for name in self.where:
            spec.joint(name).armature += self.parameters["inertia"]


class ComShift(Hidden):
    """A body's centre of mass lies elsewhere by (3,) m."""

    family = "com_shift"

    def __init__(self, body: str, shift: Array) -> None:
        values = dict(zip("xyz", map(float, shift), strict=True))
        super().__init__((body,), values, f"{body}'s centre of mass is off by {1e3 * np.linalg.norm(shift):.1f} mm")

    def shape(self, spec: mujoco.MjSpec) -> None:
        spec.body(self.where[0]).ipos = spec.body(self.where[0]).ipos + [self.parameters[axis] for axis in "xyz"]


class Inertia(Hidden):
    """A body's mass is spread otherwise: its second moments about its centre are (3,) times what they were."""

    family = "inertia"

    def __init__(self, body: str, spread: Array) -> None:
        super().__init__((body,), {}, f"{body}'s mass is spread by {', '.join(f'{s:.3g}' for s in spread)}")
        self.spread = spread

    def shape(self, spec: mujoco.MjSpec) -> None:
        body = spec.body(self.where[0])
        moments = np.array(body.inertia)
        second = moments.sum() / 2 - moments  # of mass along each axis; a moment of inertia is the sum of the others
        grown = self.spread * second
        body.inertia = grown.sum() - grown
        self.parameters = dict(zip("xyz", map(float, body.inertia / moments), strict=True))


class Bias(Hidden):
    """A sensor reports a constant too much: one number, or one for each of three axes."""

    family = "sensor_bias"

    def __init__(self, channel: str, columns: Sequence[str], bias: Array) -> None:
        names = ["bias"] if len(columns) == 1 else list("xyz")
        values = dict(zip(names, map(float, bias), strict=True))
        super().__init__((channel,), values, f"{channel} reads {np.linalg.norm(bias):.3g} too much")
        self.columns = tuple(columns)

    def read(self, columns: dict[str, Array]) -> dict[str, Array]:
        return columns | {c: columns[c] + b for c, b in zip(self.columns, self.parameters.values(), strict=True)}
