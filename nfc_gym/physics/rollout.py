"""Batched multiple-shooting roll-outs on `mujoco.batch`, with effects acting through their hooks at every physics step.

Rows of the batch are pairs (parameter vector, segment), parameter vectors slowest. Derived quantities that effects read
are one substep behind the state, exactly as they are in an `MjData` between two calls of `mj_step`, so that a wrapper
around a single environment and this roll-out agree bit for bit.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.run import Run
from nfc_gym.physics.segments import Segments, Trajectory

Array = NDArray[np.float64]
_ROW_BYTES = 300_000_000  # recorded trajectories of one call; more parameter vectors are run in turns


class Plant:
    """A model, its psi, and the effects at work in it.

    Args:
      model: the nominal model; `model.opt.timestep` is the physics step.
      space: psi.
      effects: in the order in which their hooks run.
      nthread: threads of the batch; 0 takes every core.
    """

    def __init__(
        self, model: mujoco.MjModel, space: ParameterSpace, effects: Sequence[Effect] = (), nthread: int = 0
    ) -> None:
        self.model, self.space, self.effects, self.nthread = model, space, tuple(effects), nthread
        for effect in self.effects:
            effect.bind(model)

    def with_effects(self, effects: Sequence[Effect]) -> "Plant":
        """The same machine with other effects."""
        return Plant(self.model, self.space, effects, self.nthread)

    @property
    def size(self) -> int:
        """Length of a full parameter vector: psi, then each effect's parameters."""
        return len(self.space) + sum(len(e.params) for e in self.effects)

    def split(self, x: Array) -> tuple[Array, list[Array]]:
        """Full parameter vectors (..., size) -> psi (..., d) and theta of each effect (..., k)."""
        sizes = [len(self.space), *(len(e.params) for e in self.effects)]
        psi, *thetas = np.split(x, np.cumsum(sizes)[:-1], axis=-1)
        return psi, thetas

    @property
    def null(self) -> Array:
        """(size,) nominal psi and every effect at null."""
        return np.concatenate([self.space.nominal, *(e.null for e in self.effects)])

    def chart(self, x: Array) -> Array:
        """Full parameter vectors (..., size) -> the coordinates that a fit walks in (`Effect.chart`); psi stays."""
        psi, thetas = self.split(x)
        return np.concatenate([psi, *(e.chart(t) for e, t in zip(self.effects, thetas, strict=True))], -1)

    def unchart(self, coordinates: Array) -> Array:
        """The inverse of `chart`."""
        psi, parts = self.split(coordinates)
        return np.concatenate([psi, *(e.unchart(c) for e, c in zip(self.effects, parts, strict=True))], -1)

    def under(self, x: Array, labels: NDArray[np.str_] | None) -> "tuple[Plant, Array]":
        """The machine in the conditions of some segments: effects that differ between them have one value each.

        Args:
          x: (P, size) full parameter vectors.
          labels: (S,) conditions.

        Returns:
          This plant and x where no effect differs; else a plant of the effects inside, and x (P, S, size').
        """
        if x.ndim == 3 or not any(isinstance(e, Conditioned) for e in self.effects):
            return self, x
        if labels is None:
            raise InputError("these segments have no condition, and effects of the model differ between conditions")
        psi, thetas = self.split(x)
        parts = [np.broadcast_to(psi[:, None], (len(x), len(labels), psi.shape[-1]))]
        effects: list[Effect] = []
        for effect, theta in zip(self.effects, thetas, strict=True):
            if isinstance(effect, Conditioned):
                parts.append(theta[:, effect.columns[effect.index(labels)]])
                effects.append(effect.inner)
            else:
                parts.append(np.broadcast_to(theta[:, None], (len(x), len(labels), theta.shape[-1])))
                effects.append(effect)
        return self.with_effects(effects), np.concatenate(parts, -1)

    def write(self, fields: ModelFields, x: Array) -> None:
        """Psi and the effects' model edits into one model, x (size,), or a batch, x (nsim, size)."""
        psi, thetas = self.split(x)
        self.space.write(fields, psi)
        for effect, theta in zip(self.effects, thetas, strict=True):
            effect.model(fields, theta)

    def shoot(self, x: Array, segments: Segments, sensors: bool = False) -> Trajectory:
        """Roll every segment out under every parameter vector.

        Args:
          x: (P, size) or (P, S, size) full parameter vectors, the latter with values of its own for each segment.
          segments: starts, commands and signals.
          sensors: record `sensordata` too.
        """
        plant, x = self.under(x, segments.condition)
        if plant is not self:
            return plant.shoot(x, segments, sensors)
        width = self.model.nq + self.model.nv + (self.model.nsensordata if sensors else 0)
        turn = max(1, int(_ROW_BYTES / (8 * len(segments) * (segments.steps + 1) * width)))
        parts = [self._shoot(x[i : i + turn], segments, sensors) for i in range(0, len(x), turn)]
        if len(parts) == 1:
            return parts[0]
        return Trajectory(
            np.concatenate([p.qpos for p in parts]),
            np.concatenate([p.qvel for p in parts]),
            np.concatenate([p.sensordata for p in parts if p.sensordata is not None]) if sensors else None,
            np.concatenate([p.stable for p in parts]),
            np.concatenate([p.touched for p in parts]),
        )

    def _shoot(self, x: Array, segments: Segments, sensors: bool) -> Trajectory:
        count, size = len(x), len(segments)
        rows = np.broadcast_to(x[:, None] if x.ndim == 2 else x, (count, size, self.size)).reshape(
            count * size, self.size
        )
        with np.errstate(invalid="ignore", over="ignore"):  # laws see what comes apart too; it is marked unstable
            return Run(self, rows, count, segments, sensors).roll()
