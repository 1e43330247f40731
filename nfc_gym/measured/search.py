"""The search for what a model lacks: calibrate psi, screen candidates, refit the best, select on held-out logs, repeat.

Method and its reasons: Kennedy and O'Hagan (2001) for the discrepancy that must not be credited to psi; score tests
with secants for the screening; a moving-block bootstrap (Kuensch 1989) for what is believed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import Arena, alternatives, contains
from nfc_gym.measured.contest import Judged
from nfc_gym.measured.doubt import doubted
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.form import misshapen
from nfc_gym.measured.halved import artefacts
from nfc_gym.measured.lookout import Lookout
from nfc_gym.measured.merging import merged
from nfc_gym.measured.metric import metric
from nfc_gym.measured.owned import Data
from nfc_gym.measured.ranking import Round, known_as
from nfc_gym.measured.remainder import CLEARLY, SILENT, LawSearch, Remainder
from nfc_gym.measured.rounds import Contest
from nfc_gym.measured.screen import Screen, Screened
from nfc_gym.measured.settle import settle, slack
from nfc_gym.measured.sparser import sparser
from nfc_gym.measured.suspects import Suspects
from nfc_gym.measured.swap import join_kin, swapped
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.law import Law
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
Say = Callable[[str], None]
_AGAIN = 4  # iterations of the first round's fit, which starts from a calibrated model
_LEADING = 3  # generic alternatives that are refitted, besides the best of each wordless kind
_GENERICS = 12  # generic alternatives that are screened in full, besides the best of each kind
_QUIET = 0.02  # nats a number beyond the noise, below which only suspects are looked at: half of what is searched for


@dataclass(frozen=True)
class Options:
    """Knobs of a search.

    Attributes:
      most: effects at most.
      swaps: exchanges of an earlier law at most.
      worth: share of the excess that an effect must explain to be named.
      short: candidates refitted in each round.
      first: of the suspects, where a structure head names them.
      seed: of bootstrap and chance draws.
    """

    most: int = 8
    swaps: int = 2
    worth: float = 0.02
    short: int = 8
    first: int = 5
    seed: int = 0


@dataclass(frozen=True)
class State:
    """Where a search stands between two rounds: all that the rounds to come depend on, besides data and options.

    Attributes:
      plant, x: the model that the next round starts from, as the last round's contest left it.
      rounds: so far.
      hopeless: places that showed nothing (`Lookout.hopeless`).
    """

    plant: Plant
    x: Array
    rounds: tuple[Round, ...] = ()
    hopeless: frozenset[str] = field(default_factory=frozenset)


@dataclass
class Found:
    """Outcome of a search.

    Attributes:
      calibrated: psi alone, fitted.
      extended: psi and the accepted effects, fitted.
      slack: (m,) that of the metric of the last round, under which `extended` was fitted.
      rounds: in order, the last one being the round that accepted nothing.
      generic: id of a generic alternative that beat every named effect, or None.
      hinted: id of the one that gains most beyond chance by straight lines, believed or not; None where none does.
      nearest: id of the candidate that led the last round's screening, whatever it gained; None where there was none.
      dropped: named effects that a generic alternative alone outdid.
      doubted: accepted effects that lead rivals by less than they leave over, with these (see `doubt`).
      misshapen: accepted effects whose law is not the one at work there, with what says so (see `form`).
      rest: what the named effects left, and the laws that are proposed for it; None until it was looked for.
    """

    calibrated: Fit
    extended: Fit
    slack: Array
    rounds: list[Round]
    generic: str | None
    nearest: str | None
    hinted: str | None = None
    dropped: list[str] = field(default_factory=list)
    doubted: dict[str, list[str]] = field(default_factory=dict)
    misshapen: dict[str, str] = field(default_factory=dict)
    rest: Remainder | None = None


class Search:
    """One greedy search on fit and selection problems."""

    _thinned = False  # whether laws have left the model that the round at hand starts from
    _hinted: str | None = None  # see `Found`

    def __init__(
        self,
        fit_data: Data,
        select: Data,
        candidates: Sequence[Effect],
        options: Options,
        say: Say,
        suspects: Suspects | None = None,
    ) -> None:
        self.fit_data, self.select = fit_data, select
        self.named = [e for e in candidates if not e.generic]
        self.generics = [e for e in candidates if e.generic and not isinstance(e, Law)]
        self.laws = [e for e in candidates if isinstance(e, Law)]
        self.options, self.say = options, say
        self.rng = np.random.default_rng(options.seed)
        self.lookout = Lookout(fit_data.problem, self.rng, say, suspects)

    def settle(self, plant: Plant, x: Array, polished: bool = False) -> Arena:
        """The arena of the round that starts from a model, which is refitted first."""
        data, seed = self.fit_data, None if polished else self.options.seed
        fitted, under, extra = settle(data.problem, data.sigma, plant, x, seed)
        return Arena(data, self.select, fitted, under, extra, self.rng, self.say)

    def run(
        self, calibrated: Fit, begun: State | None = None, keep: Callable[[State], None] = lambda state: None
    ) -> Found:
        """Greedy rounds from a calibrated model until nothing more is believed; then the generic alternatives' turn.

        Args:
          calibrated: psi alone, fitted.
          begun: state of a search that was interrupted, to go on from; the outcome is that of one that was not.
          keep: called with the state after every round that accepted something.
        """
        state = begun or State(calibrated.plant, calibrated.x)
        self.lookout.hopeless = set(state.hopeless)
        rounds = list(state.rounds)
        while True:
            arena = self._begin(state)
            screen = Screen(self.fit_data.problem, arena.under, arena.current)
            screened, outcome, best = self._contest(arena, screen, not rounds)
            rounds.append(outcome)
            full = len(arena.current.plant.effects) >= self.options.most
            better = best.fitted if best is not None and not full else self._exchange(arena, rounds)
            if better is None:
                break
            state = State(better.plant, better.x, tuple(rounds), frozenset(self.lookout.hopeless))
            keep(state)
        mended = self._mended(arena, rounds)
        if mended is not arena:
            arena, screen = mended, Screen(self.fit_data.problem, mended.under, mended.current)
        join_kin(arena, rounds, self.named)
        return self._concluded(arena, screen, screened, outcome, rounds, calibrated)

    def _mended(self, arena: Arena, rounds: list[Round]) -> Arena:
        """The arena in which two laws are one where one does, and which the effects that were doubted have left.

        Laws are merged before any is doubted: what two do together neither may do alone.
        """
        whole = self._merged(arena, rounds)
        confirmed = self._plainer(self._confirmed(whole, rounds), rounds)
        return confirmed if confirmed is whole else self._merged(confirmed, rounds)

    def _concluded(
        self,
        arena: Arena,
        screen: Screen,
        screened: list[Screened],
        last: Round,
        rounds: list[Round],
        calibrated: Fit,
    ) -> Found:
        """What is found, after the generic alternatives' turn, and what is to be doubted of it.

        Args:
          arena, screen: of the model that stands at the end.
          screened: candidates of the last contest.
          last: that contest, which says what generic alternatives gained.
          rounds: of the search; what was merged or dropped since that contest comes after it.
          calibrated: psi alone, fitted.
        """
        dropped: list[str] = []
        odd = misshapen(arena, [g for g in self.generics if not g.wordless], self.options.worth)
        generic = self._generic(arena, screen, last) or max(odd.values(), key=lambda j: j.total, default=None)
        label = None if generic is None else arena.label(generic)
        if generic is not None and arena.current.plant.effects and self._outdone(arena, generic, calibrated):
            self.say("a generic law explains clearly more than all named effects: none is claimed")
            dropped = [e.id for e in arena.current.plant.effects]
            bare = fit(self.fit_data.problem, arena.under, calibrated.plant, calibrated.x, 6)
            arena = self.settle(bare.plant, bare.x, polished=True)
        nearest = screened[0].effect.id if screened else None
        doubts = doubted(arena, rounds, self.named) if arena.leftover > SILENT else {}
        shapes = {i: arena.label(j) for i, j in odd.items() if i not in dropped}
        hinted = self._hinted
        return Found(calibrated, arena.current, arena.extra, rounds, label, nearest, hinted, dropped, doubts, shapes)

    def _contest(self, arena: Arena, screen: Screen, begins: bool) -> tuple[list[Screened], Round, Judged | None]:
        """The contest of one round: its screening, what is reported of it, and what it accepted.

        Where a structure head names suspects they compete first, with the families that lead plain screening, in the
        first round; all candidates do if none of these is accepted and something is left to explain: what a head
        excludes must be found all the same. Later rounds mostly accept nothing, and two contests would cost more than
        one: all candidates compete at once, but where next to nothing is left to explain the suspects alone.
        """

        def held(screened: list[Screened], short: int) -> tuple[list[Screened], Round, Judged | None]:
            contest = Contest(arena, screen, screened, short, self.options.worth, self.named)
            return screened, *contest.hold()

        lookout, quiet = self.lookout, arena.leftover < _QUIET
        if lookout.suspects is not None and (begins or quiet):
            screened = lookout.closer(screen, lookout.first(screen, self.named, begins))
            first = held(screened, self.options.first)
            if first[2] is not None or quiet:
                return first
            self.say("none of the suspects explains it: all candidates compete")
        return held(lookout.closer(screen, lookout.screen(screen, self.named)), self.options.short)

    def rest(self, found: Found) -> Remainder:
        """What the named effects left, and the laws that are believed of it."""
        data = self.fit_data
        self.rng = self.lookout.rng = np.random.default_rng([self.options.seed, len(found.rounds), 1])
        under = metric(data.problem, data.sigma, found.slack)
        arena = Arena(data, self.select, found.extended, under, found.slack, self.rng, self.say)
        laws = LawSearch(self.laws, self.options.worth, lambda f: self.settle(f.plant, f.x), self._prune)
        out = laws.run(arena, found.calibrated, found.misshapen, sure=found.generic is not None)
        out.dropped = out.dropped or found.dropped
        ground = next((g for g in self.generics if g.id == found.generic and g.wordless), None)
        if ground is not None and out.laws and self._grounded(arena, ground, out.fitted):
            for law in out.rounds:
                law.accepted, law.share, law.reason = [], 0.0, f"{ground.id} explains more"
            out = Remainder(arena.current, out.scanned, out.bare, found.dropped, out.rounds)
        return out

    def _grounded(self, arena: Arena, ground: Effect, laws: Fit) -> bool:
        """Whether what acts on the ground does better than proposed laws.

        Pushes by place stand in for floors that slip, and a torque on the base for a wheel that is out of true.
        """
        screen = Screen(arena.fit_data.problem, arena.under, arena.current)
        grip, named = arena.enter([screen.try_one(ground)]), arena.judge(laws)
        if grip.total <= named.total:
            return False
        arena.say(f"{ground.id} explains more than the proposed laws, which are left out")
        return True

    def _confirmed(self, arena: Arena, rounds: list[Round]) -> Arena:
        """The arena without the effects that do not outlive half the physics step, or whose sizes may be nothing."""
        while doubt := self._doubtful(arena):
            effect, why = doubt
            reason = f"dropped {effect.id}: {why}"
            self.say(reason)
            rounds.append(Round([], 0.0, reason=reason))
            bare = arena.without(effect).current
            arena = self.settle(bare.plant, bare.x, polished=True)
        return arena

    def _plainer(self, arena: Arena, rounds: list[Round]) -> Arena:
        """The arena with plain laws in place of one whose values differ by place, if fewer numbers do as well.

        Asked of what is confirmed alone: it says in other words what was found, and nothing new competes beside it.
        """
        while (found := sparser(arena, self.named, self.options.worth)) is not None:
            law, plainer = found
            self.say(f"plain laws in place of {law.id}: fewer numbers do as well")
            told = self._exchanged(arena.current, plainer.fitted, "with fewer numbers")
            self._inherit(told, law.id, rounds)
            rounds.append(told)
            arena = self._confirmed(self.settle(plainer.fitted.plant, plainer.fitted.x), rounds)
        return arena

    def _inherit(self, told: Round, before: str, rounds: Sequence[Round]) -> None:
        """What does as well as a law does as well as the plain one that says the same in its place."""
        known = {e.id: e for e in self.named}
        plain = known.get(told.accepted[0]) if len(told.accepted) == 1 else None
        rivals = [i for r in rounds if before in r.accepted for i in r.rivals(before)]
        if plain is None or not rivals:
            return
        own, named = told.rivals(plain.id), [(i, known.get(i.removesuffix(":each"))) for i in rivals]
        apart = [i for i, law in named if law is None or not contains(law, plain)]
        own[:] = alternatives(plain, [*own, *apart], self.named)

    def _merged(self, arena: Arena, rounds: list[Round]) -> Arena:
        """The arena with one law in place of two, as often as that does better with no more numbers."""
        while (found := merged(arena, self.named, self.options.worth)) is not None:
            two, one = found
            self.say(f"one law in place of {two[0].id} and {two[1].id}: it does better with no more numbers")
            rounds.append(self._exchanged(arena.current, one.fitted, "one in place of two"))
            arena = self._confirmed(self.settle(one.fitted.plant, one.fitted.x), rounds)
        return arena

    def _doubtful(self, arena: Arena) -> tuple[Effect, str] | None:
        """An accepted effect that had better not be claimed, and why."""
        if found := artefacts(arena, self.options.worth):
            return found[0], "at half the physics step it explains nothing worth naming"
        vague = arena.vague()
        return (vague[-1], "its fitted sizes do not differ from nothing") if vague else None

    def _exchange(self, arena: Arena, rounds: list[Round]) -> Fit | None:
        """A model in which another law took the place of an earlier one, if that is clearly better."""
        if sum(bool(r.exchanged) for r in rounds) >= self.options.swaps:
            return None
        met = None if self._thinned else _met(rounds)  # what it met beside laws that have left says nothing
        swap = swapped(arena, self.lookout, self.named, self.options.worth, self.say, met)
        if (found := swap.better) is None:
            laws = {e.id: e for e in arena.current.plant.effects}
            for r in rounds:
                for law in (i for i in r.accepted if i in laws):
                    rivals = r.rivals(law)
                    rivals[:] = alternatives(laws[law], [*rivals, *swap.alike.get(law, [])], self.named)
            return None
        rounds.append(self._exchanged(arena.current, found, "beside the others"))
        return found

    def _exchanged(self, before: Fit, after: Fit, how: str) -> Round:
        """The round in which one model takes the place of another."""
        gone, come = (
            [e for e in one.plant.effects if e not in other.plant.effects]
            for one, other in ((before, after), (after, before))
        )
        place = ", ".join(e.id for e in gone)
        out = Round([e.id for e in come], 0.0, reason=f"in place of {place}, {how}", exchanged=place)
        for law in come:
            out.rivals(law.id).extend(known_as(law, after, {e.id for e in self.named}))
        return out

    def _begin(self, state: State) -> Arena:
        """The arena of the round that follows a state.

        Each round draws from a generator of its own: what it draws does not depend on which rounds ran before it in
        this process, and a search that goes on after an interruption draws the same.
        """
        self.rng = self.lookout.rng = np.random.default_rng([self.options.seed, len(state.rounds)])
        if not state.rounds:  # psi was settled just now: only the noise has been carried anew
            data = self.fit_data
            extra = slack(data.problem, data.sigma, state.plant, state.x)
            under = metric(data.problem, data.sigma, extra)
            current = fit(data.problem, under, state.plant, state.x, _AGAIN)
            return Arena(data, self.select, current, under, extra, self.rng, self.say)
        arena = self.settle(state.plant, state.x)
        current = self._prune(arena)
        self._thinned = current is not arena.current
        return arena if current is arena.current else self.settle(current.plant, current.x, polished=True)

    def _prune(self, arena: Arena) -> Fit:
        """Drop earlier effects that the later ones have made superfluous."""
        for effect in arena.current.plant.effects[:-1]:
            without = arena.without(effect)
            kept = without.judge(arena.current)
            if not without.worth(kept, self.options.worth) and not without.likelier(kept):
                self.say(f"dropped {effect.id}: the others explain what it did")
                arena = without
        return arena.current

    # ---- generic alternatives ---------------------------------------------------------------------------------------

    def _generic(self, arena: Arena, screen: Screen, outcome: Round) -> Judged | None:
        """The smooth law that still adds most to the accepted effects, if it is believed.

        Where next to nothing is left, the ground's grip and what moves in a body alone are asked: the medians by which
        that is measured hide what is wrong in one part of the world, and what slides when it is shaken alone.
        """
        if arena.leftover > SILENT:
            screened = self.lookout.screen(screen, self.generics, _GENERICS)
        else:
            screened = [screen.try_one(g) for g in self.generics if g.patchy]
        worth = self.options.worth
        chance = screen.chance(screened, arena.blocks[0], self.rng)
        beyond = {s.effect.id: s.gain / chance[s.effect.id] for s in screened if s.gain > 0 and s.effect.id in chance}
        self._hinted = max((i for i, times in beyond.items() if times > 1), key=lambda i: beyond[i], default=None)
        # What no push on a joint says shows least in straight lines: the best of each such family is asked in any case.
        wordless = {s.effect.family: s for s in reversed(screened) if s.effect.wordless}.values()
        leading = [s for i, s in enumerate(screened) if i < _LEADING or any(s is w for w in wordless)]
        hopeful = [s for s in leading if s.gain > 0 and arena.promises(s) > arena.asked(s, worth)]
        judged = sorted((arena.enter([s]) for s in hopeful), key=lambda j: -j.total)
        outcome.ranking += [arena.row(j) for j in judged]
        if not judged or not self._holds(arena, judged[0]):
            return None
        return judged[0] if float(judged[0].fit_gains.sum()) > chance.get(arena.label(judged[0]), 0.0) else None

    def _holds(self, arena: Arena, j: Judged) -> bool:
        """Whether what a smooth law gains holds on unseen logs, there or, as named effects are asked, under a measure
        that it made itself.

        The slack of a model that lacks it hides what a floor of two frictions does but for a few great errors, and
        whether those are drawn decides the bootstrap.
        """
        worth = self.options.worth
        if arena.worth(j, worth) or j.total <= worth * arena.misfit:
            return arena.worth(j, worth)
        self.say(f"judging again under what {arena.label(j)} leaves unexplained")
        sharp = arena.sharper(j.fitted)
        return sharp.worth(sharp.enter_again(j), worth)

    def _outdone(self, arena: Arena, generic: Judged, calibrated: Fit) -> bool:
        """Whether that generic law alone explains clearly more than all accepted effects together."""
        problem = self.fit_data.problem
        bare = arena.facing(fit(problem, arena.under, calibrated.plant, calibrated.x, 6))
        effect = arena.new(generic)[0]
        plant = calibrated.plant.with_effects([effect])
        rival = bare.judge(fit(problem, arena.under, plant, np.concatenate([bare.current.x, effect.null]), 10))
        named = bare.judge(arena.current)
        return rival.total > CLEARLY * named.total and not arena.ties(rival, named)


def _met(rounds: Sequence[Round]) -> set[str] | None:
    """Ids of what the law accepted last was compared with in its round; None where it was accepted with another."""
    last = next((r for r in reversed(rounds) if r.accepted), None)
    if last is not None and len(last.accepted) > 1:
        return None
    return {row["id"] for row in last.ranking} if last is not None else set()
