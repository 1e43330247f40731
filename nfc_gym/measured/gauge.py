"""Which fitted parameters slide together: directions in which the motion says next to nothing.

Without a force sensor mass, inertia, gain and drag can all be scaled by one factor, and no motion changes: a gauge. It
shows as a direction of the Fisher matrix that is nearly null although each parameter by itself is well seen.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from nfc_gym.measured.box import box
from nfc_gym.measured.fisher import flat, free_names
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.metric import loss_weight
from nfc_gym.measured.wording import listed

Array = NDArray[np.float64]
_SEEN = 0.25 / np.sqrt(12)  # of a range: spread up to which `identifiable` says yes; see `verdict.parameter_rows`
_MORE = (
    3.0  # times its members' own spreads that a direction's must be: they slide together, and are not merely blurred
)
_PART = 0.2  # of the largest share in a direction: from which a parameter belongs to it
_ALIKE = 0.3  # relative spread of relative changes up to which they are one factor


@dataclass(frozen=True)
class Slide:
    """Parameters that can change together unseen.

    Attributes:
      names: of the parameters.
      relative: relative change of each, the largest 1.
      share: standard deviation along the direction, in the parameters' ranges.
      alone: what that would be with every parameter but one known, at worst.
    """

    names: tuple[str, ...]
    relative: tuple[float, ...]
    share: float
    alone: float

    @property
    def same_factor(self) -> bool:
        """Whether all of them scale by one factor."""
        r = np.array(self.relative)
        return bool(np.ptp(r) <= _ALIKE * abs(r.mean()))

    def say(self, anchor: str, act: str) -> str:
        """One sentence; `anchor` is the parameter to be known, `act` how to come to know it."""
        names, advice = listed(self.names, 8), f"{act} and mark it `anchored: true`"
        if self.same_factor:
            return (
                f"{names} can all be scaled by the same factor and these motions stay as they are: only their ratios "
                f"are known. {advice[:1].upper()}{advice[1:]}."
            )
        up = [n for n, r in zip(self.names, self.relative, strict=True) if r > 0]
        down = [n for n, r in zip(self.names, self.relative, strict=True) if r < 0]
        how = f"more of {listed(up, 8)} looks like less of {listed(down, 8)}" if down else f"{names} rise together"
        return f"{names} cannot be told apart by these motions: {how}. For {anchor}: {advice}."


def slides(fitted: Fit) -> list[Slide]:
    """Near-null directions of psi and accepted effects among parameters that are each well seen by themselves."""
    limits = box(fitted.plant)
    weight = loss_weight(fitted.white)
    jac = flat(weight[..., None] * fitted.jacobian)
    names = free_names(fitted.plant)
    plant = fitted.plant
    ranges = (plant.chart(limits.high) - plant.chart(limits.low))[limits.free] / limits.scale
    ranges = np.where(np.abs(ranges) > 0, np.abs(ranges), 1.0)
    # Effects' bounds are wide: their typical size, which is 1, is the range that matters.
    ranges[int(plant.space.free.sum()) :] = np.minimum(ranges[int(plant.space.free.sum()) :], 4.0)
    unit = jac * ranges  # by ranges
    alone = 1 / np.maximum(np.linalg.norm(unit, axis=0), 1e-12)
    seen = alone < _SEEN
    if seen.sum() < 2:
        return []
    values, vectors = np.linalg.eigh(unit[:, seen].T @ unit[:, seen])
    spread = 1 / np.sqrt(np.maximum(values, 1e-24))
    weak = spread > _SEEN
    at = plant.chart(fitted.x)[limits.free] / limits.scale / ranges
    out = []
    for direction in _sparse(vectors[:, weak]):
        shares = np.abs(direction) / np.abs(direction).max()
        kept = shares > _PART
        if kept.sum() < 2:
            continue
        relative = direction[kept] / np.where(np.abs(at[seen][kept]) > 1e-9, at[seen][kept], np.inf)
        if not np.abs(relative).max() > 0:
            continue
        relative = relative / relative[np.abs(relative).argmax()]
        sd = 1 / max(float(np.linalg.norm(unit[:, seen] @ direction)), 1e-12)
        if sd < _MORE * float(alone[seen][kept].max()):
            continue
        chosen = [n for n, s in zip(np.array(names)[seen], kept, strict=True) if s]
        out.append(Slide(tuple(map(str, chosen)), tuple(map(float, relative)), sd, float(alone[seen][kept].max())))
    return out


def _sparse(basis: Array) -> list[Array]:
    """Unit vectors that span the same space (f, j), each with as many zeros as elimination can make."""
    if not basis.shape[1]:
        return []
    pivots = qr(basis.T, mode="r", pivoting=True)[-1]
    block = basis[pivots[: basis.shape[1]]]
    reduced = np.linalg.solve(block.T, basis.T)
    return [row / np.linalg.norm(row) for row in reduced]


def said(fitted: Fit) -> list[str]:
    """The slides in words, each with what to measure."""
    space = fitted.plant.space
    fields = {p.name: p.field for p in space.parameters}
    out = []
    for slide in slides(fitted):
        masses = [n for n in slide.names if fields.get(n) == "body_mass"]
        declared = [n for n in slide.names if n in fields]
        anchor = (masses or declared or list(slide.names))[0]
        if masses:
            act = f"weigh what {anchor} stands for"
        elif declared:
            act = f"measure {anchor} by itself"
        else:
            act = "record a motion that tells them apart, or declare one of them as a parameter"
            out.append(slide.say(anchor, act).replace(" and mark it `anchored: true`", ""))
            continue
        out.append(slide.say(anchor, act))
    return out
