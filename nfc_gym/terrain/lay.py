"""A map in the robot's grid laid onto a heightfield: the way back from `elevation`, for residuals such as delta_e.

A posterior speaks of the ground around the robot, in the cells that `elevation` has (`egocentric`); what is simulated
is a heightfield that lies in the world. Between its cells the map is bilinear, beyond them there is nothing to add.

Towards its edge the map fades. It does not end at zero: where no camera has seen the ground delta_e is as large as the
terrain itself, and cut off 6.4 m from the robot that would be a wall around it.
"""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import real_array
from nfc_gym.terrain.egocentric import CELL, SIZE, to_grid
from nfc_gym.terrain.heightfield import Heightfield

GRID = (SIZE, SIZE)  # rows forward, columns to the left
FADE = 1.0  # m from the edge within which a map fades to zero

_IN = np.minimum(np.arange(SIZE), np.arange(SIZE)[::-1]) * CELL / FADE  # cells' distance from an edge
_SHARE = np.minimum(np.minimum(_IN[:, None], _IN[None, :]), 1.0)


def lay(patch: ArrayLike, heightfield: Heightfield, xy: ArrayLike, yaw: ArrayLike) -> NDArray[np.float64]:
    """Residuals at the points of a heightfield, of maps around robots.

    Args:
      patch: (..., SIZE, SIZE) residual heights [m], laid out as `elevation` has them.
      heightfield: at whose points; its heights do not matter.
      xy: (..., 2) where the robots' bases are in the world [m].
      yaw: (...) their headings [rad].

    Returns:
      (..., nrow, ncol) [m]; zero where no map reaches.

    Raises:
      InputError: shapes that do not fit each other, or values that are not finite.
    """
    maps, place, heading = real_array(patch), real_array(xy), real_array(yaw)
    if maps is None or place is None or heading is None:
        raise InputError(f"patch is {patch!r}, xy {xy!r} and yaw {yaw!r}; want arrays of numbers")
    lead = heading.shape
    if maps.shape != (*lead, *GRID) or place.shape != (*lead, 2):
        raise InputError(
            f"patch has shape {maps.shape}, xy {place.shape}, yaw {lead}; want (..., {SIZE}, {SIZE}), (..., 2), (...)"
        )
    if not all(np.isfinite(each).all() for each in (maps, place, heading)):
        raise InputError("patch, xy and yaw must be finite")
    nrow, ncol = heightfield.heights.shape
    centre = (place - np.array(heightfield.origin)) / heightfield.resolution
    matrices = to_grid(centre, heading, CELL / heightfield.resolution).reshape(-1, 2, 3)
    faded = (maps * _SHARE).astype(np.float32).reshape(-1, *GRID)  # of doubles OpenCV rounds places to 1/32 of a cell
    out = np.empty((len(faded), nrow, ncol), np.float32)
    for k, matrix in enumerate(matrices):
        cv2.warpAffine(faded[k], matrix, (ncol, nrow), out[k], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return out.reshape(*lead, nrow, ncol).astype(np.float64)
