"""Which families of effects to look at first: what a structure head says of the fit logs, before anything is fitted."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from nfc_gym.core.log import Log
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.effects.base import Effect

# Logs, their measured states, a seed -> probability of each family ("none" is that of no effect), number of windows.
Witness = Callable[[Sequence[Log], Sequence[Any], int], tuple[dict[str, float], int]]
NONE = "none"
_MASS = 0.95  # of the probability of having an effect at all: what the families that are looked at first make up
_MOST = 8  # of these families
_FAINT = 1e-6  # printed as this at least, so that no probability reads as zero


@dataclass(frozen=True)
class Suspects:
    """What the head said, and what follows for the search.

    Attributes:
      file: of the head.
      probabilities: of each family that it knows, "none" included.
      windows: of the fit logs, that it was asked about.
      seconds: that asking took.
    """

    file: str
    probabilities: dict[str, float]
    windows: int = 0
    seconds: float = 0.0

    @property
    def likely(self) -> tuple[str, ...]:
        """Families that together make up nearly all of the probability of having an effect, likeliest first."""
        ranked = sorted((f for f in self.probabilities if f != NONE), key=lambda f: -self.probabilities[f])
        whole, out, sum_ = sum(self.probabilities[f] for f in ranked), [], 0.0
        for family in ranked[:_MOST]:
            if sum_ > _MASS * whole:
                break
            out.append(family)
            sum_ += self.probabilities[family]
        return tuple(out)

    def told(self) -> dict[str, Any]:
        """For `report.json`."""
        ranked = sorted(self.probabilities.items(), key=lambda pair: -pair[1])
        return {
            "file": self.file, "windows": self.windows, "seconds": self.seconds,
            "families": {f: max(p, _FAINT) for f, p in ranked}, "looked_at_first": list(self.likely),
        }  # fmt: skip


def ask(witness: Witness, file: str, model: Any, logs: Sequence[Log], seed: int) -> Suspects:
    """Ask a head about the fit logs.

    Args:
      witness: the head.
      file: where it is kept.
      model: the mapping's, an `MjModel`.
      logs: that effects are fitted to; those that select and verify stay unseen.
      seed: of the noise that quiet logs are given.

    Raises:
      InputError: logs of another robot, or that its windows cannot be made of.
    """
    began = time.monotonic()
    states = [estimate_states(model, log, raw=True) for log in logs]
    probabilities, windows = witness(logs, states, seed)
    return Suspects(file, probabilities, windows, round(time.monotonic() - began, 2))


def looked_at(pool: Sequence[Effect], suspects: Suspects, rounds: Sequence[Any]) -> list[Effect]:
    """The candidates of a pool whose families a search looked at closely: suspected, or ranked in any of its rounds.

    They alone get a row in the identifiability table, which takes a roll-out and more for each.
    """
    ranked = {i for r in rounds for row in r.ranking for i in row["id"].split(" + ")}
    named = {i for r in rounds for i in (*r.accepted, *r.equivalents)}
    families = {i.partition(":")[0] for i in ranked | named} | set(suspects.likely)
    return [e for e in pool if e.family in families]


def kept(suspects: Suspects) -> dict[str, Any]:
    """Plain data from which `restored` makes the same."""
    return dict(suspects.__dict__)


def restored(data: dict[str, Any] | None) -> Suspects | None:
    """Inverse of `kept`."""
    return None if data is None else Suspects(**data)
