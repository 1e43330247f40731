"""Missions of a cart that is pushed at random, and a small detector that knows gentle pushes."""

import numpy as np
import torch

from nfc_gym.adaptation.normal import windows_of
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.inference.contrast import Contrast, ContrastConfig
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig, train

BOX = PriorBox("cart", ("mass", "damping"), ("kg", "N s/m"), (0.5, 0.0), (1.5, 2.0))
QUICK = TrainConfig(epochs=4, batch=64, rate=1e-3, warmup=5, average=0.9, muon=False)  # in half the time


def trajectory(states: np.ndarray, actions: np.ndarray, alarms: tuple[int, ...] = ()) -> Trajectory:
    scores = np.zeros(len(actions))
    scores[list(alarms)] = 2.0
    return Trajectory(
        states, actions, np.zeros(len(actions)), scores, 1.0, np.zeros((len(states), 0)), np.zeros((0, 0))
    )


def cart(steps: int, seed: int, push: float) -> Trajectory:
    """A cart that is pushed at random, in a slow wave of a strength."""
    rng = np.random.default_rng(seed)
    mass, damping = 0.5 + rng.random(), 2 * rng.random()
    actions, states = push * rng.standard_normal((steps, 1)), [rng.standard_normal(2)]
    for a in actions[:, 0]:
        speed = states[-1][1] + 0.1 * (a - damping * states[-1][1]) / mass
        states.append(np.array([states[-1][0] + 0.1 * speed, speed]))
    out = np.array(states)
    return trajectory(out - np.linspace(0, 1, steps + 1)[:, None] * [out[-1, 0], 0.0], actions)


def everything(t: Trajectory) -> np.ndarray:
    return np.ones(len(t), bool)


def watcher() -> WindowDetector:
    """Trained and calibrated on gentle pushes."""
    torch.manual_seed(0)
    parts = windows_of([cart(400, k, 1.0) for k in range(30)], 10, everything)
    states, actions = (np.concatenate([p[i] for p in parts]) for i in (0, 1))
    tensors = [torch.as_tensor(x, dtype=torch.float32) for x in (states, actions)]
    windows = TensorWindows({"states": tensors[0], "actions": tensors[1], "psi": torch.full((len(states), 2), 0.5)})
    net = Contrast.of(windows.tensors, BOX, ContrastConfig(features=16))
    train(net, *windows.split(0.2), QUICK)
    held_out = windows_of([cart(400, 1000 + k, 1.0) for k in range(10)], 10, everything)
    return WindowDetector(net).calibrated(*(np.concatenate([p[i] for p in held_out]) for i in (0, 1)), 0.05)
