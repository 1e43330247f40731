"""`Runner`: what Ant and Humanoid have in common, legged robots with a motor in each joint that run towards a target.

The target is a point `RING` metres from the middle of the map. A robot that comes within `REACHED` of it is given the
next, `ONWARD` further round the ring, so that even a fast one stays on its map for a whole episode.
"""

from typing import ClassVar, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.mirror import Plane, Signed, fixed, jointwise, sensorwise
from nfc_gym.envs.robot import DT, Array, Ground, Robot, Start
from nfc_gym.envs.rotations import Axes, at_most, axes, in_robot, some
from nfc_gym.envs.spawn import place, spread, underside
from nfc_gym.envs.view import View
from nfc_gym.physics.state import components, root

RING = 9.0  # m; the map ends 12.75 m from its middle
REACHED = 1.0  # m
ONWARD = np.pi * (3 - np.sqrt(5))  # rad, the golden angle: 16.8 m from one target to the next, in ever new directions
MIDDLE = 0.05  # m, half the side of the square of starts: the level middle of a rough map has a radius of 1 m
ASIDE = 0.5  # rad, the most by which the first target lies off the robot's heading
NEAR_LIMIT = 0.95  # of half a joint's range: from there nearness to the limit counts, up to 1 at the limit itself
FACING = 0.8  # cosine of 37 degrees: who heads closer to the target than that has the heading reward in full


class Weights(NamedTuple):
    """What the terms of the reward weigh, a control step."""

    progress: float  # per m/s towards the target
    alive: float  # per step
    upright: float  # times the cosine between the torso's up axis and the vertical
    heading: float  # times the cosine between the torso's forward axis and the target, over `FACING`, at most 1
    action: float  # per unit of squared action, summed over the joints
    energy: float  # per W of mechanical power, absolute, summed over the joints
    limits: float  # per joint at its limit


class Now(NamedTuple):
    """The torso with respect to ground and target; all (*B,)."""

    frame: Axes
    x: Array  # m, world
    y: Array
    height: Array  # m above the ground below
    towards_x: Array  # unit vector to the target, horizontal
    towards_y: Array
    yaw: Array  # rad
    roll: Array  # rad
    angle: Array  # rad, of the target, from the heading, anticlockwise
    facing: Array  # cosine between the forward axis and the direction to the target


