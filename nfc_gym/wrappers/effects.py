"""`ApplyEffects`: the effects that a model lacks, put into the simulation of any MuJoCo environment.

The objects are those of the calibrator, and act through the same class at every physics step: an effect found in logs
is the effect that a policy trains under, bit for bit.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.acting import Acting
from nfc_gym.physics.effects.base import TIME, Effect, overrides
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import numbers
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.effects_file import check_model, psi_said, read_effects
from nfc_gym.wrappers.effects_given import Given, bound, own_values, recorded
from nfc_gym.wrappers.order import beneath
from nfc_gym.wrappers.psi import RandomizePsi, VectorRandomizePsi
from nfc_gym.wrappers.simulation import simulation_of
from nfc_gym.wrappers.simulation_base import Simulation

Array = NDArray[np.float64]
Signal = float | Callable[[Any], Any]
_NONE: Mapping[str, Any] = {}


def check_signals(effects: Sequence[Effect], exogenous: Mapping[str, Signal]) -> None:
    """Refuse effects that read a signal which nobody gives."""
    for effect in effects:
        for name in effect.signals:
            if name not in exogenous and name != TIME:
                given = ", ".join(exogenous) or "none"
                raise InputError(f"ApplyEffects: {effect.id} reads {name!r}: give it in `exogenous`; given: {given}")


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
