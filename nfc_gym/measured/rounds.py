"""One round of the search: refit the shortlist, judge it on the selection logs, and decide which law is accepted."""

from collections.abc import Collection, Sequence
from dataclasses import replace

from nfc_gym.measured.arena import Arena, contains
from nfc_gym.measured.choice import Choice, too_many
from nfc_gym.measured.contest import Judged, mechanism, shortlist
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.pairing import promising
from nfc_gym.measured.ranking import Round, known_as, ranked
from nfc_gym.measured.screen import Screen, Screened, mimics
from nfc_gym.measured.yardstick import HOPE
from nfc_gym.physics.effects.base import Effect

_LEADING = 0.7  # of the best gain: what a law at several places must reach to be tried with values of their own
_PAIRED = 3  # pairs of mechanisms that are tried
_TOGETHER = 1.25  # of what the best gains alone, believed or not: what a pair must gain to be accepted at once
_HALF = 0.5  # of what was left: what a pair may leave where that is much
_LEFT = 0.1  # nats a number beyond the noise, below which a second law beside one that is believed has nothing to mend
_FINALISTS = 4  # candidates that are judged again under the sharper metric
_SHARP = 0.1  # nats a number beyond the noise, below which the metric of the model to beat is sharp enough
_FAR = 0.5  # of the best first gain: who gains less is beaten for good, and ranked by it
_FAINT = 0.02  # nats a number beyond the noise, below which two laws have nothing to mend together
_RIVAL, _DUELS = 0.5, 2  # of the best gain: who comes so near meets the best again at half the step; how many do
_BY_PSI = 0.1  # of a candidate's gain, beyond which its psi alone becomes the model to beat
_NARROWER = 2  # sets within the leading law's own where it is fitted too, those that promise most


