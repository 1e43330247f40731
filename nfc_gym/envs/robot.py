"""`Robot`: a robot's task as pure functions over a `View`; the engines (`single`, `vector`) know nothing else of it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym import assets
from nfc_gym.envs import scene
from nfc_gym.envs.components import observed
from nfc_gym.envs.mirror import SIDES, Plane, Signed
from nfc_gym.envs.view import View
from nfc_gym.physics.parameters import Parameter, ParameterSpace, parameters_from_toml
from nfc_gym.terrain import Heightfield

Array = NDArray[np.float64]
Ground = Callable[[NDArray], Any]  # see `View.ground`

FRAME_SKIP = 4  # physics steps a control step
DT = scene.TIMESTEP * FRAME_SKIP  # s: control 50 Hz
FASTEST = 1e4  # root sum of squares of all speeds, m/s and rad/s: beyond it (or NaN) a simulation has come apart
GOAL_REWARDS = ("sparse", "dense")


def goal_reward(achieved: NDArray, desired: NDArray, arrived: float, kind: str) -> Array:
    """Reward of a goal-conditioned environment, (...).

    Args:
      achieved, desired: (..., k) places [m], taken as float32 as observations have them.
      arrived: distance that counts as there [m].
      kind: `sparse`, 0 there and -1 elsewhere, or `dense`, minus the distance.
    """
    gap = np.asarray(achieved, np.float32).astype(float) - np.asarray(desired, np.float32)
    distance = np.sqrt(sum(part * part for part in gap.T)).T
    return -distance if kind == "dense" else -1.0 * (distance >= arrived)


@dataclass(frozen=True)
class Start:
    """How an episode begins.

    Attributes:
      qpos: (*B, nq); activations and controls are those of the keyframe.
      task: the episode's memory, name -> (*B, ...).
      qvel: (*B, nv), or a number for all.
    """

    qpos: Array
    task: Mapping[str, NDArray] = field(default_factory=dict)
    qvel: Array | float = 0.0


class Robot(ABC):
    """A robot with its task. Every method is a pure function over arrays with a leading batch shape B, () or (n,).

    In a control step the engine calls, in this order: `actuate`, the physics, `advance`, `derive`, `reward`, `facts`,
    `terminated`, and the observations. At a reset: `begin`, `derive`, and the observations.

    Args:
      model: the compiled scene, from which names are resolved once.
      task: one of `tasks`.

    Attributes:
      name: folder of its MJCF under `nfc_gym/assets`.
      tasks: what it can be asked to do; the first is the default.
      goal_size: size of the `goal` observation, 0 where `proprio` holds the command.
      planes: of the upright mirrors in which the robot is its own image, but for psi.
      place_size: size of a goal as a place in the world (`achieved`, `desired`), 0 where the tasks have none.
      terrain_kind, terrain_scale: of the rough ground: one of `nfc_gym.terrain.KINDS`, and what multiplies its heights.
      draws: how many uniform numbers in [0, 1) an episode's start is made of.
      reads: derived `MjData` fields that the laws read (`sensordata`, `xpos`, ...).
      arrived: distance from a goal that counts as there [m].
      goal_conditioned: None, or the kind of `goal_reward` that takes the place of the robot's own reward; set by
        `Settings.robot`.
      terms: names of the robot's own reward terms of this task, set by the constructor.
      home: (nq,) position of the keyframe `home`, the model's own where it has none.
      frame_skip: physics steps a control step.
      precision: of the observations.
    """

    name: ClassVar[str]
    tasks: ClassVar[tuple[str, ...]]
    action_size: ClassVar[int]
    proprio_size: ClassVar[int]
    goal_size: ClassVar[int] = 0
    place_size: ClassVar[int] = 0
    planes: ClassVar[tuple[Plane, ...]] = (SIDES,)
    terrain_kind: ClassVar[str] = "mixed"
    terrain_scale: ClassVar[float] = 1.0
    draws: ClassVar[int]
    reads: ClassVar[tuple[str, ...]] = ()
    arrived: ClassVar[float] = 0.3
    frame_skip: ClassVar[int] = FRAME_SKIP
    precision: ClassVar[type[np.floating]] = np.float32
    terms: tuple[str, ...]

    goal_conditioned: str | None = None

    def __init__(self, model: mujoco.MjModel, task: str) -> None:
        self.task = task
        self.home = model.key("home").qpos.copy() if model.nkey else model.qpos0.copy()

    @classmethod
    def compile(cls, maps: int) -> mujoco.MjModel:
        """The robot in its scene; `maps`: heightfields to choose from, 0 for a plane (`scene.build`)."""
        return scene.build(assets.path(cls.name), maps)

    @classmethod
    def mjcf(cls, ground: Heightfield | None) -> str:
        """The scene on one map, or on a plane, as MJCF that plain MuJoCo loads."""
        return scene.text(assets.path(cls.name), ground)

    @classmethod
    def parameters(cls) -> list[Parameter]:
        """psi, in the paper's order, from the robot's `psi.toml`."""
        return parameters_from_toml(assets.path(cls.name).with_name("psi.toml"))

    @classmethod
    def space(cls, model: mujoco.MjModel) -> ParameterSpace:
        """psi bound to a model."""
        return ParameterSpace(model, cls.parameters())

    # ---- the laws -------------------------------------------------------------------------------------------------

    @abstractmethod
    def begin(self, u: Array, ground: Ground) -> Start:
        """Start of an episode from uniform numbers u (*B, draws); `ground` gives heights below points (*B, ..., 2)."""

    @abstractmethod
    def actuate(self, action: Array, view: View) -> Array:
        """Action (*B, action_size) in [-1, 1] -> ctrl (*B, nu)."""

    @abstractmethod
    def derive(self, view: View) -> Any:
        """Quantities that several laws need, computed once a step; found as `view.now` (and `view.before`) by the rest.

        Reads the state and `view.task` alone, so that computing it twice changes nothing.
        """

    def advance(self, view: View, action: Array) -> Mapping[str, NDArray]:
        """Entries of `view.task` that change as a control step ends (clock, last action), as fresh arrays (*B, ...)."""
        return {}

    @abstractmethod
    def reward(self, view: View, action: Array) -> dict[str, Array]:
        """Reward terms (*B,), one for each of `terms` and in that order; the reward is their sum."""

    @abstractmethod
    def terminated(self, view: View) -> NDArray[np.bool_]:
        """(*B,) whether the episode ends early."""

    @abstractmethod
    def proprio(self, view: View) -> Sequence[NDArray]:
        """Parts (*B, k) whose concatenation is the observation `proprio` (*B, proprio_size)."""

    def components(self, model: mujoco.MjModel) -> list[str]:
        """What each entry of `proprio` is, see `nfc_gym.envs.components`; without more, none is known to be state."""
        return observed(self.proprio_size)

    def reflected(self, model: mujoco.MjModel, plane: Plane) -> tuple[list[Signed], Signed]:
        """In a mirror: the parts of `proprio` that `components` calls observed, in their order; and the action."""
        raise NotImplementedError

    def goal(self, view: View) -> NDArray:
        """(*B, goal_size) the command in the robot's frame, where it is not part of `proprio`."""
        raise NotImplementedError

    def facts(self, view: View) -> dict[str, NDArray]:
        """What `info` reports besides the reward terms, (*B,) each; goal tasks: `success`, `distance`."""
        return {}

    def scored(self, view: View, action: Array) -> dict[str, Array]:
        """The reward terms that count: the robot's own, or that of the goal alone."""
        if self.goal_conditioned is None:
            return self.reward(view, action)
        return {"goal": goal_reward(self.achieved(view), self.desired(view), self.arrived, self.goal_conditioned)}

    # ---- goal-conditioned robots ----------------------------------------------------------------------------------

    def state(self, view: View) -> Sequence[NDArray]:
        """Parts (*B, k) of `proprio` with nothing of the goal in it, which a goal-conditioned learner may relabel."""
        return self.proprio(view)

    def achieved(self, view: View) -> NDArray:
        """(*B, place_size) where the robot is, as a goal."""
        raise NotImplementedError

    def desired(self, view: View) -> NDArray:
        """(*B, place_size) the goal."""
        raise NotImplementedError
