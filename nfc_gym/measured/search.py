"""The search for what a model lacks: calibrate psi, screen candidates, refit the best, select on held-out logs, repeat.

Method and its reasons: Kennedy and O'Hagan (2001) for the discrepancy that must not be credited to psi; score tests
with secants for the screening; a moving-block bootstrap (Kuensch 1989) for what is believed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import Arena, Data, contains
from nfc_gym.measured.contest import Judged, shortlist
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.screen import Screen, Screened, screen_all
from nfc_gym.measured.settle import settle
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.each import Each, split

Array = NDArray[np.float64]
Say = Callable[[str], None]
_NEARLY = 0.95  # share of the best candidate's gain that a simpler law must reach to be preferred
_SHARED = 0.8  # the same for the same law at a wider place
_FIELD, _THIN = 30, 3  # a larger pool of candidates is first thinned to so many, on every third block
_ENOUGH = 12  # blocks that such a thinning must leave
_KEEP = 60  # candidates that are screened again in every round, whatever they gained
_SCOUTED = 16  # candidates, each the best of its family, that a rough problem looks around before refitting
_PURSUED = 40  # candidates that a smooth problem takes a few steps further before it shortlists
_LEADING = 0.7  # of the best gain: what a law at several places must reach to be tried with values of their own
_PAIRED, _PAIRED_ROUGH = 5, 3  # candidates that are tried in pairs
_TOGETHER = 1.25  # of what the best gains alone: what a pair must gain to be accepted at once
_FINALISTS = 4  # candidates that are judged again under the sharper metric


@dataclass(frozen=True)
class Options:
    """Knobs of a search.

    Attributes:
      most: effects at most.
      worth: share of the excess that an effect must explain to be named.
      short: candidates refitted in each round.
      seed: of bootstrap and chance draws.
    """

    most: int = 8
    worth: float = 0.02
    short: int = 8
    seed: int = 0


@dataclass
class Round:
    """What one round of the search saw, for the report."""

    accepted: list[str]
    share: float
    ranking: list[dict] = field(default_factory=list)
    equivalents: list[str] = field(default_factory=list)
    reason: str = ""


@dataclass
class Found:
    """Outcome of a search.

    Attributes:
      calibrated: psi alone, fitted.
      extended: psi and the accepted effects, fitted.
      rounds: in order, the last one being the round that accepted nothing.
      generic: a generic alternative that beat every named effect, or None.
      screened: the last round's screening, from which the identifiability table is made.
    """

    calibrated: Fit
    extended: Fit
    rounds: list[Round]
    generic: Judged | None
    screened: list[Screened]


class Search:
    """One greedy search on fit and selection problems."""

    def __init__(self, fit_data: Data, select: Data, candidates: Sequence[Effect], options: Options, say: Say) -> None:
        self.fit_data, self.select = fit_data, select
        self.named = [e for e in candidates if not e.generic]
        self.generics = [e for e in candidates if e.generic]
        self.hopeless: set[str] = set()
        self.options, self.say = options, say
        self.rng = np.random.default_rng(options.seed)

    def settle(self, current: Fit, polished: bool = False) -> Arena:
        """The arena of the round that starts from a model, which is refitted first."""
        data, seed = self.fit_data, None if polished else self.options.seed
        fitted, under, extra = settle(data.problem, data.sigma, current.plant, current.x, seed)
        return Arena(data, self.select, fitted, under, extra, self.rng, self.say)

    def run(
        self,
        calibrated: Fit,
        begun: tuple[Fit, list[Round]] | None = None,
        keep: Callable[[Fit, list[Round]], None] = lambda current, rounds: None,
    ) -> Found:
        """Greedy rounds from a calibrated model until nothing more is believed; then the generic alternatives' turn.

        Args:
          calibrated: psi alone, fitted.
          begun: model and rounds of a search that was interrupted, to go on from.
          keep: called with model and rounds after every round that accepted something.
        """
        current, rounds = begun or (calibrated, [])
        arena = self.settle(current, polished=True)
        while True:
            screen = Screen(self.fit_data.problem, arena.under, arena.current)
            screened = self._screen(screen, self.named)
            screened = self._looked_at(screen, screened)
            outcome, best = self._round(arena, screen, screened)
            rounds.append(outcome)
            if best is None or len(arena.current.plant.effects) >= self.options.most:
                break
            arena = self.settle(best.fitted)
            current = self._prune(arena)
            if current is not arena.current:
                arena = self.settle(current, polished=True)
            keep(arena.current, rounds)
        generic = self._generic(arena, screen, outcome)
        current = arena.current
        if generic is not None and current.plant.effects and self._outdone(arena, generic, calibrated):
            self.say("a generic law explains clearly more than all named effects: none is claimed")
            current = fit(self.fit_data.problem, arena.under, calibrated.plant, calibrated.x, 6)
        return Found(calibrated, current, rounds, generic, screened)

    # ---- screening --------------------------------------------------------------------------------------------------

    def _screen(self, screen: Screen, pool: Sequence[Effect]) -> list[Screened]:
        taken = {e.id.removesuffix(":each") for e in screen.current.plant.effects}
        left = [e for e in pool if e.id not in taken and (e.id not in self.hopeless or len(e.where) > 1)]
        self.say(f"screening {len(left)} candidates")
        found = screen_all(screen, self._promising(screen, left))
        # Places that show nothing at all are not looked at again; sets of places stay, since they stand for many.
        floor = 1e-3 * float(screen.projected @ screen.projected)
        self.hopeless |= {f.effect.id for f in found[_KEEP:] if f.gain < floor}
        return found

    def _thinned(self, screen: Screen) -> Screen:
        """The same screen on every third block, where there are enough of them."""
        blocks = len(self.fit_data.problem)
        if blocks < _THIN * _ENOUGH:
            return screen
        index = np.arange(0, blocks, _THIN)
        current = screen.current
        part = Fit(current.plant, current.x, current.white[index], current.jacobian[index])
        return Screen(self.fit_data.problem.take(index), screen.metric.take(index), part)

    def _promising(self, screen: Screen, pool: list[Effect]) -> list[Effect]:
        """Of a large pool, those that do best on every third block, and the best of each family."""
        thin = self._thinned(screen)
        if len(pool) <= _FIELD or thin is screen:
            return pool
        rough = screen_all(thin, pool)
        families = {r.effect.family: r.effect for r in reversed(rough)}
        best = [r.effect for r in rough[:_FIELD]]
        return best + [e for e in families.values() if e not in best]

    def _looked_at(self, screen: Screen, found: list[Screened]) -> list[Screened]:
        """The leading candidates by what they gain in truth, then the rest as screening has them."""
        if self.fit_data.problem.rough:
            leading = list({f.effect.family: f for f in reversed(found) if f.gain > 0}.values())[::-1][:_SCOUTED]
            thin = self._thinned(screen)
            look = lambda f: thin.scout(f, self.rng)  # noqa: E731
        else:
            leading, look = [f for f in found[:_PURSUED] if f.gain > 0], screen.pursue
        self.say(f"looking closer at {len(leading)} of them")
        looked = sorted(map(look, leading), key=lambda f: -f.gain)
        chosen = {id(f.effect) for f in looked}
        return looked + [f for f in found if id(f.effect) not in chosen]

    # ---- rounds -----------------------------------------------------------------------------------------------------

    def _round(self, arena: Arena, screen: Screen, screened: list[Screened]) -> tuple[Round, Judged | None]:
        """Refit the shortlist, judge it on the selection logs, and decide.

        Twice: under the metric of the model so far, and then the leading ones under the slack of the best of them. The
        first takes an error ten times the noise for one standard deviation, and all that mend most of it for equals.
        """
        chance = screen.chance(screened, arena.blocks[0], self.rng)
        entered = sorted((arena.enter([s]) for s in shortlist(screened, self.options.short)), key=lambda j: -j.total)
        first = [j for j in entered if float(j.fit_gains.sum()) > chance.get(arena.label(j), 0.0)]
        if not first:
            ranking = [arena.row(j) for j in entered]  # the report names the nearest
            return Round([], 0.0, ranking, reason="no candidate reduces the misfit more than chance does"), None
        leaders = sorted(first, key=lambda j: arena.unexplained(j.fitted))
        self.say(f"judging again under what {arena.label(leaders[0])} leaves unexplained")
        finalists = list({id(j): j for j in (*first[: _FINALISTS // 2], *leaders)}.values())[:_FINALISTS]
        arena = arena.sharper(leaders[0].fitted)
        judged = [arena.enter_again(j) for j in finalists]
        judged += self._apart(arena, judged)
        judged.sort(key=lambda j: -j.total)
        if (better := self._psi_alone(arena, judged[0])) is not None:
            # What psi can do by itself is not the candidate's to claim.
            self.say("the candidate's psi alone does better than the model before it: judging against that")
            arena = arena.facing(better)
            judged = sorted((arena.judge(j.fitted) for j in judged), key=lambda j: -j.total)
        beaten = [j for j in first if not any(arena.label(j) == arena.label(k) for k in judged)]
        outcome = Round([], 0.0, [arena.row(j) for j in [*judged, *(arena.judge(j.fitted) for j in beaten)]])
        believed = [j for j in judged if self._believed(arena, j)]
        if not believed or not self.fit_data.problem.rough:
            pairs = self._pairs(arena, judged, entered)
            outcome.ranking = [arena.row(j) for j in pairs] + outcome.ranking
            alone = max((j.total for j in believed), default=0.0)
            both = [j for j in pairs if j.total > _TOGETHER * alone and self._believed(arena, j)]
            believed = both or believed
        if not believed:
            outcome.reason = f"the best candidate, {arena.label(judged[0])}, gains no more on unseen logs than chance"
            return outcome, None
        best = self._simplest(arena, believed, screen, screened)
        chosen = arena.new(best)
        outcome.accepted = [e.id for e in chosen]
        outcome.share = best.gain / max(float(arena.base.sum()), 1e-9)
        rivals = [j for j in judged if j.total > _NEARLY * best.total and arena.label(j) not in outcome.accepted]
        rivals = [j for j in rivals if arena.ties(believed[0], j)]
        # A law that has the chosen one, or another rival, as its special case is no further alternative.
        plainer = [chosen, *(arena.new(j) for j in rivals)]
        outcome.equivalents = [
            arena.label(j)
            for j in rivals
            if not any(contains(e, w) for e in arena.new(j) for laws in plainer for w in laws if w is not e)
        ]
        self.say(f"accepted {', '.join(outcome.accepted)}")
        return outcome, best

    def _apart(self, arena: Arena, judged: Sequence[Judged]) -> list[Judged]:
        """Values of their own at each place: for what was accepted before, and for the leading laws at several places.

        Asked in the same round, lest a law that suits all places alike with more parameters of its own wins first.
        """
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

    def _believed(self, arena: Arena, j: Judged) -> bool:
        return arena.worth(j, self.options.worth) and arena.plausible(j) and arena.told_apart(j)

    def _pairs(self, arena: Arena, judged: Sequence[Judged], entered: Sequence[Judged]) -> list[Judged]:
        """Two laws at once: one may show only when the other is there.

        Where bodies touch a fit costs seconds, and pairs are tried only if none is believed alone.

        Args:
          arena: the sharper one.
          judged: candidates judged in it.
          entered: all of the shortlist as the first contest had them: who is lost alone may shine in company.
        """
        added = [j for j in judged if len(j.fitted.plant.effects) > len(arena.current.plant.effects)]
        names = {arena.label(j) for j in added}
        added = [j for j in (*added, *(j for j in entered if arena.label(j) not in names)) if arena.plausible(j)]
        added = added[: _PAIRED_ROUGH if self.fit_data.problem.rough else _PAIRED]
        pairs = [
            arena.enter_both(a, b)
            for i, a in enumerate(added)
            for b in added[i + 1 :]
            if arena.new(a)[0].family != arena.new(b)[0].family
        ]
        gain = max((j.total for j in judged if arena.plausible(j)), default=0.0)
        return sorted((p for p in pairs if p.total > gain), key=lambda j: -j.total)

    def _psi_alone(self, arena: Arena, best: Judged) -> Fit | None:
        """The model to beat, fitted from where the candidate's fit took the rest, if it is clearly better so.

        Fits of robots in contact end in one of many hollows; leading to another is no merit of a candidate.
        """
        current, plant = arena.current, best.fitted.plant
        if not self.fit_data.problem.rough or plant.effects[: len(current.plant.effects)] != current.plant.effects:
            return None
        other = fit(self.fit_data.problem, arena.under, current.plant, best.fitted.x[: len(current.x)], 10)
        gained = float(current.losses.sum() - other.losses.sum())
        return other if gained > 0.1 * float(best.fit_gains.sum()) > 0 else None

    def _simplest(self, arena: Arena, believed: list[Judged], screen: Screen, screened: Sequence[Screened]) -> Judged:
        """Of the candidates that explain the data as well as the best: fewest parameters, then widest place.

        A law whose own feature does not show gives way to the plainer laws that it contains; and a cause that like
        parts share is likelier than the same cause in just one of them, unless the data tell them apart.
        """
        best = believed[0]
        winner = arena.new(best)[0]
        added = len(best.fitted.plant.effects) > len(arena.current.plant.effects)

        def enough(j: Judged) -> float:
            rival = arena.new(j)[0]
            wider = rival.family == winner.family and set(winner.where) < set(rival.where)
            return _SHARED if wider else _NEARLY

        rivals = [j for j in believed if j.total > enough(j) * best.total and arena.ties(best, j)]
        for parts in self._plainer(winner, screen, screened) if added else []:
            plain = arena.enter(parts)
            if plain.lower > 0 and plain.total > _NEARLY * best.total and arena.ties(best, plain):
                rivals.append(plain)
        return min(rivals, key=lambda j: (len(j.fitted.x), -len(arena.new(j)[0].where), -j.total))

    def _plainer(self, law: Effect, screen: Screen, screened: Sequence[Screened]) -> list[list[Screened]]:
        """The sets of plainer laws that a law contains, screened at its place."""
        by_id = {s.effect.id: s for s in screened}
        out = []
        for families in law.simpler:
            parts = [by_id[i] for f in families if (i := f"{f}:{law.place}") in by_id]
            if isinstance(law, Each):
                apart = [split(p.effect, screen.current.plant) for p in parts]
                parts = [screen.try_one(a[0]) for a in apart if a is not None]
            if len(parts) == len(families):
                out.append(parts)
        return out

    def _prune(self, arena: Arena) -> Fit:
        """Drop earlier effects that the later ones have made superfluous."""
        current = arena.current
        for effect in list(current.plant.effects[:-1]):
            psi, thetas = current.plant.split(current.x)
            pairs = [(e, t) for e, t in zip(current.plant.effects, thetas, strict=True) if e is not effect]
            plant = current.plant.with_effects([e for e, _ in pairs])
            start = np.concatenate([psi, *(t for _, t in pairs)])
            without = arena.facing(fit(self.fit_data.problem, arena.under, plant, start, 8))
            kept = without.judge(current)
            if not without.worth(kept, self.options.worth) and not without.likelier(kept):
                self.say(f"dropped {effect.id}: the others explain what it did")
                current = without.current
        return current

    # ---- generic alternatives ---------------------------------------------------------------------------------------

    def _generic(self, arena: Arena, screen: Screen, outcome: Round) -> Judged | None:
        """The smooth law of position, speed or time that still adds most to the accepted effects, if it is believed."""
        screened = self._screen(screen, self.generics)
        judged = sorted((arena.enter([s]) for s in screened[:3] if s.gain > 0), key=lambda j: -j.total)
        outcome.ranking += [arena.row(j) for j in judged]
        if not judged or not arena.worth(judged[0], self.options.worth):
            return None
        chance = screen.chance(screened, arena.blocks[0], self.rng)
        return judged[0] if float(judged[0].fit_gains.sum()) > chance.get(arena.label(judged[0]), 0.0) else None

    def _outdone(self, arena: Arena, generic: Judged, calibrated: Fit) -> bool:
        """Whether that generic law alone explains clearly more than all accepted effects together."""
        problem = self.fit_data.problem
        bare = arena.facing(fit(problem, arena.under, calibrated.plant, calibrated.x, 6))
        effect = arena.new(generic)[0]
        plant = calibrated.plant.with_effects([effect])
        rival = bare.judge(fit(problem, arena.under, plant, np.concatenate([bare.current.x, effect.null]), 10))
        named = bare.judge(arena.current)
        return rival.total > 1.25 * named.total and not arena.ties(rival, named)
