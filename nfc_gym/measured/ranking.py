"""What one round of the search saw, for the report: candidates in order, what it accepted, what does as well."""

from collections.abc import Collection
from dataclasses import dataclass, field

from nfc_gym.measured.fit import Fit
from nfc_gym.physics.effects.base import Effect


@dataclass
class Round:
    """What one round of the search saw, for the report.

    Attributes:
      accepted: ids of the laws that it added.
      share: of the misfit on the selection logs that they explain.
      ranking: its candidates.
      equivalents: ids of what explains the data as well as the law that it added.
      reason: why nothing was accepted.
      exchanged: id of the earlier law whose place the accepted one took.
      alike: of several laws that it added at once, by id: what explains the data as well in the place of each.
      possible: ids of what explains the data as well with more numbers, where that is so much that the law it added is
        named for its simplicity alone.
    """

    accepted: list[str]
    share: float
    ranking: list[dict] = field(default_factory=list)
    equivalents: list[str] = field(default_factory=list)
    reason: str = ""
    exchanged: str = ""
    alike: dict[str, list[str]] = field(default_factory=dict)
    possible: list[str] = field(default_factory=list)

    def rivals(self, law: str) -> list[str]:
        """Ids of what explains the data as well as a law that it added; the list itself, to add to."""
        return self.equivalents if len(self.accepted) == 1 else self.alike.setdefault(law, [])


def ranked(ranking: list[dict], news: list[dict]) -> list[dict]:
    """A ranking in which some rows lead that were judged anew."""
    ids = {row["id"] for row in news}
    return news + [row for row in ranking if row["id"] not in ids]


def known_as(law: Effect, fitted: Fit, pool: Collection[str]) -> list[str]:
    """Ids, of those in a pool, of effects that are a fitted model's law by another name."""
    if not pool:
        return []
    thetas = dict(zip(map(id, fitted.plant.effects), fitted.plant.split(fitted.x)[1], strict=True))
    names = (f"{family}:{law.place}" for family in law.known_as(thetas[id(law)]))
    return [i for i in names if i in pool]
