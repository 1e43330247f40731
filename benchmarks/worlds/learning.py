"""Policies that go on learning by PPO: in the true world, in what was executed there, or in randomised ones."""

import copy
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv

from nfc_gym.adaptation.agent import ppo_agent
from nfc_gym.adaptation.policy import Policy, load_policy
from nfc_gym.adaptation.ppo import Diverged
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.worlds import VectorStaggered, batches, torchrl_env

from .world import World

EPISODE = 1000  # control steps


@dataclass(frozen=True)
class Budget:
    """What a method may use.

    Attributes:
      envs: simulations at a time.
      steps: control steps of all simulations together.
      seconds: of wall-clock time, whichever is used up first.
      executed: episodes in the true world that learning may use, of those that adapt.
      judged: episodes at each point of a curve.
      points: of a curve, beyond its first; TD-MPC2 may have none.
      threads: of the physics.
      device: of the networks.
      ratio: updates of TD-MPC2 a control step in the true world; the published one is 1.
      home: episodes at home, by which it is known what the policy earned before.
      watched: control steps of each robot at home that a detector is made of, where none is given.
      compiled: whether torch's compiler fuses what TD-MPC2 computes.
    """

    envs: int = 1024
    steps: int = 20_000_000
    seconds: float = 1800.0
    executed: int = 10
    judged: int = 32
    points: int = 10
    threads: int = 0
    device: str = "cpu"
    ratio: float = 1.0
    home: int = 64
    watched: int = 750
    compiled: bool = False


@dataclass
class Learned:
    """A policy, and what it did in the true world on the way.

    Attributes:
      policy: as it was at the end.
      curve: (control steps, mean return in the true world) from before the first to after the last.
      notes: what else is to be told.
    """

    policy: Any
    curve: list[tuple[int, float]]
    notes: dict[str, Any]


def true_world(world: World, n: int, budget: Budget, seed: int, **settings: Any) -> VectorSight:
    """Simulations of the true world, as policies see them; of several the first episodes end at different times."""
    env = world.make(
        n, context=world.context, autoreset_mode=AutoresetMode.DISABLED, nthread=budget.threads, **settings
    )
    return VectorSight(VectorStaggered(env, EPISODE, seed) if n > 1 else env)


def improve(
    policy: Policy, envs: VectorEnv, judge: Callable[[Policy], float], budget: Budget, seed: int, steps: int,
    first: float | None = None,
) -> Learned:  # fmt: skip
    """PPO in an environment, from where a policy is.

    Args:
      policy: changed in place.
      envs: in which it learns; a `VectorSight`.
      judge: policy -> mean return in the true world.
      budget: see `Budget`.
      seed: of actions and of the environments' episodes.
      steps: control steps of all simulations together.
      first: what `judge` says of the policy as it is, if that is known.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # the size of each buffer is no news
    agent = ppo_agent(policy)
    learner = agent.learner(agent.actor, agent.action_size())
    horizon = min(learner.horizon(envs.num_envs) if envs.num_envs > 1 else EPISODE, max(1, steps // envs.num_envs))
    torch.manual_seed(seed)
    env = torchrl_env(envs)
    env.set_seed(seed)
    curve, done, began, notes = [(0, judge(policy) if first is None else first)], 0, time.monotonic(), {}
    marks = [steps * (k + 1) // budget.points for k in range(budget.points)]
    for batch in batches(env, agent.actor, horizon, agent.device):
        kept = copy.deepcopy(policy.network.state_dict())
        try:
            learner.learn(batch)
        except Diverged as error:  # what was learned until then holds
            policy.network.load_state_dict(kept)
            notes["diverged"] = str(error)
            break
        done += batch.numel()
        over = done >= steps or time.monotonic() - began > budget.seconds
        if over or (marks and done >= marks[0]):
            marks = [m for m in marks if m > done]
            curve.append((done, judge(policy)))
        if over:
            break
    return Learned(policy, curve, notes | {"steps": done, "seconds": round(time.monotonic() - began, 1)})


def levelled(curve: list[tuple[int, float]], share: float = 0.05) -> bool:
    """Whether a curve rises by less than a share of its whole rise in its last quarter."""
    steps, returns = np.array(curve, float).T
    late = returns[steps >= 0.75 * steps[-1]]
    rise = returns.max() - returns[0]
    return bool(len(late) > 1 and (rise <= 0 or late.max() - late[0] <= share * rise))


def opened(nominal: str | Path, device: str) -> Policy:
    """A copy of the pretrained policy."""
    return load_policy(nominal, device)
