"""`ResidualDynamics`: what the simulator's motion lacks, s' = f_psi(s, a) + delta_s, put into its physics.

delta_s is a bias that holds for an episode, plus noise that is drawn each control step. Velocity residuals dv act as
the generalised force M dv / T over the control step T, so that contacts answer and positions follow; `mode="state"`
adds the residual to the state outright after the step, positions included. Entries that are no physical state perturb
what is observed.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.residual import OBSERVED, Components
from nfc_gym.physics.state import Inertia, move
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.rows import with_last
from nfc_gym.wrappers.simulation import simulation_of
from nfc_gym.wrappers.simulation_base import Simulation
from nfc_gym.wrappers.source import Draws, Source

Array = NDArray[np.float64]
Mode = Literal["force", "state"]


class Injection:
    """delta_s at work in a simulation; arrays have its leading batch shape.

    Attributes:
      bias: (..., s), set anew for each episode.
      noise: (s, k) times k standard normal numbers a control step is the noise of that step; k 0 is none.
      delta: (..., s) what acts in the running control step.
    """

    def __init__(self, sim: Simulation, components: Components, mode: Mode, noise: Array) -> None:
        self.sim, self.components, self.mode, self.noise = sim, components, mode, noise
        self.noisy, self.steady = bool(noise.shape[1]), components.direct and not noise.shape[1]
        self.duration = np.full(components.nv, sim.duration())  # s; by an array division is faster than by a number
        self.observing = bool(components.observed.size)
        self.bias = self.delta = np.zeros((*sim.shape, components.size))
        self.rng: np.random.Generator = np.random.default_rng(0)
        sim.bind("M")
        self.inertia = Inertia(sim.model)
        sim.on_control.add(self.begin)
        if mode == "force":
            sim.pushed = True
        else:
            sim.on_after.add(self.add)

    @property
    def bias(self) -> Array:
        """(..., s) what holds for an episode; to be set, not to be written into."""
        return self._bias

    @bias.setter
    def bias(self, value: Array) -> None:
        self._bias = value
        if self.steady:  # the acceleration is the same in every step
            self._acceleration = value[..., -self.components.nv :] / self.duration

    def kept(self) -> Callable[[], None]:
        """What puts back the bias and the noise of the running episode, after a reset that fails."""
        bias, delta, rng = self.bias, self.delta, self.rng

        def undo() -> None:
            self.bias, self.delta, self.rng = bias, delta, rng

        return undo

    def begin(self) -> None:
        """Draw the step's noise, and push."""
        self.delta = self._bias
        if self.noisy:
            self.delta = self._bias + self.rng.standard_normal((*self.sim.shape, self.noise.shape[1])).dot(self.noise.T)
        if self.mode == "force":
            sim = self.sim
            if not self.steady:
                self._acceleration = self.components.velocity(sim.qpos, self.delta) / self.duration
            inertia = sim.bind("M")
            if sim.started is True and not inertia.any():  # someone's reset left it for the first step to compute
                sim.forward()
            applied = sim.qfrc_applied
            applied += self.inertia.times(inertia, self._acceleration)

    def add(self) -> None:
        """Add positions and velocities outright."""
        step, nv = self.components.tangent(self.sim.qpos, self.delta), self.components.nv
        move(self.sim.model, self.sim.qpos, np.ascontiguousarray(step[..., :nv]))
        self.sim.qvel[...] += step[..., nv:]

    def observe(self, values: Array, delta: Array | None = None) -> Array:
        """An observation (..., s) with those entries of delta_s, by default the step's, that are no physical state."""
        out, entries = np.array(values), self.components.observed
        out[..., entries] += (self.delta if delta is None else delta)[..., entries]
        return out


