"""What a trained structure head says of logs: which family of effects their motion betrays."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.inference import checkpoint
from nfc_gym.inference.evidence import combined, shares_of, told_by
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.observed import commands, observed

Array = NDArray[np.float64]
_HALF = 0.5  # a rotation by a small angle moves a quaternion's entries by half of it


class States(Protocol):
    """Measured states along a log: positions (T, nq) and velocities (T, nv) in the order of the robot's model."""

    qpos: Array
    qvel: Array


def heads(path: Path) -> tuple[bool, bool]:
    """Whether a posterior's checkpoint has a structure head, and whether it was given a window."""
    network, given, _ = checkpoint.load(path)
    return network.structure is not None, given is not None


class Witness:
    """Cuts logs into windows like those of the training set and asks the head about each.

    Args:
      path: a checkpoint of `nfc-gym train --structure`.

    Attributes:
      families: that the head knows, "none" first.
      machine: the robot of its training set.

    Raises:
      InputError: no checkpoint, one without a structure head, or one that does not say what it was trained on.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.network, _, self.notes = checkpoint.load(path)
        if self.network.structure is None:
            raise InputError(f"{path}: trained without a structure head; `nfc-gym train --structure` trains one")
        missing = [k for k in ("environment", "noise") if k not in self.notes]
        if missing:
            raise InputError(f"{path}: does not say the {missing[0]} of its training set; `nfc-gym train` writes it")
        self.machine = Machine(self.notes["environment"])
        self.families = tuple(self.network.config.families)

    def __call__(self, logs: Sequence[Log], states: Sequence[States], seed: int = 0) -> tuple[dict[str, float], int]:
        """Probability of each family, and from how many windows.

        Args:
          logs: of one machine.
          states: as measured along each, unsmoothed: the head saw observations with their noise.
          seed: of the noise that quiet logs are given.

        Raises:
          InputError: logs of another robot or rate, or shorter than a window.
        """
        parts = [self._windows(log, s) for log, s in zip(logs, states, strict=True)]
        seen, done = (np.concatenate(p) for p in zip(*parts, strict=True))
        if not len(seen):
            need = self.network.sizes.horizon * self.machine.dt
            raise InputError(f"{self.path}: its windows last {need:g} s, and no log to fit is as long")
        told = told_by(self.network, seen, done, self._lacking(logs[0]), np.random.default_rng(seed))
        found = combined(told, shares_of(self.families, self.notes))
        return dict(zip(self.families, found.tolist(), strict=True)), len(seen)

    def _windows(self, log: Log, states: States) -> tuple[Array, Array]:
        """(W, H+1, s) and (W, H, a) of a log, one after the other; what is left at its end is dropped."""
        model = self.machine.model
        if states.qpos.shape[1] != model.nq or states.qvel.shape[1] != model.nv:
            raise InputError(
                f"{self.path}: the head is of {self.machine.environment} with {model.nq} positions and {model.nv} "
                f"velocities; the mapping's model has {states.qpos.shape[1]} and {states.qvel.shape[1]}"
            )
        sent = commands(self.machine, log.controls)
        seen, done = observed(self.machine, log.time - log.time[0], states.qpos, states.qvel, sent)
        h = self.network.sizes.horizon
        starts = range(0, len(done) - h + 1, h)
        return (
            np.array([seen[i : i + h + 1] for i in starts]).reshape(-1, h + 1, seen.shape[1]),
            np.array([done[i : i + h] for i in starts]).reshape(-1, h, done.shape[1]),
        )

    def _lacking(self, log: Log) -> Array:
        """(s,) noise that the training set's states had and the log's have not; of what no channel says, none."""
        names = self.machine.state_names
        known = {k.removesuffix("@body"): c.noise for k, c in log.channels.items() if c.noise is not None}
        own = np.zeros(len(names))
        for i, name in enumerate(names):
            channel = name.rsplit(".", 1)[0].removesuffix("@body")
            own[i] = known.get(channel, 0.0) * (_HALF if channel.endswith(":quat") else 1.0)
        return np.sqrt(np.maximum(np.square(self.notes["noise"]) - own**2, 0.0))
