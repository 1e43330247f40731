"""One model to beat and one common metric: what a fitted candidate is worth by them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.contest import (
    Judged,
    Side,
    clusters,
    dispersion,
    fitted_residual,
    fold_of,
    judge,
    left_out,
    losses,
    not_worse,
    price,
)
from nfc_gym.measured.fit import Fit, differs
from nfc_gym.measured.metric import Metric, loss, loss_weight, metric
from nfc_gym.measured.owned import Data, Owned, Told, heard, owned
from nfc_gym.measured.screen import Screened
from nfc_gym.measured.settle import slack
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.param import Param

Array = NDArray[np.float64]
HOPE = 0.25  # of the gain that a law must reach: what a cheap look must promise for a dear one to be worth its time
_EDGE = 1e-2  # of a parameter's range: nearer to a bound than this is at it
_ALIKE = 0.1  # of a parameter's effect on the motion: what must remain when all others imitate it


class Yardstick:
    """One model to beat, under one metric.

    Args:
      fit_data, select: logs that candidates are fitted to, and logs that they are judged on besides.
      current: the model to beat, fitted under `under`.
      under: metric of the fit logs.
      extra: (m,) its slack, which the selection logs' metric shares.
      rng: of the bootstrap.
      say: progress.
      own: judge each model, fitted so, by a metric of its own: the noise that it expects and the slack that it needs,
        at the price of both. Where bodies touch, noise grows with the model's own impacts, and what one model expects
        or leaves unexplained would excuse its errors and not a rival's.
      told: where the model to beat tells that noise, if not where it stands.
    """

    def __init__(
        self,
        fit_data: Data,
        select: Data,
        current: Fit,
        under: Metric,
        extra: Array,
        rng: np.random.Generator,
        say: Callable[[str], None],
        own: bool = False,
        told: Told | None = None,
    ) -> None:
        self.fit_data, self.select, self.current, self.under, self.rng, self.say = (
            fit_data, select, current, under, rng, say,
        )  # fmt: skip
        self.on, self.extra, self.own = metric(select.problem, select.sigma, extra), extra, own
        self.blocks = clusters(fit_data.problem), clusters(select.problem)
        self.folds = fold_of(fit_data.problem)
        self._owned: dict[int, Owned] = {}
        self._heard: list[Told] = [] if fit_data.by is None else [fit_data.by]
        self._face(current, told)

    def _face(self, current: Fit, told: Told | None = None) -> None:
        self.current, own = current, self._own(current, told)
        self.base = losses(self.select.problem, self.on, current)
        self._sides = (
            Side(
                self.fit_data.problem,
                self.blocks[0],
                left_out(self.fit_data.problem, own.by[0], own.fitted, self.folds),
            ),
            Side(
                self.select.problem,
                self.blocks[1],
                own.by[1].surprise(fitted_residual(self.select.problem, own.fitted))[0],
            ),
        )

    def _own(self, fitted: Fit, told: Told | None = None) -> Owned:
        """A model as it is judged; `told` is where it tells the noise that it expects, if that is known."""
        if not self.own:
            return Owned(fitted, (self.under, self.on), fitted, fitted, (fitted.plant, fitted.x))
        if id(fitted) not in self._owned:
            told = told or heard(fitted, self._heard)
            self._heard.append(told)
            one = owned(fitted, self.fit_data, self.select, self.under, told)
            self._owned |= {id(fitted): one, id(one.seen): one}
        return self._owned[id(fitted)]

    def facing(self, current: Fit) -> Self:
        """The same with another model to beat."""
        out = object.__new__(type(self))
        out.__dict__.update(self.__dict__)
        out._face(current)
        return out

    def drop(self, fitted: Fit, than: Fit) -> float:
        """By how much the loss of one model is below another's, on both sets of logs, under the common metric.

        What a judgement by metrics of their own costs a hundred times as much to say.
        """
        on_select = [float(losses(self.select.problem, self.on, f).sum()) for f in (than, fitted)]
        on_fit = [
            float(loss(self.under.whiten(fitted_residual(self.fit_data.problem, f))).sum()) for f in (than, fitted)
        ]
        return sum(before - after for before, after in (on_select, on_fit))

    def pays(self, fitted: Fit, than: Fit) -> bool:
        """Whether a fit may be worth the parameters that it has more than another: by what the common metric says.

        Where every model is judged by the one metric, the judgement itself costs no more and is asked at once.
        """
        return not self.own or self.drop(fitted, than) > HOPE * self.cost(len(fitted.x) - len(than.x))

    def judge(self, fitted: Fit, told: Told | None = None) -> Judged:
        """Compare a fitted model with the one to beat; `told` as for `Owned`."""
        own = self._own(fitted, told)
        judged = judge(own.fitted, self.current, own.by, self._sides, self.folds, self.rng)
        return replace(judged, fitted=own.seen)

    @property
    def leftover(self) -> float:
        """What the model that set the metric leaves beyond the noise: nats a number, 0 if nothing."""
        return self._beyond(self.extra)

    @property
    def remains(self) -> float:
        """Loss that the model to beat leaves beyond the noise, at most: of columns' slack, or of single blocks'."""
        return max(2 * self.leftover, self.misfit / max(self._numbers, 1) - 1, 0.0) * self._numbers

    def leaves(self, fitted: Fit) -> float:
        """The same for a fitted model, whoever set the metric."""
        data = self.fit_data
        return self._beyond(slack(data.problem, data.sigma, fitted.plant, fitted.x))

    def _beyond(self, extra: Array) -> float:
        """Nats a number of a slack (m,) beyond the noise."""
        noise = np.einsum("sii->i", self.fit_data.sigma) / max(len(self.fit_data.problem), 1)
        return float(0.5 * np.log1p(extra / np.maximum(noise, 1e-30)).mean())

    def likelier(self, j: Judged) -> bool:
        """Whether a candidate is likelier than the model to beat by more than its price, each with its own slack."""
        cost = 0.5 * np.log(max(self._numbers, 2)) * (len(j.fitted.x) - len(self.current.x))
        return self.unexplained(j.fitted) + cost < self.unexplained(self.current)

    def unexplained(self, fitted: Fit) -> float:
        """What a model leaves, under a slack of its own: minus the log-likelihood with the slack at its best.

        Under one common metric whoever set the metric is favoured: errors that it never mended count for little.
        """
        total = 0.0
        for data in (self.fit_data, self.select):
            noise = np.einsum("sii->i", data.sigma) / max(len(data.problem), 1)
            variance = slack(data.problem, data.sigma, fitted.plant, fitted.x) + noise
            total += 0.5 * float(data.problem.mask.sum(0) @ np.log(np.maximum(variance, 1e-30)))
        return total

    # ---- verdicts ---------------------------------------------------------------------------------------------------

    def sure(self, j: Judged) -> bool:
        """Whether a gain holds on unseen logs.

        The selection logs may show nothing of it (a limit that they never reach), but must not speak against it by
        more than the noise of one number.
        """
        return j.lower > 0 and j.gain > -dispersion(self.current)

    def worth(self, j: Judged, share: float) -> bool:
        """Whether a gain holds on unseen logs and is a share of the misfit worth naming."""
        return self.sure(j) and j.total > share * self.misfit

    def objection(self, j: Judged, share: float) -> str:
        """Why a candidate is not believed, in words; empty where nothing speaks against it.

        Whether others could imitate it is asked where bodies touch: fits end in one of many hollows there, and a
        candidate may gain by leading to another. Elsewhere what others could do they have done in the model to beat,
        and a gain is the candidate's own: a friction that bends with speed hardly differs from a straight one in its
        slopes, and by much in what it leaves.

        Args:
          j: the candidate.
          share: of the misfit that an effect must explain to be named.
        """
        if not self.sure(j):
            return "gains no more on unseen logs than chance"
        if not self.worth(j, share):
            return f"gains less than its numbers cost and {100 * share:.2g} % of what is left"
        if not self.plausible(j):
            return "ends at the edge of what is plausible"
        if self.fit_data.problem.rough and not self.told_apart(j):
            return "does what the other parameters could do together"
        return ""

    def believed(self, j: Judged, share: float) -> bool:
        """Whether nothing speaks against a candidate, see `objection`."""
        return not self.objection(j, share)

    @property
    def misfit(self) -> float:
        """Loss of the model to beat on both sets of logs."""
        return float(self.base.sum()) + float(self.current.losses.sum())

    def asked(self, found: Screened, share: float) -> float:
        """What a screened candidate must gain on both sets of logs: its price, and a share worth naming."""
        return self.cost(len(found.effect.params)) + share * self.misfit

    def cost(self, parameters: int) -> float:
        """Of so many more parameters."""
        return price(self._numbers, parameters, dispersion(self.current))

    def promises(self, found: Screened) -> float:
        """What a screened candidate would gain on both sets of logs if screening were right."""
        return self.on_both(found.gain)

    def on_both(self, gain: float) -> float:
        """What a gain on the fit logs would be on both sets of logs."""
        return gain * self._numbers / max(int(self.fit_data.problem.mask.sum()), 1)

    @property
    def _numbers(self) -> int:
        """How many are compared, on both sets of logs."""
        return int(self.fit_data.problem.mask.sum()) + int(self.select.problem.mask.sum())

    def ties(self, best: Judged, other: Judged, *, priced: bool = True) -> bool:
        """Whether `other` is not significantly worse, the price of its parameters counted or not."""
        return not_worse(best, other, *self.blocks, self.rng, priced=priced)

    def nearer(self, one: Judged, other: Judged) -> bool:
        """Whether two candidates are one thing that two bodies could carry, hung by the first on the one nearer to it.

        So it is where one family at two places predicts the same motion: all that lies between the predictions is less
        than what a single parameter must gain, and no logs like these could tell the two apart.
        """
        laws = self.new(one), self.new(other)
        if any(len(new) != 1 for new in laws) or laws[0][0].family != laws[1][0].family:
            return False
        apart = float(((one.fitted.white - other.fitted.white) ** 2).sum())
        far = [new[0].outlying(j.fitted.x[_of(j.fitted, new[0])]) for new, j in zip(laws, (one, other), strict=True)]
        return apart < self.cost(1) and far[0] < far[1]

    def plausible(self, j: Judged) -> bool:
        """Whether no parameter that a candidate adds ended at the edge of what is plausible.

        A law that wants to go beyond stands in for another: what fits where the logs were taken then fails elsewhere.
        """
        thetas = dict(zip(map(id, j.fitted.plant.effects), j.fitted.plant.split(j.fitted.x)[1], strict=True))
        return not any(
            _at_edge(p, value) for e in self.new(j) for p, value in zip(e.params, thetas[id(e)], strict=True)
        )

    def vague(self) -> list[Effect]:
        """Effects of the model to beat whose fitted sizes do not differ from nothing."""
        return [e for e in self.current.plant.effects if not differs(self.current, self.blocks[0], e)]

    def told_apart(self, j: Judged) -> bool:
        """Whether any of a candidate's parameters moves the motion in a way that the others could not imitate."""
        new = {id(e) for e in self.new(j)}
        plant = j.fitted.plant
        of = np.concatenate(
            [
                np.zeros(int(plant.space.free.sum()), bool),
                *(np.full(len(e.params), id(e) in new) for e in plant.effects),
            ]
        )
        slopes = (loss_weight(j.fitted.white)[..., None] * j.fitted.jacobian).reshape(-1, len(of))
        own, others = slopes[:, of], slopes[:, ~of]
        left = own - others @ np.linalg.lstsq(others, own, rcond=1e-6)[0] if others.shape[1] else own
        size = np.maximum(np.linalg.norm(own, axis=0), 1e-12)
        return bool((np.linalg.norm(left, axis=0) > _ALIKE * size).any())

    # ---- words ------------------------------------------------------------------------------------------------------

    def new(self, j: Judged) -> list[Effect]:
        """What a candidate adds to (or splits in) the model to beat."""
        before = set(map(id, self.current.plant.effects))
        return [e for e in j.fitted.plant.effects if id(e) not in before]

    def label(self, j: Judged) -> str:
        """Ids of what a candidate adds."""
        return " + ".join(e.id for e in self.new(j))

    def row(self, j: Judged) -> dict:
        """A candidate as the report ranks it."""
        thetas = dict(zip(map(id, j.fitted.plant.effects), j.fitted.plant.split(j.fitted.x)[1], strict=True))
        new = self.new(j)
        return {
            "id": self.label(j),
            "gain_fit": float(j.fit_gains.sum()),
            "share": self._share(j.fit_gains, self.current.losses, lambda: j.fitted.losses),
            "gain_select": j.gain,
            "gain_select_low": j.lower,
            "generic": new[0].generic,
            "sentence": " ".join(e.say(thetas[id(e)]) for e in new),
        }

    def explained(self, j: Judged) -> float:
        """Share of the selection logs' misfit that a candidate explains, at most 1."""
        return self._share(j.gains, self.base, lambda: losses(self.select.problem, self.on, j.fitted))

    def _share(self, gains: Array, before: Array, after: Callable[[], Array]) -> float:
        """Of a misfit (S,), told by the common metric: gains by metrics of their own are no part of it."""
        gained = before.sum() - after().sum() if self.own else gains.sum()
        return float(gained / max(before.sum(), 1e-9))


def _of(fitted: Fit, effect: Effect) -> NDArray[np.bool_]:
    """(size,) which of a fit's parameters are an effect's."""
    psi = np.zeros(len(fitted.plant.space), bool)
    return np.concatenate([psi, *(np.full(len(e.params), e is effect) for e in fitted.plant.effects)])


def _at_edge(param: Param, value: float) -> bool:
    """Whether a parameter ended at a bound that it would rather pass.

    A bound nearer to null than any size that counts is none: damping can be less than the model's by what that has.
    """
    if param.shape or param.natural:
        return False
    for bound in (param.low, param.high):
        room = abs(bound - param.null)
        if room > param.resolution and abs(value - bound) <= _EDGE * min(param.high - param.low, 2 * room):
            return True
    return False