class Runner(Robot):
    """A robot that runs; subclasses give sizes, weights and what they feel.

    Attributes:
      weights: of the reward.
      lowest: m, height of the torso above the ground below at which an episode ends.
      noise: rad, half the range by which joints start off the pose `home`.
      feet: in the order of the foot wrenches.
    """

    tasks = ("run",)
    terms = Weights._fields
    weights: ClassVar[Weights]
    lowest: ClassVar[float]
    noise: ClassVar[float]
    feet: ClassVar[tuple[str, ...]]

    def __init__(self, model: mujoco.MjModel, task: str) -> None:
        super().__init__(model, task)
        self.gear = np.abs(model.actuator_gear[:, 0])  # N m at full action
        self.low, self.high = model.jnt_range[1:].T.copy()
        # |stretch q - middle| runs from 0 in the middle of a joint's range to 1 / (1 - NEAR_LIMIT) at its limits.
        self.stretch = 2 / (self.high - self.low) / (1 - NEAR_LIMIT)
        self.middle = self.stretch * (self.low + self.high) / 2
        self.free = np.full(len(self.low), NEAR_LIMIT / (1 - NEAR_LIMIT))
        self.below = underside(model, self.home)
        # A joint off by `noise` lowers a foot by no more than this: no leg is longer than the robot is high or wide.
        self.gap = 0.01 + self.noise * float(np.abs(self.below).max())
        first, last = model.sensor(f"{self.feet[0]}_force"), model.sensor(f"{self.feet[-1]}_torque")
        self.wrenches = slice(int(first.adr[0]), int(last.adr[0]) + 3)

    def begin(self, u: Array, ground: Ground) -> Start:
        """Near the middle, target roughly ahead, joints a little off their pose, feet just above the ground."""
        x, y, bearing, aside = u.T[:4]
        bearing = 2 * np.pi * bearing
        x, y = spread(x, -MIDDLE, MIDDLE), spread(y, -MIDDLE, MIDDLE)
        qpos = place(self.home, self.below, x, y, bearing + spread(aside, -ASIDE, ASIDE), ground, self.gap)
        qpos[..., 7:] = np.clip(qpos[..., 7:] + spread(u[..., 4:], -self.noise, self.noise), self.low, self.high)
        target = RING * np.array((np.cos(bearing), np.sin(bearing))).T
        return Start(qpos, {"target": target, "action": np.zeros((*u.shape[:-1], self.action_size))})

    def actuate(self, action: Array, view: View) -> Array:
        """Torque over the motor's largest."""
        return action

    def advance(self, view: View, action: Array) -> dict[str, NDArray]:
        """The last action; the next target for whoever has reached the present one."""
        (x, y), (tx, ty) = components(view.qpos[..., :2]), components(view.task["target"])
        dx, dy = tx - x, ty - y
        reached = dx * dx + dy * dy < REACHED**2
        if not some(reached):
            return {"action": action}
        cos, sin = np.cos(ONWARD), np.sin(ONWARD)
        target = np.where(reached, (cos * tx - sin * ty, sin * tx + cos * ty), (tx, ty)).T
        return {"target": target, "action": action}

    def derive(self, view: View) -> Now:
        """Torso with respect to ground and target."""
        frame = axes(view.qpos[..., 3:7])
        x, y, z = components(view.qpos[..., :3])
        tx, ty = components(view.task["target"])
        dx, dy = tx - x, ty - y
        scale = 1 / (root(dx * dx + dy * dy) + 1e-9)  # never a division by zero
        ux, uy = dx * scale, dy * scale
        facing = frame.xx * ux + frame.yx * uy
        opposite = np.array((frame.yx, frame.zy, frame.xx * uy - frame.yx * ux))
        yaw, roll, angle = components(np.arctan2(opposite, np.array((frame.xx, frame.zz, facing))).T)
        return Now(
            frame,
            x + 0.0,  # a copy: the state is live
            y + 0.0,
            z - view.ground(view.qpos[..., :2]),
            ux,
            uy,
            yaw,
            roll,
            angle,
            facing,
        )

    def reward(self, view: View, action: Array) -> dict[str, Array]:
        """See `Weights`; progress is measured over the control step, along the direction to the target at its start."""
        w, now, was = self.weights, view.now, view.before
        moved = (now.x - was.x) * was.towards_x + (now.y - was.y) * was.towards_y
        reach = np.abs(self.stretch * view.qpos[..., 7:] - self.middle)
        near = np.maximum(reach, self.free) - self.free
        return {
            "progress": w.progress / DT * moved,
            "alive": w.alive + 0 * moved,
            "upright": w.upright * now.frame.zz,
            "heading": w.heading * at_most(now.facing / FACING, 1.0),
            "action": -w.action * np.vecdot(action, action),
            "energy": -w.energy * np.vecdot(self.gear, np.abs(view.ctrl * view.qvel[..., 6:])),
            "limits": -w.limits * np.add.reduce(near, -1),
        }

    def terminated(self, view: View) -> NDArray[np.bool_]:
        """The torso is down."""
        return view.now.height < self.lowest

    @staticmethod
    def torso_reflected(plane: Plane) -> Signed:
        """What `torso` has from the yaw on, in a mirror.

        Where front becomes rear the target goes from ahead to ahead, which the motion does not know.
        """
        return fixed(plane.axial("z"), plane.axial("x"), plane.axial("z"), 1, 1)

    def feet_reflected(self, model: mujoco.MjModel, plane: Plane) -> Signed:
        """Forces and torques of the feet in a mirror."""
        return sensorwise(plane, model, [f"{foot}_{what}" for foot in self.feet for what in ("force", "torque")])

    @staticmethod
    def motors_reflected(model: mujoco.MjModel, plane: Plane) -> Signed:
        """Torques of the motors in a mirror, each named as its joint."""
        return jointwise(plane, model, [model.actuator(i).name for i in range(model.nu)])

    def torso(self, view: View) -> NDArray:
        """The twelve numbers that both robots' proprio begins with, (*B, 12).

        Height above the ground, velocity and rates in the torso's frame, yaw, roll, angle to the target, projection of
        up on the vertical and of forward on the target's direction.
        """
        now = view.now
        velocity = in_robot(now.frame, view.qvel[..., :3])
        rates = components(view.qvel[..., 3:6])
        return np.array((now.height, *velocity, *rates, now.yaw, now.roll, now.angle, now.frame.zz, now.facing)).T
