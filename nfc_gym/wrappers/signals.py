"""`PerturbSignals`: what sensors and motors make of the numbers that pass through them: noise, bias, delay."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole
from nfc_gym.physics.parameters import numbers
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper, finite
from nfc_gym.wrappers.rows import Rows, with_last

ACTION, OBSERVATION = "action", "observation"
_LIKE = 'such as {"action": {"sd": 0.02, "delay": 1}}'
Noise = Mapping[str, Mapping[str, float | Sequence[float]]]


@dataclass(frozen=True)
class Fault:
    """What happens to one signal.

    Attributes:
      sd: standard deviation of Gaussian noise, drawn each step; one number or one an entry.
      bias: added throughout; one number or one an entry.
      bias_sd: standard deviation of a further bias, drawn for each episode.
      delay: control steps by which it is late; before an episode's first values it shows the first.
    """

    sd: float | Sequence[float] = 0.0
    bias: float | Sequence[float] = 0.0
    bias_sd: float | Sequence[float] = 0.0
    delay: int = 0


class Channel:
    """One signal with its fault: arrays (*batch, *shape) in, fresh ones of the same type out, clipped to the space."""

    def __init__(self, key: str, space: gym.Space, fault: Mapping[str, Any], batch: tuple[int, ...]) -> None:
        if not isinstance(space, spaces.Box):
            raise InputError(f"PerturbSignals: {key!r} is no Box of numbers: {space}")
        unknown = [k for k in fault if k not in Fault.__dataclass_fields__]
        if unknown:
            raise InputError(
                f"PerturbSignals: {key}: no {unknown[0]!r}; there are: {', '.join(Fault.__dataclass_fields__)}"
            )
        self.fault = Fault(**fault)
        require_whole(f"PerturbSignals: {key}: delay, in control steps,", self.fault.delay, 0)
        self.sd, self.bias, self.bias_sd = (self._wide(key, space, n) for n in ("sd", "bias", "bias_sd"))
        self.shape, self.dtype = (*batch, *space.shape), space.dtype
        self.low, self.high = space.low, space.high
        self.bounded = bool(np.isfinite([space.low, space.high]).any())
        self.noisy, self.drifting = bool(np.any(self.sd)), bool(np.any(self.bias_sd))
        self.total = np.zeros(self.shape) + self.bias
        self.past: deque[NDArray] = deque(maxlen=int(self.fault.delay) + 1)

    def _wide(self, key: str, space: spaces.Box, name: str) -> NDArray[np.float64]:
        given = getattr(self.fault, name)
        try:
            value = numbers(given, name)
        except InputError:
            value = np.array(np.nan)
        if space.dtype is not None and space.dtype.kind == "f":
            with np.errstate(over="ignore"):  # what the signal's own type cannot hold would come out as infinite
                value = np.where(np.isfinite(value.astype(space.dtype)), value, np.nan)
        if (
            value.shape not in ((), space.shape)
            or not np.isfinite(value).all()
            or (name != "bias" and (value < 0).any())
        ):
            sign = "" if name == "bias" else ", none below 0"
            raise InputError(
                f"PerturbSignals: {key}: {name} is a finite number or {space.shape} of them{sign}, as {space.dtype} "
                f"holds them, got {given!r}"
            )
        return value

    def begin(self, first: NDArray[np.bool_] | None, rng: np.random.Generator) -> None:
        """Draw the biases of the episodes that begin: of all, or of the rows `first`; their past is forgotten."""
        if first is None:
            self.past.clear()
        # Rows that began before, and of which nothing has gone in since, still wait for their first value.
        self.fresh = first if first is None or self.fresh is None else self.fresh | first
        if self.drifting:
            drawn = self.bias + self.bias_sd * rng.standard_normal(self.shape)
            self.total = drawn if first is None else np.where(_rows(first, drawn), drawn, self.total)

    fresh: NDArray[np.bool_] | None = None

    def __call__(self, values: Any, rng: np.random.Generator, again: NDArray[np.bool_] | None = None) -> NDArray:
        """What comes out of a value that goes in; of the rows `again` (n,) it is a value that went in before."""
        values = np.asarray(values)
        if self.fault.delay:
            values = self._late(values, again)
        return self._faulty(values, self.total, rng)

    def last(self, value: Any, row: int, rng: np.random.Generator) -> NDArray:
        """What comes out of the last value (*shape) of a row's episode, while that of the next is about to go in."""
        value = np.asarray(value)
        if self.fault.delay:
            value = np.asarray(self.past[len(self.past) == self.past.maxlen][row])  # the oldest, were this one appended
        return self._faulty(value, self.total[row], rng)

    def _faulty(self, values: NDArray, bias: NDArray, rng: np.random.Generator) -> NDArray:
        out = values + bias
        if self.noisy:
            out = out + self.sd * rng.standard_normal(bias.shape)
        if self.bounded:
            out = np.minimum(np.maximum(out, self.low), self.high)
        dtype = values.dtype if values.dtype.kind == "f" else self.dtype
        return _nearest(out, dtype) if dtype.kind in "iu" else out.astype(dtype)

    def _late(self, values: NDArray, again: NDArray[np.bool_] | None) -> NDArray:
        if self.fresh is not None and self.fresh.any() and self.past:
            mask = _rows(self.fresh, values)
            self.past = deque((np.where(mask, values, old) for old in self.past), maxlen=self.past.maxlen)
        self.fresh = None
        if again is None or not self.past:
            self.past.append(values.copy())
        return self.past[0]


