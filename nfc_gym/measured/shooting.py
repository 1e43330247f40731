"""Multiple shooting: segments of logs rolled out from their measured starts, and the noise that their errors have."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.log import Log
from nfc_gym.measured.cuts import Cut, Layout, cut
from nfc_gym.measured.draws import near_by, starts_off
from nfc_gym.measured.observe import Observer, observer
from nfc_gym.measured.problem import Columns, Problem
from nfc_gym.measured.recent import Blocks
from nfc_gym.measured.segments import lay, moved, pick, refine, repeat
from nfc_gym.measured.states import States, channel_noise
from nfc_gym.measured.steps import coarser, finer, interpolate
from nfc_gym.physics.effects.base import overrides
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments, Servo, Trajectory
from nfc_gym.physics.state import integrate, quat_multiply, vector_to_quat

Array = NDArray[np.float64]
_RECENT = 64_000_000  # bytes of residuals that a problem keeps


@dataclass(frozen=True)
class Stretch:
    """Measured states of a block at n samples.

    Attributes:
      steps: (n,) physics steps after the block's start, not whole numbers.
      qpos, qvel: (n, nq), (n, nv).
      straight: (nq,) coordinates that are known and add plainly (no quaternions).
      observed: (nv,) degrees of freedom that were measured.
    """

    steps: Array
    qpos: Array
    qvel: Array
    straight: NDArray[np.bool_]
    observed: NDArray[np.bool_]


@dataclass(frozen=True)
class _Kit:
    """What a roll-out problem is made of, kept to lay it out again at another time step."""

    model: mujoco.MjModel
    logs: tuple[Log, ...]
    states: tuple[States, ...]
    layout: Layout
    servos: Mapping[str, Servo]
    linear: frozenset[str]
    settle: bool


class RolloutProblem(Problem):
    """Segments that start at measured states; states are compared at several horizons.

    Args:
      states: along each of the logs.
      servos, linear: see `lay`.
      settle: hold the first command before each start (`Segments.settle`).
      where: the segments, in place of those that `cut` places by the layout.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        logs: Sequence[Log],
        states: Sequence[States],
        layout: Layout,
        servos: Mapping[str, Servo] | None = None,
        linear: frozenset[str] = frozenset(),
        settle: bool = False,
        where: Cut | None = None,
    ) -> None:
        where = cut(logs, layout) if where is None else where
        self._kit = _Kit(model, tuple(logs), tuple(states), layout, servos or {}, linear, settle)
        self._observers = [o for key, c in logs[0].channels.items() if (o := observer(model, key, c.axes)) is not None]
        self.names = tuple(log.name for log in logs)
        apart = model.geom_bodyid[:, None] != model.geom_bodyid
        self.rough = self.costly = bool((apart & ((model.geom_contype[:, None] & model.geom_conaffinity) != 0)).any())
        self._place(where, None)

    def _place(self, where: Cut, measured: list[Array] | None) -> None:
        kit = self._kit
        self._begin(len(where.log))
        self._where, self.log_of = where, where.log
        self.time_of = np.array([kit.logs[i].time[s] for i, s in zip(where.log, where.start, strict=True)])
        segments = lay(kit.model, kit.logs, kit.states, where, kit.layout, kit.servos, kit.linear)
        self.segments = replace(segments, settle=round(0.5 / kit.layout.dt) if kit.settle else 0)
        self._start_sd = [
            np.stack([getattr(kit.states[i], name)[s] for i, s in zip(where.log, where.start, strict=True)])
            for name in ("qpos_sd", "qvel_sd")
        ]

        def rows(log: Log, name: str, at: NDArray[np.intp]) -> Array:
            channel = log.channels[name]
            values = channel.values.reshape(len(log), -1)[at]
            return values if channel.mask is None else np.where(channel.mask[at][:, None], values, np.nan)

        def take(o: Observer) -> Array:
            return np.stack([rows(kit.logs[i], o.name, n) for i, n in zip(where.log, where.samples, strict=True)])

        self._measured = measured if measured is not None else [take(o) for o in self._observers]
        noise = [np.array([channel_noise(log, o.name) for log in kit.logs])[where.log] for o in self._observers]
        horizons = len(kit.layout.horizons)
        self._noise = np.concatenate(
            [np.repeat(n[:, None], horizons * o.size, 1) for n, o in zip(noise, self._observers, strict=True)], 1
        )
        self.mask = np.isfinite(
            np.concatenate(
                [self._flat(o.difference(m, m), o) for m, o in zip(self._measured, self._observers, strict=True)], -1
            )
        )
        self.columns = self._describe()

    def _begin(self, size: int) -> None:
        """Nothing is known yet of so many blocks."""
        self._recent, self._noises = Blocks(_RECENT, size), Blocks(_RECENT, size)
        self._of = np.arange(size)
        self._whole: RolloutProblem | None = None  # the same at twice the step, of a problem that was halved
        self._root: RolloutProblem | None = None  # of a part, what it is part of
        self.__dict__.pop("_draws", None)

    @staticmethod
    def _flat(difference: Array, o: Observer) -> Array:
        return difference.reshape(*difference.shape[:-2], -1)

    def _describe(self) -> Columns:
        group, unit, horizon, place, channel = [], [], [], [], []
        for o in self._observers:
            for h in self._kit.layout.horizons:
                for _ in range(o.size):
                    group.append(o.group)
                    unit.append(o.unit)
                    horizon.append(h)
                    place.append(o.place)
                    channel.append(o.name)
        return Columns(tuple(group), tuple(unit), np.array(horizon), tuple(place), tuple(channel))

    def stretches(self) -> list[Stretch]:
        """The measured states along each block."""
        kit, out = self._kit, []
        straight = np.zeros(kit.model.nq, bool)
        observed, known = kit.states[0].observed, np.any(kit.states[0].qpos_sd > 0, axis=0)
        for j in range(kit.model.njnt):
            q, d, kind = int(kit.model.jnt_qposadr[j]), int(kit.model.jnt_dofadr[j]), int(kit.model.jnt_type[j])
            if kind == int(mujoco.mjtJoint.mjJNT_FREE):  # of a base whose velocity alone is measured no place is known
                straight[q : q + 3] = known[d : d + 3]
            elif kind >= int(mujoco.mjtJoint.mjJNT_SLIDE):  # a joint's measured speed is integrated
                straight[q] = observed[d]
        for i, start in zip(self._where.log, self._where.start, strict=True):
            time = kit.logs[i].time
            last = int(np.searchsorted(time, time[start] + self.segments.steps * self.segments.dt)) + 1
            rows = slice(start, last)
            states = kit.states[i]
            steps = (time[rows] - time[start]) / self.segments.dt
            out.append(Stretch(steps, states.qpos[rows], states.qvel[rows], straight, observed))
        return out

    @property
    def sensor_sd(self) -> Array:
        """(S, m) standard deviation of each measured number."""
        return self._noise

    @property
    def observers(self) -> list[Observer]:
        """The compared channels, in the order of the columns."""
        return self._observers

    def samples(self, channel: int) -> tuple[Array, Array]:
        """The first block's compared samples of a channel: (h,) physics steps after the start and (h, dim) values."""
        there = np.isfinite(self._measured[channel][0]).all(1)
        return self._where.step[0][there], self._measured[channel][0][there]

    def predict(
        self, plant: Plant, x: Array, segments: Segments, observers: Sequence[Observer]
    ) -> tuple[list[Array], Trajectory]:
        """What each channel would report along a roll-out, (P, S, K + 1, dim) each, sensor effects included."""
        plant, x = plant.under(x, segments.condition)
        traj = plant.shoot(x, segments, sensors=any(o.needs_sensors for o in observers))
        thetas = plant.split(x)[1]
        out = []
        for o in observers:
            values = o.predict(traj)
            for effect, theta in zip(plant.effects, thetas, strict=True):
                if overrides(effect, "sense"):
                    values = effect.sense(o.name, values, theta[:, None, :] if theta.ndim == 2 else theta, segments.dt)
            out.append(o.pick(values))
        return out, traj

    def _compare(
        self,
        plant: Plant,
        x: Array,
        segments: Segments,
        measured: Sequence[Array],
        step: Array,
        mask: NDArray[np.bool_],
    ) -> Array:
        values, traj = self.predict(plant, x, segments, self._observers)
        with np.errstate(invalid="ignore", over="ignore"):  # of a roll-out that came apart nothing counts
            parts = [
                self._flat(o.difference(interpolate(v, step, o.quaternion), m), o)
                for o, v, m in zip(self._observers, values, measured, strict=True)
            ]
        residual = np.where(mask, np.concatenate(parts, -1), 0.0)
        return np.where(traj.stable[..., None], residual, np.nan)

    def residual(self, plant: Plant, x: Array) -> Array:
        """See `Problem`; read-only."""

        def rolled(rows: NDArray[np.intp], blocks: NDArray[np.intp]) -> Array:
            of = self if len(blocks) == len(self) else self.take(blocks)
            return of._compare(plant, x[rows], of.segments, of._measured, of._where.step, of.mask)

        return self._recent([_question(plant, row) for row in x], self._of, rolled)

    def each(self, plant: Plant, x: Array) -> Array:
        """See `Problem`; all in one batch, of which each block is in but once."""
        rows, of = np.unique(x, axis=0, return_inverse=True)
        of, whole, out = of.reshape(-1), list[Array](), np.empty(self.mask.shape)

        def rolled(index: NDArray[np.intp]) -> Array:
            if not whole:
                inside, own = plant.under(rows, self.segments.condition)
                own = own[of] if own.ndim == 2 else own[of, np.arange(len(self))]
                whole.append(self._again(inside, own[None], self.segments, 1)[0])
            return whole[0][index][None]

        for k, row in enumerate(rows):
            index = np.flatnonzero(of == k)
            answer = lambda _, blocks, index=index: rolled(index[blocks])  # noqa: E731
            out[index] = self._recent([_question(plant, row)], self._of[index], answer)[0]
        return out

    def touches(self, plant: Plant, x: Array) -> bool:
        """Whether bodies touch in any roll-out at x (size,)."""
        return bool(plant.shoot(x[None], self.segments).touched.any())

    def covariance(self, plant: Plant, x: Array) -> Array:
        """Sensor noise, start-state noise carried through the roll-out, and the discretisation's own error.

        Where bodies touch neither is a straight line: a foot that lands a step sooner or later makes an error in a
        direction of its own. There both are taken over starts drawn from their noise: with one direction for the
        discretisation, X of the true model of a trotting quadruped is 3 at a step of 5 ms, and with `_DRAWS` it is 1.
        And over a few psi near by: how much a landing's error grows differs from one to the next, so that under the
        noise of one alone its own errors would be the likeliest, and a fit would stay where it began.
        """
        size, width = len(self), len(self.columns)
        sigma = np.zeros((size, width, width))
        sigma[:, np.arange(width), np.arange(width)] = np.where(self.mask, self._noise**2, 1.0)
        if self.rough:
            carried, discretised = self._impacts(plant, x)
        else:
            base = self.residual(plant, x[None])[0]
            carried = self._carried(plant, x, base)
            discretised = (self._halved(plant, x, self.segments) - base) / self.reach(plant)
        for column in (*carried, *discretised):
            column = np.where(np.isfinite(column), column, 0.0)
            sigma += column[:, :, None] * column[:, None, :]
        return sigma

    @staticmethod
    def reach(plant: Plant) -> float:
        """Share of a step's whole error that halving it shows: of a first-order integrator, half."""
        order = 4 if plant.model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4) else 1
        return 1 - 0.5**order

    def _impacts(self, plant: Plant, x: Array) -> tuple[Array, Array]:
        """Columns (D, S, m) of start-state noise, (F, S, m) of the discretisation's error, from starts drawn at random.

        What was asked last is kept, block by block. At half the step they are those of the whole one: what a start
        carries is the same, and of the error that part is left which halving the step leaves.
        """
        if self._whole is not None:
            carried, error = self._whole._impacts(coarser(plant), x)
            return carried, (1 - self.reach(plant)) * error
        drawn, few = (self._root or self)._draws
        question = plant.model.opt.timestep, plant.space, plant.effects, x.tobytes()

        def rolled(_: NDArray[np.intp], blocks: NDArray[np.intp]) -> Array:
            of = self if len(blocks) == len(self) else self.part(blocks)
            columns = np.concatenate(of._drawn(plant, x, drawn[:, of._of], few))
            return np.moveaxis(columns, 0, 1).reshape(1, len(blocks), -1)

        found = self._noises([question], self._of, rolled)[0].reshape(len(self), len(drawn) + few, -1)
        carried, error = np.split(np.moveaxis(found, 1, 0), [len(drawn)])
        return carried, error

    @cached_property
    def _draws(self) -> tuple[Array, int]:
        """(D, S, 2 nv) draws of the starts' noise, and how many of them tell the discretisation's error."""
        return starts_off(np.concatenate(self._start_sd, 1))

    def _drawn(self, plant: Plant, x: Array, draws: Array, few: int) -> tuple[Array, Array]:
        """See `_impacts`, rolled out from starts off by draws (D, S, 2 nv), of which few tell the error of a step."""
        rows, bases = self._near(plant, x, self.residual(plant, x[None])[0], len(draws))
        here = self._again(plant, rows, self._begun(draws), len(draws))
        fine = self._halved(plant, rows[:few], self._begun(draws[:few]), few)
        return (here - bases) / np.sqrt(len(draws)), (here[:few] - fine) / self.reach(plant) / np.sqrt(few)

    def _near(self, plant: Plant, x: Array, base: Array, count: int) -> tuple[Array, Array]:
        """(count, size) parameters, in turn x and a few with a psi near by, and (count, S, m) residuals under each."""
        rows = near_by(plant.space, x, self._recent.size)
        bases = np.concatenate([base[None], self.residual(plant, rows[1:])])
        bases = np.where(np.isfinite(bases).all(-1, keepdims=True), bases, base)
        turn = np.arange(count) % len(rows)
        return rows[turn], bases[turn]

    def _begun(self, draws: Array) -> Segments:
        """Copies of the segments that begin off their starts by draws (D, S, 2 nv)."""
        count, seg = len(draws), self.segments
        dq, dv = np.split(draws.reshape(-1, draws.shape[-1]), 2, axis=1)
        starts = integrate(self._kit.model, np.concatenate([seg.qpos] * count), dq)
        return repeat(seg, count, starts, np.concatenate([seg.qvel] * count) + dv)

    def _carried(self, plant: Plant, x: Array, base: Array) -> Array:
        """(2 n, S, m) what noise of each of n start coordinates does to the residual, along a line and beside it.

        With f at the start and one standard deviation to either side, a coordinate's part of the residual is
        f' z + f'' z^2 / 2 with z ~ N(0, 1), whose variance is f'^2 + f''^2 / 2. Near a dead centre the noise decides
        which way a crank turns, and the second term says that this segment tells nothing.
        """
        model, seg = self._kit.model, self.segments
        directions = [(kind, d) for kind in (0, 1) for d in range(model.nv) if (self._start_sd[kind][:, d] > 0).any()]
        if not directions:
            return np.zeros((0, *base.shape))
        starts_q, starts_v = [], []
        for kind, d in directions:
            step = np.zeros((len(self), model.nv))
            for sign in (1, -1):
                step[:, d] = sign * self._start_sd[kind][:, d]
                starts_q.append(integrate(model, seg.qpos, step) if kind == 0 else seg.qpos)
                starts_v.append(seg.qvel + step if kind == 1 else seg.qvel)
        n = 2 * len(directions)
        found = self._again(plant, x, repeat(seg, n, np.concatenate(starts_q), np.concatenate(starts_v)), n) - base
        up, down = found[::2], found[1::2]
        return np.concatenate([(up - down) / 2, (up + down) / np.sqrt(2)])

    def _again(self, plant: Plant, x: Array, segments: Segments, copies: int, finer: int = 1) -> Array:
        """(copies, S, m) residual of copies of the segments with other starts, at a step so many times finer.

        x is (size,); (copies, size) with parameters of its own for each copy; or (copies, S, size) for each block.
        """
        if x.ndim == 2:
            plant, x = plant.under(x, self.segments.condition)
            x = np.repeat(x[:, None], len(self), 1) if x.ndim == 2 else x
        x = x if x.ndim == 1 else x.reshape(copies * len(self), x.shape[-1])
        measured = [np.concatenate([m] * copies) for m in self._measured]
        step, mask = np.concatenate([self._where.step * finer] * copies), np.concatenate([self.mask] * copies)
        return self._compare(plant, x[None], segments, measured, step, mask)[0].reshape(copies, len(self), -1)

    def _halved(self, plant: Plant, x: Array, segments: Segments, copies: int = 1) -> Array:
        """The same with the physics step halved."""
        return self._again(finer(plant), x, refine(segments), copies, finer=2)

    def halved(self) -> "RolloutProblem":
        """The same segments at half the physics step, for plants that are `finer`."""
        layout = self._kit.layout
        out = self.beginning(refine(self.segments))
        out._kit = replace(self._kit, layout=replace(layout, dt=layout.dt / 2))
        out._where = replace(self._where, step=self._where.step * 2)
        out._whole = self
        return out

    def beginning(self, segments: Segments, signs: Mapping[str, Array] | None = None) -> "RolloutProblem":
        """The same measurements, predicted along other segments: other starts, other signals, another step.

        Args:
          signs: that the numbers of channels are multiplied by, channel -> (dim,), or (S, 1, dim) for each block.
        """
        out = object.__new__(RolloutProblem)
        out.__dict__.update(self.__dict__)
        out.segments = segments
        out._begin(len(self))
        if signs:
            pairs = zip(self._observers, self._measured, strict=True)
            out._measured = [m * signs[o.name] if o.name in signs else m for o, m in pairs]
        return out

    def part(self, index: NDArray[np.intp]) -> "RolloutProblem":
        """See `Problem`."""
        out = self.take(index)
        out._recent, out._noises, out._of, out._root = self._recent, self._noises, self._of[index], self._root or self
        out._whole = None if self._whole is None else self._whole.part(index)
        return out

    def take(self, index: NDArray[np.intp]) -> "RolloutProblem":
        """See `Problem`."""
        out, w = self.beginning(pick(self.segments, index)), self._where
        out._begin(len(index))
        out._where = Cut(w.log[index], w.start[index], w.samples[index], w.step[index])
        out.log_of, out.time_of = self.log_of[index], self.time_of[index]
        out._start_sd = [s[index] for s in self._start_sd]
        out._measured = [m[index] for m in self._measured]
        out._noise, out.mask = self._noise[index], self.mask[index]
        out._whole = None if self._whole is None else self._whole.take(index)
        return out

    def synthetic(self, plant: Plant, x: Array, rng: np.random.Generator) -> "RolloutProblem":
        """The model's own motion from the measured starts at half the step, with fresh start and sensor noise."""
        values, traj = self.predict(finer(plant), x[None], refine(self.segments), self._observers)
        out = self.take(np.flatnonzero(traj.stable[0]))
        stable, step = traj.stable[0], self._where.step * 2
        measured = []
        at = 0
        for o, v, m in zip(self._observers, values, self._measured, strict=True):
            clean = interpolate(v, step, o.quaternion)[0]
            width = m.shape[1] * o.size
            noise = rng.normal(size=(*m.shape[:2], o.size)) * self._noise[:, at : at + width].reshape(
                *m.shape[:2], o.size
            )
            noisy = quat_multiply(clean, vector_to_quat(noise)) if o.quaternion else clean + noise
            measured.append(noisy[stable])
            at += width
        out._measured = measured
        return out.redrawn(rng)

    def redrawn(self, rng: np.random.Generator) -> "RolloutProblem":
        """The same measurements, begun at starts that are off by as much again as the measured ones may be."""
        dq, dv = (rng.normal(size=sd.shape) * sd for sd in self._start_sd)
        starts = self.segments
        return self.beginning(moved(starts, integrate(self._kit.model, starts.qpos, dq), starts.qvel + dv))


def _question(plant: Plant, x: Array) -> Hashable:
    """All that a block's residual depends on besides the block; x (size,)."""
    return plant.model, plant.space, plant.effects, x.tobytes()
