"""Where the candidates of one round meet: each is fitted to one model to beat, and judged by one yardstick."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.contest import Judged, mean
from nfc_gym.measured.fit import TURNING, Fit, fit, fit_last
from nfc_gym.measured.metric import Metric, loss, metric
from nfc_gym.measured.owned import Data, Told, heard
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.screen import Screened
from nfc_gym.measured.settle import slack
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.starting import starts
from nfc_gym.measured.steps import finer
from nfc_gym.measured.yardstick import Yardstick
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.each import Each, split
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_AT_HALF = 8  # iterations of a fit at half the step, with the slopes of the whole one
_CHORD = 10  # free parameters beyond which a candidate's refit reuses the Jacobian of the model to beat


class Arena(Yardstick):
    """Candidates that are fitted beside, or in place of, what the model to beat has, and judged."""

    def sharper(self, than: Fit) -> "Arena":
        """The arena under what another, better model leaves unexplained; where bodies touch, each by its own noise."""
        data, select, before = self.fit_data, self.select, self._heard
        if rough := data.problem.rough:
            told = heard(than, before)
            data, select = data.expected(told), select.expected(told)
        extra = slack(data.problem, data.sigma, than.plant, than.x)
        under = metric(data.problem, data.sigma, extra)
        current = fit(data.problem, under, self.current.plant, self.current.x, 6)
        told = heard(current, before)
        return Arena(data, select, current, under, extra, self.rng, self.say, own=rough, told=told)

    def halved(self) -> "Arena":
        """The arena of the same logs at half the physics step, for problems that are roll-outs.

        Raises:
          TypeError: the problem has no step.
        """
        problems = self.fit_data.problem, self.select.problem
        if not all(isinstance(p, RolloutProblem) for p in problems):
            raise TypeError("only roll-outs have a step to halve")
        data, select = (Data(p.halved(), d.sigma) for p, d in zip(problems, (self.fit_data, self.select), strict=True))
        current, told = _at_half(data.problem, self.under, self.current), self._told_at_half(self.current)
        return Arena(data, select, current, self.under, self.extra, self.rng, self.say, own=self.own, told=told)

    def enter_halved(self, duel: Sequence[Judged], whole: "Arena") -> list[Judged]:
        """Judge here, at half the step, rivals that were fitted in the arena of the whole one.

        Where each has a metric of its own, all are judged by those of all in turn, and by the mean of what they say.
        Rivals that predict much the same motion have much the same noise to expect, and the chance in what each was
        told of it may be worth more than all that lies between them. The noise follows from what was told at the whole
        step: a fit at half of it moves a model little.
        """
        told = [whole._told_at_half(j.fitted) for j in duel] if self.own else [None]
        found = []
        for j in duel:
            self.say(f"judging {self.label(j)} at half the physics step")
            at_half = _at_half(self.fit_data.problem, self.under, j.fitted)
            found.append(mean([self.judge(replace(at_half), each) for each in told]))
        return found

    def _told_at_half(self, fitted: Fit) -> Told:
        """Where a model of this arena told the noise that it expects, as a model at half the step."""
        plant, x = self._own(fitted).told
        return finer(plant), x

    # ---- entering ---------------------------------------------------------------------------------------------------

    def enter(self, picks: Sequence[Screened]) -> Judged:
        """Fit screened candidates with everything fitted so far, from where screening points or from where we are."""
        self.say(f"refitting {' and '.join(s.effect.id for s in picks)}")
        current = self.current
        plant = current.plant.with_effects([*current.plant.effects, *(s.effect for s in picks)])
        start = self._nearest(plant, starts(self.fit_data.problem, self.under, current, plant, picks))
        # Who leads is fitted again in full; where roll-outs are costly a first look must do with the slopes at hand.
        return self._refit(plant, start, 10, self.current.jacobian, quick=self.fit_data.problem.costly)

    def _refit(self, plant: Plant, start: Array, rounds: int, known: Array, quick: bool = False) -> Judged:
        """Fit and judge."""
        return self.judge(self._fit(plant, start, rounds, known, quick))

    def _fit(self, plant: Plant, start: Array, rounds: int, known: Array, quick: bool = False) -> Fit:
        """Fit; `known` (S, m, j) is the Jacobian of the first j free parameters.

        With few of them a full Jacobian costs little; with many, or for a quick look, they keep the one that they have
        (the chord method).
        """
        chord = known if quick or known.shape[-1] > _CHORD else None
        return fit(self.fit_data.problem, self.under, plant, start, rounds, known=chord, serve=TURNING)

    def enter_beside(self, leader: Judged, picks: Sequence[Screened]) -> Judged:
        """Fit screened candidates in a leading one's place, also from where the leader's fit took all the rest."""
        self.say(f"refitting {' and '.join(s.effect.id for s in picks)}, which does much the same")
        current = self.current
        plant = current.plant.with_effects([*current.plant.effects, *(s.effect for s in picks)])
        beside = np.concatenate([leader.fitted.x[: len(current.x)], *(s.theta for s in picks)])
        count = sum(len(s.effect.params) for s in picks)
        beside = fit_last(self.fit_data.problem, self.under, plant, beside, count)
        rows = np.vstack([beside, starts(self.fit_data.problem, self.under, current, plant, picks)])
        known = leader.fitted.jacobian[..., : current.jacobian.shape[-1]]
        return self._refit(plant, self._nearest(plant, rows), 10, known, quick=self.fit_data.problem.costly)

    def _nearest(self, plant: Plant, rows: Array) -> Array:
        """Of several parameter vectors (r, n) the one that leaves least."""
        white = self.under.whiten(self.fit_data.problem.residual(plant, rows))
        return rows[int(loss(white).sum(-1).argmin())]

    def enter_apart(self, start: Fit, effect: Effect) -> Judged | None:
        """Fit one of a fitted model's effects with values of its own at each place.

        None where there is but one place, or where that does hardly better than the one value.
        """
        parts = split(effect, start.plant)
        if parts is None:
            return None
        each, copies = parts
        psi, thetas = start.plant.split(start.x)
        of = {id(e): t for e, t in zip(start.plant.effects, thetas, strict=True)}
        others = [e for e in start.plant.effects if e is not effect]
        self.say(f"refitting {each.id} with values of its own at each place")
        plant = self.current.plant.with_effects([*others, each])
        x = np.concatenate([psi, *(of[id(e)] for e in others), of[id(effect)][copies]])
        found = self._fit(plant, x, 8, _slopes_of_others(start, effect))
        return self.judge(found) if self.pays(found, start) else None

    def without(self, effect: Effect) -> "Arena":
        """The same arena with the model to beat less one of its effects, refitted."""
        current = self.current
        psi, thetas = current.plant.split(current.x)
        pairs = [(e, t) for e, t in zip(current.plant.effects, thetas, strict=True) if e is not effect]
        plant = current.plant.with_effects([e for e, _ in pairs])
        x = np.concatenate([psi, *(t for _, t in pairs)])
        return self.facing(fit(self.fit_data.problem, self.under, plant, x, 8))

    def enter_again(self, other: Judged) -> Judged:
        """Go on with the fit of a candidate that comes from another arena."""
        return self.judge(self.again(other))

    def again(self, other: Judged) -> Fit:
        """The fit of a candidate that comes from another arena, gone on with here."""
        self.say(f"judging {self.label(other)}")
        plant, before = other.fitted.plant, self.current.plant.effects
        added = plant.effects[: len(before)] == before
        known = self.current.jacobian if added else np.zeros((*self.current.white.shape, 0))
        return self._fit(plant, other.fitted.x, 8, known)

    def enter_both(self, one: Judged, other: Judged) -> Judged | None:
        """Fit what two candidates add together, from where their own fits ended; None where one does as well alone."""
        effects, thetas = [], []
        for j in (one, other):
            added = {id(e) for e in self.new(j)}
            for e, theta in zip(j.fitted.plant.effects, j.fitted.plant.split(j.fitted.x)[1], strict=True):
                if id(e) in added:
                    effects.append(e)
                    thetas.append(theta)
        found = self._together(effects, thetas)
        return self.judge(found) if all(self.pays(found, j.fitted) for j in (one, other)) else None

    def enter_at(self, effects: Sequence[Effect], thetas: Sequence[Array]) -> Judged:
        """Fit laws together with everything fitted so far, from values (k,) of theirs."""
        return self.judge(self._together(effects, thetas))

    def _together(self, effects: Sequence[Effect], thetas: Sequence[Array]) -> Fit:
        self.say(f"refitting {' and '.join(e.id for e in effects)} together")
        current = self.current
        plant = current.plant.with_effects([*current.plant.effects, *effects])
        return self._fit(plant, np.concatenate([current.x, *thetas]), 10, current.jacobian)


def _at_half(problem: Problem, under: Metric, coarse: Fit) -> Fit:
    """A fit gone on with at half its step, by the slopes of the whole one."""
    return fit(problem, under, finer(coarse.plant), coarse.x, _AT_HALF, known=coarse.jacobian)


def _slopes_of_others(fitted: Fit, effect: Effect) -> Array:
    """(S, m, j) Jacobian of a fit by all free parameters but those of one effect."""
    psi = np.ones(int(fitted.plant.space.free.sum()), bool)
    keep = np.concatenate([psi, *(np.full(len(e.params), e is not effect) for e in fitted.plant.effects)])
    return fitted.jacobian[..., keep]


def contains(law: Effect, plain: Effect) -> bool:
    """Whether a law has a plainer one as its special case: it can then do no worse, and is no alternative to it."""
    same = set(plain.where) <= set(law.where)
    if law.family == plain.family:
        return same and isinstance(law, Each | Conditioned)
    return same and ((plain.family,) in law.simpler or plain.family in law.covers)


def alternatives(law: Effect, rivals: Sequence[str], pool: Sequence[Effect]) -> list[str]:
    """Of ids that do as well as a law, those that are alternatives to it and to each other, each once.

    A gale on hardly any drag is a push: beside the push, which does as well with less, the wind says nothing more.
    """
    known = {e.id: e for e in pool}
    laws = [law, *(known[i] for i in rivals if i in known)]
    return [i for i in dict.fromkeys(rivals) if i not in known or not contains_any([known[i]], laws)]


def contains_any(laws: Sequence[Effect], others: Sequence[Effect]) -> bool:
    """Whether one of some laws has one of others as its special case."""
    return any(contains(e, other) for e in laws for other in others if other is not e)
