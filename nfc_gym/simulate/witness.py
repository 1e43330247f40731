"""What a trained structure head says of logs: which family of effects their motion betrays."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference import checkpoint
from nfc_gym.inference.evidence import combined, shares_of, told_by
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.misfit import shown
from nfc_gym.simulate.observed import actions_of, commands, proprio, require_unfeeling

Array = NDArray[np.float64]
MISFIT = "misfit"  # in a checkpoint's notes: its structure head is shown the misfit beside the motion
_HALF = 0.5  # a rotation by a small angle moves a quaternion's entries by half of it
_DRAWS = 4  # of the noise that quiet logs are given


def heads(path: Path) -> tuple[bool, bool]:
    """Whether a posterior's checkpoint has a structure head for logs, and whether it was given a window."""
    network, given, notes = checkpoint.load(path)
    return network.structure is not None and bool(notes.get(MISFIT)), given is not None


class Witness:
    """Asks a structure head about stretches of a log and what a calibrated model predicts for them.

    Args:
      path: a checkpoint of `nfc-gym train --structure`.

    Attributes:
      families: that the head knows, "none" first.
      machine: the robot of its training set.
      horizon, dt: H control steps of `dt` s make a window.

    Raises:
      InputError: no checkpoint, one without a structure head, or one that does not say what it was trained on.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.network, _, self.notes = checkpoint.load(path)
        missing = [k for k in (MISFIT, "environment", "noise") if k not in self.notes]
        if self.network.structure is None or missing:
            raise InputError(f"{path}: holds no structure head for logs; `nfc-gym train --structure` trains one")
        self.machine = Machine(self.notes["environment"])
        require_unfeeling(self.machine)
        self.families = tuple(self.network.config.families)
        self.horizon, self.dt = self.network.sizes.horizon, self.machine.dt

    def __call__(
        self,
        motion: tuple[Array, Array],
        expected: tuple[Array, Array],
        sent: Mapping[str, Array],
        noise: Mapping[str, float],
        seed: int = 0,
    ) -> dict[str, float]:
        """Probability of each family given W windows together (see `inference.evidence`).

        Args:
          motion: positions (W, H+1, nq) and velocities (W, H+1, nv) as measured at control steps, unsmoothed.
          expected: the same of the calibrated model, from the same starts.
          sent: `ctrl:<actuator>` -> (W, H) what was commanded.
          noise: channel name -> standard deviation of its sensor.
          seed: of the noise that quiet logs are given: windows quieter than all that a network was trained on are new
            inputs to it.

        Raises:
          InputError: another robot's motion, or commands that none of its actions makes.
        """
        model, machine = self.machine.model, self.machine
        if motion[0].shape[2] != model.nq or motion[1].shape[2] != model.nv:
            raise InputError(
                f"{self.path}: the head is of {machine.environment} with {model.nq} positions and {model.nv} "
                f"velocities; the mapping's model has {motion[0].shape[2]} and {motion[1].shape[2]}"
            )
        count, h = motion[0].shape[0], self.horizon
        ctrl = commands(machine, {k: v.reshape(-1) for k, v in sent.items()})
        actions = actions_of(machine, ctrl).reshape(count, h, -1)
        seen, predicted = (proprio(machine, *pair, actions) for pair in (motion, expected))
        rng, sd, told = np.random.default_rng(seed), np.array(self.notes["noise"]), []
        for _ in range(_DRAWS):
            noisy = seen + self._lacking(noise) * rng.standard_normal(seen.shape)
            told.append(told_by(self.network, shown(machine, noisy, predicted, sd).astype(float), actions))
        found = combined(np.mean(told, 0), shares_of(self.families, self.notes))
        return dict(zip(self.families, found.tolist(), strict=True))

    def _lacking(self, noise: Mapping[str, float]) -> Array:
        """(s,) noise that the training set's states had and the log's have not."""
        names = self.machine.state_names
        known = {k.removesuffix("@body"): sd for k, sd in noise.items()}
        own = np.zeros(len(names))
        for i, name in enumerate(names):
            channel = name.rsplit(".", 1)[0].removesuffix("@body")
            own[i] = known.get(channel, 0.0) * (_HALF if channel.endswith(":quat") else 1.0)
        return np.sqrt(np.maximum(np.square(self.notes["noise"]) - own**2, 0.0))
