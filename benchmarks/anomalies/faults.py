"""Faults of all kinds and sizes: main mass, an actuator's gain, friction, and effects of the library."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects import Effect, build
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.fields import ModelFields
from nfc_gym.simulate.fault_kinds import flies
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.residuals import candidates, sizes

Array = NDArray[np.float64]
MASS, GAIN, FRICTION = (2.0, 1.5, 1.25, 1.1), (0.0, 0.25, 0.5, 0.75), (0.3, 0.5, 0.7, 0.9)
EFFECT = (1.0, 0.3, 3.0)  # times the size drawn


class Friction(Effect):
    """Sliding friction of every geom times a factor, for robots whose psi has none."""

    family = "benchmark_friction"

    def model(self, fields: ModelFields, theta: Array) -> None:
        """See `Effect`."""
        fields["geom_friction"][..., 0] *= theta[..., :1]


@dataclass(frozen=True)
class Fault:
    """What is wrong with a machine: `scale` (d,) multiplies psi; `theta` (k,) of an effect."""

    name: str
    scale: Array
    effect: Effect | None = None
    theta: Array | None = None
    wanted: bool = False  # whether the goal is set for it, its X / X_null aside


def faults(machine: Machine, effects: int, rng: np.random.Generator) -> list[Fault]:
    """Of all kinds and sizes; `effects` of the library are drawn."""
    names, ones = machine.space.names, np.ones(len(machine.space))

    def scaled(which: list[str], by: float) -> Array:
        return np.where([n in which for n in names], by, ones)

    body = next(n for n in names if n.endswith("_mass"))
    out = [Fault(f"{body} x {k:g}", scaled([body], k), wanted=k == MASS[0]) for k in MASS]
    servos = [n for n in names if n.endswith("_damping")]
    for k in GAIN:
        if servos:
            out.append(Fault(f"{servos[0]} x {k:g}", scaled(servos[:1], k), wanted=k == GAIN[0]))
        else:
            actuator = machine.model.actuator(0).name
            loss, theta = build("loss", actuator, {"fraction": 1 - k})
            out.append(Fault(f"gain of {actuator} x {k:g}", ones, loss, theta, wanted=k == GAIN[0]))
    own = [n for n in names if n.endswith("_friction")]
    for k in () if flies(machine.model) else FRICTION:
        slippery = None if own else Friction(("ground",), (Param("factor", "1", 0.0, 1.0, null=1.0),))
        by, theta = (scaled(own, k), None) if own else (ones, np.array([k]))
        out.append(Fault(f"friction x {k:g}", by, slippery, theta, wanted=k == FRICTION[0]))
    for effect, size in drawn(machine, effects, rng):
        each = (grown(effect, size, k) for k in EFFECT)
        out += [Fault(told(effect, theta), ones, effect, theta) for theta in each]
    return out


def drawn(machine: Machine, effects: int, rng: np.random.Generator) -> list[tuple[Effect, Array]]:
    """So many effects of the library, each with a realistic size (k,)."""
    library = candidates(machine)
    chosen = [library[i] for i in rng.choice(len(library), min(effects, len(library)), replace=False)]
    return [(effect, sizes(effect, rng.random((1, 2 * len(effect.params))))[0]) for effect in chosen]


def grown(effect: Effect, size: Array, by: float) -> Array:
    """(k,) parameters of `by` times the size, within their bounds; what only shapes the effect stays."""
    low, high = np.array([(p.low, p.high) for p in effect.params]).T
    shapes = [p.shape for p in effect.params]
    return np.clip(np.where(shapes, size, effect.null + by * (size - effect.null)), low, high)


def most_of(effect: Effect, size: Array) -> float:
    """How many times the size brings every parameter to its bound, shapes aside; beyond it nothing grows."""
    away = size - effect.null
    bound = np.array([p.high if d > 0 else p.low for p, d in zip(effect.params, away, strict=True)])
    grows = np.array([not p.shape for p in effect.params]) & (away != 0)
    return float(((bound - effect.null)[grows] / away[grows]).max(initial=1.0))


def told(effect: Effect, theta: Array) -> str:
    """Family, places and parameters (k,) of an effect."""
    said = ", ".join(f"{p.name} {v:.3g} {p.unit}" for p, v in zip(effect.params, theta, strict=True))
    return f"{effect.family}:{'+'.join(effect.where)} {said}"
