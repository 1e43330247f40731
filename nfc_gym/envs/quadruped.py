"""Quadruped: twelve joints under position control; it walks at a commanded velocity."""

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.components import base, joints, observed
from nfc_gym.envs.mirror import Plane, Signed, fixed, jointwise
from nfc_gym.envs.robot import Array, Ground, Robot, Start
from nfc_gym.envs.rotations import Axes, axes, some, to_robot
from nfc_gym.envs.spawn import place, spread, underside
from nfc_gym.envs.view import View
from nfc_gym.physics.state import components

SCALE = 0.25  # rad off the default pose at full action
NOISE = 0.05  # rad by which joints start off their pose
MIDDLE = 0.3  # m, half the side of the square that episodes start in
TILTED = float(np.cos(1.0))  # of the angle to the vertical at which an episode ends
TOUCHED = 1.0  # N on trunk or thigh that count as touching the ground, or on a foot as standing on it
FALLEN = -5.5  # m: below the lowest point that a map can have, so off its edge
EDGE = (
    11.0  # m from the middle in x or y: from there a command that leads outwards is turned round; maps end at 12.75 m
)

# The command of an episode: forward and sideways velocity and yaw rate, in the robot's frame.
FORWARD = (-0.5, 1.0)  # m/s, a fast walk of a robot of 0.29 m hip height
SIDEWAYS = (-0.4, 0.4)  # m/s
TURNING = (-1.0, 1.0)  # rad/s
STANDING = 0.1  # share of the episodes whose command is zero

# Weights of the reward, a control step.
LINEAR = 1.0  # the unit of all others: the commanded velocity, exactly met
YAW = 0.5  # the commanded yaw rate, exactly met
WIDTH = 0.25  # (m/s)^2 or (rad/s)^2: an error of 0.5 m/s or rad/s still earns exp(-1)
VERTICAL = 2.0  # per (m/s)^2: a bounce at 0.1 m/s costs 0.02
ROLLING = 0.02  # per (rad/s)^2 of roll and pitch rate: low enough that even thrashing about is better than falling
TORQUE = 1e-5  # per (N m)^2, summed: standing costs 0.005
RATE = 0.01  # per squared change of action, summed: all targets moved by 0.25 rad cost 0.12
SLIP = 0.1  # per (m/s)^2 of each standing foot: one that slides at 1 m/s costs 0.1

LEGS = ("FL", "FR", "RL", "RR")


class Now(NamedTuple):
    """The trunk's motion in its own frame."""

    frame: Axes
    linear: Array  # (*B, 3) m/s


def _readings(model: mujoco.MjModel, names: list[str], component: int = 0) -> slice:
    """Where a component of sensors lies in `sensordata`, evenly spaced as they are."""
    first, second, *_, last = (int(model.sensor(name).adr[0]) + component for name in names)
    return slice(first, last + 1, second - first)


