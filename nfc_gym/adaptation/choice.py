"""Which of an agent's weights are best: learning does not always improve.

PPO's way is not smooth, and where a belief was wrong the policy learned from it is too. A later belief knows better;
so all weights from which earlier missions left off are judged again in its worlds before learning goes on.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

from torch import nn

from nfc_gym.adaptation.agent import Agent

Weights = dict[str, Any]


def weights_of(agent: Agent) -> nn.Module:
    """All of an agent that learns and is kept."""
    return agent.weights or agent.actor


class Choice:
    """Remembers an agent's weights with the highest mean return.

    Args:
      agent: which; its weights at the time are the first that are judged.
      judge: mean return of the agent as it is, in the same episodes each time.
      others: weights that compete as well.

    Attributes:
      best: mean return of the best weights so far, which the agent has to begin with.
    """

    def __init__(self, agent: Agent, judge: Callable[[], float], others: Sequence[Weights] = ()) -> None:
        self.agent, self._judge = agent, judge
        self.best = float("-inf")
        self.judge()
        for weights in others:
            weights_of(agent).load_state_dict(weights)
            self.judge()
        self.take()

    def judge(self) -> float:
        """Mean return of the present weights; equal ones do not take the place of earlier ones."""
        found = self._judge()
        if found > self.best:
            self.best, self._weights = found, copy.deepcopy(weights_of(self.agent).state_dict())
        return found

    def take(self) -> None:
        """Give the agent the best weights."""
        weights_of(self.agent).load_state_dict(self._weights)
