"""Which of an agent's weights are best: learning does not always improve.

PPO's way is not smooth, and where a belief was wrong the policy learned from it is too. A later belief knows better;
so all weights that earlier missions left are judged again in its worlds. Learning goes on from where it was all the
same, unless that is clearly worse: what is behind a dip is often better than what was before it.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from nfc_gym.adaptation.agent import Agent

Weights = dict[str, Any]
Returns = NDArray[np.float64]
_CLEARLY = 2.0  # standard errors of the difference, episode by episode


def weights_of(agent: Agent) -> nn.Module:
    """All of an agent that learns and is kept."""
    return agent.weights or agent.actor


class Choice:
    """Remembers an agent's weights with the highest mean return.

    Args:
      agent: which; its weights at the time are where learning has come to.
      judge: (n,) returns of the agent as it is, in the same episodes each time; n must be 2 or more.
      others: weights that compete as well. Where one of these is clearly better, learning is to begin with it.

    Attributes:
      best: mean return of the best weights so far.
    """

    def __init__(self, agent: Agent, judge: Callable[[], Returns], others: Sequence[Weights] = ()) -> None:
        self.agent, self._judge = agent, judge
        self._returns = now = judge()
        self._weights = present = self._copy()
        seen = [present]
        for weights in others:
            if not any(same(weights, each) for each in seen):
                seen.append(weights)
                weights_of(agent).load_state_dict(weights)
                self.judge()
        if not clearly_better(self._returns, now):
            weights_of(agent).load_state_dict(present)
        else:
            self.take()

    @property
    def best(self) -> float:
        """See above."""
        return float(self._returns.mean())

    def judge(self) -> float:
        """Mean return of the present weights; equal ones do not take the place of earlier ones."""
        found = self._judge()
        if found.mean() > self._returns.mean():
            self._returns, self._weights = found, self._copy()
        return float(found.mean())

    def take(self) -> None:
        """Give the agent the best weights."""
        weights_of(self.agent).load_state_dict(self._weights)

    def _copy(self) -> Weights:
        return copy.deepcopy(weights_of(self.agent).state_dict())


def same(one: Weights, other: Weights) -> bool:
    """Whether two of one network are equal to the bit."""
    return all(torch.equal(value, other[name]) for name, value in one.items())


def clearly_better(one: Returns, other: Returns) -> bool:
    """Whether returns (n,) are better than others of the same episodes beyond two standard errors."""
    difference = one - other
    return bool(difference.mean() > _CLEARLY * difference.std(ddof=1) / len(difference) ** 0.5)
