"""Whose run a folder holds: of which agent, detector and posterior, as far as these can be told from others."""

import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import nn

from nfc_gym.adaptation.agent import Agent
from nfc_gym.adaptation.beliefs import Inference
from nfc_gym.adaptation.choice import weights_of
from nfc_gym.adaptation.digests import of_detector, of_posterior
from nfc_gym.adaptation.weights import of_weights
from nfc_gym.core.errors import InputError

# Digests that the weights of this process began runs with, by folder: they have learned in place since then.
_BEGAN: "weakref.WeakKeyDictionary[nn.Module, dict[Path, str]]" = weakref.WeakKeyDictionary()


class Whose:
    """What a run was begun with.

    Args:
      agent: as it is now.
      detector: of anomalies.
      inference: what infers, before the first trajectory.

    Attributes:
      told: digests of `agent`, `detector` and `posterior`; None where nobody can tell one from others.
    """

    def __init__(self, agent: Agent, detector: Any, inference: Inference) -> None:
        self._weights = weights_of(agent)
        self.told: dict[str, str | None] = {
            "agent": of_weights(self._weights), "detector": of_detector(detector), "posterior": of_posterior(inference),
        }  # fmt: skip

    def remember(self, folder: Path | None) -> None:
        """What the agent's weights were as a run began in the folder; without one nothing goes on."""
        if folder is not None:
            _BEGAN.setdefault(self._weights, {})[folder.resolve()] = str(self.told["agent"])

    def require(self, state: Path, kept: Mapping[str, str | None]) -> None:
        """Refuse to go on with the run of another agent, detector or posterior, where that can be told.

        An agent that has learned in this very folder, in this process, is the one that began there.

        Args:
          state: the file in the run's folder.
          kept: what it says of whose it is.

        Raises:
          InputError: naming what is another.
        """
        began = _BEGAN.get(self._weights, {}).get(state.parent.resolve())
        self.told["agent"] = began or self.told["agent"]
        odd = [f"another {k}" for k, now in self.told.items() if now and kept.get(k) and kept[k] != now]
        if odd:
            raise InputError(
                f"{state} is of another run, with {' and '.join(odd)}: give what that one began with, remove it to "
                "begin anew, or choose another folder"
            )
        self.remember(state.parent)
