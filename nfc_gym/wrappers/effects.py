"""`ApplyEffects`: the effects that a model lacks, put into the simulation of any MuJoCo environment.

The objects are those of the calibrator, and act through the same class at every physics step: an effect found in logs
is the effect that a policy trains under, bit for bit.
"""

import copy
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.acting import Acting
from nfc_gym.physics.effects.base import TIME, Effect, overrides
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.saved import from_row, to_row
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import numbers
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.effects_file import check_model, psi_said, read_effects
from nfc_gym.wrappers.order import beneath
from nfc_gym.wrappers.psi import RandomizePsi, VectorRandomizePsi
from nfc_gym.wrappers.simulation import Simulation, simulation_of

Array = NDArray[np.float64]
Given = Sequence[tuple[Effect, Array] | Mapping[str, Any]] | str | os.PathLike[str]
Signal = float | Callable[[Any], Any]
_NONE: Mapping[str, Any] = {}


def recorded(effects: Given) -> list[dict[str, Any]] | str:
    """Effects as a spec keeps them: rows of plain data, or a path."""
    if isinstance(effects, str | os.PathLike):
        return os.fspath(effects)
    if not isinstance(effects, Iterable):  # which `bound` refuses
        return effects
    return [_recorded(e) for e in effects]


def _recorded(given: Any) -> Any:
    """One of them; what is neither a pair nor a row is left to `bound` to refuse."""
    if _is_pair(given):
        return to_row(given[0], _values(*given))
    return dict(given) if isinstance(given, Mapping) else given


def _is_pair(given: Any) -> bool:
    return isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], Effect)


def _own_pair(given: Any) -> tuple[Effect, Array]:
    """An effect that nobody else holds, and its values."""
    return copy.deepcopy(given) if _is_pair(given) else from_row(given)


