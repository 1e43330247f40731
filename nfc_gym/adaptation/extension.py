"""An environment as close-loop found the machine to be: calibrated psi and the named effects, in many simulations.

What of the calibrated parameters is psi of the environment becomes its psi, so that the critic sees it; the rest is
written into the model (`corrected`). With `vary`, each simulation has sizes of its own, within their intervals.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from nfc_gym.adaptation.corrected import Fields, Parameters, model_like, value_in
from nfc_gym.adaptation.extended import Calibrated, Found, Named
from nfc_gym.adaptation.worlds import vector_env
from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Effect, overrides
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.simulate.machine import Machine, full_id
from nfc_gym.wrappers import VectorApplyEffects, VectorRandomizePsi
from nfc_gym.wrappers.effects import check_signals

Array = NDArray[np.float64]
_DRAWS = 4096  # psi that episodes draw from
_MOVING = ("model", "action", "friction", "modulate", "force")  # hooks that change how a robot moves
_RESTITUTION = "geom_restitution"  # MuJoCo has none: it cannot be read from a model


@dataclass(frozen=True)
class Bound:
    """An effect in an environment.

    Attributes:
      id, sentence: as it was found.
      effect: bound to the model.
      theta, low, high: (k,) its values and their 95 % intervals.
      acts: whether it changes motion; effects on sensors do not change what a policy sees.
    """

    id: str
    sentence: str
    effect: Effect
    theta: Array
    low: Array
    high: Array
    acts: bool


class Extension:
    """What was found, in an environment.

    Args:
      found: see `read_found`.
      environment: id.
      condition: whose values effects have that differ between conditions of the logs.
      signals: exogenous signals that effects read: name -> number.

    Attributes:
      effects: that were named.
      psi, psi_low, psi_high: (d,) the environment's psi.
      moved: names of the calibrated parameters, psi or not, that are not nominal.

    Raises:
      InputError: an effect or a parameter names what the robot lacks; a model of another robot; a condition or a signal
        that is missing.
    """

    def __init__(
        self, found: Found, environment: str, *, condition: str | None = None,
        signals: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        self.found, self.environment, self.signals = found, full_id(environment), dict(signals or {})
        machine = Machine(self.environment)
        self.model, self.space = machine.model, machine.space
        try:
            self.effects = tuple(self._bound(each, condition) for each in found.effects)
            check_signals([e.effect for e in self.effects], self.signals)
            self.psi = self.space.vector(dict(found.psi))
            self.psi_low, self.psi_high = self.psi.copy(), self.psi.copy()
            self._ties = np.arange(len(self.psi))
            left = self._take(found.parameters)
            self.rest = self._rest(left)
        except InputError as e:
            text = str(e)
            told = text if text.startswith(str(found.source)) else f"{found.source}: {text}"
            raise InputError(f"{told} (of {self.environment})") from None
        self.moved = self._moved(left)

    def require_something(self) -> None:
        """Raises `InputError` where nothing was found that a policy could be adapted to."""
        found = self.found
        if not self.effects and not self.moved:
            said = f"; the verdict is {found.verdict!r}" if found.verdict else ""
            raise InputError(
                f"{found.source}: there is nothing to adapt to: no effect is named and every calibrated parameter is "
                f"nominal{said}"
            )

    @property
    def reads(self) -> set[str]:
        """The exogenous signals that effects read."""
        return {name for each in self.found.effects for name in each.effect.signals}

    @property
    def differs(self) -> bool:
        """Whether an effect's values differ between conditions."""
        return any(isinstance(each.effect, Conditioned) for each in self.found.effects)

    def _bound(self, each: Named, condition: str | None) -> Bound:
        effect, theta, low, high = each.effect, each.theta, each.low, each.high
        if isinstance(effect, Conditioned):
            if condition is None:
                known = ", ".join(effect.conditions)
                raise InputError(f"{each.id} differs between conditions: say --condition, one of {known}")
            theta, low, high = (effect.inside(v, condition) for v in (theta, low, high))
            effect = effect.inner
        effect.bind(self.model)
        return Bound(each.id, each.sentence, effect, theta, low, high, any(overrides(effect, h) for h in _MOVING))

    def _take(self, parameters: Sequence[Calibrated]) -> list[Calibrated]:
        """Calibrated values into psi, object by object; what is no psi is left."""
        left = []
        for p in parameters:
            taken: set[str] = set()
            first = -1
            for i, mine in enumerate(self.space.parameters):
                if mine.field == p.field and set(mine.of) <= set(p.of):
                    self.psi[i], self.psi_low[i], self.psi_high[i] = p.value, p.low, p.high
                    first = i if first < 0 else first
                    self._ties[i] = first
                    taken |= set(mine.of)
            of = tuple(o for o in p.of if o not in taken)
            if of or not p.of:
                left.append(replace(p, of=of))
        return left

    def _rest(self, left: Sequence[Calibrated]) -> list[tuple[Effect, Array, Array, Array]]:
        """What is written into the model after psi, with values and intervals."""
        rest: list[tuple[Effect, Array, Array, Array]] = []
        if left:
            value, low, high = (np.array([getattr(p, k) for p in left], float) for k in ("value", "low", "high"))
            rest.append((Parameters(left), value, low, high))
        if self.found.model is not None:
            theirs = model_like(self.found.model, self.model, self.environment)
            self._read_psi(theirs)
            rest.append((Fields(theirs), np.zeros(0), np.zeros(0), np.zeros(0)))
        for effect, *_ in rest:
            effect.bind(self.model)
        return rest

    def _read_psi(self, theirs: mujoco.MjModel) -> None:
        """Psi as a corrected model has it."""
        for i, p in enumerate(self.space.parameters):
            if p.field == _RESTITUTION:
                continue
            value = value_in(theirs, p)
            if np.isclose(value, self.space.nominal[i], rtol=1e-6):
                continue
            if p.name in self.found.psi and not np.isclose(value, self.psi[i], rtol=1e-6):
                raise InputError(
                    f"psi is said to have {p.name} = {self.psi[i]:g}, and {self.found.model} has {value:g}; "
                    "leave one of the two out"
                )
            self.psi[i] = self.psi_low[i] = self.psi_high[i] = value

    def _moved(self, left: Sequence[Calibrated]) -> tuple[str, ...]:
        off = ~np.isclose(self.psi, self.space.nominal, rtol=1e-6)
        names = [n for n, o in zip(self.space.names, off, strict=True) if o]
        names += [
            p.name for p in left
            if p.field == _RESTITUTION or not np.isclose(p.value, value_in(self.model, p), rtol=1e-6)
        ]  # fmt: skip
        return tuple(names + [f for e, *_ in self.rest if isinstance(e, Fields) for f in e.values])

    def told(self) -> list[dict[str, Any]]:
        """The calibrated parameters that are not nominal, as reports have them; `psi`: whether the environment's."""
        x = self.space
        rows = list(zip(x.names, x.units, x.nominal, self.psi, self.psi_low, self.psi_high, strict=True))
        ours = len(rows)
        for effect, theta, low, high in self.rest:
            if isinstance(effect, Parameters):
                nominal = [None if p.field == _RESTITUTION else value_in(self.model, p) for p in effect.given]
                names, units = ([getattr(p, k) for p in effect.params] for k in ("name", "unit"))
                rows += zip(names, units, nominal, theta, low, high, strict=True)
        return [
            {"name": name, "unit": unit, "nominal": None if nominal is None else float(nominal)}
            | {"estimate": float(value), "low": float(low), "high": float(high), "psi": k < ours}
            for k, (name, unit, nominal, value, low, high) in enumerate(rows)
            if nominal is None or not np.isclose(value, nominal, rtol=1e-6)
        ]

    def without(self, effect: str) -> "Extension":
        """The same without one of the effects, by its id."""
        other = object.__new__(Extension)
        other.__dict__.update(self.__dict__)
        other.effects = tuple(e for e in self.effects if e.id != effect)
        return other

    def envs(
        self, n: int, *, vary: float = 0.0, seed: int = 0, episode: int | None = None, threads: int = 0,
        settings: Mapping[str, Any] | None = None,
    ) -> VectorEnv:  # fmt: skip
        """n simulations, made for `VectorSight`.

        Args:
          n: how many.
          vary: sizes are uniform over this multiple of their 95 % intervals, psi anew in each episode, the rest one in
            each simulation; 0 is the fitted sizes in all. Parameters go as far as nature allows, effects as a fit may.
          seed: of these draws.
          episode, threads, settings: as `vector_env`.
        """
        envs = vector_env(self.environment, n, threads=threads, episode=episode, **(settings or {}))
        rng = np.random.default_rng(seed)
        if not np.allclose(self.psi, self.space.nominal, rtol=1e-9):
            psi, allowed = self.psi, (self.space.least, self.space.most)
            if vary:
                psi = _drawn(psi, self.psi_low, self.psi_high, allowed, vary, _DRAWS, rng, self._ties)
            envs = VectorRandomizePsi(envs, psi)
        acting = [*self.rest, *((e.effect, e.theta, e.low, e.high) for e in self.effects)]
        if not acting:
            return envs
        values = [_drawn(theta, low, high, (e.low, e.high), vary, n, rng) for e, theta, low, high in acting]
        return VectorApplyEffects(envs, [(e, t) for e, t, *_ in acting], self.signals, values=values)


