"""What an environment promises, whichever engine runs it: spaces, observations, what steps report and resets take."""

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.robot import FASTEST, Array, Robot
from nfc_gym.envs.view import View
from nfc_gym.physics.parameters import ParameterSpace, numbers
from nfc_gym.terrain import SHAPE, Heightfield
from nfc_gym.terrain.egocentric import SIZE

OPTIONS = ("psi", "psi_belief", "heightfield", "perceived", "terrain_id", "terrain_residual")
FLAT = Heightfield(np.zeros(SHAPE, np.float32))
# MuJoCo's warnings of what `info["unstable"]` says. It prints and logs the first of each in a simulation alone: counted
# as there already they stay off the user's terminal and folder, and handlers of the whole process as they are.
UNSTABLE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]


def robot_class(robot: str | type[Robot]) -> type[Robot]:
    """A robot's class, or the one that `module:Class` names."""
    if isinstance(robot, type) and issubclass(robot, Robot):
        return robot
    module, _, name = str(robot).partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"robot {robot!r}: want a class of nfc_gym.envs.robot.Robot as 'module:Class'") from error
    return found


def box(*shape: int, bound: float = np.inf, dtype: type[np.floating] = np.float32) -> spaces.Box:
    """A `Box` with the same bound everywhere."""
    return spaces.Box(-bound, bound, shape, dtype)


class Observer:
    """Observations of a robot under a context.

    Args:
      robot: whose.
      psi_size: d.
      context: of `psi` and `elevation`, those to observe.

    A goal-conditioned robot has `observation`, `achieved_goal` and `desired_goal` in place of `proprio` and `goal`.
    """

    def __init__(self, robot: Robot, psi_size: int, context: Sequence[str]) -> None:
        goal_conditioned = robot.goal_conditioned is not None
        self._robot, self._goal_conditioned = robot, goal_conditioned
        self.psi, self.elevation = "psi" in context, "elevation" in context
        self.plain = not context and not goal_conditioned
        dtype = robot.precision
        parts: dict[str, spaces.Space] = {}
        if goal_conditioned:
            parts["observation"] = box(robot.proprio_size, dtype=dtype)
            parts["achieved_goal"] = parts["desired_goal"] = box(robot.place_size)
        else:
            parts["proprio"] = box(robot.proprio_size, dtype=dtype)
            if robot.goal_size:
                parts["goal"] = box(robot.goal_size, dtype=dtype)
        if self.psi:
            parts["psi"] = box(psi_size, bound=1.0)
        if self.elevation:
            parts["elevation"] = box(SIZE, SIZE)
        whole = box(robot.proprio_size + robot.goal_size, dtype=dtype)
        self.space = whole if self.plain else spaces.Dict(parts)

    def __call__(self, view: View, psi: NDArray[np.float32], elevation: NDArray[np.float32] | None) -> Any:
        """Fresh arrays; `psi` is copied, `elevation` handed on."""
        robot, dtype = self._robot, self._robot.precision
        if self.plain:
            parts = robot.proprio(view)
            return np.concatenate((*parts, robot.goal(view)) if robot.goal_size else parts, -1, dtype=dtype)
        if self._goal_conditioned:
            obs = {
                "observation": np.concatenate(robot.state(view), -1, dtype=dtype),
                "achieved_goal": robot.achieved(view).astype(np.float32),
                "desired_goal": robot.desired(view).astype(np.float32),
            }
        else:
            obs = {"proprio": np.concatenate(robot.proprio(view), -1, dtype=dtype)}
            if robot.goal_size:
                obs["goal"] = robot.goal(view).astype(dtype)
        if self.psi:
            obs["psi"] = psi.copy()
        if elevation is not None:
            obs["elevation"] = elevation
        return obs


def broken(view: View) -> Any:
    """(*B,) whether a simulation has come apart: NaN or an absurd speed."""
    speed = view.qvel
    if speed.ndim == 1:
        return not speed.dot(speed) < FASTEST * FASTEST
    return np.logical_not(np.vecdot(speed, speed) < FASTEST * FASTEST)


def outcome(
    robot: Robot, view: View, action: Array, unstable: NDArray[np.bool_] | None
) -> tuple[Array, NDArray[np.bool_], dict[str, NDArray]]:
    """Reward (*B,), termination (*B,) and `info` of a control step whose physics is done.

    Args:
      robot, view, action: the step's.
      unstable: (*B,) simulations that came apart and were put back to rest: they end, with reward 0. None: none did.
    """
    view.task.update(robot.advance(view, action))
    view.before, view.now = view.now, robot.derive(view)
    terms = robot.scored(view, action)
    ended = robot.terminated(view)
    info = {}
    reward: Any = 0.0
    for name, term in terms.items():
        if unstable is not None and robot.goal_conditioned is None:
            term = np.where(unstable, 0.0, term)[()]
        info["reward/" + name] = term
        reward = reward + term
    info.update(robot.facts(view))
    if unstable is None:
        info["unstable"] = ended & False
    else:
        info["unstable"] = unstable
        ended = ended | unstable
    if robot.goal_conditioned is not None:
        info["failed"] = ended
    return reward, ended, info


