"""What reaches the actuators along a log: its commands, after the effects on them and what the model makes late."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.measured.instant import Track
from nfc_gym.physics.activations import LED_BY, Activations
from nfc_gym.physics.delays import delayed_course, longest_delay
from nfc_gym.physics.effects.base import Effect, overrides
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import split_field
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_AT_ONCE = 4_000_000  # commands of all steps that are worked on together


@dataclass(frozen=True)
class Delivered:
    """What reaches the actuators at the samples of a track, for each of P parameter vectors.

    Attributes:
      ctrl: (P, T, nu) commands after the effects on them.
      passed: (P, T, nu) what the actuators' own delays let through of them.
      act: (P, T, na) activations when a sample's command comes, which they have not felt yet.
    """

    ctrl: Array
    passed: Array
    act: Array

    def of(self, some: slice) -> "Delivered":
        """The same for some of the parameter vectors."""
        return Delivered(self.ctrl[some], self.passed[some], self.act[some])


def delivered(plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Delivered]:
    """What reaches the actuators along each track, of one time step, at parameter vectors (P, size).

    Commands go on from row to row of the log as each is held; what remembers them goes on in steps of the physics.
    """
    psi, thetas = plant.split(x)
    commanding = [(e, theta) for e, theta in zip(plant.effects, thetas, strict=True) if overrides(e, "action")]
    effects = [e for e, _ in commanding]
    # Most parameter vectors of a fit differ in what no command feels.
    felt = psi if _led_by(plant) else psi[:, :0]
    each, where = np.unique(np.concatenate([felt, *(t for _, t in commanding)], 1), axis=0, return_inverse=True)
    courses = _Courses(plant, effects, tracks, each[:, felt.shape[1] :])
    turn = max(1, _AT_ONCE // courses.size)
    parts = [
        courses.under(some[:, felt.shape[1] :], _fields(plant, some[:, : felt.shape[1]]))
        for some in (each[i : i + turn] for i in range(0, len(each), turn))
    ]
    whole = [np.concatenate(arrays)[where.reshape(-1)] for arrays in zip(*parts, strict=True)]
    return [Delivered(*(a[:, i, : len(t.time)] for a in whole)) for i, t in enumerate(tracks)]


def _led_by(plant: Plant) -> bool:
    """Whether psi changes what the model's own filters and delays make of commands."""
    model = plant.model
    remembers = bool(model.na) or bool(longest_delay(model))
    return remembers and any(split_field(p.field)[0] in LED_BY for p in plant.space.parameters)


def _fields(plant: Plant, psi: Array) -> dict[str, Array]:
    """Of `LED_BY` those that psi (P, d) writes to, (P, 1, nu, ...) each; none where nothing is felt of it."""
    if not psi.shape[1]:
        return {}
    fields = ModelFields(Batch(plant.model, len(psi), 1))
    plant.space.write(fields, psi)
    return {name: np.array(values)[:, None] for name, values in fields.touched.items() if name in LED_BY}


class _Courses:
    """Commands of all tracks side by side, in the steps that those who remember them need."""

    def __init__(self, plant: Plant, effects: Sequence[Effect], tracks: Sequence[Track], thetas: Array) -> None:
        self.model, self.effects = plant.model, effects
        longest = max(len(t.time) for t in tracks)
        pad = lambda a: np.concatenate([a, np.repeat(a[-1:], longest - len(a), 0)])  # noqa: E731
        held = np.stack([pad(t.held) for t in tracks])
        rows = held.shape[2]
        self.late, states = bool(longest_delay(self.model)), bool(self.model.na)
        row = tracks[0].dt / rows
        # Steps of the physics from one row of the log to the next.
        parts = max(1, round(row / self.model.opt.timestep))
        first = np.broadcast_to(held[:, 0, 0], (len(thetas), *held[:, 0, 0].shape))
        remembering = self.late or any(
            e.state0(first.shape[:-1], first, th, row / parts) is not None
            for e, th in zip(effects, self._split(thetas, len(tracks)), strict=True)
        )
        linear = tracks[0].linear
        if not remembering and not (states and linear.any()):
            parts = 1  # where activations get to under a command that is held is known at once
        self.step = row / parts
        self.every = rows * parts if remembering or states else 1  # steps of a course from sample to sample
        if self.every == 1:
            self.ctrl = held[:, :, 0]
        else:
            self.ctrl = _between(held.reshape(len(tracks), -1, held.shape[-1]), parts, linear)
        names = {s for e in effects for s in e.signals}
        pick = lambda k: np.stack([pad(t.exogenous[k]) for t in tracks])  # noqa: E731
        self.signals = {k: np.repeat(pick(k), self.every, 1) for k in tracks[0].exogenous if k in names or effects}

    @property
    def size(self) -> int:
        """Numbers of one parameter vector's courses."""
        return max(self.ctrl.size, 1)

    def _split(self, thetas: Array, tracks: int) -> list[Array]:
        """(P, L, k) of each effect, of (P, size) of all that act on commands."""
        cuts = np.cumsum([len(e.params) for e in self.effects])[:-1]
        return [np.repeat(th[:, None], tracks, 1) for th in np.split(thetas, cuts, axis=1)][: len(self.effects)]

    def under(self, thetas: Array, fields: Mapping[str, Array]) -> tuple[Array, Array, Array]:
        """(P, L, T, nu), (P, L, T, nu), (P, L, T, na): see `Delivered`."""
        model, shape = self.model, (len(thetas), *self.ctrl.shape)
        ctrl = np.broadcast_to(self.ctrl, shape)
        signals = {k: np.broadcast_to(s, shape[:-1]) for k, s in self.signals.items()}
        for effect, theta in zip(self.effects, self._split(thetas, shape[1]), strict=True):
            ctrl = effect.course(ctrl, theta, signals, self.step)
        passed = delayed_course(model, ctrl, self.step, fields) if self.late else ctrl
        at = slice(None, None, self.every)
        act = Activations(model, self.step, fields).course(passed)[..., at, :]
        ctrl, passed = np.ascontiguousarray(ctrl[..., at, :]), np.ascontiguousarray(passed[..., at, :])
        return ctrl, passed, np.ascontiguousarray(act)


def _between(ctrl: Array, parts: int, linear: NDArray[np.bool_]) -> Array:
    """Commands (L, T, nu) in steps (L, T parts, nu): held from row to row, or those of `linear` (nu,) interpolated."""
    out = np.repeat(ctrl, parts, 1)
    if parts > 1 and linear.any():
        change = np.diff(ctrl[..., linear], axis=1, append=ctrl[:, -1:, linear])
        share = np.tile(np.arange(parts) / parts, ctrl.shape[1])[:, None]
        out[..., linear] += share * np.repeat(change, parts, 1)
    return out
