"""What carried rotors feel: drag in the rotor plane, loss of thrust in a climb, and the cushion near the ground."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.air import BodyMotion, body_scales, translating
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.lookup import index, one_command_each
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import body_ids, gyration, sized
from nfc_gym.physics.fields import names_of
from nfc_gym.physics.state import components, joined, rotate_parts

_SITE = int(mujoco.mjtTrn.mjTRN_SITE)


def thrusters(model: mujoco.MjModel, body: int) -> tuple[list[int], Array]:
    """Actuators that push at sites of a body or of what it carries.

    Returns their ids (n,), and the force of each for a unit input in the body's frame (n, 3), with joints in their
    reference position (rotor mounts give little).
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    frame = data.xmat[body].reshape(3, 3)
    found, pushes = [], []
    for i in range(model.nactuator if one_command_each(model) else 0):
        site = int(model.actuator_trnid[i, 0])
        if int(model.actuator_trntype[i]) != _SITE or int(model.body_rootid[model.site_bodyid[site]]) != int(
            model.body_rootid[body]
        ):
            continue
        push = frame.T @ data.site_xmat[site].reshape(3, 3) @ model.actuator_gear[i, :3]
        if np.linalg.norm(push) > 0:
            found.append(i)
            pushes.append(push)
    return found, np.array(pushes).reshape(-1, 3)


class _Rotor(Effect):
    """What both share: the total thrust along its common axis, from the actuators' forces one substep before."""

    lone = True
    driven = True

    def bind(self, model: mujoco.MjModel) -> None:
        self.motion = BodyMotion(model, int(body_ids(model, self.where)[0]))
        actuators, pushes = thrusters(model, self.motion.body)
        if not actuators:
            raise InputError(f"{self.family} at body {self.where[0]!r}: no actuator pushes at a site of it")
        total = pushes.sum(0)
        axis = total / np.linalg.norm(total)
        self.actuators, self.along, self.axis = index(np.array(actuators)), pushes @ axis, axis.tolist()

    def thrust(self, ctx: Context) -> Array:
        """Total thrust (...,), N."""
        return (ctx.data("actuator_force")[..., self.actuators] * self.along).sum(-1)

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Bodies that rotors carry, with a common direction of thrust."""
        names = names_of(model, mujoco.mjtObj.mjOBJ_BODY, model.nbody)
        out = []
        for name in translating(model):
            pushes = thrusters(model, names.index(name))[1]
            if len(pushes) and np.linalg.norm(pushes.sum(0)) > 0.5 * np.linalg.norm(pushes, axis=1).sum():
                out.append(name)
        return out


class RotorDrag(_Rotor):
    """F = T (lift |v_plane|^2 axis - drag v_plane - inflow v_axis), T total thrust, v across and along its axis.

    Blade flapping and induced drag of a rotor, linear in speed and thrust: Faessler et al., RA-L 3 (2018). `lift` is
    the thrust that a rotor gains in forward flight (translational lift: Leishman, Principles of Helicopter
    Aerodynamics, 2.14).
    """

    family = "rotor_drag"
    summary = "Aerodynamic forces of the moving rotors"
    PARAMS = (
        Param("drag", "s/m", 0.0, 1.0, probes=(0.02,), resolution=2e-4),
        Param("inflow", "s/m", 0.0, 1.0, probes=(0.02,), resolution=2e-4),
        Param("lift", "s^2/m^2", 0.0, 1.0, probes=(0.02,), resolution=2e-4),
    )

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        drag, inflow, lift = components(theta)
        quat, thrust = self.motion.quat(ctx), self.thrust(ctx)
        velocity = self.motion.own_velocity(ctx, quat)
        axial = sum(v * a for v, a in zip(velocity, self.axis, strict=True))
        plane = [v - axial * a for v, a in zip(velocity, self.axis, strict=True)]
        gain = lift * sum(p * p for p in plane) - inflow * axial
        pull = [thrust * (gain * a - drag * p) for a, p in zip(self.axis, plane, strict=True)]
        self.motion.push(ctx, joined(rotate_parts(quat, pull)), out)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for name in cls.places(model):
            speed = body_scales(model, scales, int(body_ids(model, (name,))[0]))[1]
            size = {"probes": (0.03 / speed,), "high": 2 / speed, "resolution": 5e-4 / speed}
            lift = {"probes": (0.03 / speed**2,), "high": 2 / speed**2, "resolution": 5e-4 / speed**2}
            out.append(cls((name,), sized(cls.PARAMS, drag=size, inflow=size, lift=lift)))
        return out


class GroundEffect(_Rotor):
    """Thrust grown by strength / (16 z^2) at height z over the plane z = 0, at most by half.

    Cheeseman and Bennett, ARC R&M 3021 (1955), to first order; strength is the square of the rotor's effective radius.
    """

    family = "ground_effect"
    summary = "Rotor thrust gained near the ground"
    PARAMS = (Param("strength", "m^2", 0.0, 100.0, probes=(0.05,)),)

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        height = np.maximum(ctx.data("xipos")[..., self.motion.body, 2], 1e-3)
        added = np.minimum(theta[..., 0] / (16 * height * height), 0.5) * self.thrust(ctx)
        push = rotate_parts(self.motion.quat(ctx), [added * a for a in self.axis])
        self.motion.push(ctx, joined(push), out)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for name in cls.places(model):
            radius = 2 * gyration(model, int(body_ids(model, (name,))[0]))
            size = {"probes": (radius**2,), "high": 30 * radius**2, "resolution": 0.01 * radius**2}
            out.append(cls((name,), sized(cls.PARAMS, strength=size)))
        return out
