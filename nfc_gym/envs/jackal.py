"""Jackal: a skid-steered rover that drives to goals, or follows a figure of eight."""

from typing import ClassVar, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.components import base, observed
from nfc_gym.envs.mirror import ENDS, SIDES, Plane, Signed, fixed
from nfc_gym.envs.path import figure_eight
from nfc_gym.envs.robot import DT, Array, Ground, Robot, Start
from nfc_gym.envs.rotations import Axes, axes, to_robot, turned
from nfc_gym.envs.view import View
from nfc_gym.physics.state import components, root

# Public dimensions of the machine, as in its MJCF.
RADIUS = 0.098  # m, a wheel's
TRACK = 0.37559  # m, left wheels to right wheels
REACH = 0.30  # m, from the base to the outside of any wheel

FULL_SPEED = 2.0  # m/s, the data sheet's; action 1
FULL_TURN = 4.0  # rad/s, the data sheet's; action 1

NEAREST, FARTHEST = 3.0, 8.0  # m to a goal: 4 s of driving at most, so that 20 s leave room for detours
START = 0.5  # m, half the side of the square that episodes start in: the terrain is level within 1 m
EDGE = 12.4  # m from the middle: there the map of 25.5 m ends within a robot's length
TIPPED = 0.3  # z of the robot's up axis: 72 degrees, from where the hull rests on its side

LOOP = 3.0  # m, half the length of the figure of eight, the paper's: each of its two rounds is 3 m long and 3 m wide
LAP = 20.0  # s for both rounds: 0.9 m/s on average, so one episode

# Weights of the reward, a second's worth of each adding up to a few units.
PROGRESS = 1.0  # per m/s towards the goal: 2 at full speed
ARRIVAL = 2.0  # per step at the goal: staying there is worth as much as driving at full speed
TRACKING = 2.0  # per step, times exp(-(distance / WIDTH)^2)
WIDTH = 0.5  # m
JERK = 0.05  # per squared change of action: a full reversal of one command costs 0.2
SMOOTH = 5.0  # the same along the figure of eight: with 1 its drivers swerve twice a second
TILT = 0.5  # per 1 - cos(tilt): driving on a 30 degree slope costs 0.07


class Now(NamedTuple):
    """Where the rover is with respect to its goal."""

    frame: Axes
    x: Array  # (*B,) m, of the goal, world
    y: Array
    ahead: Array  # (*B,) m, of the goal, along the horizontal heading
    left: Array  # (*B,) m
    distance: Array  # (*B,) m, in the plane


