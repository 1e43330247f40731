"""What is left when no named effect gains any more: a law in words, which the same contest must believe.

A law that is believed goes into the extended model as a proposal: it predicts, and claims no cause. If a law alone
explains clearly more than all named effects together, none of them is claimed. An effect whose form is refuted (`form`)
gives way to any law that does better in its place.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import Judged
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.laws import Scanned, scan
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.screen import Screen
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.law import Law

SILENT = 0.04  # nats a number beyond the noise, below which nothing is left to explain (chi-squared about 1.08)
CLEARLY = 1.25  # of what all named effects gain together: what a law alone must gain for none of them to be claimed
_FURTHER = 0.1  # the same for a law beside one that is believed: it would mend the first one's rounding
_MOST = 3  # laws, one after the other
_ENTERED = 3  # proposals that are refitted for each


@dataclass
class Remainder:
    """What the named effects left, and what it looks like.

    Attributes:
      fitted: the model with the laws that were believed.
      scanned: of the laws' first scan, None where nothing was left to scan.
      bare: the same without the effects that a law might have outdone, None where that was not asked.
      dropped: named effects that a law alone outdoes.
      rounds: of the laws, for the report.
    """

    fitted: Fit
    scanned: Scanned | None = None
    bare: Scanned | None = None
    dropped: list[str] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)

    @property
    def laws(self) -> list[Law]:
        """The laws that were believed."""
        return [e for e in self.fitted.plant.effects if isinstance(e, Law)]


class LawSearch:
    """Laws, tried where the named effects ended.

    Args:
      laws: the dictionary.
      worth: share of the misfit that a law must explain.
      settle: the arena of the round that starts from a fitted model.
      prune: an arena's model without the effects that the others made superfluous.
    """

    def __init__(
        self, laws: Sequence[Law], worth: float, settle: Callable[[Fit], Arena], prune: Callable[[Arena], Fit]
    ) -> None:
        self.laws, self.worth, self.settle, self.prune = laws, worth, settle, prune
        self.scanned: Scanned | None = None
        self.rounds: list[Round] = []

    def run(self, arena: Arena, calibrated: Fit, refuted: Collection[str] = (), sure: bool = False) -> Remainder:
        """Add laws to an arena's model while they are believed; first ask whether one alone outdoes what it has.

        Args:
          arena: whose model the laws are added to.
          calibrated: psi alone, fitted.
          refuted: ids of its effects whose form is not that of what is at work there (see `form`).
          sure: whether something is known to be left, however little it is beside all that is measured.
        """
        out = Remainder(arena.current)
        if not self.laws or (arena.leftover < SILENT and not sure):
            return out
        effects = [e for e in arena.current.plant.effects if not refuted or e.id in refuted]
        rival = self._instead(arena, calibrated, effects, bool(refuted)) if effects else None
        out.bare = self.scanned
        if rival is not None:
            out.dropped = [e.id for e in effects]
            arena.say(f"a law explains more than {', '.join(out.dropped)}, which is not claimed")
            out.scanned = self.scanned
            arena = self.settle(rival.fitted)
        for _ in range(_MOST):
            laws = [e for e in arena.current.plant.effects if isinstance(e, Law)]
            little = arena.leftover < (_FURTHER if laws else SILENT)
            if len(laws) >= _MOST or (little and (laws or not sure)):
                break
            best = self._best(arena)
            out.scanned = out.scanned or self.scanned
            if best is None:
                break
            further = self.settle(best.fitted)
            if (kept := self.prune(further)) is not further.current:
                further = self.settle(kept)
            # A swing beside one of nearly its frequency may be of any size against it, and neither says anything.
            if vague := [e.id for e in further.vague() if isinstance(e, Law)]:
                last, why = self.rounds[-1], f"sizes of {', '.join(vague)} would not differ from nothing"
                arena.say(f"{arena.label(best)} is left out: {why}")
                last.accepted, last.share, last.reason = [], 0.0, why
                break
            arena = further
        out.fitted, out.rounds = arena.current, self.rounds
        return out

    def _best(self, arena: Arena) -> Judged | None:
        """The law that adds most to an arena's model, if it is believed."""
        problem, current = arena.fit_data.problem, arena.current
        arena.say(f"looking for a law in what is left, among {len(self.laws)}")
        self.scanned = scan(problem, arena.under, current, self.laws, arena.rng)
        screen = Screen(problem, arena.under, current)
        entered = [arena.enter([screen.try_one(p.law)]) for p in self.scanned.proposals[:_ENTERED]]
        # A law is there to be read: one beside its likeness, of like size and against it, says nothing.
        believed = [j for j in entered if arena.believed(j, self.worth) and arena.told_apart(j)]
        best = max(believed, key=lambda j: j.total, default=None)
        outcome = Round([], 0.0, [arena.row(j) for j in sorted(entered, key=lambda j: -j.total)])
        if best is not None:
            arena.say(f"proposed {arena.label(best)}")
            outcome.accepted, outcome.share = [arena.label(best)], arena.explained(best)
        else:
            outcome.reason = "no law gains more on unseen logs than chance and does what the others could not"
        self.rounds.append(outcome)
        return best

    def _instead(self, arena: Arena, calibrated: Fit, effects: Sequence[Effect], refuted: bool) -> Judged | None:
        """A law that does better in place of effects whose form is refuted, or clearly better than all effects."""
        bare = arena
        for effect in effects if refuted else ():
            bare = bare.without(effect)
        if not refuted:
            bare = arena.facing(fit(arena.fit_data.problem, arena.under, calibrated.plant, calibrated.x, 6))
            # More than the effects a law can gain only of what they leave: where that is too little none is looked for.
            if (CLEARLY - 1) * bare.judge(arena.current).total > arena.remains:
                return None
        rival = self._best(bare)
        if rival is None:
            return None
        label, named, least = bare.label(rival), bare.judge(arena.current), CLEARLY
        if refuted:  # the common metric takes what the effects leave for noise, in which the two are equals
            bare = bare.sharper(rival.fitted)
            (rival, named), least = map(bare.enter_again, (rival, named)), 1.0
        if rival.total > least * named.total and not bare.ties(rival, named):
            return rival
        last, they = self.rounds[-1], ", ".join(e.id for e in effects)
        last.accepted, last.share, last.reason = [], 0.0, f"{label} does not do clearly better than {they}"
        arena.say(f"left out: {last.reason}")
        return None
