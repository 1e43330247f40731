"""Sparse regression over the impulse tensor: which law, on which degree of freedom, the misfit looks like.

Every term of a dictionary (`physics.effects.law`) is a product with the tensor; the best are refined in their
shape (order, power, edges) on the tensor too. One law is added at a time and refitted with everything else in
roll-outs before the next is looked for: stepwise selection, in the spirit of SINDy (Brunton et al. 2016), but on
predictions several horizons long rather than on differentiated data. Nothing here is believed: that is the contest's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from nfc_gym.measured.contest import clusters
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.forced import forced
from nfc_gym.measured.impulse import Tensor, impulse
from nfc_gym.measured.metric import Metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.screen import Screen
from nfc_gym.physics.effects.base import Array
from nfc_gym.physics.effects.law import Law

_DRAWS = 39  # residuals without any law in them: what the luckiest of all laws gains there is chance
_TURN = 60  # shapes that are evaluated at once
_EXACT = 60  # columns up to which psi's share is taken out of each; of longer scans only the best are treated so
_REFINED = 10  # laws whose shape is refined
_APART = 0.03  # of a column's square that psi and the effects at work must be unable to imitate


@dataclass(frozen=True)
class Proposal:
    """A law that the misfit looks like.

    Attributes:
      law: with bounds and probes about where it was found.
      theta: (k,) its values.
      share: of the misfit that psi cannot mend, what the law takes away as far as straight lines tell.
    """

    law: Law
    theta: Array
    share: float


@dataclass(frozen=True)
class Scanned:
    """What a scan of all laws saw.

    Attributes:
      proposals: beyond chance, best first, one a family.
      nearest: the best of all, beyond chance or not; None where no law moves anything.
      places: share of the misfit that the best law on each degree of freedom takes away, largest first.
      evidence: of a force of any course on each joint, nats, largest first (`forced`).
    """

    proposals: list[Proposal]
    nearest: Proposal | None
    places: dict[str, float]
    evidence: dict[str, float]


class _Scan:
    """One pass of a dictionary over a tensor."""

    def __init__(self, tensor: Tensor, screen: Screen, rng: np.random.Generator) -> None:
        self.tensor, self.screen = tensor.weighted(screen.weight), screen
        blocks = clusters(screen.problem)
        signs = rng.choice([-1.0, 1.0], (_DRAWS, int(blocks.max()) + 1))[:, blocks]
        shape = screen.current.white.shape
        rest = screen.projected.reshape(shape)
        flipped = (signs[:, :, None] * rest).reshape(_DRAWS, -1)
        self.targets = np.concatenate([screen.projected[None], flipped]).T  # (n, 1 + draws)
        self.total = max(float(screen.projected @ screen.projected), 1e-12)
        self.luck = np.zeros(_DRAWS)

    def columns(self, law: Law, shapes: Array, exact: bool) -> tuple[Array, Array]:
        """(G, k, n) columns, psi's share taken out if `exact`, and (G,) whether psi leaves enough of them."""
        raw = self.tensor.columns(law, shapes)
        raw = raw.reshape(*raw.shape[:2], -1)
        before = (raw**2).sum((1, 2))
        if not exact:
            return raw, before > 0
        left = raw - (raw @ self.screen.basis) @ self.screen.basis.T
        return left, (left**2).sum((1, 2)) > np.maximum(_APART * before, 1e-18)

    def gains(self, columns: Array, apart: Array) -> tuple[Array, Array]:
        """Gain (G, 1 + draws) of the best sizes on every target, and those sizes on the first, (G, k)."""
        norms = np.maximum(np.linalg.norm(columns, axis=-1), 1e-12)
        unit = columns / norms[..., None]
        gram = unit @ unit.transpose(0, 2, 1) + 1e-6 * np.eye(columns.shape[1])
        right = unit @ self.targets
        size = np.linalg.solve(gram, right)
        return np.where(apart[:, None], (right * size).sum(1), 0.0), -size[:, :, 0] / norms

    def best(self, law: Law) -> tuple[float, Array]:
        """The gain and shape (s,) of the best on a law's grid; chance is kept along the way."""
        grid = law.grid(self.tensor.context)
        exact = len(grid) * law.terms <= _EXACT
        found, shape = 0.0, grid[0]
        for i in range(0, len(grid), _TURN):
            some = grid[i : i + _TURN]
            gains, _ = self.gains(*self.columns(law, some, exact))
            self.luck = np.maximum(self.luck, gains[:, 1:].max(0))
            at = int(gains[:, 0].argmax())
            if gains[at, 0] > found:
                found, shape = float(gains[at, 0]), some[at]
        return found, shape

    def refined(self, law: Law, shape: Array) -> Proposal:
        """The shape moved to where the law gains most, psi's share taken out."""
        room = law.reach(self.tensor.context, shape)
        low, high = law.least(self.tensor.context), np.array([p.high for p in law.params[law.terms :]])

        def value(s: Array) -> tuple[float, Array]:
            gains, sizes = self.gains(*self.columns(law, np.clip(s, low, high)[None], True))
            return float(gains[0, 0]), sizes[0]

        if len(shape):
            simplex = shape + np.concatenate([np.zeros((1, len(room))), 0.25 * np.diag(room)])
            options = {"initial_simplex": simplex, "maxfev": 30 + 30 * len(shape), "xatol": 1e-3 * room.min()}
            shape = np.clip(minimize(lambda s: -value(s)[0], shape, method="Nelder-Mead", options=options).x, low, high)
        gain, size = value(shape)
        theta = np.concatenate([size, shape])
        return Proposal(law.at(self.tensor.context, theta), theta, gain / self.total)


