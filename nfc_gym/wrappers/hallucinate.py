"""`Hallucinate`: a policy that chooses, within a posterior's uncertainty, the world in its favour.

The Box action grows by pi_h in [-1, 1], and the world is mean + beta L pi_h (see `nfc_gym.wrappers.belief`). Mass and
ground do not change in mid-stride: what the first action of an episode says of psi and delta_e holds until its end;
delta_s follows each action. Until that first action the world is the posterior's mean, which also is what the agent is
told of psi (`psi_belief`) throughout: it is trained to believe the mean, as it will on the robot.
"""

import copy
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.whole import require_whole
from nfc_gym.physics.residual import Components
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper, finite
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.belief import Belief
from nfc_gym.wrappers.dynamics import Injection, Mode, checked_mode, component_names
from nfc_gym.wrappers.ground import Ground
from nfc_gym.wrappers.order import PSI, TERRAIN, beneath
from nfc_gym.wrappers.psi import Psi, Space, space_of
from nfc_gym.wrappers.simulation import Simulation, SingleSimulation, simulation_of
from nfc_gym.wrappers.source import Source, sampler_of

Array = NDArray[np.float64]


def checked_beta(beta: Any) -> float:
    """A number of standard deviations.

    Raises:
      InputError: it is none, or below zero.
    """
    if isinstance(beta, bool) or not isinstance(beta, Real) or not 0 <= float(beta) < np.inf:
        raise InputError(f"Hallucinate: beta is {beta!r}; want a number of standard deviations, 0 or more")
    return float(beta)


def drawn(posterior: Source, samples: int) -> Fidelity:
    """Samples of a posterior, always the same ones: what the action means must not change from run to run."""
    count = require_whole("samples", samples, 1)
    return sampler_of(posterior, "psi", "Hallucinate").sample(count, np.random.default_rng(0))


