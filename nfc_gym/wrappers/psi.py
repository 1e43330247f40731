"""`RandomizePsi`: physical coefficients that are drawn anew for each episode."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from numbers import Real
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.fields import ModelFields, names_of
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.simulation import SingleSimulation, simulation_of
from nfc_gym.wrappers.source import Draws, Source

Array = NDArray[np.float64]
Distribution = float | Mapping[str, Sequence[float]] | Source
Space = ParameterSpace | Sequence[str] | Sequence[Mapping[str, Any]]
_SPREAD = 0.5  # a body mass of which no bounds are given lies within half of its nominal value


class Prior:
    """Draws of psi.

    Args:
      space: what psi is.
      distribution: a fraction f in (0, 1]: uniform between nominal - f (nominal - low) and nominal + f (high -
        nominal); name -> (low, high): uniform, the rest nominal; or samples of psi: an array (d,) or (n, d), a
        posterior, a path.

    Raises:
      InputError: a fraction outside (0, 1], a name that the space lacks, bounds that are not ordered or reach what
        nature does not allow (a mass of 0, negative friction), a source of another width.
    """

    def __init__(self, space: ParameterSpace, distribution: Distribution) -> None:
        self.space = space
        self.low = self.high = space.nominal
        self.draws: Draws | None = None
        if isinstance(distribution, Mapping):
            self._named(distribution)
        elif isinstance(distribution, Real):
            fraction = float(distribution)
            if isinstance(distribution, bool) or not 0 < fraction <= 1:
                raise InputError(f"RandomizePsi: a fraction of the prior lies in (0, 1], got {distribution!r}")
            self.low = space.nominal - fraction * (space.nominal - space.low)
            self.high = space.nominal + fraction * (space.high - space.nominal)
            self.low, self.high = (np.where(space.free, b, space.nominal) for b in (self.low, self.high))
        else:
            self.draws = Draws(distribution, "psi", "RandomizePsi")
            self.draws.expect((len(space),), meaning=f"the parameters {', '.join(space.names)}")
        for bound in (self.low, self.high):
            space.require_possible(bound)

    def _named(self, bounds: Mapping[str, Sequence[float]]) -> None:
        for name, pair in bounds.items():
            ends = np.array(pair) if np.shape(pair) == (2,) else np.zeros(0)
            if ends.dtype.kind not in "fiu" or not ends.size or not np.isfinite(ends).all() or ends[0] > ends[1]:
                raise InputError(f"RandomizePsi: {name!r} needs (low, high) with low <= high, got {pair!r}")
        self.low = self.space.vector({n: float(b[0]) for n, b in bounds.items()})
        self.high = self.space.vector({n: float(b[1]) for n, b in bounds.items()})

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """(n, d) psi in physical units; samples that nature does not allow raise `InputError`."""
        if self.draws is not None:
            psi = self.draws.draw(n, rng)
            self.space.require_possible(psi)
            return psi
        return rng.uniform(self.low, self.high, (n, len(self.space)))


def space_of(env: Any, model: mujoco.MjModel, space: Space | None, names: Sequence[str]) -> ParameterSpace:
    """The psi of an environment: its own, or what is given: a space, parameters as tables, or names of bodies (masses).

    Raises:
      InputError: the environment has none and none is given, or a name or field does not exist.
    """
    if space is None:
        own = getattr(env.unwrapped, "psi_space", None)
        if isinstance(own, ParameterSpace):
            return own
        if not names:
            raise InputError(
                f"psi: {type(env.unwrapped).__name__} has no `psi_space`: give `space`, a ParameterSpace, a list "
                f"of parameters or names of bodies whose masses vary: {_bodies(model)}"
            )
        space = list(names)
    if isinstance(space, ParameterSpace):
        return space
    each = [space] if isinstance(space, str) else space
    if isinstance(each, Mapping) or not isinstance(each, Iterable):
        raise InputError(
            f"RandomizePsi: space is {space!r}; want a ParameterSpace, a list of parameters, or names of bodies whose "
            f"masses vary: {_bodies(model)}"
        )
    return ParameterSpace(model, [_mass(model, p) if isinstance(p, str) else _parameter(p) for p in each])


def _parameter(table: Any) -> Parameter:
    """A parameter from a table; `of` may be left out of one of `opt`."""
    known = {f.name: f.default is MISSING for f in fields(Parameter)}
    row = {"of": (), **table} if isinstance(table, Mapping) else {}
    if set(row) - set(known) or {name for name, needed in known.items() if needed} - set(row):
        needed, others = (", ".join(k for k in known if known[k] is which) for which in (True, False))
        raise InputError(f"RandomizePsi: {table!r} is no parameter: want a table of {needed}, and perhaps {others}")
    of = row["of"]
    return Parameter(**{**row, "of": (of,) if isinstance(of, str) else tuple(of)})


def _mass(model: mujoco.MjModel, body: str) -> Parameter:
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
    if found < 1:
        raise InputError(f"RandomizePsi: the model has no body named {body!r}; it has: {_bodies(model)}")
    mass = float(model.body_mass[found])
    if mass <= 0:
        raise InputError(f"RandomizePsi: body {body!r} has no mass of its own to vary")
    return Parameter(body, "body_mass", (body,), "kg", (1 - _SPREAD) * mass, (1 + _SPREAD) * mass)


def _bodies(model: mujoco.MjModel) -> str:
    return ", ".join(n for n in names_of(model, mujoco.mjtObj.mjOBJ_BODY, model.nbody)[1:] if n)


def told(belief: ArrayLike | Mapping[str, float] | None, space: ParameterSpace, own: bool) -> dict[str, Any]:
    """The reset options that show a belief of psi in place of the truth.

    Raises:
      InputError: the environment observes no psi, or the belief is none of its space.
    """
    if belief is None:
        return {}
    if not own:
        raise InputError("RandomizePsi: belief is what `obs['psi']` shows, and this environment observes no psi")
    value = space.vector(dict(belief) if isinstance(belief, Mapping) else belief)
    if value.shape != space.nominal.shape or not np.isfinite(value).all():
        raise InputError(f"RandomizePsi: belief is {belief!r}; want finite numbers: {', '.join(space.names)}")
    return {"psi_belief": value}


class Psi:
    """Psi of one environment, written through its `reset` options where it has psi of its own, else into its model."""

    def __init__(self, env: gym.Env, space: ParameterSpace, sim: SingleSimulation) -> None:
        self.space, self.sim = space, sim
        self.own = getattr(env.unwrapped, "psi_space", None) is space
        self.value = space.nominal.copy()
        if not self.own:
            sim.edits.add(self._edit)

    def _edit(self, fields: ModelFields) -> None:
        self.space.write(fields, self.value)

    def options(
        self, value: Array, options: Mapping[str, Any] | None, more: Mapping[str, Any] | None = None
    ) -> dict[str, Any] | None:
        """Reset options under which the coming episode runs with `value` (d,), and with `more`, but for what the
        caller's own say.

        Raises:
          InputError: the caller's are no mapping, or name a psi that nature does not allow.
        """
        if not isinstance(options, Mapping | None):
            raise InputError(f"reset: options is {options!r}, want a dict")
        own = {"psi": value, **(more or {})}
        # None of the caller's is not given, as the environment has it.
        options = own | {k: v for k, v in (options or {}).items() if v is not None or k not in own}
        psi = self.space.vector(options["psi"])
        if psi.shape == self.space.nominal.shape:  # another one is refused where it is written
            self.space.require_possible(psi)
        self.value = psi
        if self.own:
            return options
        del options["psi"]
        self.sim.edit()
        return options or None

    def kept(self) -> Callable[[], None]:
        """What puts back the psi of the running episode, into its model too, after a reset that fails."""
        value, undo = self.value, self.sim.kept(edits=True)

        def both() -> None:
            self.value = value
            undo()

        return both

    def write(self, value: Array) -> None:
        """Psi of an episode that has begun but not moved yet; derived quantities follow."""
        self.value = value
        if self.own:
            self.sim.env.note_psi(value)
        self.sim.edit_again()


class RandomizePsi(EnvWrapper):
    """Draws psi at each reset.

    Args:
      env: any MuJoCo environment. One with a `psi_space` is asked to by `reset(options={"psi": ...})`; of any other the
        model is edited, always from nominal, with inertias and derived constants following.
      distribution: see `Prior`; default the whole prior. With a mapping of body names and bounds in kg, an environment
        without psi needs no `space`.
      space: psi of an environment that has none: a `ParameterSpace`, tables with the attributes of `Parameter`, or
        names of bodies, whose masses then have a prior of half to one and a half times their nominal value.

      belief: (d,) what `obs["psi"]` shows in every episode, of an environment with psi of its own; default the truth.

    `reset(options={"psi": vector | {name: value}})` overrides the draw. `psi` and `psi_space` read back what holds.
    """

    def __init__(
        self,
        env: gym.Env,
        distribution: Distribution = 1.0,
        space: Space | None = None,
        belief: ArrayLike | Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(env, distribution=distribution, space=space, belief=belief)
        sim = simulation_of(env, "RandomizePsi")
        names = tuple(distribution) if isinstance(distribution, Mapping) else ()
        self.psi_space = space_of(env, sim.nominal, space, names)
        self.prior = Prior(self.psi_space, distribution)
        self._psi = Psi(env, self.psi_space, sim)
        self._told = told(belief, self.psi_space, self._psi.own)

    @property
    def psi(self) -> Array:
        """(d,) psi of the running episode, physical units."""
        return self._psi.value.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw psi, then reset."""
        with self.refusable(self._psi.kept()):
            value = self.prior.draw(1, self.stream(seed))[0]
            return self.env.reset(seed=seed, options=self._psi.options(value, options, self._told))


