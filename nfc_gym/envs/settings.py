"""`Settings`: the arguments that both engines take, checked once."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import Any, Self

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole
from nfc_gym.envs.render import TRACK, Camera
from nfc_gym.envs.robot import GOAL_REWARDS, Robot
from nfc_gym.envs.terrains import Pool

CONTEXT = ("psi", "elevation")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Arguments of an environment; all can be written as JSON.

    Attributes:
      kind: the robot's class; not an argument itself.
      task: one of the robot's tasks; None is its first.
      goal_conditioned: `observation`, `achieved_goal`, `desired_goal` in place of `proprio` and `goal` (see `goals`).
      reward_type: of a goal-conditioned environment, `sparse` (0 at the goal, else -1) or `dense` (minus the distance).
      context: which of `psi` and `elevation` the observation holds; () gives a plain `Box`.
      elevation_hz: how often the elevation map is renewed; None is every control step (50 Hz).
      difficulty: of the terrain, in [0, 1].
      terrain_seed, terrain_pool, terrain_kind: the pool of maps that episodes draw from; None is the robot's kind.
        Flat ground takes them, and `difficulty`, without effect, so that the same arguments serve all ids.
      width, height: of pictures, in pixels.
      camera: name of a camera of the robot's file, or a free one (`render.camera_of`).

    Raises:
      InputError: a value is none of these; the message says what would be valid.
    """

    kind: type[Robot] = field(repr=False)
    task: str | None = None
    goal_conditioned: bool = False
    reward_type: str = GOAL_REWARDS[0]
    context: Sequence[str] = CONTEXT
    elevation_hz: float | None = None
    difficulty: float = 0.5
    terrain_seed: int = 0
    terrain_pool: int = 64
    terrain_kind: str | None = None
    width: int = 640
    height: int = 480
    camera: Camera = TRACK

    @classmethod
    def of(cls, kind: type[Robot], given: dict[str, Any]) -> Self:
        """Settings from keyword arguments; an unknown one raises `TypeError`, as Python's own calls do."""
        known = [f.name for f in fields(cls) if f.name != "kind"]
        for name in given:
            if name not in known:
                raise TypeError(f"got an unexpected keyword argument {name!r}; there are: {', '.join(known)}")
        return cls(kind=kind, **given)

    def __post_init__(self) -> None:
        kind = self.kind
        if self.task is not None and self.task not in kind.tasks:
            raise InputError(f"{kind.name} has no task {self.task!r}; it has: {', '.join(kind.tasks)}")
        if self.reward_type not in GOAL_REWARDS:
            raise InputError(f"reward_type is {self.reward_type!r}, want one of: {', '.join(GOAL_REWARDS)}")
        if self.reward_type != GOAL_REWARDS[0] and not self.goal_conditioned:
            raise InputError(f"reward_type is {self.reward_type!r}, which wants goal_conditioned=True beside it")
        if not isinstance(self.goal_conditioned, bool):
            raise InputError(f"goal_conditioned is {self.goal_conditioned!r}, want True or False")
        if self.goal_conditioned and not kind.place_size:
            raise InputError(f"goal_conditioned: the {kind.name} has no goals to reach")
        # An iterator would be used up here: whoever made the environment again from its spec would get another one.
        several = isinstance(self.context, Iterable) and not isinstance(self.context, str | Iterator)
        if not several or any(c not in CONTEXT for c in self.context):
            raise InputError(f"context is {self.context!r}, want a sequence of: {', '.join(CONTEXT)}")
        require_whole("width", self.width, 1)
        require_whole("height", self.height, 1)
        self.pool  # noqa: B018 (raises where there is no such pool)

    @property
    def pool(self) -> Pool:
        """The maps to draw from."""
        kind = self.kind
        named = self.terrain_kind or kind.terrain_kind
        return Pool(self.terrain_pool, self.terrain_seed, self.difficulty, named, kind.terrain_scale)

    def robot(self, model: Any) -> Robot:
        """The robot with its task, bound to a model."""
        robot = self.kind(model, self.task or self.kind.tasks[0])
        robot.goal_conditioned = self.reward_type if self.goal_conditioned else None
        return robot

    def refresh_period(self, fps: int) -> int:
        """Control steps between two elevation maps, given those a second."""
        if self.elevation_hz is None:
            return 1
        hz = self.elevation_hz
        rate = float(hz) if isinstance(hz, Real) and not isinstance(hz, bool) else 0.0
        period = fps / rate if rate > 0 else 0.0
        if period < 1 or not float(period).is_integer():
            rates = ", ".join(f"{fps / k:g}" for k in (1, 2, 5, 10, 25, 50))
            raise InputError(
                f"elevation_hz is {self.elevation_hz!r}, want {fps} divided by a whole number, such as {rates}"
            )
        return round(period)