class Contest:
    """The candidates of one round.

    Args:
      arena: where they meet the model to beat.
      screen, screened: their screening, the leading ones looked at closely.
      short: how many are refitted.
      worth: share of the misfit that an effect must explain to be named.
      pool: all effects that may be named, screened or not.
    """

    def __init__(
        self,
        arena: Arena,
        screen: Screen,
        screened: Sequence[Screened],
        short: int,
        worth: float,
        pool: Sequence[Effect] = (),
    ) -> None:
        self.arena, self.screen, self.screened, self.short, self.worth = arena, screen, screened, short, worth
        self.pool = {e.id: e for e in pool}
        self._known = {s.effect.id: s for s in screened}
        self.rough = arena.fit_data.problem.rough

    def hold(self) -> tuple[Round, Judged | None]:
        """Judge twice, and decide.

        First under the metric of the model so far, then the leading ones under the slack of the best of them. The first
        takes an error ten times the noise for one standard deviation, and all that mend most of it for equals.
        """
        entered, first = self._entered()
        # Where the metric is as sharp as the noise already, the second look shows what the first has shown.
        if not first or (self.arena.leftover < _SHARP and all(j.total < 0 for j in first)):
            ranking = [self.arena.row(j) for j in entered]
            return Round([], 0.0, ranking, reason="no candidate reduces the misfit more than chance does"), None
        judged, lost = self._final(first)
        arena = self.arena
        far = _FAR * max(j.total for j in first)
        beaten = [j for j in first if not any(arena.label(j) == arena.label(k) for k in (*judged, *lost))]
        outcome = Round([], 0.0, [arena.row(j) for j in [*judged, *beaten, *lost]])
        believed = [j for j in judged if self._believed(j)]
        pairs = self._pairs(judged, entered) if arena.leftover > (_LEFT if believed else _FAINT) else []
        outcome.ranking = [arena.row(j) for j in pairs] + outcome.ranking
        believed = self._together(pairs, believed, judged) or believed
        if not believed:
            objection = arena.objection(judged[0], self.worth)
            outcome.reason = f"the best candidate, {arena.label(judged[0])}, {objection}"
            return outcome, None
        best, judged, believed = self._challenged(outcome, judged, believed)
        beaten = [arena.judge(j.fitted) for j in beaten if j.total > far]
        return self._accepted(outcome, best, judged, beaten, believed[0], entered)

    def _entered(self) -> tuple[list[Judged], list[Judged]]:
        """The shortlist, fitted and judged, best first; and those of it that gain more than chance would bring."""
        arena = self.arena
        chance = self.screen.chance(self.screened, arena.blocks[0], arena.rng)
        picks = shortlist(self.screened, self.short)
        hopeful = [s for s in picks if arena.promises(s) > HOPE * arena.asked(s, self.worth)]
        # The report names the nearest even where there is no hope.
        entered = sorted((arena.enter([s]) for s in hopeful or picks[:1]), key=lambda j: -j.total)
        shared = self._shared(entered)
        lucky = chance.get(arena.label(entered[0]), 0.0) if entered else 0.0
        chance = {arena.label(j): lucky for j in shared} | chance
        entered = sorted([*entered, *shared], key=lambda j: -j.total)
        return entered, [j for j in entered if float(j.fit_gains.sum()) > chance.get(arena.label(j), 0.0)]

    def _accepted(
        self,
        outcome: Round,
        best: Judged,
        judged: Sequence[Judged],
        beaten: Sequence[Judged],
        leading: Judged,
        entered: Sequence[Judged],
    ) -> tuple[Round, Judged | None]:
        """The outcome with the law that is accepted and what explains the data as well; too many such are no finding.

        Args:
          outcome: of the round so far.
          best: the law to accept.
          judged, beaten: what it met in the sharper arena, and what lost to it before.
          leading: of those that are believed, the one that gains most.
          entered: all of the shortlist.
        """
        arena, met, crowd = self.arena, [*judged, *beaten], list[str]()
        alike = self._choice.alike(met, best, leading)
        if too_many(alike):
            # So many causes that do alike are no finding: each would be named for want of the others.
            outcome.reason = f"{len(alike)} effects explain it alike: {', '.join(alike)}"
            if (both := self._instead(best, judged, entered)) is None:
                return outcome, None
            outcome.reason, best, alike = "", both, self._choice.alike([], both, both)
            outcome.ranking = [arena.row(best), *outcome.ranking]
        else:
            # What the data cannot exclude is an equivalent even where more parameters make it the less likely, short of
            # so much that it says nothing: then it is told apart.
            possible = self._choice.alike(met, best, leading, priced=False)
            alike, crowd = (alike, possible) if too_many(possible) else (possible, [])
        outcome.accepted = [e.id for e in arena.new(best)]
        outcome.share = arena.explained(best)
        again = {arena.label(j) for j in judged}  # the others' fits are a first look
        outcome.equivalents = [i for i in alike[len(outcome.accepted) :] if i in again]
        outcome.possible = [i for i in crowd if i not in alike]
        for effect in arena.new(best):
            rivals = outcome.rivals(effect.id)
            rivals += [i for i in known_as(effect, best.fitted, self.pool) if i not in rivals]
        arena.say(f"accepted {', '.join(outcome.accepted)}")
        return outcome, best

    def _shared(self, entered: Sequence[Judged]) -> list[Judged]:
        """Where bodies touch, the leading law at the wider and the narrower sets of like places than its own.

        A limit that all drives share is reached now by one and now by another, and straight lines from its realistic
        size may show nothing of it; a dead zone of all of them shows most at the hips, and a limit of the ankles is
        seen at all joints where no hip comes near it. What promises enough at some share of that size is fitted.
        """
        arena = self.arena
        new = arena.new(entered[0]) if self.rough and entered else []
        if len(new) != 1:
            return []
        asked, own = {arena.label(j) for j in entered}, set(new[0].where)
        like = [e for e in self.pool.values() if e.family == new[0].family and e.id not in asked]

        def promising(effects: list[Effect]) -> list[Screened]:
            found = [self.screen.scout(s, arena.rng, draws=0) for e in effects if (s := self._screened(e.id))]
            return [s for s in found if arena.promises(s) > HOPE * arena.asked(s, self.worth)]

        wider = promising([e for e in like if own < set(e.where)])
        narrower = sorted(promising([e for e in like if set(e.where) < own]), key=lambda s: -s.gain)
        return [arena.enter([s]) for s in (*wider, *narrower[:_NARROWER])]

    def _challenged(
        self, outcome: Round, judged: list[Judged], believed: list[Judged]
    ) -> tuple[Judged, list[Judged], list[Judged]]:
        """The law to accept, when the one about to be accepted has met who may be the right one in its place.

        First what does nearly the same, then, where bodies touch, its rivals at half the physics step.

        Returns:
          The law, all that were judged, and those of them that are believed; the outcome's ranking has the new ones.
        """
        arena, best = self.arena, self._choice.simplest(believed)
        if mimics := self._mimics(best, judged):
            judged = sorted([*judged, *mimics], key=lambda j: -j.total)
            outcome.ranking = ranked(outcome.ranking, [arena.row(j) for j in mimics])
            best = self._choice.simplest(believed := [j for j in judged if self._believed(j)])
        if rivals := self._rivals(best, judged):
            duel = self._at_half([best, *rivals, *self._places(best, judged)])
            # Their families' other forms were judged at the whole step alone, and lost to these there.
            families = {arena.new(j)[0].family for j in duel}
            judged = [*duel, *(j for j in judged if arena.new(j)[0].family not in families)]
            outcome.ranking = ranked(outcome.ranking, [arena.row(j) for j in duel])
            best = self._choice.simplest(believed := [j for j in judged if self._believed(j)] or [best])
        return best, judged, believed

    def _final(self, first: list[Judged]) -> tuple[list[Judged], list[Judged]]:
        """The leading candidates, judged again in a sharper arena, which takes the place of the first; best first.

        Beside them those of which a fit there was enough to see that they do not come near the best, as they were.
        """
        arena = self.arena
        leaders = sorted(first, key=lambda j: arena.unexplained(j.fitted))
        arena.say(f"judging again under what {arena.label(leaders[0])} leaves unexplained")
        finalists = list({id(j): j for j in (*first[: _FINALISTS // 2], *leaders)}.values())[:_FINALISTS]
        self.arena = arena = arena.sharper(leaders[0].fitted)
        fits = list(map(arena.again, finalists))
        near = self._near(fits)
        judged = [arena.judge(f) for f, yes in zip(fits, near, strict=True) if yes]
        lost = [j for j, yes in zip(finalists, near, strict=True) if not yes]
        judged += self._apart(judged)
        judged.sort(key=lambda j: -j.total)
        if (better := self._psi_alone(judged[0])) is not None:
            # What psi can do by itself is not the candidate's to claim.
            arena.say("the candidate's psi alone does better than the model before it: judging against that")
            self.arena = arena = arena.facing(better)
            judged = sorted((arena.judge(j.fitted) for j in judged), key=lambda j: -j.total)
        return judged, lost

    def _near(self, fits: Sequence[Fit]) -> list[bool]:
        """Which of fitted candidates are the best or come near it and may pay; all, where judging them costs little."""
        arena = self.arena
        if not arena.own:
            return [True] * len(fits)
        drops = [arena.drop(f, arena.current) for f in fits]
        most = max(drops)
        return [
            d == most or (d >= _FAR * most and arena.pays(f, arena.current)) for f, d in zip(fits, drops, strict=True)
        ]

    def _mimics(self, best: Judged, judged: Sequence[Judged]) -> list[Judged]:
        """Fits of what does nearly the same as the law about to be accepted, and was not asked in full.

        A first look may lose the right one of two laws that straight lines cannot tell apart. Where bodies touch, those
        lines are too rough to show the likeness of laws that are kin.
        """
        arena, new = self.arena, self.arena.new(best)
        asked = {arena.label(j) for j in judged} | {e.id for e in (*new, *arena.current.plant.effects)}
        added = len(best.fitted.plant.effects) > len(arena.current.plant.effects)
        if len(new) != 1 or new[0].id not in self._known or not added:
            return []
        names = [f"{family}:{new[0].place}" for family in new[0].kin]
        kin = [s for name in names if name not in asked and (s := self._screened(name)) is not None]
        asked |= {s.effect.id for s in kin}
        places = self._elsewhere(new[0], asked)
        asked |= {s.effect.id for s in places}
        others = [s for s in self.screened if s.effect.id not in asked]
        like = mimics(self._known[new[0].id], others, self.screen.projected)
        return [arena.enter_beside(best, [s]) for s in (*kin, *places, *like)]

    def _elsewhere(self, law: Effect, asked: Collection[str]) -> list[Screened]:
        """The same law at the places where it does nearly the same, of which a shortlist has two and screening some.

        Where bodies touch those alone that were screened: straight lines are rough there, and screening is dear.
        """
        places = [i for i, e in self.pool.items() if e.family == law.family and i not in asked]
        places = [i for i in places if i in self._known or not self.rough]
        found = [s for i in places if (s := self._screened(i)) is not None]
        return mimics(self._known[law.id], found, self.screen.projected)

    @property
    def _choice(self) -> Choice:
        return Choice(self.arena, self.worth, self.pool, self._look)

    def _look(self, effect: Effect) -> Screened:
        return self._screened(effect.id) or self.screen.try_one(effect)

    def _screened(self, name: str) -> Screened | None:
        """A candidate as screening has it; None where there is none of that id.

        In a large pool it may have been left out of the screening, and is screened now.
        """
        if name not in self._known and name in self.pool:
            self._known[name] = self.screen.try_one(self.pool[name])
        return self._known.get(name)

    def _rivals(self, best: Judged, judged: Sequence[Judged]) -> list[Judged]:
        """Where bodies touch, the leading candidates of other families that come near the law about to be accepted.

        A law and its own special case are no rivals: what they share errs alike at any step.
        """
        arena, new = self.arena, self.arena.new(best)
        if not self.rough or len(new) != 1:
            return []
        near: dict[str, Judged] = {}
        for j in judged:
            laws = arena.new(j)
            if len(laws) != 1 or laws[0].family == new[0].family or j.total <= _RIVAL * best.total:
                continue
            if not contains(laws[0], new[0]) and not contains(new[0], laws[0]):
                near.setdefault(laws[0].family, j)
        return list(near.values())[:_DUELS]

    def _places(self, best: Judged, judged: Sequence[Judged]) -> list[Judged]:
        """The same law as the one about to be accepted, at other places where it does as well: coupled joints share it.

        What its family did at other places at the whole step alone is forgotten where it meets its rivals at half.
        """
        arena, law = self.arena, self.arena.new(best)[0]

        def elsewhere(j: Judged) -> bool:
            one, *more = arena.new(j)
            return not more and one.family == law.family and set(one.where) != set(law.where)

        return [j for j in judged if elsewhere(j) and arena.ties(best, j, priced=False)][:_DUELS]

    def _at_half(self, duel: Sequence[Judged]) -> list[Judged]:
        """Candidates with the gains that they have at half the physics step, best first.

        A coarse step errs in time by about half of itself, which a delay mends better than the lag that is at work.
        """
        found = self.arena.halved().enter_halved(duel, self.arena)
        found = [replace(f, fitted=j.fitted) for f, j in zip(found, duel, strict=True)]
        return sorted(found, key=lambda j: -j.total)

    def _together(self, pairs: Sequence[Judged], believed: Sequence[Judged], judged: Sequence[Judged]) -> list[Judged]:
        """The pairs that gain clearly more than one law does, are believed, and leave little or half of what was there.

        Two stand-ins for what the library lacks gain more than one of them, and leave most of it even so; each law more
        is then tried, exchanged and dropped at the cost of a round. Where no single law is believed the best of all
        sets the mark.
        """
        arena = self.arena
        alone = max((j.total for j in believed or judged if arena.plausible(j)), default=0.0)
        both = [j for j in pairs if j.total > _TOGETHER * alone and self._believed(j)]
        least = max(_LEFT, _HALF * arena.leaves(arena.current)) if both else 0.0
        return [j for j in both if arena.leaves(j.fitted) <= least]

    def _instead(self, best: Judged, judged: Sequence[Judged], entered: Sequence[Judged]) -> Judged | None:
        """Two laws at once where too many single ones do alike for any of them to be believed.

        What they leave may be another law's, which hides which of them is at work. Where much is left, pairs were tried
        before, and lost.
        """
        if not _FAINT < self.arena.leftover <= _LEFT:
            return None
        both = self._together(self._pairs(judged, entered), [best], judged)
        return self._choice.simplest(both) if both else None

    def _apart(self, judged: Sequence[Judged]) -> list[Judged]:
        """Values of their own at each place: for what was accepted before, and for the leading laws at several places.

        Asked in the same round, lest a law that suits all places alike with more parameters of its own wins first.
        """
        arena = self.arena
        best = max(j.total for j in judged)
        pairs = [(arena.current, e) for e in arena.current.plant.effects]
        families: set[str] = set()
        for j in sorted(judged, key=lambda j: -j.total):
            new = arena.new(j)
            if len(new) == 1 and len(new[0].where) > 1 and j.total > _LEADING * best and new[0].family not in families:
                families.add(new[0].family)
                pairs.append((j.fitted, new[0]))
        found = [arena.enter_apart(start, effect) for start, effect in pairs]
        return [j for j in found if j is not None]

    def _believed(self, j: Judged) -> bool:
        return self.arena.believed(j, self.worth)

    def _pairs(self, judged: Sequence[Judged], entered: Sequence[Judged]) -> list[Judged]:
        """Two laws at once: one may show only when the other is there.

        Args:
          judged: candidates judged in the sharper arena.
          entered: all of the shortlist as the first contest had them: who is lost alone may shine in company.
        """
        arena = self.arena
        pool: dict[tuple, Judged] = {}
        for j in (*judged, *entered):
            if len(j.fitted.plant.effects) > len(arena.current.plant.effects) and arena.plausible(j):
                pool.setdefault(mechanism(arena.new(j)[0]), j)
        fitted = [arena.enter_both(a, b) for a, b in promising(arena, list(pool.values()), _PAIRED)]
        pairs = [p for p in fitted if p is not None]
        gain = max((j.total for j in judged if arena.plausible(j)), default=0.0)
        return sorted((p for p in pairs if p.total > gain), key=lambda j: -j.total)

    def _psi_alone(self, best: Judged) -> Fit | None:
        """The model to beat, fitted from where the candidate's fit took the rest, if it is clearly better so.

        Fits of robots in contact end in one of many hollows; leading to another is no merit of a candidate.
        """
        arena = self.arena
        current, plant = arena.current, best.fitted.plant
        if not self.rough or plant.effects[: len(current.plant.effects)] != current.plant.effects:
            return None
        other = fit(arena.fit_data.problem, arena.under, current.plant, best.fitted.x[: len(current.x)], 10)
        if not arena.pays(other, current):
            return None
        gained = arena.judge(other)
        share = _BY_PSI * max(float(best.fit_gains.sum() + best.gains.sum()), 0.0)
        return other if gained.gain + float(gained.fit_gains.sum()) > share > 0 else None
