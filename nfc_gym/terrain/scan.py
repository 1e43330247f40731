"""What a depth camera sees of a terrain, and what it makes of that: one image as a cloud of points.

A heightfield hides a point from the camera where, on the way there, the ground rises above the line of sight. In the
vertical plane through both that is a running maximum of (height - camera's height) / distance, so one polar sampling of
the map and one `maximum.accumulate` replace the rendering of an image. Robots' own bodies hide nothing.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from nfc_gym.terrain.camera import DepthCamera
from nfc_gym.terrain.heightfield import Heightfield

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.intp]

STEP = 0.08  # m between samples along a line; each image shifts them anew, so that images fill each other's gaps
TURN = np.deg2rad(1.25)  # between lines: 0.13 m at 6 m, shifted likewise
RISE = 0.1  # m from one sample to the next above which a face is sampled on its height too
LEVELS = 6  # samples on such a face


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
    ground = _sample(heightfield, eye, directions[:, :1] * distances, directions[:, 1:] * distances)
    slope = ground / distances
    horizon = np.maximum.accumulate(slope, axis=1)
    # A sample stands for the face from the one before it, of which what lies above the horizon is seen.
    before = np.concatenate([np.full_like(horizon[:, :1], -np.inf), horizon[:, :-1]], axis=1)
    visible = slope >= horizon
    sample = np.flatnonzero(visible)  # flat indices: several times faster than pairs
    line = sample // len(distances)
    r, h = distances[sample - line * len(distances)], ground.ravel()[sample]
    on_face, between = _on_faces(sample, r, ground, rng)
    if on_face.size:  # the faces' own heights, as between two samples of a sharp edge a chord would cut the corner
        ahead = directions[on_face // len(distances)] * between[..., None]
        height = _sample(heightfield, eye, ahead[..., 0], ahead[..., 1])
        shown = height >= before.ravel()[on_face] * between
        sample = np.concatenate([sample, on_face[shown]])
        line = np.concatenate([line, on_face[shown] // len(distances)])
        r, h = np.concatenate([r, between[shown]]), np.concatenate([h, height[shown]])
    x, y = directions[line, 0] * r, directions[line, 1] * r
    # Depth is measured along the optical axis; the image's sides are planes through the eye.
    depth, left, up = (x * axis[0] + y * axis[1] + h * axis[2] for axis in axes.T.astype(np.float32))
    wide, high = np.tan(np.array(camera.fov, np.float32) / 2)
    seen = (depth > camera.near) & (depth < camera.far) & (np.abs(left) < wide * depth) & (np.abs(up) < high * depth)
    chosen = np.flatnonzero(seen)
    sample = sample[chosen]
    # Far ground is seen so flat that the image's rows skip samples, each as many rows high as it adds to the horizon.
    rising = slope.ravel()[sample]
    rows = camera.focal * (rising - before.ravel()[sample]) / (1 + rising * rising)
    kept = rng.random(len(sample), np.float32) < np.minimum(rows, 1) * (1 - camera.dropout)
    kept &= ~_blotches(camera, angles, distances, rng).ravel()[sample]
    kept = np.flatnonzero(kept)
    sample, chosen = sample[kept], chosen[kept]
    r, depth, points = r[chosen], depth[chosen], np.stack([x[chosen], y[chosen], h[chosen]], axis=1)
    sd = camera.noise(depth).astype(np.float32)
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


def _sample(heightfield: Heightfield, eye: Array, x: Floats, y: Floats) -> Floats:
    """Heights at points (2-D arrays), all relative to the eye [m]."""
    start = ((eye[:2] - heightfield.origin) / heightfield.resolution).astype(np.float32)
    cells = np.float32(1 / heightfield.resolution)
    cols, rows = x * cells + start[0], y * cells + start[1]
    heights = cv2.remap(heightfield.heights, cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return heights.astype(np.float32, copy=False) - np.float32(eye[2])


def _on_faces(sample: Ints, r: Floats, ground: Floats, rng: np.random.Generator) -> tuple[Ints, Floats]:
    """Samples (LEVELS, m) whose face is steep, and distances between the sample before each and its own."""
    flat = ground.ravel()
    rise = flat[sample] - flat[np.maximum(sample - 1, 0)]
    steep = np.flatnonzero((rise > RISE) & (sample % ground.shape[1] > 0))
    back = (np.arange(LEVELS)[:, None] + rng.random((LEVELS, len(steep)))) * (STEP / LEVELS)
    return np.broadcast_to(sample[steep], back.shape), r[steep] - back.astype(np.float32)


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
    taken = np.full(len(sample), np.inf, np.float32)
    mixed = np.flatnonzero(rng.random(len(sample), np.float32) < camera.flying)
    if not mixed.size:
        return taken
    front = np.maximum.accumulate(visible * distances, axis=1).ravel()
    shown, width, last = visible.ravel(), visible.shape[1], visible.size - 1
    for offset in (-1, -width, width):
        beside = np.clip(sample[mixed] + offset, 0, last)
        edge = ~shown[beside] & (sample[mixed] % width > 0)
        low, high = front[beside[edge]], distances[sample[mixed[edge]] % width]
        taken[mixed[edge]] = low + (high - low) * rng.random(len(low), np.float32)
    return taken
