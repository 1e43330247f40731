"""Which faults a robot may have, and of what size: draws of psi that is off, or of an effect that acts."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects import Effect, build
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.fields import ModelFields
from nfc_gym.simulate.draws import geometric
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.residuals import candidates, sizes

Array = NDArray[np.float64]
KINDS = ("none", "mass", "friction", "gain", "effect")
_MASS, _FRICTION = (1.2, 2.5), (0.2, 0.8)  # a mass is more or less by that factor
_GAIN, _FORCE = (0.0, 0.5), (0.0, 0.9)  # a Quadcopter that lacks more than half of a rotor's force is thrown at once
_TOGETHER = 10  # windows with the same effect, whose edits of the model take longer than the windows


@dataclass(frozen=True)
class Scaled:
    """Psi is off: `factors` (d,) of one machine, drawn."""

    factors: Callable[[np.random.Generator], Array]


@dataclass(frozen=True)
class Acting:
    """One of the `effects` acts; `theta(effect, n, rng)` draws its parameters (n, k)."""

    effects: tuple[Effect, ...]
    theta: Callable[[Effect, int, np.random.Generator], Array]

    @property
    def together(self) -> int | None:
        """Windows with the same effect; None is all."""
        return _TOGETHER if len(self.effects) > 1 else None


class Slippery(Effect):
    """Sliding friction of everything times a factor, for robots whose psi has no friction."""

    family = "fault_friction"

    def model(self, fields: ModelFields, theta: Array) -> None:
        """See `Effect`."""
        fields["geom_friction"][..., 0] *= theta[..., :1]


def fault_kinds(machine: Machine) -> dict[str, Scaled | Acting]:
    """Kinds of fault by their name in `KINDS`, in its order.

    The main body is heavier or lighter (x 1.2 to 2.5, or one by that); friction is less (x 0.2 to 0.8), but for robots
    that fly; a servo's gain is less (x 0 to 0.5) or, where psi has none, an actuator's force (x 0 to 0.9); and any
    effect of the library acts, of a realistic size.
    """
    names = machine.space.names
    bodies = [n for n in names if n.endswith("_mass")][:1]
    rubbing = [n for n in names if n.endswith("_friction")]
    servos = [n for n in names if n.endswith("_damping")]  # the gain of a wheel's servo

    def scaled(which: list[str], by: float) -> Array:
        return np.where([n in which for n in names], by, 1.0)

    def mass(rng: np.random.Generator) -> Array:
        return scaled(bodies, float(geometric(rng.random(1), *_MASS)[0]) ** rng.choice([-1, 1]))

    def friction(rng: np.random.Generator) -> Array:
        return scaled(rubbing, float(geometric(rng.random(1), *_FRICTION)[0]))

    def gain(rng: np.random.Generator) -> Array:
        return scaled([servos[rng.integers(len(servos))]], rng.uniform(*_GAIN))

    kinds: dict[str, Scaled | Acting] = {"mass": Scaled(mass)} if bodies else {}
    if rubbing or not flies(machine.model):
        kinds["friction"] = Scaled(friction) if rubbing else _slippery()
    kinds["gain"] = Scaled(gain) if servos else _weak(machine)
    library = tuple(candidates(machine))
    return kinds | {"effect": Acting(library, lambda effect, n, rng: np.tile(_realistic(effect, rng), (n, 1)))}


def flies(model: mujoco.MjModel) -> bool:
    """Whether a robot is carried by thrust, and no friction beneath it."""
    return bool((model.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE).any())  # thrust


def _slippery() -> Acting:
    everything = Slippery(("ground",), (Param("factor", "1", 0.0, 1.0, null=1.0),))
    return Acting((everything,), lambda _, n, rng: geometric(rng.random((n, 1)), *_FRICTION))


def _weak(machine: Machine) -> Acting:
    model = machine.model
    each = tuple(build("loss", model.actuator(i).name, {"fraction": 0.0})[0] for i in range(model.nu))
    return Acting(each, lambda _, n, rng: 1 - rng.uniform(*_FORCE, (n, 1)))


def _realistic(effect: Effect, rng: np.random.Generator) -> Array:
    return sizes(effect, rng.random((1, 2 * len(effect.params))))