def _nearest(values: NDArray, dtype: np.dtype) -> NDArray:
    """The nearest whole numbers that a type holds: cut off, noise would pull all values down."""
    info = np.iinfo(dtype)
    most = float(info.max)
    if most > info.max:  # 64 bits: the next number that both types hold
        most = np.nextafter(most, 0.0)
    return np.clip(np.rint(values), float(info.min), most).astype(dtype)


def _rows(mask: NDArray[np.bool_], like: NDArray) -> NDArray[np.bool_]:
    return mask.reshape(-1, *(1,) * (like.ndim - 1))


def channels(noise: Noise, observed: gym.Space, acted: gym.Space, batch: tuple[int, ...]) -> dict[str, Channel]:
    """A channel for each key of `noise`.

    Raises:
      InputError: a key that is neither `action` nor of the observation, or a fault that is none.
    """
    known: dict[str, gym.Space] = (
        dict(observed.items()) if isinstance(observed, spaces.Dict) else {OBSERVATION: observed}
    )
    known[ACTION] = acted
    if not isinstance(noise, Mapping):
        raise InputError(f"PerturbSignals: noise is {noise!r}; want signal -> fault, {_LIKE}")
    for key, fault in noise.items():
        if key not in known:
            raise InputError(f"PerturbSignals: no signal {key!r}; there are: {', '.join(known)}")
        if not isinstance(fault, Mapping):
            raise InputError(f"PerturbSignals: {key} is {fault!r}; want a fault as a mapping, {_LIKE}")
    return {key: Channel(key, known[key], fault, batch) for key, fault in noise.items()}


class _Perturbing:
    """What the wrapper and its twin share."""

    channels: dict[str, Channel]
    rng: np.random.Generator | None

    def _act(self, action: Any) -> Any:
        if self.rng is None:
            raise ResetNeeded("PerturbSignals: step before the first reset")
        channel = self.channels.get(ACTION)
        return action if channel is None else channel(finite(action, channel.shape), self.rng)

    def _begin(self, first: NDArray[np.bool_] | None) -> None:
        for channel in self.channels.values():
            channel.begin(first, self.rng)  # type: ignore[arg-type]

    def _see(self, observation: Any, again: NDArray[np.bool_] | None = None) -> Any:
        assert self.rng is not None, "`reset` makes one, and `_act` asks for it"
        if not isinstance(observation, dict):
            channel = self.channels.get(OBSERVATION)
            return observation if channel is None else channel(observation, self.rng, again)
        changed = {k: c(observation[k], self.rng, again) for k, c in self.channels.items() if k != ACTION}
        return {**observation, **changed}

    def _see_last(self, row: int, observation: Any, rng: np.random.Generator) -> Any:
        if not isinstance(observation, dict):
            channel = self.channels.get(OBSERVATION)
            return observation if channel is None else channel.last(observation, row, rng)
        changed = {k: c.last(observation[k], row, rng) for k, c in self.channels.items() if k != ACTION}
        return {**observation, **changed}


class PerturbSignals(_Perturbing, EnvWrapper):
    """Perturbs actions and observations of any environment, MuJoCo or not.

    Args:
      env: the environment.
      noise: signal -> `Fault` as a mapping: `{"proprio": {"sd": 0.01, "delay": 1}, "action": {"bias": 0.05}}`. Signals
        are the keys of a Dict observation, `observation` where it is a Box, and `action` (the motors).

    Results stay inside the spaces. All zeros change nothing.
    """

    def __init__(self, env: gym.Env, noise: Noise) -> None:
        super().__init__(env, noise=noise)
        self.channels = channels(noise, env.observation_space, env.action_space, ())

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw the episode's biases, and reset."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.stream(seed)
        self._begin(None)
        return self._see(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step with the perturbed action; the perturbed observation comes back."""
        observation, *rest = self.env.step(self._act(action))
        return self._see(observation), *rest


class VectorPerturbSignals(_Perturbing, VectorEnvWrapper):
    """`PerturbSignals` around any vector environment; arguments as there.

    `final_obs` of same-step autoreset is perturbed too.
    """

    def __init__(self, env: VectorEnv, noise: Noise) -> None:
        super().__init__(env, noise=noise)
        self.rows = Rows(env)
        self.channels = channels(noise, env.single_observation_space, env.single_action_space, (env.num_envs,))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw the biases of the rows that are reset, and reset."""
        self.vet(seed, options)
        self.stream(seed)
        new = self.rows.reset(options)
        self._begin(None if new.all() else new)
        observation, info = self.env.reset(seed=seed, options=options)
        return self._see(observation, None if new.all() else ~new), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step with perturbed actions; perturbed observations come back."""
        observation, reward, terminated, truncated, info = self.env.step(self._act(actions))
        first = self.rows.step(terminated, truncated)
        if first.any():
            noise = self.rng.spawn(1)[0]  # type: ignore[union-attr]  # a stream aside: other rows draw what they drew
            info = with_last(info, lambda row, last: self._see_last(row, last, noise))
            self._begin(first)
        return self._see(observation), reward, terminated, truncated, info