def scan(problem: Problem, metric: Metric, current: Fit, laws: Sequence[Law], rng: np.random.Generator) -> Scanned:
    """Every law of a dictionary against what a fitted model leaves.

    Args:
      laws: with probes of realistic size.
      rng: of the draws by chance.
    """
    model = current.plant.model
    taken = {e.id for e in current.plant.effects}
    free = [law.again() if law.id in taken else law for law in laws]
    laws = [law for law in free if law is not None and law.id not in taken]
    for law in laws:
        law.bind(model)
    sizes = _sizes(laws)
    tensor = impulse(problem, metric, current, sizes) if laws else None
    if tensor is None:
        return Scanned([], None, {}, {})
    part = Fit(current.plant, current.x, current.white[tensor.index], current.jacobian[tensor.index])
    screen = Screen(problem.take(tensor.index), metric.take(tensor.index), part)
    run = _Scan(tensor, screen, rng)
    found = sorted(((*run.best(law), law) for law in laws), key=lambda f: -f[0])
    refined = [run.refined(law, shape) for gain, shape, law in found[:_REFINED] if gain > 0]
    refined.sort(key=lambda p: -p.share)
    places: dict[str, float] = {}
    shares = [(p.share, p.law) for p in refined] + [(gain / run.total, law) for gain, _, law in found]
    for share, place in ((s, law.where[0]) for s, law in shares):
        places[place] = max(places.get(place, 0.0), min(share, 1.0))
    chance = float(run.luck.max()) / run.total
    kept = {p.law.family: p for p in reversed(refined) if p.share > chance}
    proposals = sorted(kept.values(), key=lambda p: -p.share)
    places = dict(sorted(places.items(), key=lambda kv: -kv[1]))
    evidence = forced(model, run.tensor, sizes, screen.projected.reshape(part.white.shape))
    return Scanned(proposals, refined[0] if refined else None, places, evidence)


def _sizes(laws: Sequence[Law]) -> dict[int, float]:
    """A realistic force on each degree of freedom that a law pushes, from the laws' own probes."""
    plain = {w.dof: w.params[0].probes[0] for w in laws if not w.in_body and w.params[0].unit in ("N", "N m")}
    pushed = (d for w in laws for d in (range(w.first, w.first + 3) if w.in_body else [w.dof]))
    return {d: plain.get(d, 1e-2) for d in sorted(set(pushed))}
