"""The elevation map that a robot has, rather than the true one: seen by a depth camera, fused while the pose drifts.

Each robot keeps a grid in the frame of its own pose estimate, which wraps around: a cell belongs to whatever place
within `SIDE / 2` cells of the robot falls on it. An image's points are averaged a cell with weights 1 / variance,
earlier weights fade with half of the camera's window as time constant, and cells not seen within it are forgotten.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.terrain.camera import DepthCamera
from nfc_gym.terrain.egocentric import CELL, SIZE, to_grid
from nfc_gym.terrain.heightfield import Heightfield
from nfc_gym.terrain.scan import scan

Array = NDArray[np.float64]

SIDE = 192  # cells of the grid: half of it (9.6 m) holds the map's farthest corner (9.1 m)
FLOOR = 0.005  # m, standard deviation below which a cell's height is never believed: its ground is not level
_FLAGS = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


class PerceivedMap:
    """Perceived elevation maps of one robot, or of a batch of robots that do not see each other.

    `reset`, then `update` at each control step (or less often): it takes an image whenever one is due and returns the
    map. Cells that were not seen within the camera's window hold the height of the ground below the base, which a robot
    knows from its feet, wheels or altimeter; `valid` says which were seen.

    Args:
      camera: mount, field of view, noise, drift; see `DepthCamera`.
      num: None for one robot, whose arrays have no leading axis; n for a batch, (n, ...). A robot takes 0.44 MB.
    """

    def __init__(self, camera: DepthCamera | None = None, num: int | None = None) -> None:
        if num is not None and num < 1:
            raise InputError(f"num {num!r}: want None for one robot, or a number of robots")
        self.camera = camera or DepthCamera()
        self.num = num
        self._robots: list[_Robot | None] = [None] * (num or 1)
        self._valid = np.zeros((num or 1, SIZE, SIZE), bool)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(SIZE, SIZE) or (num, SIZE, SIZE): cells of the last map that were seen within the window; a copy."""
        return (self._valid[0] if self.num is None else self._valid).copy()

    def reset(
        self,
        rng: np.random.Generator | Sequence[np.random.Generator],
        mask: NDArray[np.bool_] | None = None,
    ) -> None:
        """Forget all that was seen, and the drift.

        Args:
          rng: draws all noise until the next reset; for a batch one generator for each robot.
          mask: (num,) which robots of a batch begin anew, by default all; the other entries of `rng` are not used.
        """
        generators = [rng] if isinstance(rng, np.random.Generator) else list(rng)
        if len(generators) != len(self._robots) or (self.num is not None and isinstance(rng, np.random.Generator)):
            raise InputError(f"{len(generators)} random generators for {len(self._robots)} robots; want one each")
        chosen = np.ones(len(generators), bool) if mask is None else np.asarray(mask, bool)
        if chosen.shape != (len(generators),):
            raise InputError(f"mask has shape {chosen.shape}; want ({len(generators)},)")
        for k in np.flatnonzero(chosen):
            self._robots[k] = _Robot(self.camera, generators[k])
            self._valid[k] = False

    def update(
        self,
        heightfield: Heightfield | Sequence[Heightfield],
        xyz: ArrayLike,
        quat: ArrayLike,
        yaw: ArrayLike,
        time: ArrayLike,
        mask: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """The map as it is known at a time.

        Args:
          heightfield: the true terrain; one for all, or a sequence with one for each robot.
          xyz: (3,) or (num, 3) true base positions [m].
          quat: (4,) or (num, 4) true base orientations, w first.
          yaw: () or (num,) true headings [rad].
          time: () or (num,) [s], not decreasing from one reset to the next.
          mask: (num,) which robots of a batch look, by default all; of the other arrays' entries the rest is not used.

        Returns:
          (SIZE, SIZE) or (num, SIZE, SIZE) float32 [m], a fresh array, laid out as `elevation` has it; with a mask a
          map for each robot that it names.

        Raises:
          InputError: before the first reset, time that runs backwards, shapes that do not fit, values not finite.
        """
        count = len(self._robots)
        lead = () if self.num is None else (self.num,)
        base, turn, heading = (np.asarray(a, np.float64) for a in (xyz, quat, yaw))
        if (base.shape, turn.shape, heading.shape) != ((*lead, 3), (*lead, 4), lead):
            raise InputError(
                f"xyz, quat, yaw have shapes {base.shape}, {turn.shape}, {heading.shape};"
                f" want {(*lead, 3)}, {(*lead, 4)}, {lead}"
            )
        if not all(np.isfinite(a).all() for a in (base, turn, heading)):
            raise InputError("xyz, quat and yaw must be finite")
        fields = [heightfield] * count if isinstance(heightfield, Heightfield) else list(heightfield)
        if len(fields) != count:
            raise InputError(f"{len(fields)} heightfields for {count} robots; want one for all or one each")
        chosen = np.ones(count, bool) if mask is None else np.asarray(mask, bool)
        maps = np.empty((int(chosen.sum()), SIZE, SIZE), np.float32)
        fresh = iter(maps)
        times = np.broadcast_to(np.asarray(time, np.float64), lead).reshape(count)
        poses = zip(base.reshape(-1, 3), turn.reshape(-1, 4), heading.reshape(-1), times, strict=True)
        for k, (place, quaternion, angle, now) in enumerate(poses):
            if not chosen[k]:
                continue
            robot, field = self._robots[k], fields[k]
            if robot is None:
                raise InputError("update before reset: call reset(rng) first")
            robot.advance(field, place, quaternion, float(now))
            self._valid[k] = robot.draw(field, place, float(angle), next(fresh))
        return maps[0] if self.num is None else maps


class _Robot:
    """One robot's grid, drift and clock.

    Attributes:
      height, weight, seen: (SIDE, SIDE) float32 estimate [m], its 1 / variance [1/m^2], and when it was last seen [s].
      drift: estimated minus true x, y, z [m] and heading [rad].
    """

    def __init__(self, camera: DepthCamera, rng: np.random.Generator) -> None:
        self.camera, self.rng = camera, rng
        self.height = np.zeros((SIDE, SIDE), np.float32)
        self.weight = np.zeros((SIDE, SIDE), np.float32)
        self.seen = np.full((SIDE, SIDE), -np.inf, np.float32)
        self.drift = np.zeros(4)
        self.time: float | None = None
        self.due = 0.0

    def advance(self, field: Heightfield, xyz: Array, quat: Array, now: float) -> None:
        """Let the pose estimate drift until now, and take an image if one is due."""
        if self.time is None:
            self.due = now
        elif now < self.time:
            raise InputError(f"time {now:g} s is before the last update's {self.time:g} s; reset in between")
        elif now > self.time:  # no draws for no time: a second look at one moment changes nothing that comes later
            walk = np.array([self.camera.drift] * 3 + [self.camera.yaw_drift]) * np.sqrt(now - self.time)
            self.drift += walk * self.rng.standard_normal(4)
        self.time = now
        if now >= self.due - 1e-9:
            self.due += np.ceil((now - self.due + 1e-9) * self.camera.rate) / self.camera.rate
            self._look(field, xyz, quat, now)

    def _look(self, field: Heightfield, xyz: Array, quat: Array, now: float) -> None:
        """Take an image and enter its points where the robot believes them to be."""
        turn = _rotation(quat)
        arm = turn @ self.camera.position
        points, sd = scan(self.camera, field, xyz + arm, turn @ self.camera.mount, self.rng)
        tilt = self.camera.tilt * self.rng.standard_normal(2)
        # Small errors of roll and pitch turn the cloud about the base; heading turns it about the vertical.
        cos, sin = np.cos(self.drift[3]), np.sin(self.drift[3])
        error = np.array([[cos, -sin, tilt[0]], [sin, cos, tilt[1]], [-tilt[0], -tilt[1], 1]])
        believed = points @ error.T.astype(np.float32) + (error @ arm + xyz + self.drift[:3]).astype(np.float32)
        cells = np.rint(believed[:, :2] / CELL).astype(np.int64)
        # What lies beyond the map would be entered on its other side.
        inside = (np.abs(cells - np.rint((xyz + self.drift[:3])[:2] / CELL).astype(np.int64)) < SIDE // 2).all(1)
        believed, sd, cells = believed[inside], sd[inside], cells[inside] % SIDE
        flat = cells[:, 1] * SIDE + cells[:, 0]
        gain = 1 / (sd * sd + FLOOR**2)
        total = np.bincount(flat, gain, SIDE * SIDE)
        hit = np.flatnonzero(total > 0)
        mean = np.bincount(flat, gain * believed[:, 2], SIDE * SIDE)[hit] / total[hit]
        height, weight, seen = (grid.reshape(-1) for grid in (self.height, self.weight, self.seen))
        age = now - seen[hit]
        old = np.where(age <= self.camera.window, weight[hit] * np.exp(-2 * age / self.camera.window), 0.0)
        fused = old + total[hit]
        height[hit] += ((mean - height[hit]) * total[hit] / fused).astype(np.float32)
        weight[hit] = np.minimum(fused, 1 / FLOOR**2)
        seen[hit] = now

    def draw(self, field: Heightfield, xyz: Array, yaw: float, out: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Write the map around the robot into `out`, and return which of its cells were seen."""
        believed = xyz + self.drift[:3]
        assert self.time is not None
        known = (self.seen >= self.time - self.camera.window - 1e-6).astype(np.float32)
        # Unroll the grid so that the robot's own cell lies in its middle.
        middle = np.rint(believed[:2] / CELL).astype(np.int64)
        shift = tuple(SIDE // 2 - middle[::-1] % SIDE)
        weighted, known = (np.roll(grid, shift, (0, 1)) for grid in (self.height * known, known))
        matrix = to_grid(believed[:2] / CELL - middle + SIDE // 2, np.float64(yaw) + self.drift[3])
        # Known cells alone are interpolated: what fills the others must not leak into them.
        cv2.warpAffine(weighted, matrix, (SIZE, SIZE), out, _FLAGS)
        share = cv2.warpAffine(known, matrix, (SIZE, SIZE), flags=_FLAGS)
        valid = share >= 0.5
        out /= np.maximum(share, 0.5)
        out -= np.float32(believed[2])
        out[~valid] = field.height(xyz[:2]) - xyz[2]
        return valid


def _rotation(quat: Array) -> Array:
    """(3, 3) rotation of a quaternion, w first."""
    norm = np.linalg.norm(quat)
    if not norm > 1e-6:
        raise InputError(f"quat {quat.tolist()}: want a unit quaternion, w first")
    w, x, y, z = quat / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
