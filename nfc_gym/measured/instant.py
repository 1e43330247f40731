"""Problems without roll-outs: what `inverse` and `forward` share.

Both look at every sample at once. They carry less evidence than roll-outs, since accelerations come from differences;
they are what a machine offers that measures forces, or whose states are known while only a sensor is to be predicted.
"""

import copy
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.problem import Columns, Problem
from nfc_gym.measured.smoothing import covered, moving_average
from nfc_gym.measured.states import States, channel_noise
from nfc_gym.physics.effects.base import Context
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.lookup import actuator_names
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_AT_ONCE = 200_000  # samples of all tracks under all parameter vectors


@dataclass(frozen=True)
class Track:
    """One log thinned to every `stride`-th sample: what the model is evaluated at, and what it is compared with.

    `wanted` (T,) says at which samples a prediction is asked for; None is all, and a problem may give more. `held`
    (T, stride, nu) are the commands from each sample on until the next, those of the rows between them among these;
    `linear` (nu,) says of which of them the ways from row to row are straight, and not steps.
    """

    name: str
    time: Array
    dt: float
    qpos: Array
    qvel: Array
    qacc: Array
    held: Array
    linear: NDArray[np.bool_]
    exogenous: dict[str, Array]
    known: dict[tuple[str, tuple[str, ...]], Array]
    measured: Array
    mask: NDArray[np.bool_]
    noise: Array
    condition: str = ""
    wanted: NDArray[np.bool_] | None = None

    @property
    def ctrl(self) -> Array:
        """(T, nu) commands at the samples."""
        return self.held[:, 0]


