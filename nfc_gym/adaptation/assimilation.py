"""`Assimilation`: psi and delta_s from one trajectory, by replaying it; no trained network is needed.

The trajectory is cut into segments of `SPAN` control steps. Each is replayed from the state that was estimated at its
start, under many draws of psi, the same noise in all of them, so that what differs between two replays is psi's doing
alone. A regression of where segments end on psi (in probit coordinates of the prior's box, where the prior is standard
normal) gives a linear model of the robot around the present belief, and Bayes' rule for a linear model with Gaussian
noise the next belief (iterated posterior linearisation: Garcia-Fernandez et al. 2015). Its mean goes there only as far
as replays say that it is better. The noise of a segment's end is the sensors' and what the noise of start, motors and
map makes of it, found by replays of one psi, scaled to what the best replays miss, and what the regression leaves.

What the replays under the posterior's psi still miss, a control step, is delta_s: its mean over the segments, and how
sure that mean is. With `effects`, sizes of what the model may lack (`structure`) are inferred along with psi: where a
delay is missing, masses need not make up for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from nfc_gym.adaptation.assimilated import Assimilated, Box
from nfc_gym.adaptation.linear import Linear, as_seen, cost, regressed
from nfc_gym.adaptation.perceived import perceived_ground
from nfc_gym.adaptation.replaying import Segments, replayed
from nfc_gym.adaptation.structure import Structure, structure_of
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.core.posterior import Sampler
from nfc_gym.physics.quiet import no_warnings
from nfc_gym.simulate.machine import MOTOR, Machine
from nfc_gym.simulate.start import disturbed, observed
from nfc_gym.terrain import Heightfield

Array = NDArray[np.float64]
SPAN = 10  # control steps of a segment: long enough to show psi, short enough for motion to be nearly linear in it
SHORT = 5  # of a robot that fell at once
SEGMENTS = 40  # of a trajectory at most, evenly spread; and of all that are remembered
MEMORY = 4  # trajectories
DRAWS = 64  # replays a segment, and of the noise
EARLIER = 15  # control steps before a segment, whose commands delays and lags still remember
GROUNDS = 8  # that a perceived ground may as well be, by which its noise counts
_EVEN = 1e-4  # m: noise of a map below which it is left out
# Of the covariance that is believed, at which each round's draws lie around the mean. Wide ones find the way, bent by
# what is not linear, which counts as noise; narrow ones find the place.
_NEAR = (0.4, 0.4, 0.4, 0.4, 0.2, 0.1, 0.05, 0.02)
_NEARER = (1, 0.5, 0.25, 0.12, 0.06, 0.03, 0.015, 0.008, 0.004, 0.002, 0.001)  # the same, of `Assimilated.near`
_ALIKE = 2.0  # nats a parameter that draws of `near` may fit worse than the mean, twice what is due to their number
_SPREAD = 1.4826  # of a normal, over its median size
_FEW = 12  # draws by which that is seen
_STEPS = np.array([1.0, 0.5, 0.2, 0.05, 0.0])  # of the way to where the linear model leads, of which the best is gone
_SPARSER = 10  # times that a round asks which effects are there
_LEAST = 0.02  # variance of the prior of an effect that is not
_SHRUNK = 0.1  # of a covariance of few draws, towards its diagonal


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
      effects: whether to infer the sizes of effects that the model may lack too.
      motor: standard deviation of the motors' noise, a share of the actions' range.
      memory: earlier trajectories, of the same world, that a belief is made of besides the last one.
      seed: of all draws.
      nthread: threads.
    """

    reads_belief: ClassVar[bool] = False
    environment: str
    reach: float = 0.0
    ground: Heightfield | None = None
    map_error: float = 0.0
    delta_s: bool = True
    effects: bool = True
    motor: float = MOTOR
    memory: int = MEMORY
    seed: int = 0
    nthread: int = 1
    remembered: tuple[Trajectory, ...] = ()
    machine: Machine = field(init=False)
    box: Box = field(init=False)
    structure: Structure = field(init=False)

    def __post_init__(self) -> None:
        self.machine = machine = Machine(self.environment)
        if self.ground is not None and not machine.rough:
            raise InputError(f"assimilation: {self.environment} is a plane and has no `ground`")
        if not 0 <= self.map_error < 1:
            raise InputError(f"assimilation: map_error is {self.map_error!r}, want metres from 0 up to 1")
        if self.memory < 0:
            raise InputError(f"assimilation: memory is {self.memory!r}, want 0 or more earlier trajectories")
        self.structure = structure_of(machine) if self.effects else Structure()
        space = machine.space
        beyond = self.reach * (space.high - space.low)
        # What cannot be negative stays as positive as the prior has it, or at a fiftieth of nominal.
        floor = np.where(space.low >= 0, np.minimum(space.low, 0.02 * np.abs(space.nominal)), -np.inf)
        low, high = np.maximum(space.low - beyond, floor), space.high + beyond
        self.box = Box(np.maximum(low, space.least), np.minimum(high, space.most))

    # ---- `Inference` ----------------------------------------------------------------------------------------------

    @no_warnings()  # draws that come apart are left out
    def infer(self, trajectory: Trajectory) -> Assimilated:
        """The belief given the whole trajectory and those that are remembered.

        Where all of them are too short to be cut into segments, as of a robot that fell at once, it is psi's prior.

        Raises:
          InputError: it is of another robot, tells no state to start from, or on rough ground neither it nor `ground`
            says what is underfoot.
        """
        self._require_own(trajectory)
        told = [t for t in (*self.remembered, trajectory) if len(t) >= 2 * SHORT]
        if not told:
            size = len(self.machine.space)
            return Assimilated(self.box, np.zeros(size), np.eye(size))
        most = SEGMENTS // max(1, len(self.remembered))
        parts = [self.segments(t) if t is trajectory else self.segments(t, most) for t in told]
        rng, seen = np.random.default_rng(self.seed), self.machine.told
        scale = self.machine.noise[seen]
        d = len(self.machine.space) + len(self.structure)
        mean, covariance, prior = np.zeros(d), np.eye(d), np.ones(d)
        noise = self._noise(parts, mean, rng, seen, scale) + np.eye(int(seen.sum()))
        off = self._misses(parts, mean[None], seen, scale)
        each = as_seen(noise, off[0])
        for near in _NEAR:
            z = rng.multivariate_normal(mean, near * covariance, max(DRAWS, 2 * d), method="cholesky")
            linear = regressed(z, self._misses(parts, z, seen, scale))
            each = each + linear.left[..., None] * np.eye(noise.shape[-1])
            wanted, covariance, prior = self._believed(linear, each, prior)
            tried = mean + _STEPS[:, None] * (wanted - mean)
            off = self._misses(parts, tried, seen, scale)
            best = int(np.argmin(cost(tried, prior, off, each)))
            mean, off = tried[best], off[best : best + 1]
            each = as_seen(noise, off[0])
        belief = Assimilated(self.box, mean, covariance, structure=self.structure)
        worst = cost(mean[None], prior, off, each)[0] + _ALIKE * d
        for share in _NEARER:
            belief = replace(belief, share=share)
            z = belief.near().coordinates(_FEW, rng)
            if np.median(cost(z, prior, self._misses(parts, z, seen, scale), each)) <= worst:
                break
        belief = replace(belief, noise=self._sensed(trajectory.states, parts, mean, off[0] * scale, seen))
        return self._with_residual(belief, parts, rng) if self.delta_s else belief

    @property
    def parts(self) -> tuple[str, ...]:
        """That its beliefs speak of."""
        maybe = (("delta_s",) if self.delta_s else ()) + (("effects",) if len(self.structure) else ())
        return ("psi", *maybe, "noise")

    def updated(self, trajectory: Trajectory, belief: Sampler) -> "Assimilation":
        """One that remembers the trajectory: where a policy that was adapted goes wrong, its belief did."""
        kept = (*self.remembered, trajectory)[-self.memory :] if self.memory else ()
        return replace(self, remembered=kept)

    # ---- inside ---------------------------------------------------------------------------------------------------

    def segments(self, trajectory: Trajectory, most: int = SEGMENTS) -> Segments:
        """Parts of a trajectory, evenly spread, `most` at most.

        Raises:
          InputError: it is of another robot, has fewer than two parts, or on rough ground there is no map for it.
        """
        span = SPAN if len(trajectory) >= 2 * SPAN else SHORT
        count = len(trajectory) // span
        self._require_own(trajectory)
        if count < 2:
            raise InputError(f"assimilation: {len(trajectory)} control steps; want at least {2 * SHORT}")
        at = span * np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
        first = trajectory.states[at]
        hidden = not trajectory.estimate.size
        starts = observed(self.machine, first) if hidden else trajectory.estimate[at]
        given = np.clip(trajectory.actions, -1, 1)
        actions = given[at[:, None] + np.arange(span)]
        earlier = given[np.maximum(at[:, None] + np.arange(-EARLIER, 0), 0)]
        last, maps = trajectory.states[at + span], self._grounds(trajectory)
        return Segments(starts, first, trajectory.states[at + 1], last, actions, earlier, maps, hidden)

    def _require_own(self, trajectory: Trajectory) -> None:
        """Raises `InputError` where a trajectory is of another robot."""
        kind = self.machine.kind
        if trajectory.states.shape[1:] != (kind.proprio_size,) or trajectory.actions.shape[1:] != (kind.action_size,):
            raise InputError(
                f"assimilation: states {trajectory.states.shape} and actions {trajectory.actions.shape} are not of "
                f"{self.environment}: want widths {kind.proprio_size} and {kind.action_size}"
            )

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

    def _believed(self, linear: Linear, noise: Array, prior: Array) -> tuple[Array, Array, Array]:
        """Mean and covariance by a linear model, and the prior's variances that the structure then deserves.

        Of many effects few are there: the prior variance of an effect's sizes is what they are believed to be, over and
        over (automatic relevance determination: MacKay 1994, Tipping 2001), so that an effect which psi or another one
        makes needless vanishes and takes its share of the doubt about psi with it.
        """
        d, prior = len(self.machine.space), prior.copy()
        mean, covariance = linear.posterior(noise, prior)
        for _ in range(_SPARSER):
            at = d
            for sizes in self.structure.sizes:
                own = slice(at, at + len(sizes))
                prior[own] = np.clip((mean[own] ** 2 + np.diag(covariance)[own]).mean(), _LEAST, 1.0)
                at += len(sizes)
            mean, covariance = linear.posterior(noise, prior)
        return mean, covariance, prior

    def _misses(self, parts: Sequence[Segments], z: Array, seen: NDArray[np.bool_], scale: Array) -> Array:
        """(m, n, k) by how much the ends that were seen are off replays under z (m, d), in sensors' noise."""
        off = [self.machine.difference(p.last[None], self._ends(p, z, None)) for p in parts]
        return np.concatenate(off, 1)[..., seen] / scale

    def _noise(
        self, parts: Sequence[Segments], z: Array, rng: np.random.Generator, seen: NDArray[np.bool_], scale: Array
    ) -> Array:
        """(n, k, k) covariance of a segment's end by the noise of start, motors and map, in units of the sensors'.

        One bump tilts, lifts and slows a robot at once: entries taken as independent would count it several times.
        """
        many = np.tile(z, (DRAWS, 1))
        ends = np.concatenate([self._ends(p, many, rng) for p in parts], 1)
        last = np.concatenate([p.last for p in parts])
        off = self.machine.difference(ends, np.broadcast_to(last, ends.shape))[..., seen] / scale
        off = off[np.isfinite(off).all((1, 2))]
        if len(off) < DRAWS // 4:
            raise InputError("assimilation: most replays come apart: the trajectory does not fit this robot")
        off = off - off.mean(0)
        found = np.einsum("mnk,mnl->nkl", off, off) / (len(off) - 1)
        return (1 - _SHRUNK) * found + _SHRUNK * found * np.eye(found.shape[1])

    def _sensed(
        self, states: Array, parts: Sequence[Segments], mean: Array, late: Array, seen: NDArray[np.bool_]
    ) -> Array:  # fmt: skip
        """(s,) noise of `proprio`: the least of three sizes, each of which holds more than noise.

        What the mean's replays miss after a step still has the start's noise, and at the ends (n, k) what the model
        gets wrong; fourth differences of what was sensed, of which white noise has 70 times its variance, have what is
        rough in the motion. Medians leave out impacts.
        """
        short = [replace(p, actions=p.actions[:, :1], last=p.second) for p in parts]
        soon = self._misses(short, mean[None], seen, np.ones(int(seen.sum())))[0]
        sizes = [soon, late]
        if len(states) > SPAN:
            sizes.append(np.diff(states[:, seen], 4, axis=0) / np.sqrt(70))
        found = np.zeros(len(seen))
        found[seen] = _SPREAD * np.min([np.nanmedian(np.abs(size), 0) for size in sizes], 0)
        return found

    def _with_residual(
        self, belief: Assimilated, parts: Sequence[Segments], rng: np.random.Generator
    ) -> Assimilated:  # fmt: skip
        """What replays under the belief miss, a control step."""
        z = belief.near().coordinates(DRAWS, rng)
        off = [self.machine.difference(p.last[None], self._ends(p, z, None)) / p.actions.shape[1] for p in parts]
        missed = np.concatenate(off, 1)
        missed = np.nanmean(np.where(np.isfinite(missed), missed, np.nan), 0) * self.machine.told
        spread = missed.std(0, ddof=1) / np.sqrt(len(missed))
        return replace(belief, delta=missed.mean(0), spread=spread)

    def _ends(self, segments: Segments, z: Array, rng: np.random.Generator | None) -> Array:
        """(m, n, s) `proprio` at the ends of n segments under m draws; with `rng`, starts and motors are noisy."""
        m, n, machine = len(z), len(segments.starts), self.machine
        psi, given = (
            self.box.psi(z[:, : len(machine.space)]),
            self.structure.given(np.repeat(z[:, len(machine.space) :], n, 0)),
        )
        sims = machine.simulations(m * n, self.nthread, segments.maps)
        options: dict[str, Any] = {"psi": np.repeat(psi, n, 0)}
        if machine.rough:
            # The noise of the map counts with that of start and motors.
            many = np.arange(m * n) // n % len(segments.maps)
            options["terrain_id"] = np.zeros(m * n, int) if rng is None else many
        sims.begin(np.arange(m * n), options)
        starts, first = np.tile(segments.starts, (m, 1)), np.tile(segments.first, (m, 1))
        actions = np.tile(segments.actions, (m, 1, 1))
        if rng is not None:
            moving = machine.model.nq + machine.model.nv
            eps = rng.standard_normal((m * n, 2 * machine.model.nv))
            noisy = disturbed(machine, starts[:, :moving], eps, segments.hidden)
            starts = np.concatenate([noisy, starts[:, moving:]], 1)
            actions = np.clip(actions + self.motor * rng.standard_normal(actions.shape), -1, 1)
        with np.errstate(over="ignore", invalid="ignore"):
            earlier = np.tile(segments.earlier, (m, 1, 1))
            return replayed(machine, sims, starts, first, actions, given, earlier).reshape(m, n, -1)
