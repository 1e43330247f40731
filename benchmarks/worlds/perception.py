"""What a mapping node makes of the ground, map by map: blurred errors, spikes, and patches that it saw wrong."""

import cv2
import numpy as np

from nfc_gym.terrain import Heightfield

BLUR = 3.0  # cells: errors of one image lie over the next
BLOTCHES = 40  # on a map of 25.5 m: puddles that reflect, tufts taken for ground
ACROSS = (2.0, 6.0)  # cells, of a blotch


def perceived(ground: Heightfield, sd: float, rng: np.random.Generator) -> Heightfield:
    """A map of the ground with errors of that standard deviation [m], and blotches that are three times as far off."""
    noise = cv2.GaussianBlur(rng.standard_normal(ground.heights.shape), (0, 0), BLUR)
    heights = ground.heights + sd * noise / noise.std()
    rows, columns = np.indices(ground.heights.shape)
    for _ in range(BLOTCHES):
        row, column = (rng.uniform(0, n) for n in ground.heights.shape)
        size = rng.uniform(*ACROSS)
        heights = heights + rng.normal(0, 3 * sd) * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / size**2)
    return Heightfield(heights.astype(np.float32), ground.resolution, ground.origin)