def track(
    model: mujoco.MjModel,
    log: Log,
    states: States,
    channels: Sequence[str],
    stride: int,
    linear: frozenset[str] = frozenset(),
) -> Track:
    """Thin a log; measured columns of all channels are set side by side.

    Args:
      linear: names of commands that go straight from row to row (`ctrl:<actuator>`); all others are held.
    """
    rows = slice(None, None, stride)
    straight = np.array([f"ctrl:{name}" in linear for name in actuator_names(model)], bool)
    ctrl = np.zeros((-(-len(log) // stride) * stride, model.nu))
    for key, values in log.controls.items():
        a = actuator_names(model).index(key.removeprefix("ctrl:"))
        ctrl[: len(log), a], ctrl[len(log) :, a] = values, values[-1]
    known = {}
    for key, values in log.known.items():
        name, _, of = key.partition(":")
        known[(name, tuple(of.split("+")) if of else ())] = values[rows]
    columns, masks, noise = [], [], []
    for name in channels:
        c = log.channels[name]
        values = c.values.reshape(len(log), -1)
        columns.append(values)
        masks.append(np.isfinite(values) & (np.ones(len(log), bool) if c.mask is None else c.mask)[:, None])
        noise += [channel_noise(log, name)] * values.shape[1]
    return Track(
        log.name, log.time[rows], log.interval * stride,
        states.qpos[rows], states.qvel[rows], states.qacc[rows], ctrl.reshape(-1, stride, model.nu), straight,
        {k: v[rows] for k, v in log.exogenous.items()}, known,
        np.concatenate(columns, 1)[rows], np.concatenate(masks, 1)[rows], np.array(noise), log.condition,
    )  # fmt: skip


def still(model: mujoco.MjModel, dt: float, q: Array, v: Array, ctrl: Array, exogenous: dict[str, Array]) -> Context:
    """A context without a simulation: laws of state, command and signals can be evaluated in it, and no others."""

    def none(name: str) -> Array:
        raise KeyError(f"{name}: only states, commands and signals are known here")

    return Context(model, dt, q, v, ctrl, exogenous, none, none)


class InstantProblem(Problem):
    """Blocks of consecutive samples; a subclass says what is predicted along a whole track.

    Args:
      states: along each of the logs.
      length: s, of a block.
      stride: rows of a log from sample to sample.
      linear: see `track`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        logs: Sequence[Log],
        states: Sequence[States],
        length: float,
        stride: int = 1,
        linear: frozenset[str] = frozenset(),
    ) -> None:
        self.channels = self.compared(model, logs[0])
        self.smooth = max(logs[0].channels[c].smooth for c in self.channels)
        self.stride = stride if self.smooth == 1 else min(stride, max(1, self.smooth // 3))
        kept = self.channels, self.stride, linear
        self.tracks = [track(model, log, s, *kept) for log, s in zip(logs, states, strict=True)]
        self.names = tuple(log.name for log in logs)
        self._layout(model, length)

    @abstractmethod
    def compared(self, model: mujoco.MjModel, log: Log) -> list[str]:
        """Channels of the log that this problem predicts."""

    @abstractmethod
    def evaluate(self, plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Array]:
        """Predictions (P, T, C) along each track, of one time step, for parameter vectors (P, size)."""

    @abstractmethod
    def describe(self, model: mujoco.MjModel) -> list[tuple[str, str, str, str]]:
        """(group, unit, place, channel) of each of the C columns."""

    def _layout(self, model: mujoco.MjModel, length: float) -> None:
        """Cut every track into blocks; within a block smoothed samples are thinned to independent ones."""
        thin = max(1, self.smooth // (2 * self.stride))
        per = max(2, round(length / (self.tracks[0].dt * thin)))
        log_of, rows = [], []
        for i, t in enumerate(self.tracks):
            index = np.arange(0, len(t.time), thin)
            for b in range(len(index) // per):
                block = index[b * per : (b + 1) * per]
                if t.mask[block].any():
                    log_of.append(i)
                    rows.append(block)
        if not rows:
            raise InputError(
                f"no log is long enough for one block of {length:g} s with a valid sample: shorten segments.length"
            )
        self.log_of, self.rows = np.array(log_of), np.array(rows)
        self.mask = np.stack([self.tracks[i].mask[r].ravel() for i, r in zip(self.log_of, self.rows, strict=True)])
        self.time_of = np.array([self.tracks[i].time[r[0]] for i, r in zip(self.log_of, self.rows, strict=True)])
        what = self.describe(model) * per
        group, unit, place, channel = zip(*what, strict=True)
        self.columns = Columns(group, unit, np.zeros(len(what)), place, channel)

    @property
    def window(self) -> int:
        """Samples that remain of the declared width of the moving average."""
        return max(1, self.smooth // self.stride)

    def smoothed(self, values: Array, mask: NDArray[np.bool_]) -> Array:
        """Moving average (T, C) of the values that count."""
        return moving_average(values, self.window, mask)

    def turns(self, count: int, tracks: Sequence[Track]) -> list[slice]:
        """Parameter vectors that are evaluated together, so that memory stays bounded whatever their number."""
        turn = max(1, _AT_ONCE // sum(len(t.time) for t in tracks))
        return [slice(i, i + turn) for i in range(0, count, turn)]

    def along(self, plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Array]:
        """`evaluate`, each track in its own condition, and together with those of its own time step only."""
        apart = any(isinstance(e, Conditioned) for e in plant.effects)
        kinds = [(t.condition if apart else "", f"{t.dt:.3g}") for t in tracks]
        out: list[Array] = [np.zeros(0)] * len(tracks)
        for kind in dict.fromkeys(kinds):
            of = [i for i, own in enumerate(kinds) if own == kind]
            inside, own = plant.under(x, np.array([kind[0]])) if apart else (plant, x[:, None])
            for i, values in zip(of, self.evaluate(inside, own[:, 0], [tracks[i] for i in of]), strict=True):
                out[i] = values
        return out

    def residual(self, plant: Plant, x: Array) -> Array:
        """See `Problem`."""
        needed = np.unique(self.log_of)
        predicted = self.along(plant, x, [replace(self.tracks[i], wanted=self._wanted(i)) for i in needed])
        out = np.zeros((len(x), *self.mask.shape))
        for i, values in zip(needed, predicted, strict=True):
            t = self.tracks[i]
            where = np.flatnonzero(self.log_of == i)
            for p in range(len(x)):
                error = self.smoothed(t.measured - values[p], t.mask)
                out[p, where] = error[self.rows[where]].reshape(len(where), -1)
        return np.where(self.mask, out, 0.0)

    def _wanted(self, log: int) -> NDArray[np.bool_]:
        """Samples of a track that its blocks are smoothed from."""
        reach = self.window
        read = np.zeros(len(self.tracks[log].time))
        read[self.rows[self.log_of == log]] = 1.0
        return np.convolve(read, np.ones(2 * reach + 1))[reach : reach + len(read)] > 0.5

    def covariance(self, plant: Plant, x: Array) -> Array:
        """Sensor noise alone: what the differentiated motion adds is unknown and lands in the unexplained variance."""
        width = self.mask.shape[1]
        noise = np.stack([np.tile(self.tracks[i].noise, width // len(self.tracks[i].noise)) for i in self.log_of])
        # A mean of the few samples at an end, or beside masked ones, has more noise than one of a whole window.
        share = {i: covered(self.tracks[i].mask, self.window) for i in np.unique(self.log_of)}
        held = np.stack([share[i][r].ravel() for i, r in zip(self.log_of, self.rows, strict=True)])
        sigma = np.zeros((len(self), width, width))
        variance = np.maximum(noise, 1e-9) ** 2 / self.window / np.where(self.mask, held, 1.0)
        sigma[:, np.arange(width), np.arange(width)] = variance
        return sigma

    def motion(self, model: mujoco.MjModel) -> Context:
        """What laws of the motion read at every compared sample, (S, T, ...) each."""
        pairs = list(zip(self.log_of, self.rows, strict=True))
        pick = lambda name: np.stack([getattr(self.tracks[i], name)[r] for i, r in pairs])  # noqa: E731
        exogenous = {k: np.stack([self.tracks[i].exogenous[k][r] for i, r in pairs]) for k in self.tracks[0].exogenous}
        return still(model, self.tracks[0].dt, pick("qpos"), pick("qvel"), pick("ctrl"), exogenous)

    def take(self, index: NDArray[np.intp]) -> "InstantProblem":
        """See `Problem`."""
        out = copy.copy(self)
        out.log_of, out.rows, out.mask, out.time_of = (
            self.log_of[index],
            self.rows[index],
            self.mask[index],
            self.time_of[index],
        )
        return out

    def synthetic(self, plant: Plant, x: Array, rng: np.random.Generator) -> "InstantProblem":
        """See `Problem`."""
        out = copy.copy(self)
        predicted = self.along(plant, x[None], self.tracks)
        out.tracks = [
            Track(**{**t.__dict__, "measured": p[0] + rng.normal(size=t.measured.shape) * t.noise})
            for t, p in zip(self.tracks, predicted, strict=True)
        ]
        return out