def noise_root(covariance: ArrayLike | None, size: int) -> Array:
    """(size, k) root of a noise's covariance, given as (size, size), as variances (size,), or None for no noise.

    Raises:
      InputError: another shape, or no covariance.
    """
    if covariance is None:
        return np.zeros((size, 0))
    try:
        matrix = np.asarray(covariance, float)
    except (TypeError, ValueError):
        raise InputError(f"ResidualDynamics: covariance is {covariance!r}, want numbers") from None
    matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise InputError(
            f"ResidualDynamics: covariance must be finite, ({size}, {size}) or ({size},) variances, got {matrix.shape}"
        )
    if not np.allclose(matrix, matrix.T):
        i, k = np.unravel_index(np.abs(matrix - matrix.T).argmax(), matrix.shape)
        raise InputError(
            f"ResidualDynamics: covariance is not symmetric: [{i}, {k}] is {matrix[i, k]:g}, and [{k}, {i}] is "
            f"{matrix[k, i]:g}"
        )
    values, vectors = np.linalg.eigh(matrix)
    if values.min() < -1e-9 * max(abs(values).max(), 1e-300):
        raise InputError(f"ResidualDynamics: covariance has the eigenvalue {values.min():g}; want none below 0")
    keep = values > 0
    return vectors[:, keep] * np.sqrt(values[keep])


def box_key(space: gym.Space, key: str | None, size: int, observed: bool) -> str | None:
    """The key of a Dict observation that entries of delta_s perturb, None for a plain Box.

    Args:
      space: of an observation.
      key: that which was asked for; None is the first that fits.
      size: of delta_s.
      observed: whether any entry of it perturbs what is observed.

    Raises:
      InputError: the key does not exist, or entries that are observed find none as wide as delta_s.
    """
    if not observed:
        there = list(space.keys()) if isinstance(space, spaces.Dict) else []
        if key is not None and key not in there:
            raise InputError(
                f"ResidualDynamics: the observation has no key {key!r}; it has: {', '.join(there) or 'none'}"
            )
        return None
    if isinstance(space, spaces.Dict):
        boxes = [k for k, s in space.items() if s.shape == (size,)]
        key = key or next(iter(boxes), None)
        if key not in boxes:
            there = ", ".join(f"{k!r} {s.shape}" for k, s in space.items())
            wanted = f"a key of the observation with shape ({size},), which entries named {OBSERVED!r} perturb"
            found = f"key={key!r} is none" if key else "there is none"
            raise InputError(f"ResidualDynamics: delta_s of {size} entries wants {wanted}; {found}: {there}")
        return key
    if space.shape != (size,):
        raise InputError(
            f"ResidualDynamics: delta_s has {size} entries where the observation has shape {space.shape}; environments "
            'of this package have `proprio`, of which their delta_s is, as a key of its own with context=["psi"]'
        )
    return None


class _Observing:
    """What the wrapper and its twin share."""

    injection: Injection
    key: str | None

    def _observed(self, observation: Any, delta: Array | None = None) -> Any:
        if not self.injection.observing:
            return observation
        if self.key is None:
            return self.injection.observe(observation, delta)
        return {**observation, self.key: self.injection.observe(observation[self.key], delta)}


