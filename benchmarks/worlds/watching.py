"""A detector for where none is given: what the robot's motion is like at home, under the policy that is to adapt."""

from typing import Any

import numpy as np
from anomaly import Unconditional
from gymnasium.vector import VectorEnv

from nfc_gym.inference.detector import WindowDetector
from nfc_gym.measured.hidden import Array

from .judge import Policy
from .players import seen_by
from .world import World

HORIZON = 50  # control steps of a window: 1 s
RATE = 0.01  # false alarms a window
EVERY = 10  # control steps from one window to the next that is looked at
ROBOTS = 96  # at home; half of them fit the detector, the others set its threshold


class Familiar:
    """Distance of a window's means and deviations from those of windows at home; a `WindowScore`."""

    horizon = HORIZON

    def __init__(self, states: Array, actions: Array) -> None:
        self.states, self.actions = states.shape[2], actions.shape[2]
        self._known = Unconditional({"states": states})

    def score(self, states: Array, actions: Array) -> Array:
        """(n,)."""
        return self._known.score({"states": states})


def windows(policy: Policy, env: VectorEnv, size: int, seed: int, steps: int = 750) -> tuple[Array, Array]:
    """Windows (n, HORIZON + 1, s) of `proprio` and (n, HORIZON, a) of actions, robot by robot, within episodes.

    Args:
      policy, env: who acts where.
      size: s; in the flat observation `proprio` comes first.
      seed: of the episodes.
      steps: that are recorded; what comes after a robot's first episode is left out.
    """
    observation, _ = env.reset(seed=seed)
    rows, live = [], np.ones(env.num_envs, bool)
    for _ in range(steps):
        action = np.asarray(policy(observation), float)
        before = observation["observation"][:, :size].astype(float)
        observation, _, ended, truncated, _ = env.step(action)
        rows.append((before, action, live.copy()))
        over = ended | truncated
        live &= ~over
        if over.any():
            observation, _ = env.reset(options={"reset_mask": over})
    states, actions, held = (np.array(part) for part in zip(*rows, strict=True))
    starts = [(i, k) for i in range(env.num_envs) for k in range(0, int(held[:, i].sum()) - HORIZON, HORIZON)]
    return (
        np.array([states[k : k + HORIZON + 1, i] for i, k in starts]),
        np.array([actions[k : k + HORIZON, i] for i, k in starts]),
    )


def watcher(policy: Policy, world: World, seed: int, **settings: Any) -> WindowDetector:
    """A detector for a world's robot and policy; the sensors' noise is known at home, what is hidden is not."""
    at_home = World(world.place, "nominal", world.seed, engine=world.engine)
    env = seen_by(policy, at_home, ROBOTS, **settings)
    states, actions = windows(policy, env, world.kind.proprio_size, seed)
    half = len(states) // 2
    familiar = Familiar(states[:half], actions[:half])
    return WindowDetector(familiar, every=EVERY).calibrated(states[half:], actions[half:], RATE)