class VectorRandomizePsi(VectorEnvWrapper):
    """`RandomizePsi` around a vector environment on `mujoco.batch`; `env`, `distribution` and `belief` as there.

    Each episode of each simulation has a psi of its own. `reset(options={"psi": ...})` overrides the draws of the
    rows that it resets, for their coming episode; `psi_belief` likewise.
    """

    def __init__(
        self, env: VectorEnv, distribution: Distribution = 1.0, belief: ArrayLike | Mapping[str, float] | None = None
    ) -> None:
        super().__init__(env, distribution=distribution, belief=belief)
        self.sim = batch_simulation_of(env, "RandomizePsi")
        self.psi_space = space_of(env, self.sim.nominal, None, ())
        self.prior = Prior(self.psi_space, distribution)
        self._told = told(belief, self.psi_space, own=True)
        self.sim.on_reset.add(self._draw)

    def _draw(self, ids: NDArray[np.intp]) -> dict[str, Any]:
        return {"psi": self.prior.draw(len(ids), self.stream(None))} | self._told

    @property
    def psi(self) -> Array:
        """(n, d) psi of the running episodes, physical units."""
        return self.env.unwrapped.psi

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset; psi is drawn for the rows that are."""
        self.vet(seed, options)
        self.stream(seed)
        return self.env.reset(seed=seed, options=options)
