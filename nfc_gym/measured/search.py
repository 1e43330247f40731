"""The search for what a model lacks: calibrate psi, screen candidates, refit the best, select on held-out logs, repeat.

Method and its reasons: Kennedy and O'Hagan (2001) for the discrepancy that must not be credited to psi; score tests
with secants for the screening; a moving-block bootstrap (Kuensch 1989) for what is believed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import box
from nfc_gym.measured.contest import Judged, clusters, fold_of, judge, left_out_losses, losses, not_worse, shortlist
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.metric import Metric, loss, loss_weight, metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.screen import Screen, Screened, screen_all
from nfc_gym.measured.settle import settle
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.each import Each, split

Array = NDArray[np.float64]
Say = Callable[[str], None]
_NEARLY = 0.95  # share of the best candidate's gain that a simpler law must reach to be preferred
_SHARED = 0.8  # the same for the same law at a wider place
_FIELD, _THIN = 30, 3  # a larger pool of candidates is first thinned to so many, on every third block
_KEEP = 60  # candidates that are screened again in every round, whatever they gained
_LEADING = 0.7  # of the best gain: what a law at several places must reach to be tried with values of their own
_ALIKE = 0.1  # of a parameter's effect on the motion: what must remain when all others imitate it
_CHORD = 10  # free parameters beyond which a candidate's refit reuses psi's Jacobian


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


@dataclass
class Data:
    """A problem with its noise covariance at the calibrated model."""

    problem: Problem
    sigma: Array


class Search:
    """One greedy search on fit and selection problems."""

    def __init__(self, fit_data: Data, select: Data, candidates: Sequence[Effect], options: Options, say: Say) -> None:
        self.fit_data, self.select = fit_data, select
        self.named = [e for e in candidates if not e.generic]
        self.generics = [e for e in candidates if e.generic]
        self.hopeless: set[str] = set()
        self.options, self.say = options, say
        self.rng = np.random.default_rng(options.seed)
        self.fit_blocks, self.select_blocks = clusters(fit_data.problem), clusters(select.problem)
        self.folds = fold_of(fit_data.problem)
        self.left_out: tuple[Fit | None, Metric | None, Array] = (
            None,
            None,
            np.zeros(0),
        )  # of the model candidates are compared with

    def settle(self, current: Fit) -> tuple[Fit, Metric, Metric]:
        """The model refitted, and the common metrics of the round that starts from it."""
        data = self.fit_data
        fitted, under, extra = settle(data.problem, data.sigma, current.plant, current.x, self.options.seed)
        return fitted, under, metric(self.select.problem, self.select.sigma, extra)

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
        current, fit_metric, select_metric = self.settle(current)
        while True:
            screen = Screen(self.fit_data.problem, fit_metric, current)
            screened = self._screen(screen, self.named, current)
            outcome, best = self._round(screen, screened, current, fit_metric, select_metric)
            if best is not None and (better := self._psi_alone(best, current, fit_metric)) is not None:
                # What psi can do by itself is not the candidate's to claim: the round begins again from there.
                self.say("the candidate's psi alone does better than the model before it: judging again")
                current = better
                outcome, best = self._round(screen, screened, current, fit_metric, select_metric)
            rounds.append(outcome)
            if best is None or len(current.plant.effects) >= self.options.most:
                break
            current, fit_metric, select_metric = self.settle(best.fitted)
            current = self._prune(current, fit_metric, select_metric)
            keep(current, rounds)
        generic = self._generic(screen, current, fit_metric, select_metric, outcome)
        if (
            generic is not None
            and current.plant.effects
            and self._outdone(generic, calibrated, current, fit_metric, select_metric)
        ):
            self.say("a generic law explains clearly more than all named effects: none is claimed")
            current = fit(self.fit_data.problem, fit_metric, calibrated.plant, calibrated.x, 6)
        return Found(calibrated, current, rounds, generic, screened)

    def _psi_alone(self, best: Judged, current: Fit, under: Metric) -> Fit | None:
        """The model without the candidate, fitted from where the candidate's fit took the rest, if that is better.

        Fits of robots in contact end in one of many hollows; leading to another is no merit of a candidate.
        """
        if not self.fit_data.problem.rough or len(best.fitted.plant.effects) != len(current.plant.effects) + 1:
            return None
        start = best.fitted.x[: len(current.x)]
        other = fit(self.fit_data.problem, under, current.plant, start, 10)
        gained = float(current.losses.sum() - other.losses.sum())
        return other if gained > 0.1 * float(best.fit_gains.sum() + best.gain) else None

    def _screen(self, screen: Screen, pool: Sequence[Effect], current: Fit) -> list[Screened]:
        taken = {e.id.removesuffix(":each") for e in current.plant.effects}
        left = [e for e in pool if e.id not in taken and (e.id not in self.hopeless or len(e.where) > 1)]
        self.say(f"screening {len(left)} candidates")
        found = screen_all(screen, self._promising(screen, left))
        # Places that show nothing at all are not looked at again; sets of places stay, since they stand for many.
        floor = 1e-3 * float(screen.projected @ screen.projected)
        self.hopeless |= {f.effect.id for f in found[_KEEP:] if f.gain < floor}
        return found

    def _promising(self, screen: Screen, pool: list[Effect]) -> list[Effect]:
        """Of a large pool, those that do best on every third block, and the best of each family."""
        blocks = len(self.fit_data.problem)
        if len(pool) <= _FIELD or blocks < _THIN * 20:
            return pool
        index = np.arange(0, blocks, _THIN)
        current = screen.current
        part = Fit(current.plant, current.x, current.white[index], current.jacobian[index])
        rough = screen_all(Screen(self.fit_data.problem.take(index), screen.metric.take(index), part), pool)
        families = {r.effect.family: r.effect for r in reversed(rough)}
        best = [r.effect for r in rough[:_FIELD]]
        return best + [e for e in families.values() if e not in best]

    def _generic(
        self, screen: Screen, current: Fit, fit_metric: Metric, select_metric: Metric, outcome: Round
    ) -> Judged | None:
        """The smooth law of position, speed or time that still adds most to the accepted effects, if it is believed."""
        screened = self._screen(screen, self.generics, current)
        if not screened:
            return None
        base_losses = losses(self.select.problem, select_metric, current)
        judged = [self._try(current, [s], fit_metric, select_metric, base_losses) for s in screened[:3] if s.gain > 0]
        judged.sort(key=lambda j: -j.total)
        outcome.ranking += [self._row(j, current) for j in judged]
        chance = screen.chance(screened, self.fit_blocks, self.rng)
        return judged[0] if judged and self._believed(judged[0], chance, current, base_losses) else None

    def _outdone(
        self, generic: Judged, calibrated: Fit, current: Fit, fit_metric: Metric, select_metric: Metric
    ) -> bool:
        """Whether that generic law alone explains clearly more than all accepted effects together."""
        base = self.refit(calibrated, fit_metric, rounds=6)
        base_losses = losses(self.select.problem, select_metric, base)
        effect = self._new(generic, current)[0]
        plant = base.plant.with_effects([effect])
        alone = fit(self.fit_data.problem, fit_metric, plant, np.concatenate([base.x, effect.null]), 10)
        rival = self._judge(alone, base, fit_metric, select_metric, base_losses)
        named = self._judge(current, base, fit_metric, select_metric, base_losses)
        return rival.total > 1.25 * named.total and not not_worse(
            rival, named, self.fit_blocks, self.select_blocks, self.rng
        )

    def _round(
        self, screen: Screen, screened: list[Screened], current: Fit, fit_metric: Metric, select_metric: Metric
    ) -> tuple[Round, Judged | None]:
        """Refit the shortlist, judge it on the selection logs, and decide."""
        chance = screen.chance(screened, self.fit_blocks, self.rng)
        base_losses = losses(self.select.problem, select_metric, current)
        judged: list[Judged] = []
        for s in shortlist(screened, self.options.short):
            self.say(f"refitting {s.effect.id}")
            judged.append(self._try(current, [s], fit_metric, select_metric, base_losses))
        judged += self._apart(judged, current, fit_metric, select_metric, base_losses)
        judged.sort(key=lambda j: -j.total)
        outcome = Round([], 0.0, [self._row(j, current) for j in judged])
        believed = [j for j in judged if self._believed(j, chance, current, base_losses)]
        if not believed:
            name = self._label(judged[0], current) if judged else ""
            outcome.reason = (
                f"the best candidate, {name}, gains no more on unseen logs than chance"
                if judged
                else "no candidate reduces the misfit"
            )
            return outcome, None
        best = self._simplest(believed, screen, screened, current, fit_metric, select_metric, base_losses)
        outcome.accepted = [e.id for e in self._new(best, current)]
        outcome.share = best.gain / max(float(base_losses.sum()), 1e-9)
        outcome.equivalents = [
            self._label(j, current)
            for j in judged
            if self._label(j, current) not in outcome.accepted
            and j.total > _NEARLY * best.total
            and not any(_contains(e, w) for e in self._new(j, current) for w in self._new(best, current))
            and self._ties(believed[0], j)
        ]
        self.say(f"accepted {', '.join(outcome.accepted)}")
        return outcome, best

    def _apart(
        self, judged: Sequence[Judged], current: Fit, fit_metric: Metric, select_metric: Metric, base_losses: Array
    ) -> list[Judged]:
        """Values of their own at each place: for what was accepted before, and for the leading laws at several places.

        Asked in the same round, lest a law that suits all places alike with more parameters of its own wins first.
        """
        best = max((j.total for j in judged), default=0.0)
        pairs = [(current, e) for e in current.plant.effects]
        families: set[str] = set()
        for j in sorted(judged, key=lambda j: -j.total):
            new = self._new(j, current)
            if len(new) == 1 and len(new[0].where) > 1 and j.total > _LEADING * best and new[0].family not in families:
                families.add(new[0].family)
                pairs.append((j.fitted, new[0]))
        out = []
        for start, effect in pairs:
            parts = split(effect, current.plant)
            if parts is not None:
                out.append(self._try_split(start, effect, parts, current, fit_metric, select_metric, base_losses))
        return out

    def _enough(self, j: Judged, best: Judged, current: Fit) -> float:
        """Share of the best gain a rival must reach: less for the best one's law at a place that includes its place."""
        rival, winner = self._new(j, current)[0], self._new(best, current)[0]
        wider = rival.family == winner.family and set(winner.where) < set(rival.where)
        return _SHARED if wider else _NEARLY

    def _ties(self, best: Judged, other: Judged) -> bool:
        return not_worse(best, other, self.fit_blocks, self.select_blocks, self.rng)

    def _simplest(
        self,
        believed: list[Judged],
        screen: Screen,
        screened: list[Screened],
        current: Fit,
        fit_metric: Metric,
        select_metric: Metric,
        base_losses: Array,
    ) -> Judged:
        """Of the candidates that explain the data as well as the best: fewest parameters, then widest place.

        A law whose own feature does not show gives way to the plainer laws that it contains; and a cause that like
        parts share is likelier than the same cause in just one of them, unless the data tell them apart.
        """
        best = believed[0]
        rivals = [j for j in believed if j.total > self._enough(j, best, current) * best.total and self._ties(best, j)]
        by_id = {s.effect.id: s for s in screened}
        effect = self._new(best, current)[0]
        added = len(best.fitted.plant.effects) > len(current.plant.effects)
        for families in effect.simpler if added else ():
            parts = [by_id[i] for f in families if (i := f"{f}:{effect.place}") in by_id]
            if len(parts) < len(families):
                continue
            if isinstance(effect, Each):
                apart = [split(p.effect, current.plant) for p in parts]
                parts = [screen.try_one(a[0]) for a in apart if a is not None]
            self.say(f"refitting {' and '.join(families)} instead")
            plain = self._try(current, parts, fit_metric, select_metric, base_losses)
            if plain.lower > 0 and plain.total > _NEARLY * best.total and self._ties(best, plain):
                rivals.append(plain)
        return min(rivals, key=lambda j: (len(j.fitted.x), -len(self._new(j, current)[0].where), -j.total))

    def _try(
        self, current: Fit, picks: Sequence[Screened], fit_metric: Metric, select_metric: Metric, base_losses: Array
    ) -> Judged:
        """Refit screened candidates with everything fitted so far, from where screening points or where we are."""
        plant = current.plant.with_effects([*current.plant.effects, *(s.effect for s in picks)])
        limits, thetas = box(current.plant), [s.theta for s in picks]
        moved = limits.x(limits.at(current.x) + picks[0].shift, current.x)
        starts = np.stack([np.concatenate([x, *thetas]) for x in (moved, current.x)])
        white = fit_metric.whiten(self.fit_data.problem.residual(plant, starts))
        start = starts[int(loss(white).sum(-1).argmin())]
        # With few parameters a full Jacobian costs little; with many, psi keeps the one that it has (the chord method).
        known = current.jacobian if len(limits.scale) > _CHORD else None
        fitted = fit(self.fit_data.problem, fit_metric, plant, start, 10, known=known)
        return self._judge(fitted, current, fit_metric, select_metric, base_losses)

    def _try_split(
        self,
        start: Fit,
        effect: Effect,
        parts: tuple[Effect, NDArray[np.intp]],
        current: Fit,
        fit_metric: Metric,
        select_metric: Metric,
        base_losses: Array,
    ) -> Judged:
        """The same effect with a value of its own at each place."""
        each, copies = parts
        psi, thetas = start.plant.split(start.x)
        pieces: list[Array] = [psi]
        effects: list[Effect] = []
        for e, theta in zip(start.plant.effects, thetas, strict=True):
            effects.append(each if e is effect else e)
            pieces.append(theta[copies] if e is effect else theta)
        self.say(f"refitting {each.id} with values of its own at each place")
        plant = current.plant.with_effects(effects)
        fitted = fit(self.fit_data.problem, fit_metric, plant, np.concatenate(pieces), 8)
        return self._judge(fitted, current, fit_metric, select_metric, base_losses)

    def _judge(self, fitted: Fit, base: Fit, fit_metric: Metric, select_metric: Metric, base_losses: Array) -> Judged:
        if self.left_out[0] is not base or self.left_out[1] is not fit_metric:
            self.left_out = (base, fit_metric, left_out_losses(self.fit_data.problem, fit_metric, base, self.folds))
        return judge(
            fitted, base, self.fit_data.problem, fit_metric, self.left_out[2], self.folds, self.fit_blocks,
            self.select.problem, select_metric, base_losses, self.rng,
        )  # fmt: skip

    def _believed(self, j: Judged, chance: dict[str, float], current: Fit, base_losses: Array) -> bool:
        """Whether the gain holds on unseen logs, is worth naming, and exceeds the luckiest candidate's by chance."""
        if not self._told_apart(j, current):
            return False
        worth = self.options.worth * (float(base_losses.sum()) + float(current.losses.sum()))
        lucky = max((chance.get(e.id, 0.0) for e in self._new(j, current)), default=0.0)
        return j.lower > 0 and j.gain > 0 and j.total > worth and float(j.fit_gains.sum()) > lucky

    def _told_apart(self, j: Judged, current: Fit) -> bool:
        """Whether any of a candidate's parameters moves the motion in a way that the others could not imitate."""
        new = {id(e) for e in self._new(j, current)}
        of = np.concatenate(
            [
                np.zeros(int(j.fitted.plant.space.free.sum()), bool),
                *(np.full(len(e.params), id(e) in new) for e in j.fitted.plant.effects),
            ]
        )
        weight = loss_weight(j.fitted.white)
        slopes = (weight[..., None] * j.fitted.jacobian).reshape(-1, len(of))
        own, others = slopes[:, of], slopes[:, ~of]
        size = np.linalg.norm(own, axis=0)
        left = own - others @ np.linalg.lstsq(others, own, rcond=1e-6)[0] if others.shape[1] else own
        return bool((np.linalg.norm(left, axis=0) > _ALIKE * np.maximum(size, 1e-12)).any())

    @staticmethod
    def _new(j: Judged, current: Fit) -> list[Effect]:
        """What a candidate adds to (or splits in) the current model."""
        before = set(map(id, current.plant.effects))
        return [e for e in j.fitted.plant.effects if id(e) not in before]

    def _label(self, j: Judged, current: Fit) -> str:
        return " + ".join(e.id for e in self._new(j, current))

    def _row(self, j: Judged, current: Fit) -> dict:
        thetas = dict(zip(map(id, j.fitted.plant.effects), j.fitted.plant.split(j.fitted.x)[1], strict=True))
        new = self._new(j, current)
        return {
            "id": self._label(j, current),
            "gain_fit": float(j.fit_gains.sum()),
            "gain_select": j.gain,
            "gain_select_low": j.lower,
            "generic": new[0].generic,
            "sentence": " ".join(e.say(thetas[id(e)]) for e in new),
        }

    def _prune(self, current: Fit, fit_metric: Metric, select_metric: Metric) -> Fit:
        """Drop earlier effects that the later ones have made superfluous."""
        for effect in list(current.plant.effects[:-1]):
            rest = [e for e in current.plant.effects if e is not effect]
            psi, thetas = current.plant.split(current.x)
            start = np.concatenate(
                [psi, *(t for e, t in zip(current.plant.effects, thetas, strict=True) if e is not effect)]
            )
            without = fit(self.fit_data.problem, fit_metric, current.plant.with_effects(rest), start, 8)
            base = losses(self.select.problem, select_metric, without)
            kept = self._judge(current, without, fit_metric, select_metric, base)
            if kept.lower <= 0 or kept.total < self.options.worth * (float(base.sum()) + float(without.losses.sum())):
                self.say(f"dropped {effect.id}: the others explain what it did")
                current = without
        return current


def _contains(law: Effect, plain: Effect) -> bool:
    """Whether a law has a plainer one as its special case: it can then do no worse, and is no alternative to it."""
    same = set(plain.where) <= set(law.where)
    if law.family == plain.family:
        return same and isinstance(law, Each)
    return same and (plain.family,) in law.simpler
