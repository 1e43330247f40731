"""A local planner with motion primitives, and a PID below it: what outdoor rovers have without any learning.

After the idea of Zhang, Hu, Chadha and Singh, "Falco: Fast likelihood-based collision avoidance with extension to
human-guided navigation", J. Field Robotics 37 (2020): arcs are laid out beforehand with the grid cells that each of
them crosses; a look at the map says which of them are passable and how rough they are; of those, the one that
leads best towards the goal is driven. All robots are planned for at once.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.hidden import Array

CELL, SIZE = 0.1, 128  # m, of the elevation map; its middle is the robot
FULL_SPEED, FULL_TURN = 2.0, 4.0  # m/s, rad/s of action 1
DT = 0.02  # s
HALF_WIDTH = 0.21  # m, half a Jackal's width with its wheels


@dataclass(frozen=True)
class Gains:
    """What was tuned, on the nominal machine on flat and rough ground alone.

    Attributes:
      speed: m/s at most.
      slow: m from the goal at which to drive slower.
      climb: m between neighbouring samples that no arc may cross.
      roughness: cost of a metre of mean climbing along an arc, in metres of nearness to the goal.
      spin, spinning, near: rad off the heading from which the robot turns on the spot, how fast [rad/s], and the
        distance below which it does not [m].
      replan: control steps between two plans.
      turn_p, turn_i, turn_d: of yaw rate's error.
      speed_p, speed_i: of forward speed's error.
    """

    speed: float = 1.6
    slow: float = 0.8
    climb: float = 0.12
    roughness: float = 3.0
    spin: float = 1.4
    spinning: float = 1.5
    near: float = 0.5
    replan: int = 5
    turn_p: float = 1.0
    turn_i: float = 4.0
    turn_d: float = 0.0
    speed_p: float = 0.3
    speed_i: float = 1.0


class Arcs:
    """Primitives: arcs (k, s, 2) in the robot's frame [m], forward first, then backward.

    Attributes:
      curvature, direction: (k,) 1/m, and 1 or -1.
      points: (k, s, 2).
      cells: (k, s, 3, 2) indices in the elevation map below both sides and the middle.
    """

    def __init__(self, length: float = 2.0, samples: int = 20) -> None:
        bends = np.concatenate([[0.0], *((b, -b) for b in (0.1, 0.25, 0.45, 0.7, 1.0, 1.5, 2.2, 3.2))])
        self.curvature = np.concatenate([bends, bends[:5]])
        self.direction = np.concatenate([np.ones(len(bends)), -np.ones(5)])
        along = self.direction[:, None] * length * (1 + np.arange(samples)) / samples
        heading = self.curvature[:, None] * along
        bent = np.where(self.curvature == 0, 1.0, self.curvature)[:, None]
        x = np.where(self.curvature[:, None] == 0, along, np.sin(heading) / bent)
        y = np.where(self.curvature[:, None] == 0, 0.0, (1 - np.cos(heading)) / bent)
        self.points, self.heading = np.stack([x, y], -1), heading
        side = HALF_WIDTH * np.stack([-np.sin(heading), np.cos(heading)], -1)
        tracks = self.points[:, :, None] + side[:, :, None] * np.array([-1.0, 0.0, 1.0])[:, None]
        self.cells = np.clip(np.rint(tracks / CELL + (SIZE - 1) / 2).astype(np.intp), 0, SIZE - 1)

    def climbs(self, elevation: Array) -> Array:
        """(n, k, s - 1) largest height difference between two neighbouring samples of a track [m]."""
        heights = elevation[:, self.cells[..., 0], self.cells[..., 1]]
        return np.abs(np.diff(heights, axis=2)).max(-1)


class Falco:
    """Goal and elevation map in, forward speed and yaw rate out; needs the observation's `elevation` and `proprio`.

    Args:
      gains: see `Gains`.
    """

    def __init__(self, gains: Gains | None = None) -> None:
        self.gains, self.arcs = gains or Gains(), Arcs()

    def begin(self, n: int) -> None:
        """Forget the plan and the integrals of n robots."""
        self.age = 0
        self.chosen = np.zeros(n, np.intp)
        self.turned, self.driven, self.before = np.zeros(n), np.zeros(n), np.zeros(n)

    def plan(self, goal: Array, elevation: Array) -> NDArray[np.intp]:
        """(n,) arc of each robot: of the passable ones the nearest to the goal, roughness counted in."""
        g, arcs = self.gains, self.arcs
        climbs = arcs.climbs(elevation)
        # Only what lies before the goal is in the way, and only the point nearest to the goal counts.
        gaps = np.linalg.norm(goal[:, None, None] - arcs.points, axis=-1)
        nearest = gaps.argmin(2)
        before = np.arange(climbs.shape[2]) < np.maximum(nearest, 1)[..., None]
        blocked = ((climbs > g.climb) & before).any(2)
        rough = np.where(before, climbs, 0).sum(2) / before.sum(2)
        end = np.take_along_axis(gaps, nearest[..., None], 2)[..., 0]
        at = np.take_along_axis(np.broadcast_to(arcs.points, (*gaps.shape, 2)), nearest[..., None, None], 2)[:, :, 0]
        way = goal[:, None] - at
        facing = np.take_along_axis(np.broadcast_to(arcs.heading, gaps.shape), nearest[..., None], 2)[..., 0]
        off = np.abs(np.arctan2(way[..., 1], way[..., 0]) - facing)
        off = np.minimum(off, 2 * np.pi - off) * np.minimum(end, 1.0)  # of no matter once there
        cost = end + 0.3 * off + g.roughness * rough
        backward = arcs.direction < 0  # only where no arc leads forward
        return np.where(blocked, cost + 1e3 + 10 * (climbs * before).max(2), cost + 100 * backward).argmin(1)

    def __call__(self, observation: Any) -> Array:
        """Actions (n, 2)."""
        g, arcs = self.gains, self.arcs
        goal, own = np.asarray(observation["goal"], float), np.asarray(observation["proprio"], float)
        if self.age % g.replan == 0:
            self.chosen = self.plan(goal, np.asarray(observation["elevation"], float))
        self.age += 1
        distance = np.linalg.norm(goal, axis=1)
        speed = g.speed * np.clip(distance / g.slow, 0.0, 1.0) / (1 + 0.35 * np.abs(arcs.curvature[self.chosen]))
        speed = np.where(distance < 0.1, 0.0, speed) * arcs.direction[self.chosen]
        turn = speed * arcs.curvature[self.chosen]
        bearing = np.arctan2(goal[:, 1], goal[:, 0])
        spin = (np.abs(bearing) > g.spin) & (distance > g.near)
        speed, turn = np.where(spin, 0.0, speed), np.where(spin, g.spinning * np.sign(bearing), turn)
        return np.stack([self._drive(speed, own[:, 4]), self._turn(turn, own[:, 9])], 1)

    def _drive(self, wanted: Array, measured: Array) -> Array:
        error = wanted - measured
        self.driven = np.clip(self.driven + self.gains.speed_i * DT * error, -0.5, 0.5)
        return np.clip((wanted + self.gains.speed_p * error + self.driven) / FULL_SPEED, -1, 1)

    def _turn(self, wanted: Array, measured: Array) -> Array:
        g, error = self.gains, wanted - measured
        self.turned = np.clip(self.turned + g.turn_i * DT * error, -3.0, 3.0)
        slope, self.before = (error - self.before) / DT, error
        return np.clip((wanted + g.turn_p * error + self.turned + g.turn_d * slope) / FULL_TURN, -1, 1)
