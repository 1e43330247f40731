"""Of candidates that explain the data alike: which law is accepted, and what is told beside it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from nfc_gym.measured.arena import Arena, contains_any
from nfc_gym.measured.contest import Judged
from nfc_gym.measured.screen import Screen, Screened
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.each import Each, split

NEARLY = 0.95  # share of the best candidate's gain that a simpler law must reach to be preferred
_SHARED = 0.8  # the same for the same law at a wider place
_ALIKE = 3  # families that may explain the data alike for one of them to be claimed


@dataclass(frozen=True)
class Choice:
    """The choice among candidates that were judged in one arena.

    Attributes:
      arena: where they met the model to beat.
      worth: share of the misfit that an effect must explain to be named.
      pool: all effects that may be named, by id.
      look: screens one of them.
    """

    arena: Arena
    worth: float
    pool: Mapping[str, Effect]
    look: Callable[[Effect], Screened]

    def simplest(self, believed: list[Judged]) -> Judged:
        """Of the candidates that explain the data as well as the best: fewest parameters, then widest place.

        A law whose own feature does not show gives way to the plainer laws that it contains; and a cause that like
        parts share is likelier than the same cause in just one of them, unless the data tell them apart.
        """
        arena, best = self.arena, believed[0]
        winner = arena.new(best)[0]

        def enough(j: Judged) -> float:
            rival = arena.new(j)[0]
            wider = rival.family == winner.family and set(winner.where) < set(rival.where)
            return _SHARED if wider else NEARLY

        rivals = [j for j in believed if j.total > enough(j) * best.total and arena.ties(best, j)]
        plainer = (p for p in self._plainer(best) if p.total > NEARLY * best.total)
        rivals += [p for p in plainer if arena.believed(p, self.worth) and arena.ties(best, p)]
        chosen = min(rivals, key=lambda j: (len(j.fitted.x), -len(arena.new(j)[0].where), -j.total))
        return next((j for j in rivals if arena.nearer(j, chosen)), chosen)

    def _plainer(self, best: Judged) -> Iterator[Judged]:
        """Fits of the plainer laws that the leading one contains, in its place.

        Where it is an accepted law with values of its own at each place, that law leaves with it. Their psi begins as
        the leading law's own: from elsewhere a fit may end in a hollow.
        """
        arena, look = self.arena, self.look
        law, *more = arena.new(best)
        gone = [e for e in arena.current.plant.effects if not any(e is kept for kept in best.fitted.plant.effects)]
        if more or not law.simpler:
            return
        if gone:
            arena = arena.without(gone[0])
            look = Screen(arena.fit_data.problem, arena.under, arena.current).try_one
        for families in law.simpler:
            plain = [e for f in families if (e := self.pool.get(f"{f}:{law.place}")) is not None]
            if isinstance(law, Each):
                plain = [apart[0] for e in plain if (apart := split(e, arena.current.plant)) is not None]
            if len(plain) == len(families):
                entered = arena.enter_beside(best, [look(e) for e in plain])
                yield self.arena.judge(entered.fitted) if gone else entered

    def alike(self, judged: Sequence[Judged], best: Judged, leading: Judged, *, priced: bool = True) -> list[str]:
        """Ids of the law that is accepted and of what explains the data as well, each once."""
        ids = [*(e.id for e in self.arena.new(best)), *self._equivalents(judged, best, leading, priced=priced)]
        return list(dict.fromkeys(ids))

    def _equivalents(
        self, judged: Sequence[Judged], best: Judged, leading: Judged, *, priced: bool = True
    ) -> list[str]:
        """Ids of what explains the data as well as the law that is accepted, see `Arena.ties`.

        Without prices: a load that gains as much as the shift that it is in truth costs one number more, which beside a
        small gain is much.
        """
        arena, chosen = self.arena, self.arena.new(best)
        ids = [e.id for e in chosen]
        enough = NEARLY * (best.total if priced else best.drop)
        rivals = [j for j in judged if (j.total if priced else j.drop) > enough and arena.label(j) not in ids]
        rivals = [j for j in rivals if arena.ties(leading, j, priced=priced)]
        # Nor is one thing that two bodies could carry, hung on the one farther away.
        rivals = [j for j in rivals if not any(arena.nearer(k, j) for k in (best, *rivals))]
        # A law that has the chosen one, or another rival, as its special case is no further alternative.
        laws = [*chosen, *(e for j in rivals for e in arena.new(j))]
        return [arena.label(j) for j in rivals if not contains_any(arena.new(j), laws)]


def too_many(ids: Sequence[str]) -> bool:
    """Whether more families explain the data alike than one of them may be claimed among."""
    return len({i.partition(":")[0] for i in ids}) > _ALIKE
