"""Threads besides the physics': as many as are asked for, of networks and of maps."""

import cv2
import torch

from nfc_gym.adaptation.threads import limit_threads


def test_networks_and_maps_take_as_many_threads_as_are_asked_for() -> None:
    before = torch.get_num_threads(), cv2.getNumThreads()
    try:
        for threads in (2, 1):
            limit_threads(threads)
            assert (torch.get_num_threads(), cv2.getNumThreads()) == (threads, threads)
        limit_threads(0)
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (1, 1)
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])