class ResidualDynamics(_Observing, EnvWrapper):
    """Puts residual dynamics into the physics of any MuJoCo environment.

    Args:
      env: the environment.
      source: where an episode's delta_s comes from: a posterior, an array (s,) or (n, s) of samples, a path.
      mode: `force` (M dv / T) or `state` (added to positions and velocities after the step).
      covariance: (s, s), or variances (s,), of noise drawn each control step; None is none.
      components: what each entry of delta_s is, see `nfc_gym.physics.residual.Components`; default the environment's
        own `proprio_components` where they fit, else the nv velocities, or 2 nv tangent positions and velocities. In
        `force` mode positions follow from the velocities, and residuals of them are not added.
      key: of a Dict observation, what entries named `obs` perturb.

    A residual of zero leaves every bit as it is.
    """

    def __init__(
        self,
        env: gym.Env,
        source: Source,
        mode: Mode = "force",
        covariance: ArrayLike | None = None,
        components: Sequence[str] | None = None,
        key: str | None = None,
    ) -> None:
        super().__init__(env, source=source, mode=mode, covariance=covariance, components=components, key=key)
        sim = simulation_of(env, "ResidualDynamics")
        self.draws, bound, root = prepare(env, sim, source, mode, covariance, components)
        sim.attach("ResidualDynamics", after=mode == "state", substeps=False)
        self.sim = sim
        self.key = box_key(env.observation_space, key, bound.size, bool(bound.observed.size))
        self.injection = Injection(sim, bound, mode, root)

    @property
    def delta_s(self) -> Array:
        """(s,) bias of the running episode."""
        return self.injection.bias.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw the episode's bias, then reset."""
        with self.refusable(self.injection.kept(), self.sim.kept()):
            self.injection.rng = self.stream(seed)
            self.injection.bias = self.draws.draw(1, self.injection.rng)[0]
            self.injection.delta = self.injection.bias
            self.sim.begin_episode()
            observation, info = self.env.reset(seed=seed, options=options)
        return self._observed(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and perturb what is observed."""
        observation, *rest = self.env.step(action)
        return self._observed(observation), *rest


class VectorResidualDynamics(_Observing, VectorEnvWrapper):
    """`ResidualDynamics` around a vector environment on `mujoco.batch`; arguments as there.

    Each episode of each simulation has a bias of its own.
    """

    def __init__(
        self,
        env: VectorEnv,
        source: Source,
        mode: Mode = "force",
        covariance: ArrayLike | None = None,
        components: Sequence[str] | None = None,
        key: str | None = None,
    ) -> None:
        super().__init__(env, source=source, mode=mode, covariance=covariance, components=components, key=key)
        sim = batch_simulation_of(env, "ResidualDynamics")
        self.draws, bound, root = prepare(env, sim, source, mode, covariance, components)
        self.key = box_key(env.single_observation_space, key, bound.size, bool(bound.observed.size))
        sim.attach("ResidualDynamics", after=mode == "state", substeps=False)
        self.injection = Injection(sim, bound, mode, root)
        self._before = self.injection.delta  # (n, s) what acted last in episodes that same-step autoreset ends
        sim.on_reset.add(self._draw)

    @property
    def delta_s(self) -> Array:
        """(n, s) biases of the running episodes."""
        return self.injection.bias.copy()

    def _draw(self, ids: NDArray[np.intp]) -> None:
        bias = self.injection.bias.copy()
        bias[ids] = self.draws.draw(len(ids), self.stream(None))
        self.injection.bias, self._before = bias, self.injection.delta
        self.injection.delta = np.where(np.isin(np.arange(len(bias)), ids)[:, None], bias, self.injection.delta)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset; biases are drawn for the rows that are."""
        self.vet(seed, options)
        self.injection.rng = self.stream(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        return self._observed(observation), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step, and perturb what is observed, an episode's last observation by what acted in it."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        info = with_last(info, lambda row, last: self._observed(last, self._before[row]))
        return self._observed(observation), reward, terminated, truncated, info


def prepare(
    env: Any,
    sim: Simulation,
    source: Source,
    mode: str,
    covariance: ArrayLike | None,
    names: Sequence[str] | None,
) -> tuple[Draws, Components, Array]:
    """The draws, the components bound to the model and the noise's root, checked against each other."""
    checked_mode(mode)
    draws = Draws(source, "delta_s", "ResidualDynamics")
    if len(draws.shape) != 1:
        raise InputError(f"ResidualDynamics: a sample of delta_s is a vector, got shape {draws.shape}")
    size = draws.shape[0]
    return draws, Components(sim.model, component_names(env, names, size), size), noise_root(covariance, size)


def checked_mode(mode: str) -> None:
    """Refuse a mode that is none."""
    if mode not in get_args(Mode):
        raise InputError(f"residual dynamics: no mode {mode!r}; there are: {', '.join(get_args(Mode))}")


def component_names(env: Any, names: Sequence[str] | None, size: int) -> Sequence[str] | None:
    """Names of delta_s's entries: those given, else the environment's own where there are as many.

    Raises:
      InputError: what is given is no list of names.
    """
    if names is not None and (isinstance(names, str) or not isinstance(names, Sequence)):
        raise InputError(
            f"ResidualDynamics: components is {names!r}; want a list of {size} names, one an entry of delta_s"
        )
    own = getattr(env.unwrapped, "proprio_components", None)
    return own if names is None and own is not None and len(own) == size else names