def require_read(extensions: Sequence[Extension], condition: str | None, signals: Mapping[str, float] | None) -> None:
    """Raises `InputError` where a condition or a signal is given and none of the effects asks for it."""
    read = set().union(*(x.reads for x in extensions))
    unread = [name for name in signals or {} if name not in read]
    if unread:
        known = ", ".join(sorted(read)) or "none"
        raise InputError(f"--signal {unread[0]}: no effect reads it, leave it out; signals that are read: {known}")
    if condition is not None and not any(x.differs for x in extensions):
        raise InputError(f"--condition {condition}: no effect differs between conditions, leave it out")


def _drawn(
    value: Array, low: Array, high: Array, bounds: tuple[Array, Array], vary: float, n: int, rng: np.random.Generator,
    ties: NDArray[np.intp] | None = None,
) -> Array:  # fmt: skip
    """(n, k) draws, uniform over that part of `vary` times the interval about the value which lies inside the bounds.

    To cut the interval is to draw again what falls outside: nothing piles up at a bound. A value that went beyond one
    widens it. Those with the same tie go together.
    """
    u = rng.random((n, len(value)))
    low = np.maximum(value - vary * (value - low), np.minimum(bounds[0], value))
    high = np.minimum(value + vary * (high - value), np.maximum(bounds[1], value))
    return low + (high - low) * (u if ties is None else u[:, ties])
