"""A depth camera after the Intel RealSense D435: what of a terrain it sees, and what it makes of that.

A heightfield hides a point from the camera where, on the way there, the ground rises above the line of sight. In the
vertical plane through both that is a running maximum of (height - camera's height) / distance, so one polar sampling of
the map and one `maximum.accumulate` replace the rendering of an image. Robots' own bodies hide nothing.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.terrain.heightfield import Heightfield

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.intp]

STEP = 0.08  # m between samples along a line; each image shifts them anew, so that images fill each other's gaps
TURN = np.deg2rad(1.25)  # between lines: 0.13 m at 6 m, shifted likewise
RISE = 0.1  # m from one sample to the next above which a face is sampled on its height too
LEVELS = 6  # samples on such a face


@dataclass(frozen=True)
class DepthCamera:
    """A stereo depth camera's mount and figures, those of the D435 by default, and what a mapping node does with it.

    Sources: [D] Intel, "RealSense Product Family D400 Series Datasheet" (fields of view, baseline, minimum depth at
    848 x 480, RMS error up to 2 % of the depth at 2 m); [T] Intel, "Tuning Depth Cameras for Best Performance" (depth
    error = depth^2 x subpixel / (focal length x baseline), subpixel below 0.1 on good texture). What has no source is
    an assumption and says so.

    Attributes:
      position: in the base's frame [m] (assumption: at the front of a 0.4 m trunk).
      pitch: of the optical axis below the base's x axis [rad] (assumption: 30 degrees, as on walking robots).
      yaw: of the optical axis to the left of the base's x axis [rad].
      fov: full horizontal and vertical angle [rad]: 87 x 58 degrees [D].
      near, far: usable depths [m]: 0.28 [D]; beyond 6 the error exceeds 13 cm.
      columns: of the image: 848 [D, the recommended mode].
      baseline: between the two imagers [m]: 0.050 [D].
      subpixel: matching error, standard deviation [pixels]: 0.08 [T], 14 mm at 2 m.
      dropout: share of pixels without a match ([D]: a fill rate of 99 % on a textured wall).
      blotches: mean number of patches without depth in an image, where texture is poor or light reflected (assumption).
      flying: share of the samples at a depth edge that take a depth between front and back (assumption: one pixel of
        the seven that a sample is wide).
      rate: images that are used [Hz] (assumption: the camera has 30, a mapping node keeps up with 10).
      window: age at which what was seen is forgotten [s].
      drift: random walk of the estimated position [m / sqrt(s)] (assumption: 1 % of the way at 1 m/s).
      yaw_drift: random walk of the estimated heading [rad / sqrt(s)] (assumption).
      tilt: error of the estimated roll and pitch in each image [rad] (assumption: 0.2 degrees, a fused IMU's).
    """

    position: tuple[float, float, float] = (0.22, 0.0, 0.05)
    pitch: float = np.deg2rad(30.0)
    yaw: float = 0.0
    fov: tuple[float, float] = (np.deg2rad(87.0), np.deg2rad(58.0))
    near: float = 0.28
    far: float = 6.0
    columns: int = 848
    baseline: float = 0.05
    subpixel: float = 0.08
    dropout: float = 0.01
    blotches: float = 2.0
    flying: float = 0.15
    rate: float = 10.0
    window: float = 1.0
    drift: float = 0.01
    yaw_drift: float = 0.005
    tilt: float = 0.0035

    def __post_init__(self) -> None:
        if len(self.position) != 3 or not np.isfinite(self.position).all():
            raise InputError(f"position {self.position!r}: want x, y, z in the base's frame [m]")
        if len(self.fov) != 2 or not all(0 < angle < np.pi for angle in self.fov):
            raise InputError(f"fov {self.fov!r}: want two angles between 0 and pi [rad]")
        if not 0 <= self.near < self.far < np.inf:
            raise InputError(f"near {self.near!r} and far {self.far!r}: want 0 <= near < far [m]")
        for name in ("columns", "baseline", "rate", "window"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"{name} {getattr(self, name)!r}: want a number above 0")
        for name in ("subpixel", "blotches", "drift", "yaw_drift", "tilt"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"{name} {getattr(self, name)!r}: want 0 or more")
        for name in ("dropout", "flying"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} {getattr(self, name)!r}: want a share from 0 to 1")

    @property
    def focal(self) -> float:
        """Focal length [pixels]."""
        return self.columns / 2 / np.tan(self.fov[0] / 2)

    def noise(self, depth: NDArray[np.floating]) -> NDArray[np.floating]:
        """Standard deviation of a measured depth [m], as [T] has it."""
        return depth * depth * (self.subpixel / (self.focal * self.baseline))

    @cached_property
    def mount(self) -> Array:
        """(3, 3) rotation from the camera's axes (forward, left, up) to the base's."""
        (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (self.pitch, self.yaw))
        return np.array([[cy * cp, -sy, cy * sp], [sy * cp, cy, sy * sp], [-sp, 0.0, cp]])

    @cached_property
    def corners(self) -> Array:
        """(4, 3) directions through the image's corners, in the camera's axes."""
        wide, high = np.tan(self.fov[0] / 2), np.tan(self.fov[1] / 2)
        return np.array([[1, wide, high], [1, -wide, high], [1, -wide, -high], [1, wide, -high]])


class Scan(NamedTuple):
    """Points that one image yields.

    Attributes:
      points: (m, 3) float32, relative to the camera in the world's axes [m].
      sd: (m,) float32 standard deviation of each depth [m].
    """

    points: Floats
    sd: Floats


def scan(camera: DepthCamera, heightfield: Heightfield, eye: Array, axes: Array, rng: np.random.Generator) -> Scan:
    """One image of a terrain, as a cloud of points.

    Args:
      camera: its figures.
      heightfield: what it looks at.
      eye: (3,) the camera's position in the world [m].
      axes: (3, 3) rotation from its axes (forward, left, up) to the world's.
      rng: draws noise, holes and flying pixels.
    """
    angles, distances = _fan(camera, axes, rng)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32)
    ground = _sample(heightfield, eye, directions, distances)
    slope = ground / distances
    horizon = np.maximum.accumulate(slope, axis=1)
    # A sample stands for the face from the one before it, of which what lies above the horizon is seen.
    before = np.concatenate([np.full_like(horizon[:, :1], -np.inf), horizon[:, :-1]], axis=1)
    visible = slope >= horizon
    sample = np.flatnonzero(visible)  # flat indices: several times faster than pairs
    r, h = distances[sample % len(distances)], ground.ravel()[sample]
    sample, r, h = _with_faces(sample, r, h, ground, before, rng)
    line = sample // len(distances)
    x, y = directions[line, 0] * r, directions[line, 1] * r
    # Depth is measured along the optical axis; the image's sides are planes through the eye.
    depth, left, up = (x * axis[0] + y * axis[1] + h * axis[2] for axis in axes.T.astype(np.float32))
    wide, high = np.tan(np.array(camera.fov, np.float32) / 2)
    seen = (depth > camera.near) & (depth < camera.far) & (np.abs(left) < wide * depth) & (np.abs(up) < high * depth)
    sample, points, r, depth = sample[seen], np.stack([x[seen], y[seen], h[seen]], axis=1), r[seen], depth[seen]
    # Far ground is seen so flat that the image's rows skip samples, each as many rows high as it adds to the horizon.
    rising = slope.ravel()[sample]
    rows = camera.focal * (rising - before.ravel()[sample]) / (1 + rising * rising)
    kept = rng.random(len(sample), np.float32) < np.minimum(rows, 1) * (1 - camera.dropout)
    kept &= ~_blotches(camera, angles, distances, rng).ravel()[sample]
    sample, points, r, depth = sample[kept], points[kept], r[kept], depth[kept]
    sd = np.maximum(camera.noise(depth), 1e-4).astype(np.float32)
    stretch = 1 + sd * rng.standard_normal(len(depth), np.float32) / depth
    flying = _flying(camera, visible, sample, distances, rng)
    stretch = np.where(np.isfinite(flying), flying / r, stretch)
    return Scan(points * stretch[:, None], sd)


def _fan(camera: DepthCamera, axes: Array, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Headings (a,) of vertical planes that hold the view [rad], and distances (d,) of the samples along each [m]."""
    corners = camera.corners @ axes.T
    vertical = axes[2]  # in the camera's axes
    if (np.abs(vertical[1:]) < np.tan(np.array(camera.fov) / 2) * abs(vertical[0])).all():
        first, last = -np.pi, np.pi - TURN  # straight down (or up) is in view, so all headings are
    else:
        middle = np.arctan2(*corners[:, 1::-1].mean(axis=0))
        offsets = np.arctan2(corners[:, 1], corners[:, 0]) - middle
        offsets = (offsets + np.pi) % (2 * np.pi) - np.pi
        first, last = middle + offsets.min(), middle + offsets.max()
    reach = camera.far * np.hypot(corners[:, 0], corners[:, 1]).max()
    angles = first - TURN * rng.random() + TURN * np.arange(np.ceil((last - first) / TURN) + 2)
    distances = STEP * (0.1 + 0.9 * rng.random() + np.arange(np.ceil(reach / STEP)))
    return angles.astype(np.float32), distances.astype(np.float32)


def _sample(heightfield: Heightfield, eye: Array, directions: Floats, distances: Floats) -> Floats:
    """Heights (a, d) along the lines, relative to the eye."""
    steps = directions / np.float32(heightfield.resolution)
    start = ((eye[:2] - heightfield.origin) / heightfield.resolution).astype(np.float32)
    cols, rows = (steps[:, k : k + 1] * distances + start[k] for k in (0, 1))
    heights = cv2.remap(heightfield.heights, cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return heights - np.float32(eye[2])


def _with_faces(
    sample: Ints, r: Floats, h: Floats, ground: Floats, before: Floats, rng: np.random.Generator
) -> tuple[Ints, Floats, Floats]:
    """Samples, distances and heights, and with them more points on steep faces, which few samples of a map hit."""
    rise = h - ground.ravel()[np.maximum(sample - 1, 0)]
    steep = np.flatnonzero((rise > RISE) & (sample % ground.shape[1] > 0))
    # The share of the face that lies above each point, (LEVELS, steep faces).
    back = (np.arange(LEVELS, dtype=np.float32)[:, None] + rng.random((LEVELS, len(steep)), np.float32)) / LEVELS
    more = np.broadcast_to(sample[steep], back.shape)
    distance: Floats = r[steep] - np.float32(STEP) * back
    height: Floats = h[steep] - rise[steep] * back
    shown = height >= before.ravel()[more] * distance
    return (
        np.concatenate([sample, more[shown]]),
        np.concatenate([r, distance[shown]]),
        np.concatenate([h, height[shown]]),
    )


def _blotches(camera: DepthCamera, angles: Floats, distances: Floats, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Samples (a, d) in patches where no match is found."""
    lost = np.zeros((len(angles), len(distances)), bool)
    for _ in range(rng.poisson(camera.blotches)):
        heading, half_turn = rng.uniform(angles[0], angles[-1]), rng.uniform(0.02, 0.1)
        distance, half_length = rng.uniform(0, distances[-1]), rng.uniform(0.05, 0.25)
        lines = np.searchsorted(angles, (heading - half_turn, heading + half_turn))
        places = np.searchsorted(distances, (distance - half_length, distance + half_length))
        lost[slice(*lines), slice(*places)] = True
    return lost


def _flying(
    camera: DepthCamera, visible: NDArray[np.bool_], sample: Ints, distances: Floats, rng: np.random.Generator
) -> Floats:
    """Distances (m,) that flying pixels take instead of their own; infinite for all other points.

    A depth edge is where a seen point borders on a hidden one, before it or beside it. There a matching window holds
    both the point and what hides its neighbour, and the depth comes out anywhere between the two.
    """
    front = np.maximum.accumulate(np.where(visible, distances, 0), axis=1).ravel()
    shown, width, last = visible.ravel(), visible.shape[1], visible.size - 1
    taken = np.full(len(sample), np.inf, np.float32)
    mixed = np.flatnonzero(rng.random(len(sample), np.float32) < camera.flying)
    for offset in (-1, -width, width):
        beside = np.clip(sample[mixed] + offset, 0, last)
        edge = ~shown[beside] & (sample[mixed] % width > 0)
        low, high = front[beside[edge]], distances[sample[mixed[edge]] % width]
        taken[mixed[edge]] = low + (high - low) * rng.random(len(low), np.float32)
    return taken
