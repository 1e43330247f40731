"""Effects at joints: friction, springs, rotors, cogging, gears."""

from collections.abc import Sequence

import mujoco
import numpy as np

from .effect import Array, Effect, Form, Signals


class AtJoint(Effect):
    """An effect at one hinge or slide; `self.dof` and `self.at` are its places in qvel and qpos."""

    def __init__(
        self, family: str, joint: str, parameters: dict[str, float], text: str, others: Sequence[Form] = ()
    ) -> None:
        super().__init__((Form(family, (joint,), parameters), *others), (joint,), f"{joint}: {text}")
        self.joint = joint

    def begin(self, model: mujoco.MjModel, signals: Signals) -> None:
        self.dof, self.at = int(model.joint(self.joint).dofadr[0]), int(model.joint(self.joint).qposadr[0])


class Coulomb(AtJoint):
    """Dry friction, as a hard constraint."""

    def __init__(self, joint: str, level: float, others: Sequence[Form] = ()) -> None:
        super().__init__("coulomb", joint, {"level": level}, f"dry friction of {level:.3g}", others)
        self.level = level

    def build(self, model: mujoco.MjModel) -> None:
        dof = int(model.joint(self.joint).dofadr[0])
        model.dof_frictionloss[dof] += self.level
        model.dof_solref[dof], model.dof_solimp[dof] = [0.004, 1], [0.99, 0.99, 0.001, 0.5, 2]


class Spring(AtJoint):
    """A spring beside the drive."""

    def __init__(self, joint: str, stiffness: float, rest: float) -> None:
        values = {"stiffness": stiffness, "rest": rest}
        super().__init__("spring_offset", joint, values, f"a spring of {stiffness:.3g} that rests at {rest:.3g}")
        self.stiffness, self.rest = stiffness, rest

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        data.qfrc_applied[self.dof] -= self.stiffness * (data.qpos[self.at] - self.rest)


class Armature(AtJoint):
    """A rotor that the model does not have."""

    def __init__(self, joint: str, inertia: float) -> None:
        super().__init__("armature", joint, {"inertia": inertia}, f"a rotor of {inertia:.3g} more")
        self.inertia = inertia

    def build(self, model: mujoco.MjModel) -> None:
        model.dof_armature[int(model.joint(self.joint).dofadr[0])] += self.inertia


class Cogging(AtJoint):
    """A torque that repeats `order` times a turn."""

    def __init__(self, joint: str, size: float, order: int, phase: float) -> None:
        self.cosine, self.sine, self.order = size * np.cos(phase), size * np.sin(phase), order
        values = {"cosine": self.cosine, "sine": self.sine, "order": float(order)}
        super().__init__("cogging", joint, values, f"cogs by {size:.3g} N m, {order} times a turn")

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        angle = self.order * data.qpos[self.at]
        data.qfrc_applied[self.dof] += self.cosine * np.cos(angle) + self.sine * np.sin(angle)


class LoadFriction(AtJoint):
    """Friction of a gear: a constant part and a share of what its motor presses."""

    TURNS = 2e-3  # rad/s or m/s within which it changes sides

    def __init__(self, joint: str, level: float, share: float) -> None:
        values = {"level": level, "motor": share}
        super().__init__(
            "load_friction", joint, values, f"friction of {level:.3g} and {share:.3g} of the motor's force"
        )
        self.level, self.share = level, share

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        level = self.level + self.share * abs(data.qfrc_actuator[self.dof])
        data.qfrc_applied[self.dof] -= level * np.tanh(data.qvel[self.dof] / self.TURNS)


class Bias(Effect):
    """A sensor of one column that is off by a constant."""

    def __init__(self, channel: str, bias: float) -> None:
        form = Form("sensor_bias", (channel,), {"bias": bias})
        super().__init__((form,), (channel.split(":")[1],), f"{channel} reads {bias:.3g} too much")
        self.channel, self.bias = channel, bias

    def read(self, channel: str, value: Array) -> Array:
        return value + self.bias if channel == self.channel else value
