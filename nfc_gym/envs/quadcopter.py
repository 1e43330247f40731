"""Quadcopter: flies to goals, past obstacles on rough ground, or follows a figure of eight."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.components import base, joints, observed
from nfc_gym.envs.mirror import ENDS, SIDES, Plane, Signed, fixed
from nfc_gym.envs.path import figure_eight
from nfc_gym.envs.robot import DT, Array, Ground, Robot, Start
from nfc_gym.envs.rotations import Axes, at_least, at_most, axes, turned
from nfc_gym.envs.view import View
from nfc_gym.physics.state import components, root

REACH = 0.35  # m, from the chassis' centre to a propeller's tip, with room
NEAREST, FARTHEST = 3.0, 8.0  # m to a goal over ground: within the map of 25.5 m
TIP = 0.28  # m, from the chassis' centre to a propeller's tip
LOW, HIGH = 1.0, 2.5  # m of starts and goals above a map's level middle, 0: below the tallest obstacles (4 m)
ABOVE = 0.6  # m that a start or goal lies above what stands there: a rotor's reach and as much again
START = 0.5  # m, half the side of the square that episodes start in: 1 m around the middle is free
STRAY = 8.0  # m from the straight way between start and goal: lost
TILTED = float(np.cos(2.5))  # z of the up axis at 2.5 rad, upside down

LOOP = 3.0  # m, half the length of the figure of eight
LAP = 10.0  # s for one round: 1.8 m/s on average

# Weights of the reward, per step: hovering at the goal earns 3.5, hovering 5 m away 0.5.
NEARNESS = 2.0  # times 1 / (1 + (distance / 1 m)^2)
UPRIGHT = 0.5  # times the z of the up axis
RATES = 0.02  # per (rad/s)^2: a turn of a second, 2 pi rad/s, costs 0.8
ARRIVAL = 1.0  # at the goal


class Now(NamedTuple):
    """Where the craft is with respect to its goal."""

    frame: Axes
    goal: Array  # (*B, 3) m, world
    offset: Array  # (*B, 3) m, from the craft to the goal, world
    distance: Array  # (*B,) m


def _top(ground: Ground, x: Array, y: Array, reach: float) -> Array:
    """(*B,) m, of what stands within a craft's reach of a place."""
    around = np.pi / 4 * np.arange(9)
    ring = reach * np.array((np.cos(around), np.sin(around))).T * (np.arange(9) < 8)[:, None]
    return ground(np.array((x, y)).T[..., None, :] + ring).max(-1)


