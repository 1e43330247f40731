"""What windows of each robot are like: their length, where and how long it moves before, what its sensors' noise is."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.contract import robot_class
from nfc_gym.envs.mirror import Mirror, mirror
from nfc_gym.envs.registry import ROBOTS, register
from nfc_gym.envs.robot import DT, Array
from nfc_gym.envs.runner import Runner
from nfc_gym.envs.settings import Settings
from nfc_gym.envs.simulations import Simulations
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.terrain import Heightfield


@dataclass(frozen=True)
class Habit:
    """How a robot's windows are made.

    Attributes:
      horizon: H, control steps a window (the paper's, per robot).
      warm: least and most control steps before it.
      roam: m, half the side of the square in which motion begins on rough ground; the level middle is left.
      swing: of the excitation, see `motion`: how far targets or commands go, least and most.
      offset: how far the excitation's mean may lie off zero.
      noise: standard deviations, one for each group of entries of `proprio`, (entries, value) in their order.
    """

    horizon: int
    warm: tuple[int, int]
    roam: float
    swing: tuple[float, float]
    offset: float
    noise: tuple[tuple[int, float], ...]


# Noise: a fused state estimate's position 2 cm, quaternion 0.005 (0.6 degrees), velocity 5 cm/s; the rates of a
# gyroscope on a shaking machine 0.03 rad/s; encoders of 0.002 rad and, differentiated, 0.05 rad/s; foot forces and
# torques 5 N and 5 N m, joint torques 0.5 N m. Commands and last actions are known exactly. All are assumptions.
HABITS: Mapping[str, Habit] = {
    "ant": Habit(
        50, (5, 50), 8.0, (0.3, 1.0), 0.3,
        ((1, 0.02), (3, 0.05), (3, 0.03), (5, 0.005), (8, 0.002), (8, 0.05), (24, 5.0)),
    ),
    "quadruped": Habit(
        20, (5, 50), 8.0, (0.3, 1.0), 0.3,
        ((3, 0.05), (3, 0.03), (3, 0.005), (3, 0.0), (12, 0.002), (12, 0.05), (12, 0.0)),
    ),
    "humanoid": Habit(
        20, (2, 25), 8.0, (0.1, 0.6), 0.2,
        ((1, 0.02), (3, 0.05), (3, 0.03), (5, 0.005), (21, 0.002), (21, 0.05), (21, 0.5), (12, 5.0), (21, 0.0)),
    ),
    "quadcopter": Habit(
        20, (5, 50), 8.0, (0.2, 1.0), 0.3, ((3, 0.02), (4, 0.005), (3, 0.05), (3, 0.03), (8, 0.002))
    ),
    "jackal": Habit(50, (5, 30), 8.0, (0.3, 1.0), 0.6, ((4, 0.005), (3, 0.05), (3, 0.03), (3, 0.02), (2, 0.0))),
}  # fmt: skip
# What motors make of a command, as a share of its full range: Gaussian, anew in each control step (the paper's "motor
# control" noise). Without any, a second of contacts would tell of psi through their chatter, as no real machine does.
MOTOR = 0.02
TERRAINS = ("rough", "slopes", "steps", "mixed", "obstacles")  # kinds that windows are made on; Flat is a plane


def full_id(name: str) -> str:
    """`JackalFlat` and the like -> `nfc_gym/JackalFlat-v0`.

    Raises:
      InputError: this package has no such environment.
    """
    known = [f"nfc_gym/{robot}{ground}-v0" for robot in ROBOTS for ground in ("Flat", "Rough")]
    full = f"nfc_gym/{name.removeprefix('nfc_gym:').removeprefix('nfc_gym/').removesuffix('-v0')}-v0"
    if full not in known:
        raise InputError(f"no environment {name!r} to simulate; there are: {', '.join(known)}")
    return full


class Machine:
    """A registered environment, as windows of it are made.

    Args:
      environment: id, `nfc_gym/JackalFlat-v0` or `JackalFlat`.

    Raises:
      InputError: no such id.
    """

    def __init__(self, environment: str) -> None:
        register()
        self.environment = full_id(environment)
        self.kwargs: dict[str, Any] = dict(gymnasium.registry[self.environment].kwargs)
        self.kind, self.rough = robot_class(self.kwargs["robot"]), bool(self.kwargs["rough"])
        self.settings = Settings.of(self.kind, {})
        self.habit = HABITS[self.kind.name]

    @cached_property
    def model(self) -> Any:
        """The nominal model on a plane: names and sizes."""
        return self.kind.compile(0)

    @cached_property
    def space(self) -> ParameterSpace:
        """psi."""
        return self.kind.space(self.model)

    @property
    def dt(self) -> float:
        """Control step, s."""
        return DT

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """What each entry of `proprio` is."""
        return tuple(self.settings.robot(self.model).components(self.model))

    @cached_property
    def action_names(self) -> tuple[str, ...]:
        """What each action is."""
        if self.kind.name == "jackal":
            return ("forward", "turn")
        return tuple(self.model.actuator(i).name for i in range(self.kind.action_size))

    @cached_property
    def mirrors(self) -> tuple[Mirror, ...]:
        """How its windows look in each of the mirrors in which it is its own image."""
        robot, model = self.settings.robot(self.model), self.model
        return tuple(
            mirror(plane, self.state_names, self.space.names, *robot.reflected(model, plane), model)
            for plane in self.kind.planes
        )

    @cached_property
    def noise(self) -> Array:
        """(s,) standard deviation of the measurement noise of `proprio`."""
        return np.repeat([sd for _, sd in self.habit.noise], [k for k, _ in self.habit.noise])

    @cached_property
    def angles(self) -> list[int]:
        """Entries of `proprio` that are angles which jump from pi to -pi: a runner's yaw, roll, angle to its target."""
        return [7, 8, 9] if issubclass(self.kind, Runner) else []

    @cached_property
    def aims(self) -> list[int]:
        """Entries of `proprio` that tell of a runner's target, which nobody who looks at a window knows."""
        return [9, 11] if issubclass(self.kind, Runner) else []

    @cached_property
    def told(self) -> NDArray[np.bool_]:
        """(s,) entries of `proprio` that are measured and that a replay can say: no commands, nothing of aims."""
        found = self.noise > 0
        found[self.aims] = False
        return found

    def difference(self, after: Array, before: Array) -> Array:
        """`after` minus `before`, (..., s) each of `proprio`; angles go the shorter way round."""
        change = after - before
        change[..., self.angles] = (change[..., self.angles] + np.pi) % (2 * np.pi) - np.pi
        return change

    @property
    def terrain_kinds(self) -> tuple[str, ...]:
        """Kinds that its rough ground is made of, indices of which windows hold."""
        return TERRAINS

    def kinds_of_ground(self) -> tuple[str, ...]:
        """Kinds that are drawn, each as likely: the robot's own, and for those on the ground the single ones too."""
        own = self.kind.terrain_kind
        return (own,) if own == "obstacles" else ("rough", "slopes", "steps", "mixed")

    def simulations(self, n: int, nthread: int, maps: list[Heightfield]) -> Simulations:
        """n simulations on some maps (none on a plane)."""
        return Simulations(self.settings, n, nthread, maps, maps)
