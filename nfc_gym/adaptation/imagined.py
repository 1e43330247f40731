"""The worlds that a policy is adapted in: simulations with psi, delta_s and delta_e as a posterior believes them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from nfc_gym.adaptation.sight import Sight, VectorSight
from nfc_gym.adaptation.worlds import VectorStaggered, vector_env
from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import PARTS, Fidelity
from nfc_gym.core.posterior import Sampler, without_maps
from nfc_gym.inference.posterior import NeuralPosterior
from nfc_gym.inference.random import mixed
from nfc_gym.wrappers import (
    VectorApplyEffects,
    VectorHallucinate,
    VectorPerturbSignals,
    VectorRandomizePsi,
    VectorResidualDynamics,
    VectorResidualTerrain,
)


@dataclass(frozen=True)
class Parts:
    """A posterior that speaks of some parts of a fidelity alone.

    Attributes:
      posterior: to draw from.
      parts: that are kept of its draws.
    """

    posterior: Sampler
    parts: tuple[str, ...]

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """See `Sampler`."""
        posterior = self.posterior if "delta_e" in self.parts else without_maps(self.posterior)
        drawn = posterior.sample(n, rng)
        return Fidelity(**{part: getattr(drawn, part) for part in self.parts})


@dataclass
class Joint:
    """A posterior of whose samples each wrapper takes a part: what goes together in a sample stays together.

    At a reset wrappers draw one after the other, each for itself. The first one's samples are drawn, with its
    generator; `again` hands those behind it the same.

    Attributes:
      posterior: to draw from.
      last: what was drawn last.
    """

    posterior: Sampler
    last: Fidelity = field(default_factory=Fidelity)

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """See `Sampler`."""
        self.last = self.posterior.sample(n, rng)
        return self.last

    @property
    def again(self) -> Sampler:
        """To draw from behind the first wrapper."""
        return _Again(self)


@dataclass(frozen=True)
class _Again:
    joint: Joint

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """See `Joint`; wrappers refuse another number than they ask for."""
        return self.joint.last


# What a belief may have besides the parts of a fidelity: `effects(n, rng)`, and standard deviations of what is sensed.
EFFECTS, NOISE = "effects", "noise"
ALL = (*PARTS, EFFECTS, NOISE)
# Streams of random numbers: what a simulation lacks, and its ground, are not to go with when its first episode ends.
_EFFECTS, _GROUND = 1, 2
_MAPS = 64  # of a network's draws of delta_e, at most: each takes a second without a GPU


def require_parts(wanted: Sequence[str]) -> None:
    """Raises `InputError` at a name that is of no part of a belief."""
    wrong = [p for p in wanted if p not in ALL]
    if wrong:
        raise InputError(f"adapt: no part {wrong[0]!r} of a belief; there are: {', '.join(ALL)}")


def spoken(posterior: Sampler, wanted: Sequence[str]) -> tuple[str, ...]:
    """Of the parts that are wanted those that a posterior speaks of.

    Raises:
      InputError: of none.
    """
    require_parts(wanted)
    more = tuple(p for p in (EFFECTS, NOISE) if getattr(posterior, p, None) is not None)
    network = isinstance(posterior, NeuralPosterior)  # which says it without seconds of drawing maps
    given = posterior.parts if network else posterior.sample(2, np.random.default_rng(0)).given
    return among((*given, *more), wanted)


def among(given: Sequence[str], wanted: Sequence[str]) -> tuple[str, ...]:
    """The wanted parts that are given; raises `InputError` where none is."""
    found = tuple(p for p in wanted if p in given)
    if not found:
        raise InputError(f"adapt: the posterior speaks of {', '.join(given) or 'nothing'}, not of {', '.join(wanted)}")
    return found


def imagined(
    environment: str, belief: Sampler, n: int, *, hallucinate: bool, parts: Sequence[str], beta: float, episode: int,
    threads: int, seed: int, sight: Sight | None = None, settings: dict[str, Any] | None = None,
    staggered: bool = True,
) -> VectorSight:  # fmt: skip
    """n simulations whose episodes are drawn from a belief, or from it as pi_h leans it.

    Args:
      environment: id.
      belief: a posterior given what was observed.
      n: simulations.
      hallucinate: widen the action by pi_h; else each episode draws from the belief itself.
      parts: of the belief, those that are used where it speaks of them: of a fidelity, `effects` and `noise`.
      beta: see `Hallucinate`.
      episode: control steps.
      threads: of the physics.
      seed: of the first episodes' ends, and of the sizes of effects, which have draws of their own.
      sight: what is seen of them.
      settings: of the environment.
      staggered: first episodes end at different times, as learning wants it; to judge a policy takes whole ones.
    """
    found = spoken(belief, parts)
    belief = getattr(belief, "near", lambda: belief)()
    envs: VectorEnv = vector_env(environment, n, threads=threads, episode=episode, **(settings or {}))
    if "delta_e" in found and envs.unwrapped.rough:  # type: ignore[attr-defined]
        envs = VectorResidualTerrain(envs, _grounds(belief, n, seed))
    moving = tuple(p for p in found if p in ("psi", "delta_s"))
    acting = getattr(belief, EFFECTS)(n, np.random.default_rng(mixed(seed, _EFFECTS))) if EFFECTS in found else []
    if acting:  # each simulation has sizes of its own
        values = [v for _, v in acting]
        envs = VectorApplyEffects(envs, [(e, v.mean(0)) for e, v in acting], values=values)
    if NOISE in found:
        envs = VectorPerturbSignals(envs, {"proprio": {"sd": getattr(belief, NOISE).tolist()}})
    if hallucinate and moving:
        envs = VectorHallucinate(envs, Parts(belief, moving), beta=beta)
    elif moving:
        joint = Joint(without_maps(belief))
        if "psi" in moving:
            envs = VectorRandomizePsi(envs, Parts(joint, ("psi",)))
        if "delta_s" in moving:
            envs = VectorResidualDynamics(envs, Parts(joint.again if "psi" in moving else joint, ("delta_s",)))
    return VectorSight(VectorStaggered(envs, episode, seed) if staggered else envs, sight)


def _grounds(belief: Sampler, n: int, seed: int) -> Sampler:
    """What residual terrain is drawn from: of a network as many draws as there are simulations, made once."""
    only = Parts(belief, ("delta_e",))
    if not isinstance(belief, NeuralPosterior):
        return only
    return only.sample(min(n, _MAPS), np.random.default_rng(mixed(seed, _GROUND)))