class Quadcopter(Robot):
    """Four actions: the thrust of each rotor, -1 for none and 1 for the maximum."""

    name = "quadcopter"
    planes = (SIDES, ENDS)
    tasks = ("goal", "figure8")
    terrain_kind = "obstacles"
    action_size, proprio_size, place_size, draws = 4, 21, 3, 7
    reads = ("sensordata",)
    terms = ("nearness", "upright", "rates", "arrival")

    def __init__(self, model: mujoco.MjModel, task: str) -> None:
        super().__init__(model, task)
        self._half = model.actuator_ctrlrange[:, 1] / 2  # N
        touch = int(model.sensor("collision").adr[0])
        self._touch = slice(touch, touch + 1)

    def begin(self, u: Array, ground: Ground) -> Start:
        """Hovering near the middle, any heading; the goal is above whatever stands there."""
        x, y, z, heading, far, bearing, high = u.T
        x, y, heading = START * (2 * x - 1), START * (2 * y - 1), 2 * np.pi * heading
        z, high = LOW + (HIGH - LOW) * z, LOW + (HIGH - LOW) * high
        qpos = np.empty((*u.shape[:-1], len(self.home)))
        qpos[...] = self.home
        qpos[..., 3:7] = turned(self.home[3:7], heading)
        if self.task == "figure8":
            way = np.arange(32) / 32
            columns = [part[..., None] for part in (x, y, heading)]
            z = np.maximum(z, ground(np.stack(figure_eight(way, LOOP, *columns), -1)).max(-1) + ABOVE)
            qpos[..., :3] = np.array((x, y, z)).T
            return Start(qpos, {"clock": np.zeros(u.shape[:-1]), "place": np.array((x, y, z, heading)).T})
        z = np.maximum(z, _top(ground, x, y, TIP) + ABOVE)
        qpos[..., :3] = start = np.array((x, y, z)).T
        far, bearing = NEAREST + (FARTHEST - NEAREST) * far, 2 * np.pi * bearing
        x, y = x + far * np.cos(bearing), y + far * np.sin(bearing)
        goal = np.array((x, y, np.maximum(high, _top(ground, x, y, REACH) + ABOVE))).T
        return Start(qpos, {"goal": goal, "start": start})

    def actuate(self, action: Array, view: View) -> Array:
        """Thrust of each rotor (N)."""
        return (action + 1) * self._half

    def advance(self, view: View, action: Array) -> dict[str, NDArray]:
        """The clock of the figure of eight."""
        return {"clock": view.task["clock"] + DT} if self.task == "figure8" else {}

    def derive(self, view: View) -> Now:
        """Goal as seen from the craft."""
        if self.task == "figure8":
            x, y, z, heading = components(view.task["place"])
            goal = np.array((*figure_eight(view.task["clock"] / LAP, LOOP, x, y, heading), z)).T
        else:
            goal = view.task["goal"]
        offset = goal - view.qpos[..., :3]
        dx, dy, dz = components(offset)
        return Now(axes(view.qpos[..., 3:7]), goal, offset, root(dx * dx + dy * dy + dz * dz))

    def reward(self, view: View, action: Array) -> dict[str, Array]:
        """See the table of weights above."""
        distance = view.now.distance
        rx, ry, rz = components(view.qvel[..., 3:6])
        return {
            "nearness": NEARNESS / (1 + distance * distance),
            "upright": UPRIGHT * view.now.frame.zz,
            "rates": -RATES * (rx * rx + ry * ry + rz * rz),
            "arrival": ARRIVAL * (distance < self.arrived),
        }

    def terminated(self, view: View) -> NDArray[np.bool_]:
        """Collided, overturned, or too far off the way."""
        now = view.now
        (force,) = components(view.sensordata[..., self._touch])
        lost = self._off_the_way(view) > STRAY if self.task == "goal" else now.distance > STRAY
        return (force > 0) | (now.frame.zz < TILTED) | lost

    def _off_the_way(self, view: View) -> Array:
        """Distance (*B,) from the straight line between start and goal [m]."""
        ax, ay, az = components(view.now.goal - view.task["start"])
        dx, dy, dz = components(view.now.offset)
        share = (ax * dx + ay * dy + az * dz) / (ax * ax + ay * ay + az * az)
        share = at_most(at_least(share, 0.0), 1.0)  # of the way that is left
        ex, ey, ez = dx - share * ax, dy - share * ay, dz - share * az
        return root(ex * ex + ey * ey + ez * ez)

    def components(self, model: mujoco.MjModel) -> list[str]:
        """See `Robot`."""
        pose = [*observed(3), *base(model, "quat", "wxyz")]
        return [*pose, *base(model, "linvel"), *base(model, "angvel@body"), *joints(model, "pos")]

    def reflected(self, model: mujoco.MjModel, plane: Plane) -> tuple[list[Signed], Signed]:
        """See `Robot`."""
        rotors = [model.actuator(i).name for i in range(model.nu)]
        action = Signed(np.array([rotors.index(plane.opposite(name)) for name in rotors]), np.ones(len(rotors)))
        return [fixed(*map(plane.vector, "xyz"))], action  # offset to the goal

    def proprio(self, view: View) -> tuple[NDArray, ...]:
        """Goal offset (world), then `_motion`."""
        return view.now.offset, *self._motion(view)

    def state(self, view: View) -> tuple[NDArray, ...]:
        """Position (world) in place of the goal offset, then `_motion`."""
        return view.qpos[..., :3], *self._motion(view)

    @staticmethod
    def _motion(view: View) -> tuple[NDArray, ...]:
        """Quaternion, linear velocity (world), angular velocity (own frame), angles of the rotor mounts."""
        return view.qpos[..., 3:7], view.qvel[..., :6], view.qpos[..., 7:]

    def facts(self, view: View) -> dict[str, NDArray]:
        """Distance to the goal (m), and whether that counts as reached."""
        return {"success": view.now.distance < self.arrived, "distance": view.now.distance}

    def achieved(self, view: View) -> NDArray:
        """World position (m)."""
        return view.qpos[..., :3]

    def desired(self, view: View) -> NDArray:
        """World position of the goal (m)."""
        return view.now.goal
