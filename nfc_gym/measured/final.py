"""The last fits of a run: the calibrated and the extended model on every segment that does not verify."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured import marginal
from nfc_gym.measured.contest import clusters
from nfc_gym.measured.distances import Model
from nfc_gym.measured.elsewhere import STARTS, Ended, hollows, resized
from nfc_gym.measured.fit import Fit, differs, stand
from nfc_gym.measured.halved import step_error
from nfc_gym.measured.metric import Metric, metric
from nfc_gym.measured.owned import heard
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.run import Run
from nfc_gym.measured.search import Found
from nfc_gym.measured.settle import settle
from nfc_gym.measured.verdict import Open
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_NOTHING = 0.5  # of the chance that an effect without size would seem smaller: a median one of these is no effect


def final_models(run: Run, found: Found, whole: Problem) -> tuple[Model, Fit, Open]:
    """Calibrated and extended model refitted on every fit segment; what search and step leave open of the latter."""
    assert found.rest is not None
    last = found.rest.fitted
    effects = bool(last.plant.effects)
    # Psi alone began its way here from several places; its intervals are asked for only where there is nothing beside.
    calibrated = extended = _settled(run, "calibrated", found.calibrated, whole, starts=0 if effects else STARTS)
    if effects:
        # What psi alone went to is another place for the same psi to begin.
        psi = calibrated.x[: len(last.plant.space)]
        extended = _settled(run, "extended", last, whole, (np.concatenate([psi, last.x[len(psi) :]]),))
        if gone := [e for e in last.plant.effects if not differs(extended.fitted, clusters(whole), e, _NOTHING)]:
            why = f"dropped {', '.join(e.id for e in gone)}: on all segments together its size comes to nothing"
            run.say(why)
            found.rounds.insert(len(found.rounds) - 1, Round([], 0.0, reason=why))  # the last one found nothing more
            rest = _without(extended.fitted, gone)
            extended = _settled(run, "extended, less", rest, whole) if rest.plant.effects else calibrated
    left = Open(extended.unsure, step_error(whole, extended.under, extended.fitted))
    return Model(calibrated.plant, calibrated.x), extended.fitted, left


def _without(fitted: Fit, gone: Sequence[Effect]) -> Fit:
    """A model less some of its effects, the other parameters as they were; to begin a fit from."""
    psi, thetas = fitted.plant.split(fitted.x)
    pairs = [(e, t) for e, t in zip(fitted.plant.effects, thetas, strict=True) if not any(e is g for g in gone)]
    plant = fitted.plant.with_effects([e for e, _ in pairs])
    return replace(fitted, plant=plant, x=np.concatenate([psi, *(t for _, t in pairs)]))


@dataclass
class _Settled:
    """A model on every fit segment, and (size,) what the search for its parameters leaves open.

    Psi alone beside effects is asked for its parameters alone: noise and slopes are rolled out for who wants them.

    Attributes:
      whole: the segments.
      plant, x: the model.
      extra: (m,) slack of its metric.
      unsure: (size,).
      told: (size,) where it told the noise of its metric.
    """

    whole: Problem
    plant: Plant
    x: Array
    extra: Array
    unsure: Array
    told: Array

    @cached_property
    def under(self) -> Metric:
        """The metric that it was fitted under."""
        return metric(self.whole, self.whole.covariance(self.plant, self.told), self.extra)

    @cached_property
    def fitted(self) -> Fit:
        """The model as it stands."""
        return stand(self.whole, self.under, self.plant, self.x)


def _settled(
    run: Run, name: str, start: Fit, whole: Problem, others: tuple[Array, ...] = (), starts: int = STARTS
) -> _Settled:
    """Fit a model from where it stands and, where bodies touch, from other places (size,) or over drawn starts too."""
    plant, stage = start.plant, f"final {name}"
    if run.stages.get(stage) is None:
        run.say(f"fitting the {name} model on all {len(whole)} segments")
        fitted, under, extra = settle(whole, whole.covariance(plant, start.x), plant, start.x)
        if not whole.rough and (other := resized(whole, under, fitted)) is not fitted:
            fitted, under, extra = settle(whole, whole.covariance(plant, other.x), plant, other.x)
        if run.bench.short:
            tick = lambda k: run.say(f"fitting the {name} model over drawn starts, turn {k} of {marginal.TURNS}")  # noqa: E731
            ended = marginal.marginal(whole, under, fitted, run.seed, tick)
        else:
            tick = lambda k: run.say(f"fitting the {name} model from elsewhere, start {k}")  # noqa: E731
            ended = hollows(whole, under, extra, fitted, run.seed, others, starts, tick, start.x)
        told = _told(fitted, start.x, ended) if whole.rough else start.x
        kept = {"x": ended.x, "slack": extra, "unsure": ended.unsure, "told": told}
        run.stages.put(stage, {k: v.tolist() for k, v in kept.items()})
    return _Settled(
        whole, plant, *(np.array(run.stages.get(stage)[k], float) for k in ("x", "slack", "unsure", "told"))
    )


def _told(fitted: Fit, start: Array, ended: Ended) -> Array:
    """(size,) where a model tells its noise in the end; it told it before at `start` (size,), where its fit began."""
    return heard(fitted, [(fitted.plant, start)], ended.x)[1] if ended.told is None else ended.told
