"""How many threads a process takes besides the physics'."""

import cv2
import torch

from nfc_gym.core.whole import require_whole


def limit_threads(threads: int) -> None:
    """Give networks and maps so many threads; 0 leaves both as they are.

    OpenCV takes as many as there are cores by default, in each of many processes beside each other.

    Raises:
      InputError: it is no whole number, or below 0.
    """
    require_whole("threads", threads, 0)
    if threads:
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
