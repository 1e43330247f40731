"""What all wrappers share: recorded arguments, pickling, random numbers, and the checks on what is wrapped."""

import operator
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any
from zlib import crc32

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from nfc_gym.core.errors import InputError
from nfc_gym.wrappers.order import beneath, check_order, kind
from nfc_gym.wrappers.rows import mode_of


def _rebuild(cls: type, env: Any, kwargs: dict[str, Any]) -> Any:
    """A pickled wrapper, which must be reset before it steps: what it drew for its episode is gone."""
    for inner in beneath(env):
        if isinstance(inner, gym.wrappers.OrderEnforcing):
            inner._has_reset = False
    return cls(env, **kwargs)


def finite(action: Any, shape: tuple[int, ...] | None = None) -> Any:
    """An action that a wrapper reads before the environment does.

    Raises:
      InputError: it has another shape than the one that is asked for, or an entry that is no finite number, which the
        message names.
    """
    action = np.asarray(action)
    if action.dtype.kind not in "fiub":
        raise InputError(f"action is {action.tolist()!r}, want numbers")
    if shape is not None and action.shape != shape:
        raise InputError(f"action has shape {action.shape}, want {shape}")
    # Counting is three times as fast as `all` on a handful of numbers, and this runs every step.
    if np.count_nonzero(np.isfinite(action)) != action.size:
        at = tuple(int(i) for i in np.argwhere(~np.isfinite(action))[0])
        raise InputError(f"action[{', '.join(map(str, at))}] is {action[at]}, want finite numbers")
    return action


class _Common(RecordConstructorArgs):
    """The wrapper's own stream of random numbers, and pickling through the constructor.

    A pickle or a deep copy begins before its first reset, also where the bare environment's would go on: what wrappers
    drew and remember of the running episode is not in it, and `step` before `reset` raises `ResetNeeded`.

    The stream follows from the seed of `reset` and never draws from the environment's own generator, so that a wrapper
    which changes nothing leaves the environment's draws as they are.
    """

    env: Any
    arguments: dict[str, Any]
    rng: np.random.Generator | None

    def _open(self, env: Any, arguments: dict[str, Any]) -> None:
        """To be called first by every constructor."""
        self.arguments = arguments
        RecordConstructorArgs.__init__(
            self, _disable_deepcopy=True, **{k: self.recorded(k, v) for k, v in arguments.items()}
        )
        check_order(self, env)
        self.rng = None
        self._depth = sum(kind(w) == kind(self) for w in beneath(env))

    def __reduce__(self) -> tuple[Any, ...]:
        """The wrapper made anew around its environment, before the first reset: a running episode is not kept."""
        return _rebuild, (type(self), self.env, self.arguments)

    def recorded(self, name: str, value: Any) -> Any:
        """A constructor's argument as a spec keeps it: paths as text, the rest as it is."""
        return os.fspath(value) if isinstance(value, os.PathLike) else value

    def writes(self, what: str) -> bool:
        """Whether the wrapper writes what `order` says that only one may; some do so only with certain arguments."""
        return True

    def own_seed(self, seed: Any) -> Any:
        """The one seed that the wrapper's own stream follows from."""
        return seed

    def stream(self, seed: Any) -> np.random.Generator:
        """The generator of the coming episode: anew from a seed, else as it goes on from the last episode."""
        seed = self.own_seed(seed)
        if seed is None and self.rng is not None:
            return self.rng
        if seed is None:  # never seeded: what the environment has, which makes itself a seed where it has none
            seed = self.own_seed(self.env.unwrapped.np_random_seed)
        try:
            own = operator.index(seed)
        except TypeError:
            own = -1  # the environment refuses what is no seed
        entropy = None if own < 0 else [own, crc32(kind(self).encode()), self._depth]
        self.rng = np.random.default_rng(entropy)
        return self.rng

    @contextmanager
    def refusable(self, *undo: Callable[[], None]) -> Iterator[None]:
        """A reset that may be refused once the wrapper has drawn for it: its stream then stands where it stood.

        Args:
          undo: called then, to put back what else was changed for the episode that does not begin.
        """
        rng, state = self.rng, None if self.rng is None else self.rng.bit_generator.state
        try:
            yield
        except BaseException:
            self.rng = rng
            if rng is not None:
                rng.bit_generator.state = state
            for each in undo:
                each()
            raise


class EnvWrapper(_Common, gym.Wrapper):
    """Base of the wrappers around one environment. A pickle or a deep copy must be reset before it steps."""

    def __init__(self, env: gym.Env, **arguments: Any) -> None:
        self.require(env)
        self._open(env, arguments)
        gym.Wrapper.__init__(self, env)

    @classmethod
    def require(cls, env: Any) -> None:
        """Refuse a vector environment."""
        if isinstance(env, VectorEnv):
            raise InputError(
                f"{cls.__name__} wraps one environment; around a vector environment use Vector{cls.__name__}"
            )


class VectorEnvWrapper(_Common, VectorWrapper):
    """Base of their twins around a vector environment; all rows draw from one stream.

    This package's own vector environments cannot be pickled or copied, and so neither can their wrappers.
    """

    def __init__(self, env: VectorEnv, **arguments: Any) -> None:
        self.require(env)
        self._open(env, arguments)
        VectorWrapper.__init__(self, env)

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """Of the environment; TorchRL asks for it here."""
        return mode_of(self.env)

    def vet(self, seed: Any, options: Any) -> None:
        """Refuse what the environment would refuse of a reset, before anything is drawn or forgotten for it."""
        check = getattr(self.env.unwrapped, "check_reset", None)
        if check is not None:
            check(seed, options)

    def own_seed(self, seed: Any) -> Any:
        """Of the rows' seeds the first that is given; what can be read only once is left for the environment."""
        several = isinstance(seed, Iterable) and not isinstance(seed, str | Iterator) and getattr(seed, "ndim", 1)
        return next((s for s in seed if s is not None), None) if several else seed

    @classmethod
    def require(cls, env: Any) -> None:
        """Refuse a single environment."""
        if not isinstance(env, VectorEnv):
            name = cls.__name__.removeprefix("Vector")
            raise InputError(f"Vector{name} wraps a vector environment; around a single one use {name}")
