"""A stereo depth camera's figures, by default those of the Intel RealSense D435."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError

Array = NDArray[np.float64]
# The most that an image may be asked for: samples as far as `far`, and patches one by one, are worked out for each.
FARTHEST = 100.0  # m, four times the side of a map
MOST_BLOTCHES = 1000.0  # patches of 0.12 rad x 0.3 m on average: over 1.6 rad and 9 m, more than all there is


def _finite(value: Any, count: int) -> bool:
    """Whether a value is that many finite numbers, or with 0 a single one."""
    try:
        given = np.asarray(value)
    except ValueError:  # ragged
        return False
    return given.dtype.kind in "iuf" and given.shape == ((count,) if count else ()) and bool(np.isfinite(given).all())


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
        for each in fields(self):
            count, value = {"position": 3, "fov": 2}.get(each.name, 0), getattr(self, each.name)
            if not _finite(value, count):
                want = f"{count} finite numbers" if count else "a finite number"
                raise InputError(f"{each.name} {value!r}: want {want}")
        if not all(0 < angle < np.pi for angle in self.fov):
            raise InputError(f"fov {self.fov!r}: want two angles between 0 and pi [rad]")
        if not 0 <= self.near < self.far <= FARTHEST:
            raise InputError(f"near {self.near!r} and far {self.far!r}: want 0 <= near < far <= {FARTHEST:g} [m]")
        for name in ("columns", "baseline", "rate", "window"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"{name} {getattr(self, name)!r}: want a number above 0")
        for name in ("subpixel", "blotches", "drift", "yaw_drift", "tilt"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"{name} {getattr(self, name)!r}: want 0 or more")
        if self.blotches > MOST_BLOTCHES:
            raise InputError(f"blotches {self.blotches!r}: want {MOST_BLOTCHES:g} or less")
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
