"""Forces of joints other than dry friction: damping, rotor inertia, springs, cogging."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.lookup import index, joint_dofs
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import (
    angle_unit,
    force_unit,
    joint_places,
    joint_scales,
    sized,
    typical,
    with_joint_units,
    with_units,
)
from nfc_gym.physics.fields import ModelFields, rows_of


class _OnJoint(Effect):
    """What the laws share: joints resolved to dofs."""

    def bind(self, model: mujoco.MjModel) -> None:
        dofs = joint_dofs(model, self.where, self.BALLS)
        self.dofs, self.params = index(dofs), with_joint_units(self.params, model, dofs)


class DampingPoly(_OnJoint):
    """Damping force -(linear v + quadratic v |v| + cubic v^3), added to what the model has."""

    family = "damping_poly"
    BALLS = True
    summary = "Joint damping"
    PARAMS = (
        Param("linear", "N m s/rad", -1e3, 1e3, probes=(0.01,)),  # it may be less than the model's own
        Param("quadratic", "N m s^2/rad^2", -1e3, 1e3, probes=(0.01,)),
        Param("cubic", "N m s^3/rad^3", -1e3, 1e3, probes=(0.01,)),
    )

    def model(self, fields: ModelFields, theta: Array) -> None:
        fields["dof_damping"][..., self.dofs] += theta[..., 0:1]
        fields["dof_dampingpoly"][..., self.dofs, 0] += theta[..., 1:2]
        fields["dof_dampingpoly"][..., self.dofs, 1] += theta[..., 2:3]

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for where in joint_places(model):
            force, speed = joint_scales(model, scales, where)
            has = float(model.dof_damping[joint_dofs(model, where)].min())
            unit, per = force_unit(model, where[0]), angle_unit(model, where[0])
            changes, units = {}, {}
            for power, name in enumerate(("linear", "quadratic", "cubic"), 1):
                size = force / speed**power
                # Less damping than the model's is allowed; a negative cubic must not outweigh it at 5 times the speed.
                low = -0.95 * has / (1.0 if power == 1 else 25.0 * speed ** (power - 1))
                changes[name] = {"probes": (0.1 * size,), "low": low, "high": 5 * size, "resolution": 2e-3 * size}
                units[name] = f"{unit} s/{per}" if power == 1 else f"{unit} s^{power}/{per}^{power}"
            out.append(cls(where, with_units(sized(cls.PARAMS, **changes), units)))
        return out


class Armature(_OnJoint):
    """Inertia of a rotor behind a gear, seen at the joint (gear ratio squared times the rotor's own)."""

    family = "armature"
    BALLS = True
    summary = "Rotor inertia reflected to the joint"
    PARAMS = (Param("inertia", "kg m^2", 0.0, 1e3, probes=(0.01,)),)

    def model(self, fields: ModelFields, theta: Array) -> None:
        fields["dof_armature"][..., self.dofs] += theta[..., :1]

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for where in joint_places(model):
            own = typical(model.dof_M0, joint_dofs(model, where), 1e-6)
            unit = "kg m^2" if force_unit(model, where[0]) == "N m" else "kg"
            sizes = {"probes": (0.1 * own, 0.5 * own), "high": 10 * own, "resolution": 5e-3 * own}
            out.append(cls(where, with_units(sized(cls.PARAMS, inertia=sizes), {"inertia": unit})))
        return out


class SpringOffset(_OnJoint):
    """A spring that the model lacks: force -stiffness (q - rest), added to the joint's own."""

    family = "spring_offset"
    summary = "Joint spring"
    PARAMS = (
        Param("stiffness", "N m/rad", 0.0, 1e3, probes=(0.1,)),
        Param("rest", "rad", -10.0, 10.0, probes=(0.0,), shape=True),
    )

    def chart(self, theta: Array) -> Array:
        """Stiffness and stiffness times rest: a spring's force is a straight line in these."""
        return np.concatenate([theta[..., :1], theta[..., :1] * theta[..., 1:]], -1)

    def unchart(self, coordinates: Array) -> Array:
        stiffness = coordinates[..., :1]
        least = 1e-6 * self.params[0].high
        return np.concatenate([stiffness, coordinates[..., 1:] / np.maximum(stiffness, least)], -1)

    def bind(self, model: mujoco.MjModel) -> None:
        super().bind(model)
        self.joints = model.dof_jntid[self.dofs].astype(np.intp)
        self.coordinates = rows_of(model, "qpos_spring", self.where)

    def model(self, fields: ModelFields, theta: Array) -> None:
        stiffness, rests = fields["jnt_stiffness"], fields["qpos_spring"]
        own, added = stiffness[..., self.joints], theta[..., 0:1]
        total = own + added
        # Two springs in parallel are one whose rest is the mean weighted by stiffness.
        share = np.where(total > 0, added / np.where(total > 0, total, 1.0), 0.0)
        rests[..., self.coordinates] += share * (theta[..., 1:2] - rests[..., self.coordinates])
        stiffness[..., self.joints] = total

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for where in joint_places(model):
            dofs = joint_dofs(model, where)
            joints = model.dof_jntid[dofs]
            if model.jnt_stiffnesspoly[joints].any():
                continue  # moving the rest would also move a stiffening spring
            force, rests, reach = typical(scales.force, dofs), *_rests(model, where, scales)
            unit, per = force_unit(model, where[0]), angle_unit(model, where[0])
            size = force / reach
            changes = {
                "stiffness": {"probes": (0.1 * size, 0.5 * size), "high": 5 * size, "resolution": 2e-3 * size},
                "rest": {"probes": rests, "low": min(rests) - 2 * reach, "high": max(rests) + 2 * reach},
            }
            out.append(
                cls(where, with_units(sized(cls.PARAMS, **changes), {"stiffness": f"{unit}/{per}", "rest": per}))
            )
        return out


def _rests(model: mujoco.MjModel, where: tuple[str, ...], scales: Scales) -> tuple[tuple[float, ...], float]:
    """Rest positions to try, the joint's own and those about where it moves, and its typical excursion."""
    coordinate = int(rows_of(model, "qpos_spring", where[:1])[0])
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, where[0])
    own = float(model.qpos_spring[coordinate])
    spread = scales.channels.get(f"joint:{where[0]}:pos", (0.0, 0.0))[0]
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (own - 1.0, own + 1.0)
    reach = max(spread, 0.1 * (high - low), 1e-3)
    middle = own
    if scales.low is not None and scales.high is not None:
        middle = float(scales.low[coordinate] + scales.high[coordinate]) / 2
    return (own, middle - reach, middle + reach), reach