class Jackal(Robot):
    """Two actions: forward speed and yaw rate, turned into wheel speeds of either side.

    Attributes:
      loop, lap: half the length of the figure of eight [m], and the time for one round [s].
    """

    name = "jackal"
    planes = (SIDES, ENDS)
    tasks = ("goal", "figure8")
    terrain_scale = 0.3  # steps of difficulty 0.5 are then 0.03 m, a third of a wheel's radius: what it can climb
    action_size, proprio_size, goal_size, place_size, draws = 2, 15, 2, 2, 5
    loop: ClassVar[float] = LOOP
    lap: ClassVar[float] = LAP

    def __init__(self, model: mujoco.MjModel, task: str) -> None:
        super().__init__(model, task)
        self.terms = ("progress" if task == "goal" else "tracking", "arrival", "jerk", "tilt")

    def begin(self, u: Array, ground: Ground) -> Start:
        """Somewhere near the middle, any heading, above the highest point below the wheels."""
        x, y, heading, far, bearing = u.T
        x, y, heading = START * (2 * x - 1), START * (2 * y - 1), 2 * np.pi * heading
        around = 2 * np.pi * np.arange(9) / 8
        ring = REACH * np.array((np.cos(around), np.sin(around))).T * (np.arange(9) < 8)[:, None]
        spot = np.array((x, y)).T
        top = ground(spot[..., None, :] + ring).max(-1)
        qpos = np.empty((*u.shape[:-1], len(self.home)))
        qpos[...] = self.home
        qpos[..., :2] = spot
        qpos[..., 2] += top
        qpos[..., 3:7] = turned(self.home[3:7], heading)
        far, bearing = NEAREST + (FARTHEST - NEAREST) * far, 2 * np.pi * bearing
        goal = np.array((x + far * np.cos(bearing), y + far * np.sin(bearing))).T
        zero = np.zeros((*u.shape[:-1], 2))
        task = {"goal": goal, "action": zero, "jerk": zero[..., 0]}
        if self.task == "figure8":
            task |= {"clock": zero[..., 0], "start": np.array((x, y, heading)).T}
        return Start(qpos, task)

    def actuate(self, action: Array, view: View) -> Array:
        """Wheel speeds (rad/s) in the order front left, front right, rear left, rear right."""
        forward, turn = components(action)
        forward, turn = FULL_SPEED / RADIUS * forward, FULL_TURN * TRACK / 2 / RADIUS * turn
        return np.array((forward - turn, forward + turn, forward - turn, forward + turn)).T

    def advance(self, view: View, action: Array) -> dict[str, NDArray]:
        """The last action and how much it changed; the clock of the figure of eight."""
        (forward, turn), (last_forward, last_turn) = components(action), components(view.task["action"])
        forward, turn = forward - last_forward, turn - last_turn
        task = {"action": action, "jerk": forward * forward + turn * turn}
        if self.task == "figure8":
            task["clock"] = view.task["clock"] + DT
        return task

    def derive(self, view: View) -> Now:
        """Goal as seen from the rover."""
        frame = axes(view.qpos[..., 3:7])
        x, y = components(view.qpos[..., :2])
        if self.task == "figure8":
            gx, gy = figure_eight(view.task["clock"] / self.lap, self.loop, *components(view.task["start"]))
        else:
            gx, gy = components(view.task["goal"])
        dx, dy = gx - x, gy - y
        distance = root(dx * dx + dy * dy)
        cos, sin = frame.xx, frame.yx  # horizontal part of the forward axis, to be scaled to unit length
        scale = 1 / root(cos * cos + sin * sin + 1e-12)  # upright on its nose it has no heading
        return Now(frame, gx, gy, (cos * dx + sin * dy) * scale, (cos * dy - sin * dx) * scale, distance)

    def reward(self, view: View, action: Array) -> dict[str, Array]:
        """See the table of weights above."""
        now, before = view.now, view.before
        distance = now.distance
        if self.task == "goal":
            main = PROGRESS / DT * (before.distance - distance)
        else:
            main = TRACKING * np.exp(-distance * distance / WIDTH**2)
        return {
            self.terms[0]: main,
            "arrival": ARRIVAL * (distance < self.arrived),
            "jerk": -(JERK if self.task == "goal" else SMOOTH) * view.task["jerk"],
            "tilt": TILT * (now.frame.zz - 1),
        }

    def terminated(self, view: View) -> NDArray[np.bool_]:
        """Tipped over, or off the map."""
        x, y = components(view.qpos[..., :2])
        return (view.now.frame.zz < TIPPED) | (x * x > EDGE * EDGE) | (y * y > EDGE * EDGE)

    def components(self, model: mujoco.MjModel) -> list[str]:
        """See `Robot`."""
        motion = [*base(model, "quat", "wxyz"), *base(model, "linvel@body"), *base(model, "angvel@body")]
        return [*motion, *base(model, "pos"), *observed(2)]

    def reflected(self, model: mujoco.MjModel, plane: Plane) -> tuple[list[Signed], Signed]:
        """See `Robot`."""
        action = fixed(plane.vector("x"), plane.axial("z"))  # forward speed and yaw rate
        return [action], action

    def proprio(self, view: View) -> tuple[NDArray, ...]:
        """Quaternion, velocity and rates in the rover's own frame, position, last action."""
        q, v = view.qpos, view.qvel
        return q[..., 3:7], to_robot(view.now.frame, v[..., :3]), v[..., 3:6], q[..., :3], view.task["action"]

    def goal(self, view: View) -> NDArray:
        """Goal ahead and to the left (m)."""
        return np.array((view.now.ahead, view.now.left)).T

    def facts(self, view: View) -> dict[str, NDArray]:
        """Distance to the goal in the plane (m), and whether that counts as reached."""
        return {"success": view.now.distance < self.arrived, "distance": view.now.distance}

    def achieved(self, view: View) -> NDArray:
        """World x and y (m)."""
        return view.qpos[..., :2]

    def desired(self, view: View) -> NDArray:
        """World x and y of the goal (m)."""
        return np.array((view.now.x, view.now.y)).T
