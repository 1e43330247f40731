"""A detector for where none is given: how the robot moves at home, under the policy that is to adapt."""

from typing import Any

import numpy as np
from anomalies.unconditional import Unconditional
from gymnasium.vector import VectorEnv

from nfc_gym.adaptation.trajectory import Array
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.rates import threshold_at, wanted

from .judge import Policy
from .players import play, seen_by
from .world import World

HORIZON = 50  # control steps of a window: 1 s
RATE = 0.05  # false alarms an episode
EVERY = 25  # control steps from one window to the next that is looked at
LASTING = 36  # windows whose surprises add up: a stumble is over sooner, what a machine lacks stays
ROBOTS = 128  # at home; half of them fit the detector, the others set its threshold
ROUNDS = 4  # of so many robots, at most, where some fall or crash before there is a window of them


class Unforeseen:
    """How unlike home a window's one-step surprises are; a `WindowScore`.

    The next observation is foretold, linearly, from the present one and the last two actions; what is left of a
    window (its means and deviations, and those of its changes) is compared to what is left at home.

    Args:
      states: (n, HORIZON + 1, s) `proprio` at home.
      actions: (n, HORIZON, a).
    """

    horizon = HORIZON

    def __init__(self, states: Array, actions: Array) -> None:
        self.states, self.actions = states.shape[2], actions.shape[2]
        given, wanted = _inputs(states, actions), np.diff(states, axis=1).reshape(-1, self.states)
        self._mean, self._scale = given.mean(0), given.std(0) + 1e-6
        inputs = self._scaled(given)
        ridge = 1e-5 * len(inputs) * np.eye(inputs.shape[1])
        self._weights: Any = np.linalg.solve(inputs.T @ inputs + ridge, inputs.T @ wanted)
        self._sizes = (wanted - inputs @ self._weights).std(0) + 1e-9
        self._known = Unconditional({"states": self._left(states, actions)})

    def _scaled(self, given: Array) -> Array:
        return np.concatenate([(given - self._mean) / self._scale, np.ones((len(given), 1))], 1)

    def _left(self, states: Array, actions: Array) -> Array:
        """(n, HORIZON, s) of the next observations' changes, in deviations at home."""
        foretold = (self._scaled(_inputs(states, actions)) @ self._weights).reshape(len(states), -1, self.states)
        return (np.diff(states, axis=1) - foretold) / self._sizes

    def score(self, states: Array, actions: Array) -> Array:
        """(n,)."""
        return self._known.score({"states": self._left(states, actions)})


def _inputs(states: Array, actions: Array) -> Array:
    before = np.concatenate([actions[:, :1], actions[:, :-1]], 1)
    return np.concatenate([states[:, :-1], actions, before], -1).reshape(-1, states.shape[2] + 2 * actions.shape[2])


class Lasting:
    """Evidence that adds up over an episode, a `Detector`: one stumble is no anomaly, a machine that is off is.

    Args:
      scorer: of windows.
      home: scores of windows at home that nothing was fitted to.
      threshold: from which score on a transition is anomalous.
    """

    def __init__(self, scorer: Unforeseen, home: Array, threshold: float | None = None) -> None:
        self.windows, self.threshold = WindowDetector(scorer, every=EVERY), threshold
        logs = np.log(home)
        self._mean, self._spread = logs.mean(), logs.std()
        self.reset()

    def reset(self) -> None:
        """An episode begins."""
        self.windows.reset()
        self._steps, self._past, self._now = 0, [], 0.0

    def update(self, observation: Any, action: Any, after: Any) -> float:
        """The score after one more transition; 0 until there is a window."""
        score = self.windows.update(observation, action, after)
        self._steps += 1
        if self._steps >= HORIZON and (self._steps - HORIZON) % EVERY == 0:
            self._past.append(float(score))
            self._now = float(self.lasting(np.array(self._past))[-1])
        return self._now

    def lasting(self, scores: Array) -> Array:
        """Of an episode's windows (n,), each with those before it: exp of the mean surprise times the root of how many.

        A surprise is a logarithm's distance from the mean at home in deviations there, so that many small ones count
        for as much as a large one that stands alone.
        """
        each = (np.log(np.maximum(scores, 1e-300)) - self._mean) / self._spread
        last = [each[max(0, k + 1 - LASTING) : k + 1] for k in range(len(each))]
        return np.exp([min(part.mean() * np.sqrt(len(part)), 700.0) for part in last])


def windows(
    policy: Policy, env: VectorEnv, size: int, seed: int, steps: int
) -> list[tuple[Array, Array]]:  # fmt: skip
    """Of each robot's first episode the windows (n, HORIZON + 1, s) of `proprio` and (n, HORIZON, a) of actions.

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
    found = []
    for i, length in enumerate(held.sum(0)):
        starts = np.arange(0, int(length) - HORIZON, EVERY)[:, None]
        found.append((states[starts + np.arange(HORIZON + 1), i], actions[starts + np.arange(HORIZON), i]))
    return [(s, a) for s, a in found if len(s)]


def watcher(policy: Policy, world: World, seed: int, steps: int = 750, **settings: Any) -> Lasting:
    """A detector for a world's robot and policy, of `steps` of each of some robots at home.

    The sensors' noise is known at home, what is hidden is not.
    """
    at_home = World(world.place, "nominal", world.seed, engine=world.engine)
    robots: list[tuple[Array, Array]] = []
    for k in range(ROUNDS):
        env = seen_by(policy, at_home, ROBOTS, **settings)
        robots += windows(policy, env, world.kind.proprio_size, seed + k * ROBOTS, steps)
        env.close()
        if len(robots) >= 2 * wanted(RATE):
            break
    half = min(len(robots) // 2, ROBOTS // 2)
    scorer = Unforeseen(*(np.concatenate(part) for part in zip(*robots[:half], strict=True)))
    scores = [scorer.score(*each) for each in robots[half:]]
    lasting = Lasting(scorer, np.concatenate(scores))
    lasting.threshold = threshold_at([lasting.lasting(each).max() for each in scores], RATE, "episodes").value
    return lasting


def earned_at_home(
    policy: Policy, world: World, seed: int, episodes: int, episode: int, **settings: Any
) -> list[float]:
    """Returns at home, where nothing is hidden but the sensors' noise, of episodes of so many control steps at most."""
    at_home = World(world.place, "nominal", world.seed, engine=world.engine)
    return play(policy, at_home, episodes, seed, max_episode_steps=episode, **settings).returns