def nothing_yet(robot: Robot, view: View) -> dict[str, NDArray]:
    """`info` of a reset: the keys of a step's, every reward term 0."""
    shape = view.qpos.shape[:-1]
    own = robot.goal_conditioned is None
    zero = {"reward/" + name: np.zeros(shape)[()] for name in (robot.terms if own else ("goal",))}
    flags = ("unstable",) if own else ("unstable", "failed")
    return zero | robot.facts(view) | {name: np.zeros(shape, bool)[()] for name in flags}


def checked_options(options: Mapping[str, Any] | None, rough: bool, more: tuple[str, ...] = ()) -> dict[str, Any]:
    """Reset options; what is no mapping, an unknown one, or a terrain for a flat environment raises `InputError`."""
    if options is not None and not isinstance(options, Mapping):
        raise InputError(f"options is {options!r}, want None or a mapping with: {', '.join((*OPTIONS, *more))}")
    given = {k: v for k, v in (options or {}).items() if v is not None}
    for key in given:
        if key not in (*OPTIONS, *more):
            raise InputError(f"reset has no option {key!r}; it has: {', '.join((*OPTIONS, *more))}")
        if not rough and key in ("heightfield", "perceived", "terrain_id", "terrain_residual"):
            raise InputError(f"option {key!r}: the ground of a Flat environment is a plane; use the Rough one")
    if "heightfield" in given and "terrain_id" in given:
        raise InputError("options 'heightfield' and 'terrain_id' both name the terrain: give one of them")
    return given


def psi_of(space: ParameterSpace, values: Any, shape: tuple[int, ...], name: str = "psi") -> Array:
    """(*shape, d) psi from a vector, one a simulation, or a dict of names (the rest nominal); None is nominal.

    Raises:
      InputError: an unknown name, another shape, a value that is no finite number.
    """
    if values is None:
        psi: ArrayLike = space.nominal
    elif isinstance(values, Mapping):
        psi = np.broadcast_to(space.nominal, (*shape, len(space))).copy()
        for key, value in values.items():
            if key not in space.names:
                raise InputError(f"{name} has no parameter {key!r}; there are: {', '.join(space.names)}")
            own = numbers(value, f"{name}[{key!r}]")
            if own.shape not in ((), shape):
                want = f"() or {shape}" if shape else "()"
                raise InputError(f"{name}[{key!r}] has shape {own.shape}, want {want}")
            psi[..., space.names.index(key)] = own
    else:
        psi = numbers(values, name)
        if psi.shape not in ((len(space),), (*shape, len(space))):
            raise InputError(f"{name} has shape {psi.shape}, want {(*shape, len(space))}: {', '.join(space.names)}")
    psi = np.broadcast_to(psi, (*shape, len(space))).astype(float)
    wrong = np.argwhere(~np.isfinite(psi))
    if len(wrong):
        raise InputError(f"{name}: {space.names[wrong[0, -1]]} is not finite")
    return psi


def seen_psi(space: ParameterSpace, psi: Array) -> NDArray[np.float32]:
    """psi as agents see it: [-1, 1] by the prior's bounds, clipped."""
    return np.clip(space.normalise(psi), -1, 1).astype(np.float32)


def rest_key(model: mujoco.MjModel) -> int:
    """Keyframe that simulations are reset to: `home`, or -1, the model's own state, where it has no keyframes."""
    return int(model.key("home").id) if model.nkey else -1


def as_numbers(action: Any) -> Array:
    """An action as a fresh array, of whatever shape.

    Raises:
      InputError: it is no array of numbers.
    """
    try:
        given = np.asarray(action)
        if given.dtype.kind in "fiubO":
            return np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"action is {action!r}, want numbers in [-1, 1]")


def wrong_action(action: NDArray, shape: tuple[int, ...]) -> InputError:
    """The error for an action of another shape or with an entry that is not finite, which it names."""
    if action.shape != shape:
        return InputError(f"action has shape {action.shape}, want {shape}")
    at = tuple(int(i) for i in np.argwhere(~np.isfinite(action))[0])
    return InputError(f"action[{', '.join(map(str, at))}] is {action[at]}, want finite numbers in [-1, 1]")