class Quadruped(Robot):
    """Twelve actions: joint targets off the default pose (abduction, hip, knee of each leg), in units of 0.25 rad."""

    name = "quadruped"
    tasks = ("walk",)
    action_size, proprio_size, draws = 12, 48, 3 + 12 + 4
    reads = ("sensordata", "actuator_force")
    terms = ("linear", "yaw", "vertical", "rolling", "torque", "rate", "slip")

    def __init__(self, model: mujoco.MjModel, task: str) -> None:
        super().__init__(model, task)
        self.pose = model.key("home").ctrl.copy()
        self.below = underside(model, self.home)
        self.gap = 0.01 + NOISE * float(np.abs(self.below).max())
        self.feet = _readings(model, [f"{leg}_foot_touch" for leg in LEGS])
        self.hull = _readings(model, ["base_touch", *(f"{leg}_thigh_touch" for leg in LEGS)])
        self.along, self.across = (_readings(model, [f"{leg}_foot_velocity" for leg in LEGS], axis) for axis in (0, 1))

    def begin(self, u: Array, ground: Ground) -> Start:
        """Near the middle, any heading and command, joints a little off their pose, feet just above the ground."""
        x, y, heading = u.T[:3]
        x, y = spread(x, -MIDDLE, MIDDLE), spread(y, -MIDDLE, MIDDLE)
        qpos = place(self.home, self.below, x, y, 2 * np.pi * heading, ground, self.gap)
        qpos[..., 7:] += spread(u[..., 3:15], -NOISE, NOISE)
        forward, sideways, turning, standing = u.T[15:]
        command = np.array((spread(forward, *FORWARD), spread(sideways, *SIDEWAYS), spread(turning, *TURNING)))
        command = np.where(standing < STANDING, 0.0, command).T
        zero = np.zeros((*u.shape[:-1], self.action_size))
        return Start(qpos, {"command": command, "action": zero, "rate": zero[..., 0]})

    def actuate(self, action: Array, view: View) -> Array:
        """Joint targets (rad); the position servos do the rest."""
        return self.pose + SCALE * action

    def advance(self, view: View, action: Array) -> dict[str, NDArray]:
        """The last action and how much it changed; a command that leads off the map is turned round."""
        change = action - view.task["action"]
        task = {"action": action, "rate": np.vecdot(change, change)}
        x, y = components(view.qpos[..., :2])
        far = (x * x > EDGE * EDGE) | (y * y > EDGE * EDGE)
        if some(far):
            frame = view.now.frame
            forward, sideways, turning = components(view.task["command"])
            vx, vy = frame.xx * forward + frame.xy * sideways, frame.yx * forward + frame.yy * sideways
            turn = np.where(far & (vx * x + vy * y > 0), -1.0, 1.0)
            task["command"] = np.array((turn * forward, turn * sideways, turning)).T
        return task

    def derive(self, view: View) -> Now:
        """Velocity in the trunk's frame."""
        frame = axes(view.qpos[..., 3:7])
        return Now(frame, to_robot(frame, view.qvel[..., :3]))

    def reward(self, view: View, action: Array) -> dict[str, Array]:
        """See the table of weights above."""
        vx, vy, vz = components(view.now.linear)
        wx, wy, wz = components(view.qvel[..., 3:6])
        forward, sideways, turning = components(view.task["command"])
        sensors, torque = view.sensordata, view.field("actuator_force")
        feet = (components(sensors[..., part]) for part in (self.feet, self.along, self.across))
        slip: Any = sum((force > TOUCHED) * (vx * vx + vy * vy) for force, vx, vy in zip(*feet, strict=True))
        dx, dy, dz = vx - forward, vy - sideways, wz - turning
        return {
            "linear": LINEAR * np.exp(-(dx * dx + dy * dy) / WIDTH),
            "yaw": YAW * np.exp(-dz * dz / WIDTH),
            "vertical": -VERTICAL * vz * vz,
            "rolling": -ROLLING * (wx * wx + wy * wy),
            "torque": -TORQUE * np.vecdot(torque, torque),
            "rate": -RATE * view.task["rate"],
            "slip": -SLIP * slip,
        }

    def terminated(self, view: View) -> NDArray[np.bool_]:
        """Trunk or a thigh touches the ground, the trunk leans too far, or the robot has fallen off the map."""
        (z,) = components(view.qpos[..., 2:3])
        touching = sum(force > TOUCHED for force in components(view.sensordata[..., self.hull]))
        return (touching > 0) | (view.now.frame.zz < TILTED) | (z < FALLEN)

    def components(self, model: mujoco.MjModel) -> list[str]:
        """See `Robot`."""
        motion = [*base(model, "linvel@body"), *base(model, "angvel@body")]
        return [*motion, *observed(6), *joints(model, "pos"), *joints(model, "vel"), *observed(12)]

    def reflected(self, model: mujoco.MjModel, plane: Plane) -> tuple[list[Signed], Signed]:
        """See `Robot`."""
        down = fixed(*map(plane.vector, "xyz"))
        command = fixed(plane.vector("x"), plane.vector("y"), plane.axial("z"))
        action = jointwise(plane, model, [model.actuator(i).name for i in range(model.nu)])
        return [down, command, action], action

    def proprio(self, view: View) -> tuple[NDArray, ...]:
        """Linear and angular velocity, down (own frame), command, joint positions and velocities, last action."""
        frame, v = view.now.frame, view.qvel
        down = np.array((-frame.zx, -frame.zy, -frame.zz)).T
        task = view.task
        return view.now.linear, v[..., 3:6], down, task["command"], view.qpos[..., 7:], v[..., 6:], task["action"]
