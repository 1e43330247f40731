"""What a policy is shown of an environment: one flat vector, the same in training and wherever it is put to work.

It is `proprio`, then the `goal` where there is one, then a few cells of `elevation` on rough ground. Psi is not in it:
on the robot only a belief is known, which before any calibration is the same nominal value always, so that nothing
could be learned from it. The critic, which is used in simulation alone, sees the psi that is simulated.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Any, Self

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.rotations import yaw
from nfc_gym.terrain.egocentric import SIZE, Cells

_WALKER = Cells((56, 56), 3, (9, 6))  # 0.3 m apart, from 0.75 m behind to 1.65 m ahead, 0.75 m to either side
# By robot; a rover sees further ahead, and what flies sees as far to every side.
CELLS: Mapping[str, Cells] = {
    "ant": _WALKER,
    "humanoid": _WALKER,
    "quadruped": _WALKER,
    "jackal": Cells((56, 53), 3, (13, 8)),
    "quadcopter": Cells((41, 41), 3, (16, 16)),
}


@dataclass(frozen=True)
class Sight:
    """Layout of a policy's observation.

    Attributes:
      environment: id of the environment that it is of, `nfc_gym/AntFlat-v0`.
      proprio, goal: sizes.
      cells: of the elevation map; None sees none.
    """

    environment: str
    proprio: int
    goal: int
    cells: Cells | None

    @property
    def size(self) -> int:
        """Of the flat observation."""
        return self.proprio + self.goal + (int(np.prod(self.cells.shape)) if self.cells else 0)

    @classmethod
    def of(cls, envs: Any) -> Self:
        """Of an environment of this package, single or vector."""
        kind, spec = envs.unwrapped.robot, envs.spec
        name = spec.id if spec is not None else type(kind).__name__
        cells = CELLS[kind.name] if envs.unwrapped.rough else None
        return cls(name, kind.proprio_size, kind.goal_size, cells)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a file."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """Its inverse."""
        cells = plain["cells"]
        made = None if cells is None else Cells(tuple(cells["first"]), cells["step"], tuple(cells["shape"]))
        return cls(plain["environment"], plain["proprio"], plain["goal"], made)

    def flat(self, observation: Any) -> NDArray[np.float32]:
        """The policy's observation (..., size).

        Args:
          observation: what the environment gives: a mapping with `proprio` (and `goal`, `elevation`), or what it gives
            with `context=()`; or of `VectorSight`, or a vector that already is of this layout.

        Raises:
          InputError: it is of another robot, or lacks what the policy looks at.
        """
        if not isinstance(observation, Mapping):
            flat = np.asarray(observation, np.float32)
            if flat.shape[-1:] != (self.size,):
                raise InputError(f"an observation of shape {flat.shape} for {self.says()}")
            return flat
        if np.shape(observation.get("observation", 0))[-1:] == (self.size,):
            return np.asarray(observation["observation"], np.float32)
        parts = []
        for key, size in (("proprio", self.proprio), ("goal", self.goal)):
            if size:
                if key not in observation:
                    raise InputError(f"an observation of {', '.join(observation)}, without {key!r}, for {self.says()}")
                part = np.asarray(observation[key], np.float32)
                if part.shape[-1:] != (size,):
                    raise InputError(f"an observation whose {key!r} has shape {part.shape} for {self.says()}")
                parts.append(part)
        if self.cells is not None:
            seen = np.asarray(observation.get("elevation", np.zeros(0)), np.float32)
            if seen.shape[-2:] != (SIZE, SIZE):
                raise InputError(f"an observation whose 'elevation' has shape {seen.shape} for {self.says()}")
            parts.append(self.cells.of(seen).reshape(*seen.shape[:-2], -1))
        return np.concatenate(parts, -1)

    def says(self) -> str:
        """In words, for errors."""
        goal = f", goal {self.goal}" if self.goal else ""
        cells = f", {self.size - self.proprio - self.goal} cells of elevation" if self.cells else ""
        return f"a policy of {self.environment}: proprio {self.proprio}{goal}{cells}, together {self.size}"


class VectorSight(VectorWrapper):
    """Shows a vector environment of this package as policies and critics see it.

    The observation becomes `{"observation": (n, size), "psi": (n, d)}`. Of an environment made with `context=["psi"]`
    the cells of the elevation map are looked up without making the whole map, which costs a tenth of it.

    Args:
      env: vector environment of this package with wrappers of this package around it.
      sight: what is seen; default the robot's own.

    Attributes:
      seconds: spent in the environment so far.
    """

    def __init__(self, env: VectorEnv, sight: Sight | None = None) -> None:
        super().__init__(env)
        self.sight, self.seconds = sight or Sight.of(env), 0.0
        inner = env.single_observation_space
        if not isinstance(inner, spaces.Dict) or not {"proprio", "psi"} <= set(inner.spaces):
            raise InputError(f"VectorSight: make the environment with context=['psi']; its observation is {inner}")
        if env.metadata.get("autoreset_mode") is not AutoresetMode.DISABLED:
            raise InputError("VectorSight: make the environment with autoreset_mode='Disabled': TorchRL resets itself")
        self._mapped = "elevation" in inner.spaces
        seen = spaces.Box(-np.inf, np.inf, (self.sight.size,), np.float32)
        self.single_observation_space = spaces.Dict({"observation": seen, "psi": inner["psi"]})
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """Of the environment; TorchRL asks for it here."""
        return self.metadata["autoreset_mode"]

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset."""
        began = perf_counter()
        observation, info = self.env.reset(seed=seed, options=options)
        seen = self.seen(observation)
        self.seconds += perf_counter() - began
        return seen, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step."""
        began = perf_counter()
        observation, reward, terminated, truncated, info = self.env.step(actions)
        seen = self.seen(observation)
        self.seconds += perf_counter() - began
        return seen, reward, terminated, truncated, info

    def seen(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """What policy and critic see of an observation, (n, ...)."""
        if self._mapped or self.sight.cells is None:
            return {"observation": self.sight.flat(observation), "psi": observation["psi"]}
        parts = [observation["proprio"], *([observation["goal"]] if self.sight.goal else [])]
        base = self.env.unwrapped
        qpos = base.batch.bind("qpos")
        cells = self.sight.cells.around(base.perceived, qpos[:, :3], yaw(qpos[:, 3:7]))
        parts.append(cells.reshape(len(cells), -1))
        return {"observation": np.concatenate(parts, -1, dtype=np.float32), "psi": observation["psi"]}
