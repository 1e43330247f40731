"""`Assimilation`: psi and delta_s from one trajectory, by replaying it; no trained network is needed.

The trajectory is cut into segments of `SPAN` control steps. Each is replayed from the state that was estimated at its
start, under many draws of psi, the same noise in all of them, so that what differs between two replays is psi's doing
alone. A regression of where segments end on psi (in probit coordinates of the prior's box, where the prior is standard
normal) gives a linear model of the robot around the present belief, and Bayes' rule for a linear model with Gaussian
noise the next belief; after a few rounds the draws lie where the posterior does (iterated posterior linearisation:
Garcia-Fernandez et al. 2015). The noise of a segment's end is the sensors', what the noise of start, motors and map
makes of it, found by replays of one psi, and what the regression leaves.

What the replays under the posterior's psi still miss, a control step, is delta_s: its mean over the segments, and how
sure that mean is.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from nfc_gym.adaptation.perceived import perceived_ground
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.posterior import Sampler
from nfc_gym.envs.simulations import Simulations
from nfc_gym.simulate.machine import MOTOR, Machine
from nfc_gym.simulate.recorded import place
from nfc_gym.simulate.replay import told
from nfc_gym.simulate.roll import step
from nfc_gym.simulate.start import disturbed, observed
from nfc_gym.terrain import Heightfield

Array = NDArray[np.float64]
SPAN = 5  # control steps of a segment: long enough to show psi, short enough for motion to be nearly linear in it
SEGMENTS = 40  # of a trajectory at most, evenly spread
DRAWS = 64  # replays a segment, and of the noise
ROUNDS = 4
GROUNDS = 8  # that a perceived ground may as well be, by which its noise counts
_EVEN = 1e-4  # m: noise of a map below which it is left out
_NEAR = 4.0  # of the covariance, by which the next draws are wider than what the regression alone would believe
_SHRUNK = 0.1  # of a covariance of few draws, towards its diagonal
_EDGE = 1e-4  # how near to its box's bounds psi is drawn, as a share of the box


@dataclass(frozen=True)
class Box:
    """Bounds of psi, and its coordinates z in which the prior is standard normal.

    Attributes:
      low, high: (d,) physical units.
    """

    low: Array
    high: Array

    def psi(self, z: Array) -> Array:
        """(..., d) in physical units."""
        return self.low + (self.high - self.low) * np.clip(ndtr(z), _EDGE, 1 - _EDGE)

    def z(self, psi: Array) -> Array:
        """Its inverse."""
        return ndtri(np.clip((psi - self.low) / (self.high - self.low), _EDGE, 1 - _EDGE))


def linear_posterior(slope: Array, offset: Array, noise: Array, excess: Any = 0.0) -> tuple[Array, Array]:
    """Mean (d,) and covariance (d, d) of z ~ N(0, I) given offset = slope z + N(0, diag(noise)).

    Args:
      slope: (k, d).
      offset: (k,).
      noise: (k,) variances.
      excess: (d, d) precision that errors of the slope alone would seem to give, to be taken off; directions of which
        nothing then is left keep the prior.
    """
    weighted = slope / noise[:, None]
    precision = weighted.T @ slope
    values, vectors = np.linalg.eigh(precision - excess)
    covariance = (vectors / (1 + np.maximum(values, 0))) @ vectors.T
    mean: Any = np.linalg.solve(np.eye(len(precision)) + precision, weighted.T @ offset)
    return mean, covariance


@dataclass(frozen=True)
class Assimilated:
    """A belief about psi and delta_s.

    Attributes:
      box: psi's.
      mean, covariance: of z, (d,) and (d, d).
      delta: (s,) mean of delta_s, a control step; None says nothing of it.
      spread: (s,) standard deviation of that mean.
    """

    box: Box
    mean: Array
    covariance: Array
    delta: Array | None = None
    spread: Array | None = None

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """See `Sampler`."""
        psi = self.box.psi(rng.multivariate_normal(self.mean, self.covariance, n, method="cholesky"))
        if self.delta is None or self.spread is None:
            return Fidelity(psi)
        return Fidelity(psi, self.delta + self.spread * rng.standard_normal((n, len(self.delta))))


@dataclass(frozen=True)
class Segments:
    """Parts of a trajectory.

    Attributes:
      starts: (n, nq + nv), or with the actuators' states behind them (n, nq + nv + na).
      first, last: (n, s) `proprio` where they start and end.
      actions: (n, span, a).
      maps: the ground underfoot, and others that it may as well be; none is a plane.
      hidden: the starts are made of `proprio` alone (`start.observed`).
    """

    starts: Array
    first: Array
    last: Array
    actions: Array
    maps: list[Heightfield] = field(default_factory=list)
    hidden: bool = False


@dataclass
class Assimilation:
    """Infers by replaying; an `Inference` for `adapt`.

    Args:
      environment: id.
      reach: by how much of the prior's width psi may lie beyond its bounds: anomalies do.
      ground: the map underfoot, for a Rough environment; None takes the ground that each trajectory perceived.
      map_error: m, how far the heights of a perceived ground may be off (standard deviation); as much as its maps
        disagree with each other is taken at least. An error that all maps share shows in none of them.
      delta_s: whether to infer residual dynamics too.
      motor: standard deviation of the motors' noise, a share of the actions' range.
      seed: of all draws.
      nthread: threads.
    """

    environment: str
    reach: float = 0.0
    ground: Heightfield | None = None
    map_error: float = 0.0
    delta_s: bool = True
    motor: float = MOTOR
    seed: int = 0
    nthread: int = 1
    machine: Machine = field(init=False)
    box: Box = field(init=False)

    def __post_init__(self) -> None:
        self.machine = machine = Machine(self.environment)
        if self.ground is not None and not machine.rough:
            raise InputError(f"assimilation: {self.environment} is a plane and has no `ground`")
        if not 0 <= self.map_error < 1:
            raise InputError(f"assimilation: map_error is {self.map_error!r}, want metres from 0 up to 1")
        space = machine.space
        beyond = self.reach * (space.high - space.low)
        # What cannot be negative stays as positive as the prior has it, or at a fiftieth of nominal.
        floor = np.where(space.low >= 0, np.minimum(space.low, 0.02 * np.abs(space.nominal)), -np.inf)
        self.box = Box(np.maximum(space.low - beyond, floor), space.high + beyond)

    # ---- `Inference` ----------------------------------------------------------------------------------------------

    def infer(self, trajectory: Trajectory) -> Assimilated:
        """The belief given the whole trajectory.

        Raises:
          InputError: it is shorter than a segment, of another robot, tells no state to start from, or on rough ground
            neither it nor `ground` says what is underfoot.
        """
        segments, rng = self.segments(trajectory), np.random.default_rng(self.seed)
        seen = told(self.machine)
        scale = self.machine.noise[seen]
        d = len(self.machine.space)
        mean, covariance = np.zeros(d), np.eye(d)
        near = covariance  # where the robot is taken to be linear in psi
        noise = self._noise(segments, self.box.psi(mean), rng, seen, scale)
        for _ in range(ROUNDS):
            z = rng.multivariate_normal(mean, near, max(DRAWS, 4 * d), method="cholesky")
            ends = self._ends(segments, self.box.psi(z), None)
            mean, covariance, near = self._round(segments, z, ends, seen, scale, noise)
        belief = Assimilated(self.box, mean, covariance)
        return self._with_residual(belief, segments, rng) if self.delta_s else belief

    def updated(self, trajectory: Trajectory, belief: Sampler) -> "Assimilation":
        """Itself: a belief is made of one trajectory, whose world may be another than the last one's."""
        return self

    # ---- inside ---------------------------------------------------------------------------------------------------

    def segments(self, trajectory: Trajectory) -> Segments:
        """Up to `SEGMENTS` parts of a trajectory, evenly spread."""
        count = len(trajectory) // SPAN
        kind = self.machine.kind
        if trajectory.states.shape[1:] != (kind.proprio_size,) or trajectory.actions.shape[1:] != (kind.action_size,):
            raise InputError(
                f"assimilation: states {trajectory.states.shape} and actions {trajectory.actions.shape} are not of "
                f"{self.environment}: want widths {kind.proprio_size} and {kind.action_size}"
            )
        if count < 2:
            raise InputError(f"assimilation: {len(trajectory)} control steps; want at least {2 * SPAN}")
        at = SPAN * np.unique(np.linspace(0, count - 1, min(count, SEGMENTS)).round().astype(int))
        first = trajectory.states[at]
        hidden = not trajectory.estimate.size
        starts = observed(self.machine, first) if hidden else trajectory.estimate[at]
        actions = np.stack([trajectory.actions[at + k] for k in range(SPAN)], 1)
        last, maps = trajectory.states[at + SPAN], self._grounds(trajectory)
        return Segments(starts, first, last, np.clip(actions, -1, 1), maps, hidden)

    def _grounds(self, trajectory: Trajectory) -> list[Heightfield]:
        """See `Segments.maps`: the likeliest is the first."""
        if not self.machine.rough:
            return []
        if self.ground is not None:
            return [self.ground]
        found, off = perceived_ground(trajectory)
        off = max(off, self.map_error)
        if off < _EVEN:
            return [found]
        rng = np.random.default_rng(self.seed)
        others = [found.heights + off * rng.standard_normal(found.heights.shape) for _ in range(GROUNDS - 1)]
        return [found, *(Heightfield(heights, found.resolution, found.origin) for heights in others)]

    def _round(
        self, segments: Segments, z: Array, ends: Array, seen: NDArray[np.bool_], scale: Array, noise: Array
    ) -> tuple[Array, Array, Array]:
        """Regress ends (m, n, s) on z (m, d), and apply Bayes' rule: mean, covariance, and that of the next draws."""
        off = self.machine.difference(segments.last[None], ends)[..., seen] / scale  # (m, n, k)
        fine = np.isfinite(off).all((1, 2))
        if fine.sum() < z.shape[1] + 4:
            raise InputError("assimilation: most replays come apart: the trajectory does not fit this robot")
        centre = z[fine].mean(0)
        design = np.concatenate([z[fine] - centre, np.ones((fine.sum(), 1))], 1)
        y = off[fine].reshape(fine.sum(), -1)
        found: Any = np.linalg.lstsq(design, y, rcond=None)[0]
        left = ((y - design @ found) ** 2).sum(0) / max(1, fine.sum() - design.shape[1])
        slope = -found[:-1].T
        offset, (n, k, _) = found[-1] + slope @ centre, noise.shape
        each = noise + np.eye(k) + left.reshape(n, k)[..., None] * np.eye(k)
        white: Any = np.linalg.inv(np.linalg.cholesky(each))
        slope, offset = (
            (white @ slope.reshape(n, k, -1)).reshape(n * k, -1),
            (white @ offset.reshape(n, k, 1)).reshape(-1),
        )
        one = np.ones(n * k)
        # The slope of k ends is off by independent errors, which would add up to a precision that is not there.
        spurious = (white**2 @ left.reshape(n, k, 1)).sum()
        excess = spurious * np.linalg.inv((z[fine] - centre).T @ (z[fine] - centre))
        mean, covariance = linear_posterior(slope, offset, one, excess)
        near = _NEAR * linear_posterior(slope, offset, one)[1]
        return mean, covariance, near

    def _noise(
        self, segments: Segments, psi: Array, rng: np.random.Generator, seen: NDArray[np.bool_], scale: Array
    ) -> Array:
        """(n, k, k) covariance of a segment's end by the noise of start, motors and map, in units of the sensors'.

        One bump tilts, lifts and slows a robot at once: entries taken as independent would count it several times.
        """
        ends = self._ends(segments, np.tile(psi, (DRAWS, 1)), rng)
        off = self.machine.difference(ends, np.broadcast_to(segments.last, ends.shape))[..., seen] / scale
        off = off[np.isfinite(off).all((1, 2))]
        if len(off) < DRAWS // 4:
            raise InputError("assimilation: most replays come apart: the trajectory does not fit this robot")
        off = off - off.mean(0)
        found = np.einsum("mnk,mnl->nkl", off, off) / (len(off) - 1)
        return (1 - _SHRUNK) * found + _SHRUNK * found * np.eye(found.shape[1])

    def _with_residual(self, belief: Assimilated, segments: Segments, rng: np.random.Generator) -> Assimilated:
        """What replays under the belief miss, a control step."""
        ends = self._ends(segments, self.box.psi(rng.multivariate_normal(belief.mean, belief.covariance, DRAWS)), None)
        missed = self.machine.difference(segments.last[None], ends) / SPAN
        missed = np.nanmean(np.where(np.isfinite(missed), missed, np.nan), 0) * told(self.machine)
        spread = missed.std(0, ddof=1) / np.sqrt(len(missed))
        return Assimilated(belief.box, belief.mean, belief.covariance, missed.mean(0), spread)

    def _ends(self, segments: Segments, psi: Array, rng: np.random.Generator | None) -> Array:
        """(m, n, s) `proprio` at the ends of n segments under m psi; with `rng`, starts and motors are noisy."""
        m, n, machine = len(psi), len(segments.starts), self.machine
        sims = machine.simulations(m * n, self.nthread, segments.maps)
        given: dict[str, Any] = {"psi": np.repeat(psi, n, 0)}
        if machine.rough:
            # The noise of the map counts with that of start and motors.
            many = np.arange(m * n) // n % len(segments.maps)
            given["terrain_id"] = np.zeros(m * n, int) if rng is None else many
        sims.begin(np.arange(m * n), given)
        starts, first = np.tile(segments.starts, (m, 1)), np.tile(segments.first, (m, 1))
        actions = np.tile(segments.actions, (m, 1, 1))
        if rng is not None:
            moving = machine.model.nq + machine.model.nv
            eps = rng.standard_normal((m * n, 2 * machine.model.nv))
            noisy = disturbed(machine, starts[:, :moving], eps, segments.hidden)
            starts = np.concatenate([noisy, starts[:, moving:]], 1)
            actions = np.clip(actions + self.motor * rng.standard_normal(actions.shape), -1, 1)
        with np.errstate(over="ignore", invalid="ignore"):
            return replayed(machine, sims, starts, first, actions).reshape(m, n, -1)


def replayed(machine: Machine, sims: Simulations, starts: Array, first: Array, actions: Array) -> Array:
    """(n, s) `proprio` after the actions (n, span, a), from `Segments.starts`; nan where simulations come apart."""
    sims.batch.reset(np.arange(sims.n), sims.rest)
    robot, view = sims.robot, sims.view
    view.task.update({name: np.zeros_like(value) for name, value in view.task.items()})
    place(machine, sims, starts, first)
    sims.batch.forward()
    view.now = robot.derive(view)
    for action in actions.transpose(1, 0, 2):
        view.ctrl[...] = robot.actuate(action, view)
        step(sims, np.ones(sims.n, bool), machine.kind.frame_skip)
        view.task.update(robot.advance(view, action))
        view.before, view.now = view.now, robot.derive(view)
    return np.concatenate(robot.proprio(view), -1)
