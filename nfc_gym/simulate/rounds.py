"""`Simulator`: windows under given psi, in memory, as sequential rounds of inference ask for them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.core.whole import require_share, require_whole
from nfc_gym.simulate import workers
from nfc_gym.simulate.draws import Array
from nfc_gym.simulate.machine import MOTOR, Machine
from nfc_gym.simulate.maps import maps
from nfc_gym.simulate.policy import Act
from nfc_gym.simulate.recorded import Recorded
from nfc_gym.simulate.run import PER_SHARD, manifest_of, settled, units
from nfc_gym.simulate.shard import Plan


@dataclass(frozen=True)
class Simulator:
    """Calls with (psi, generator) simulate one window for each psi, in their order.

    Attributes:
      environment: id.
      effects, motor, policy, policy_share: as of `simulate`.
      jobs: processes, and threads where one shard is all there is; 0 takes all cores.
      noise: what multiplies the sensors' noise, which is added to the states.
      recorded: motion that the windows repeat in place of excitation, see `recorded.Recorded`.
      names: arrays of the batch, as of `Windows`; `map` and `delta_e`, where named, are rebuilt.

    Raises:
      InputError: a share outside [0, 1], jobs that are no number of processes, or a noise below 0.
    """

    environment: str
    effects: float = 0.5
    motor: float = MOTOR
    policy: Act | str | Path | None = None
    policy_share: float = 0.5
    jobs: int = 0
    noise: float = 1.0
    names: Sequence[str] = ("states", "actions", "delta_s", "family")
    recorded: Recorded | None = None

    def __post_init__(self) -> None:
        for name in ("effects", "motor", "policy_share"):
            require_share(f"simulator: {name}", getattr(self, name))
        require_whole("simulator: jobs", self.jobs, 0)
        if not 0 <= self.noise < np.inf:
            raise InputError(f"simulator: noise multiplies the sensors' own, want 0 or more, got {self.noise!r}")

    def __call__(self, psi: Array, rng: np.random.Generator) -> dict[str, Any]:
        """A batch of tensors with a leading axis of n windows.

        Args:
          psi: (n, d) in physical units.
          rng: draws the seed, from which all else follows, and the sensors' noise.

        Raises:
          InputError: psi of another size or outside the prior's box, no psi, or an array that windows do not have.
          MissingExtra: torch is not installed.
        """
        return self._batch(len(psi), units(np.asarray(psi, float), Machine(self.environment).space, len(psi)), rng)

    def draw(self, n: int, rng: np.random.Generator) -> dict[str, Any]:
        """A batch of n windows whose psi is drawn from the prior, and is in it as `psi`, positions u in the box.

        Of a psi under which no motion holds another is drawn.

        Args:
          n: windows.
          rng: see `__call__`.
        """
        return replace(self, names=("psi", *self.names))._batch(n, None, rng)

    def _batch(self, n: int, u: Array | None, rng: np.random.Generator) -> dict[str, Any]:
        try:
            import torch
        except ImportError:
            raise MissingExtra("rounds of inference need torch: pip install 'nfc_gym[inference]'") from None
        require_whole("simulator: the number of windows", n, 1)
        machine = Machine(self.environment)
        if self.recorded is not None:
            self.recorded.require(machine)
        manifest = manifest_of(self.environment, n, int(rng.integers(2**32)), PER_SHARD, {})
        share = self.policy_share if self.policy is not None and self.recorded is None else 0.0
        plan = Plan(manifest, settled(self.policy), self.effects, share, self.motor, self.recorded)
        made = workers.made(
            plan, range(manifest.shards), lambda k: None if u is None else u[k * PER_SHARD : (k + 1) * PER_SHARD],
            self.jobs, None,
        )  # fmt: skip
        shards = [safetensors.numpy.load(data) for _, data in sorted(made)]
        whole = {name: np.concatenate([s[name] for s in shards]) for name in shards[0]}
        if {"map", "delta_e"} & set(self.names):
            rebuilt = maps(manifest, whole)
            whole |= {"map": rebuilt.perceived, "delta_e": rebuilt.delta_e}
        odd = [n for n in self.names if n not in whole]
        if odd:
            raise InputError(f"windows have no array {odd[0]!r}; there are: {', '.join(whole)}")
        sd = (self.noise * machine.noise).astype(np.float32)
        whole["states"] = whole["states"] + sd * rng.standard_normal(whole["states"].shape, np.float32)
        return {name: torch.from_numpy(np.ascontiguousarray(whole[name])) for name in self.names}