def wider(space: gym.Space, more: int) -> spaces.Box:
    """A Box action with `more` entries in [-1, 1] behind its own."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise InputError(f"Hallucinate widens a Box of shape (k,), and the action is {space}")
    one = np.ones(more, space.dtype)
    return spaces.Box(np.concatenate([space.low, -one]), np.concatenate([space.high, one]), dtype=space.dtype.type)


def ground_of(env: gym.Env, sim: SingleSimulation, belief: Belief) -> Ground | None:
    """The ground that an episode's first action chooses; None where the posterior says nothing of it.

    Raises:
      InputError: it speaks of a map that is neither the environment's heightfield nor the robot's grid.
    """
    if not belief.mode_count:
        return None
    ground = Ground(env, sim, "Hallucinate")
    ground.require(belief.shape, "Hallucinate")
    sim.late_ground = True
    return ground


def injection_of(
    env: Any, sim: Simulation, belief: Belief, mode: Mode, components: Sequence[str] | None
) -> Injection | None:
    """delta_s wired into a simulation; None where the posterior says nothing of it."""
    if not belief.step_size:
        return None
    checked_mode(mode)
    bound = Components(sim.model, component_names(env, components, belief.step_size), belief.step_size)
    sim.attach("Hallucinate", after=mode == "state", substeps=False)
    return Injection(sim, bound, mode, np.zeros((belief.step_size, 0)))


class _Hallucinating:
    """What the wrapper and its twin share."""

    belief: Belief

    def writes(self, what: str) -> bool:
        """Psi and the simulated terrain only where the posterior speaks of them."""
        return {PSI: bool(self.belief.psi_size), TERRAIN: bool(self.belief.mode_count)}.get(what, True)


class Hallucinate(_Hallucinating, EnvWrapper):
    """Widens the action by pi_h and puts the world that it asks for into the simulation.

    Args:
      env: any MuJoCo environment whose action is a Box (k,).
      posterior: with `sample(n, rng)`, an array (n, d) of draws of psi, or a path. Parts that its samples lack are left
        as they are.
      beta: how far from the mean pi_h = 1 leads, in standard deviations.
      modes: principal modes of delta_e at most.
      samples: how many are drawn, once, to tell mean and covariance. A neural posterior's delta_e takes a second a
        draw without a GPU: say fewer there, though more than pi_h has entries.
      space: psi of an environment that has none of its own, as for `RandomizePsi`.
      mode, components: of delta_s, as for `ResidualDynamics`; entries that are no physical state are left out.

    Where the posterior speaks of delta_e, the first step begins the episode again from the same draws, those of the
    environment and of this package's wrappers beneath, on the ground that was asked for: of maps in the robot's grid it
    is laid where the robot starts, as `ResidualTerrain` lays it. The action's layout is
    (own, psi, modes, delta_s): `belief` has the sizes; `fidelity` is what holds.
    """

    def __init__(
        self,
        env: gym.Env,
        posterior: Source,
        beta: float = 1.0,
        modes: int = 4,
        samples: int = 256,
        space: Space | None = None,
        mode: Mode = "force",
        components: Sequence[str] | None = None,
    ) -> None:
        self.require(env)
        sampled = drawn(posterior, samples)
        sim = simulation_of(env, "Hallucinate")
        psi = None if sampled.psi is None else space_of(env, sim.nominal, space, ())
        self.beta = checked_beta(beta)
        self.belief = Belief(sampled, psi, modes)
        super().__init__(
            env, posterior=posterior, beta=beta, modes=modes, samples=samples, space=space, mode=mode,
            components=components,
        )  # fmt: skip
        self.sim = sim
        self.own = int(np.prod(env.action_space.shape or (0,)))
        self.action_space = wider(env.action_space, self.belief.size)
        self._wanted = self.action_space.shape
        self.psi = None if psi is None else Psi(env, psi, sim)
        self.ground = ground_of(env, sim, self.belief)
        self.injection = injection_of(env, sim, self.belief, mode, components)
        # What the episode's first action has chosen, and delta_s as its latest one has, the mean at first.
        self._h, self._chosen = np.zeros(self.belief.size), False
        # Of delta_s: the part of it that holds throughout, what moves the rest, and the bounds of that part of pi_h.
        self._made = self.belief.held_part(self._h[: self.belief.held], self.beta)
        self._lever, self._high = self.belief.lever(self.beta), np.ones(self.belief.step_size)
        self._low = -self._high
        self._again: tuple[Any, ...] = ()  # how the running episode began: seed, options, draws

    @property
    def fidelity(self) -> Fidelity:
        """What holds now: psi and delta_e as the episode's first action has chosen them, delta_s as the last did."""
        return self.belief.at(self._h, self.beta)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in the posterior's mean."""
        with self.refusable(*self._kept()):
            self._chosen = False
            self._again = (seed, options, self._draws() if seed is None else None)
            self._h = np.zeros(self.belief.size)
            return self._begin(seed, options)

    def _kept(self) -> list[Callable[[], None]]:
        """What puts back the world of the running episode after a reset that fails."""
        before = {name: self.__dict__[name] for name in ("_chosen", "_again", "_h", "_made")}
        undo = [lambda: self.__dict__.update(before), self.sim.kept()]
        if self.ground is not None:
            undo.append(self.ground.kept(np.asarray(self.fidelity.delta_e)))
        return undo + [part.kept() for part in (self.psi, self.injection) if part is not None]

    def _draws(self) -> tuple[Any, list[tuple[EnvWrapper, np.random.Generator | None]]]:
        """Where the environment's generator stands, and the streams of the wrappers beneath."""
        streams = [(w, copy.deepcopy(w.rng)) for w in beneath(self.env) if isinstance(w, EnvWrapper)]
        return copy.deepcopy(self.env.unwrapped.np_random.bit_generator.state), streams

    def _begin(self, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, dict[str, Any]]:
        world = self.fidelity
        self._made = self.belief.held_part(self._h[: self.belief.held], self.beta)
        if self.psi is not None and world.psi is not None:
            mean = self.belief.at(np.zeros(self.belief.size), self.beta).psi
            options = self.psi.options(world.psi, options, {"psi_belief": mean} if self.psi.own else None)
        if self.ground is not None and world.delta_e is not None:
            options = self.ground.options(world.delta_e, options, seed)
        if self.injection is not None and world.delta_s is not None:
            self.injection.bias = self.injection.delta = world.delta_s
        self.sim.begin_episode()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step in the world that the action asks for."""
        action = finite(action, self._wanted)
        if not self._chosen:
            self._h, self._chosen = np.array(action[self.own :], float), True
            self._enter()
        if self.injection is not None:
            varying = self._h[self.belief.held :]
            varying[:] = action[self.own + self.belief.held :]
            h = np.minimum(np.maximum(varying, self._low), self._high)
            self.injection.bias = self._made + self._lever.dot(h)
        return self.env.step(action[: self.own])

    def _enter(self) -> None:
        """Psi and ground of the episode, as its first action has chosen them."""
        if self.ground is not None:
            seed, options, draws = self._again
            if draws is not None:
                self.env.unwrapped.np_random.bit_generator.state, streams = draws
                for wrapper, stream in streams:
                    wrapper.rng = stream
            self._begin(seed, options)
            return
        self._made = self.belief.held_part(self._h[: self.belief.held], self.beta)
        psi = self.fidelity.psi
        if self.psi is not None and psi is not None:
            self.psi.write(psi)


class VectorHallucinate(_Hallucinating, VectorEnvWrapper):
    """`Hallucinate` around a vector environment on `mujoco.batch`; arguments as there.

    Each simulation holds what its own first action said. delta_e cannot be chosen by an action there, since the
    batch is built anew for other terrains: a posterior that speaks of it is refused (draw residual terrains between
    roll-outs with `VectorResidualTerrain`).
    """

    def __init__(
        self,
        env: VectorEnv,
        posterior: Source,
        beta: float = 1.0,
        samples: int = 256,
        mode: Mode = "force",
        components: Sequence[str] | None = None,
    ) -> None:
        self.require(env)
        sampled = drawn(posterior, samples)
        if sampled.delta_e is not None:
            raise InputError(
                "VectorHallucinate: the posterior speaks of delta_e, which no action can choose where the batch is "
                "built anew for other terrains; give one of psi and delta_s, and put VectorResidualTerrain around"
            )
        sim = batch_simulation_of(env, "Hallucinate")
        self.psi_space = None if sampled.psi is None else space_of(env, sim.nominal, None, ())
        self.beta = checked_beta(beta)
        self.belief = Belief(sampled, self.psi_space, 0)
        super().__init__(env, posterior=posterior, beta=beta, samples=samples, mode=mode, components=components)
        self.sim = sim
        self.own = int(np.prod(env.single_action_space.shape or (0,)))
        self.single_action_space = wider(env.single_action_space, self.belief.size)
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self._wanted = self.action_space.shape
        sim.attach("Hallucinate", substeps=False)  # what tells when an episode's first step is over
        self.injection = injection_of(env, sim, self.belief, mode, components)
        self._held = np.zeros((env.num_envs, self.belief.held))
        self.fidelity = self.belief.at(np.zeros((env.num_envs, self.belief.size)), self.beta)
        sim.on_reset.add(self._mean)

    def _mean(self, ids: NDArray[np.intp]) -> dict[str, Any]:
        self._held[ids] = 0
        mean = self.belief.at(np.zeros((len(ids), self.belief.size)), self.beta).psi
        return {} if mean is None else {"psi": mean}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step in the worlds that the actions ask for."""
        actions = finite(actions, self._wanted)
        h = actions[:, self.own :].astype(float)
        first = self.sim.beginning
        if first.any():
            self._held[first] = h[first, : self.belief.held]
        self.fidelity = self.belief.at(np.concatenate([self._held, h[:, self.belief.held :]], 1), self.beta)
        if first.any() and self.psi_space is not None and self.fidelity.psi is not None:
            self._write(np.flatnonzero(first), self.fidelity.psi[first])
        if self.injection is not None and self.fidelity.delta_s is not None:
            self.injection.bias = self.fidelity.delta_s
        return self.env.step(actions[:, : self.own])

    def _write(self, ids: NDArray[np.intp], psi: Array) -> None:
        """Psi of episodes that have begun but not moved yet, with every other edit on top."""
        assert self.psi_space is not None
        fields = self.sim.fields_of(ids)
        fields.restore()
        self.psi_space.write(fields, psi)
        self.sim.apply(fields)
        fields.commit()
        self.sim.env.note_psi(psi, ids)
        self.sim.forward(ids)