def _values(effect: Effect, theta: ArrayLike) -> Array:
    """Values (k,) of an effect; another number of them, or what cannot be, raises `InputError`."""
    try:
        values = np.asarray(theta, float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (len(effect.params),) or not np.isfinite(values).all():
        names = ", ".join(p.name for p in effect.params)
        raise InputError(f"ApplyEffects: {effect.id} takes finite values of {names}, got {theta}")
    effect.require_possible(values)
    return values


def bound(effects: Given, model: mujoco.MjModel, condition: str | None = None) -> tuple[list[Effect], list[Array]]:
    """Effects of their own, bound to a model, and their values in a condition.

    Raises:
      InputError: a row, a family, a place or a parameter that does not exist, values of another number, or values that
        cannot be (`Param.nature`).
    """
    if isinstance(effects, str | os.PathLike):
        try:
            return bound(read_effects(effects)["effects"], model, condition)
        except InputError as e:
            file = os.fspath(effects)
            raise InputError(str(e) if str(e).startswith(file) else f"{file}: {e}") from None
    if isinstance(effects, Mapping) or not isinstance(effects, Iterable):
        raise InputError(f"ApplyEffects: effects is {effects!r}; want a list of them, or the path of an effects.yaml")
    pairs = [_own_pair(e) for e in effects]
    pairs = [_in_condition(effect, _values(effect, theta), condition) for effect, theta in pairs]
    for effect, _ in pairs:
        effect.bind(model)
    return [e for e, _ in pairs], [t for _, t in pairs]


def _in_condition(effect: Effect, theta: Array, condition: str | None) -> tuple[Effect, Array]:
    """The effect with its values of one condition, where they differ."""
    if not isinstance(effect, Conditioned):
        return effect, theta
    if condition is None:
        known = ", ".join(effect.conditions)
        raise InputError(f"ApplyEffects: {effect.id} differs between conditions: say condition=, one of {known}")
    return effect.inner, effect.inside(theta, condition)


def check_signals(effects: Sequence[Effect], exogenous: Mapping[str, Signal]) -> None:
    """Refuse effects that read a signal which nobody gives."""
    for effect in effects:
        for name in effect.signals:
            if name not in exogenous and name != TIME:
                given = ", ".join(exogenous) or "none"
                raise InputError(f"ApplyEffects: {effect.id} reads {name!r}: give it in `exogenous`; given: {given}")


def own_values(effects: Sequence[Effect], each: Sequence[ArrayLike], shape: tuple[int, ...]) -> list[Array]:
    """Values (*shape, k) of each effect.

    Raises:
      InputError: of another number or shape, not finite, or what cannot be.
    """
    if len(each) != len(effects):
        raise InputError(f"ApplyEffects: values of {len(each)} effects are given, and there are {len(effects)}")
    found = [np.array(numbers(v, f"ApplyEffects: values of {e.id}")) for v, e in zip(each, effects, strict=True)]
    for effect, theta in zip(effects, found, strict=True):
        want = (*shape, len(effect.params))
        if theta.shape != want or not np.isfinite(theta).all():
            raise InputError(f"ApplyEffects: values of {effect.id} must be finite, of shape {want}, got {theta.shape}")
        over = tuple(range(len(shape)))
        for extreme in (theta.min(over), theta.max(over)):
            effect.require_possible(extreme)
    return found


def with_psi(env: Any, effects: Given, randomize: type[RandomizePsi] | type[VectorRandomizePsi]) -> Any:
    """The environment with the psi that an `effects.yaml` says beside its effects, in every episode.

    A wrapper that writes it is put around the environment; that of an earlier turn, as of a spec, will do.
    """
    if not isinstance(effects, str | os.PathLike):
        return env
    bounds = {name: (value, value) for name, value in psi_said(effects, read_effects(effects)).items()}
    there = (w.arguments["distribution"] for w in beneath(env) if isinstance(w, RandomizePsi | VectorRandomizePsi))
    return env if not bounds or any(isinstance(d, dict) and d == bounds for d in there) else randomize(env, bounds)


class Application:
    """Effects wired into a simulation, one or a batch.

    Args:
      sim: the simulation.
      given: as `ApplyEffects` takes them.
      exogenous, condition: as `ApplyEffects` takes them.
      each: as `VectorApplyEffects` takes `values`.
    """

    def __init__(
        self, sim: Simulation, given: Given, exogenous: Mapping[str, Signal] | None, condition: str | None = None,
        each: Sequence[ArrayLike] | None = None,
    ) -> None:  # fmt: skip
        self.sim, self.exogenous = sim, _named(exogenous, sim.shape)
        self.effects, values = bound(given, sim.nominal, condition)
        self.thetas = [np.broadcast_to(t, (*sim.shape, len(t))) for t in values]
        if each is not None:
            self.thetas = own_values(self.effects, each, sim.shape)
        check_signals(self.effects, self.exogenous)
        self.reads = any(e.signals for e in self.effects)
        dt = float(sim.nominal.opt.timestep)
        self.acting = Acting(sim.nominal, self.effects, self.thetas, sim.fields, sim, dt)
        if any(overrides(e, "model") for e in self.effects):
            sim.edits.add(self._edit, rank=1)
        if self.acting.commanding or self.acting.acts:
            sim.attach("ApplyEffects")
            sim.on_control.add(self._begin)
            sim.on_substep.add(self._act)
            sim.pushed = sim.pushed or bool(self.acting.pushing)
        self.values = values
        if any(overrides(e, "sense") for e in self.effects):
            sim.senses.add(self.sense)

    def sense(self, channel: str, series: Array, interval: float) -> Array:
        """What a channel's sensor reports of its true series (T, k)."""
        for effect, theta in zip(self.effects, self.values, strict=True):
            series = effect.sense(channel, series, theta, interval)
        return series

    def _edit(self, fields: ModelFields) -> None:
        for effect, theta in zip(self.effects, self.thetas, strict=True):
            effect.model(fields, fields.own(theta))

    def _begin(self) -> None:
        """Before a control step: forget the hidden states of episodes that begin."""
        started = self.sim.started
        if started is True:
            self.acting.restart()
        elif started is not False and started.any():
            self.acting.fields = self.sim.fields
            self.acting.restart(started)

    def _act(self) -> None:
        """One physics step's command, friction and forces."""
        sim, acting = self.sim, self.acting
        signals = self._signals() if self.reads else _NONE
        if acting.commanding:
            sim.ctrl[...] = acting.command(sim.commanded, signals)
        if acting.pushing:
            sim.restore_forces()
        acting.push(sim.ctrl, signals)

    def _signals(self) -> dict[str, Any]:
        time = np.asarray(self.sim.bind("time"), float)
        signals = self.exogenous.items()
        return {TIME: time, **{n: _level(n, s(time), self.sim.shape) if callable(s) else s for n, s in signals}}


def _named(exogenous: Mapping[str, Signal] | None, shape: tuple[int, ...]) -> dict[str, Any]:
    """Functions of time by name, and levels (*shape,) for what is none."""
    if not isinstance(exogenous or {}, Mapping):
        raise InputError(f"ApplyEffects: exogenous maps names to numbers or functions of time, and is no {exogenous!r}")
    return {name: s if callable(s) else _level(name, s, shape) for name, s in (exogenous or {}).items()}


def _level(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """(*shape,) a signal now; MuJoCo would drop all commands where one is not finite."""
    try:
        level = np.broadcast_to(numbers(value, name), shape)
    except (InputError, ValueError):
        level = None
    if level is None or not np.isfinite(level).all():
        want = f"finite numbers of shape {shape}" if shape else "a finite number"
        raise InputError(f"ApplyEffects: exogenous {name!r} is {value!r}; want {want}, or a function of time that is")
    return level


class ApplyEffects(EnvWrapper):
    """Effects at work in an environment.

    Args:
      env: any MuJoCo environment.
      effects: (effect, values) pairs, rows `{"family": ..., "where": ..., "parameters": {name: value}}`, or the path
        of an `effects.yaml`. They act in this order. The `psi` that such a file may have holds in every episode.
      exogenous: signals that effects read: name -> a number, or a function of the episode's time in s (`exo:time` is
        given).
      condition: which condition's values effects that differ between conditions have.

    Commands are changed, dry friction and forces written before every physics step; model edits are made at each reset,
    on top of psi; hidden states (delays, lags, heat) begin settled at an episode's first command. Effects on sensors
    change what `RecordLog` records, not the observation, whose entries have no channel names.

    Raises:
      InputError: an unknown family, place or parameter, a signal that is missing, an environment that cannot be
        stepped so.
    """

    def __init__(
        self,
        env: gym.Env,
        effects: Given,
        exogenous: Mapping[str, Signal] | None = None,
        condition: str | None = None,
    ) -> None:
        self.require(env)
        env = with_psi(env, effects, RandomizePsi)
        super().__init__(env, effects=effects, exogenous=exogenous, condition=condition)
        self.sim = simulation_of(env, "ApplyEffects")
        self.application = Application(self.sim, effects, exogenous, condition)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects at work, bound to the environment's model."""
        return tuple(self.application.effects)

    @property
    def thetas(self) -> tuple[Array, ...]:
        """Their parameter values, (k,) each."""
        return tuple(self.application.thetas)

    @classmethod
    def from_file(
        cls,
        env: gym.Env,
        path: str | os.PathLike[str],
        exogenous: Mapping[str, Signal] | None = None,
        any_model: bool = False,
        condition: str | None = None,
    ) -> "ApplyEffects":
        """The effects of an `effects.yaml`, for an environment whose model is the `model.xml` beside it.

        Args:
          env: the environment.
          path: an `effects.yaml`.
          exogenous, condition: as for the constructor.
          any_model: put them into another model too.

        Raises:
          InputError: the file is no `effects.yaml`, or was made for another model than the environment's.
          MissingExtra: YAML cannot be read for want of the extra `measured`.
        """
        if not any_model:
            check_model(env, os.fspath(path))
        return cls(env, os.fspath(path), exogenous, condition)

    def recorded(self, name: str, value: Any) -> Any:
        """See `EnvWrapper`."""
        return recorded(value) if name == "effects" else super().recorded(name, value)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Edit the model from nominal, forget hidden states, reset."""
        with self.refusable(self.sim.kept(edits=True)):
            self.sim.edit()
            self.sim.begin_episode()
            return self.env.reset(seed=seed, options=options)


class VectorApplyEffects(VectorEnvWrapper):
    """`ApplyEffects` around a vector environment on `mujoco.batch`; arguments as there, and `values`.

    Each simulation has hidden states of its own. Signals that are functions are given the episodes' times (n,).
    With `values`, an array (n, k) for each effect, every simulation has values of its own in place of those in
    `effects`; what sensors report keeps the latter.
    """

    def __init__(
        self,
        env: VectorEnv,
        effects: Given,
        exogenous: Mapping[str, Signal] | None = None,
        condition: str | None = None,
        values: Sequence[ArrayLike] | None = None,
    ) -> None:
        self.require(env)
        env = with_psi(env, effects, VectorRandomizePsi)
        super().__init__(env, effects=effects, exogenous=exogenous, condition=condition, values=values)
        self.sim = batch_simulation_of(env, "ApplyEffects")
        self.application = Application(self.sim, effects, exogenous, condition, values)

    def recorded(self, name: str, value: Any) -> Any:
        """See `EnvWrapper`."""
        if name == "values":
            return None if value is None else [np.asarray(v, float).tolist() for v in value]
        return recorded(value) if name == "effects" else super().recorded(name, value)
