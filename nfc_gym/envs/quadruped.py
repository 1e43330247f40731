"""Quadruped: twelve joints under position control; it walks at a commanded velocity."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.robot import Array, Ground, Robot, Start
from nfc_gym.envs.rotations import Axes, axes, to_robot
from nfc_gym.envs.spawn import place, spread, underside
from nfc_gym.envs.view import View

SCALE = 0.25  # rad off the default pose at full action
NOISE = 0.05  # rad by which joints start off their pose
MIDDLE = 0.3  # m, half the side of the square that episodes start in
TILTED = np.cos(1.0)  # of the angle to the vertical at which an episode ends
TOUCHED = 1.0  # N on trunk or thigh that count as touching the ground, or on a foot as standing on it
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
ROLLING = 0.05  # per (rad/s)^2 of roll and pitch rate: 1 rad/s costs 0.05
TORQUE = 1e-5  # per (N m)^2, summed: standing costs 0.005
RATE = 0.01  # per squared change of action, summed: all targets moved by 0.25 rad cost 0.12
SLIP = 0.1  # per (m/s)^2 of each standing foot: one that slides at 1 m/s costs 0.1

LEGS = ("FL", "FR", "RL", "RR")


class Now(NamedTuple):
    """The trunk's motion in its own frame."""

    frame: Axes
    linear: Array  # (*B, 3) m/s


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

        def touch(names: list[str]) -> NDArray[np.intp]:
            return np.array([model.sensor(f"{name}_touch").adr[0] for name in names])

        self.feet = touch([f"{leg}_foot" for leg in LEGS])
        self.hull = touch(["base", *(f"{leg}_thigh" for leg in LEGS)])
        self.sliding = np.array([[model.sensor(f"{leg}_foot_velocity").adr[0] + i for i in (0, 1)] for leg in LEGS])

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
        forward, sideways, turning = view.task["command"].T
        x, y = view.qpos.T[:2]
        frame = axes(view.qpos.T[3:7].T)
        outwards = (frame.xx * forward + frame.xy * sideways) * x + (frame.yx * forward + frame.yy * sideways) * y > 0
        turn = np.where(outwards & (np.maximum(np.abs(x), np.abs(y)) > EDGE), -1.0, 1.0)
        command = np.array((turn * forward, turn * sideways, turning)).T
        return {"command": command, "action": action, "rate": (change * change).sum(-1)}

    def derive(self, view: View) -> Now:
        """Velocity in the trunk's frame."""
        frame = axes(view.qpos.T[3:7].T)
        return Now(frame, to_robot(frame, view.qvel.T[:3].T))

    def reward(self, view: View, action: Array) -> dict[str, Array]:
        """See the table of weights above."""
        vx, vy, vz = view.now.linear.T
        wx, wy, wz = view.qvel.T[3:6]
        forward, sideways, turning = view.task["command"].T
        sensors, torque = view.sensordata, view.field("actuator_force")
        standing = sensors[..., self.feet] > TOUCHED
        sliding = sensors[..., self.sliding] ** 2
        return {
            "linear": LINEAR * np.exp(-((vx - forward) ** 2 + (vy - sideways) ** 2) / WIDTH),
            "yaw": YAW * np.exp(-((wz - turning) ** 2) / WIDTH),
            "vertical": -VERTICAL * vz * vz,
            "rolling": -ROLLING * (wx * wx + wy * wy),
            "torque": -TORQUE * (torque * torque).sum(-1),
            "rate": -RATE * view.task["rate"],
            "slip": -SLIP * (standing * (sliding[..., 0] + sliding[..., 1])).sum(-1),
        }

    def terminated(self, view: View) -> NDArray[np.bool_]:
        """Trunk or a thigh touches the ground, the trunk leans too far, or the robot has fallen off the map."""
        touched = (view.sensordata[..., self.hull] > TOUCHED).any(-1)
        sunk = view.qpos[..., 2] < view.ground(view.qpos[..., :2])
        return touched | (view.now.frame.zz < TILTED) | sunk

    def proprio(self, view: View) -> tuple[NDArray, ...]:
        """Linear and angular velocity, down (own frame), command, joint positions and velocities, last action."""
        frame, v = view.now.frame, view.qvel
        down = np.array((-frame.zx, -frame.zy, -frame.zz)).T
        task = view.task
        return view.now.linear, v[..., 3:6], down, task["command"], view.qpos[..., 7:], v[..., 6:], task["action"]