class Cogging(_OnJoint):
    """Torque that repeats `order` times a turn: cosine cos(order q) + sine sin(order q).

    Proposed where the joint travels as far as its torque takes to repeat: what is seen of less is a spring.
    """

    family = "cogging"
    summary = "Cogging torque"
    PARAMS = (
        Param("cosine", "N m", -1e3, 1e3, probes=(0.05,)),
        Param("sine", "N m", -1e3, 1e3, probes=(0.05,)),
        Param("order", "1", 0.5, 50.0, probes=(1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0), shape=True),
    )

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        angle = theta[..., 2:3] * ctx.q[..., self.coordinates]
        out.qfrc[..., self.dofs] += theta[..., 0:1] * np.cos(angle) + theta[..., 1:2] * np.sin(angle)

    def bind(self, model: mujoco.MjModel) -> None:
        super().bind(model)
        self.coordinates = index(model.jnt_qposadr[model.dof_jntid[self.dofs]].astype(np.intp))

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        hinges = [w[0] for w in joint_places(model) if len(w) == 1 and force_unit(model, w[0]) == "N m"]
        for name in hinges:
            force, _ = joint_scales(model, scales, (name,))
            size = {"probes": (0.1 * force,), "low": -2 * force, "high": 2 * force, "resolution": 2e-3 * force}
            order = cls.PARAMS[2]
            least = max(order.low, 2 * np.pi / max(cls._travel(model, scales, name), 1e-9))
            if least < order.high:
                probes = tuple(p for p in order.probes if p > least) or (min(1.5 * least, order.high),)
                shape = {"low": least, "probes": probes}
                out.append(cls((name,), sized(cls.PARAMS, cosine=size, sine=size, order=shape)))
        return out

    @staticmethod
    def _travel(model: mujoco.MjModel, scales: Scales, name: str) -> float:
        """How far a joint moves in the logs, rad; without end where that is unknown."""
        if scales.low is None or scales.high is None:
            return np.inf
        at = int(model.jnt_qposadr[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)])
        return float(scales.high[at] - scales.low[at])
