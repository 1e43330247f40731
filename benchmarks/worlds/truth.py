"""What is true in a world: psi, and what the machine hides, written into MJCF by code apart from the package's."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np
from standin.legged import grow

from nfc_gym.core.errors import InputError
from nfc_gym.measured.hidden import Hidden
from nfc_gym.physics.parameters import ParameterSpace

RANDOMISED = 0.5  # share of the way from nominal to the prior's bounds that policies are pretrained in
BEYOND = 1.5  # of that way, at which the largest anomalies lie
FIXED = "geom_restitution"  # not made anomalous: on tyres that sink it does next to nothing


def _set_mass(spec: mujoco.MjSpec, name: str, value: float) -> None:
    grow(spec, [name], value / spec.body(name).mass)


def _set_stiffness(spec: mujoco.MjSpec, name: str, value: float) -> None:
    spec.joint(name).stiffness[0] = value


def _set_servo(entry: int) -> Callable[[mujoco.MjSpec, str, float], None]:
    def write(spec: mujoco.MjSpec, name: str, value: float) -> None:
        servo = spec.actuator(name)
        servo.gainprm[0], servo.biasprm[entry] = value, -value

    return write


def _set_friction(spec: mujoco.MjSpec, name: str, value: float) -> None:
    spec.geom(name).friction[0] = value


WRITE: dict[str, Callable[[mujoco.MjSpec, str, float], None]] = {
    "body_mass": _set_mass,
    "jnt_stiffness": _set_stiffness,
    "servo_kv": _set_servo(2),
    "servo_kp": _set_servo(1),
    "geom_friction[0]": _set_friction,
}


@dataclass(frozen=True)
class Truth:
    """What an agent is not told.

    Attributes:
      psi: parameters that differ from nominal, in physical units.
      hidden: effects that the agent's model lacks.
      settings: of the environment: the kind of ground and how difficult it is.
    """

    psi: Mapping[str, float] = field(default_factory=dict)
    hidden: Hidden = field(default_factory=Hidden)
    settings: Mapping[str, object] = field(default_factory=dict)

    def shape(self, spec: mujoco.MjSpec, space: ParameterSpace) -> None:
        """Write it into a description of the robot in its nominal state.

        Args:
          spec: changed in place.
          space: the robot's psi, for what the names stand for.
        """
        known = {p.name: p for p in space.parameters}
        for name, value in self.psi.items():
            if name not in known or known[name].field not in WRITE:
                settable = ", ".join(n for n, p in known.items() if p.field in WRITE)
                raise InputError(f"psi has no {name!r} that a world may change; there are: {settable}")
            for thing in known[name].of:
                WRITE[known[name].field](spec, thing, value)
        self.hidden.shape(spec)

    @property
    def text(self) -> str:
        """What is hidden, in words."""
        psi = ", ".join(f"{k} {v:.3g}" for k, v in self.psi.items())
        return "; ".join(t for t in (psi, self.hidden.text if self.hidden.family != "none" else "") if t) or "nothing"


def psi_off(space: ParameterSpace, rng: np.random.Generator, severity: float) -> dict[str, float]:
    """psi of which a quarter is anomalous, and the rest within the range that policies are pretrained in.

    Args:
      space: names, nominal values and bounds.
      severity: how far the anomalies lie between that range's edge (0), the prior's bound (0.5) and beyond (1).
    """
    free = [i for i, p in enumerate(space.parameters) if p.field != FIXED]
    odd = rng.choice(free, max(1, len(free) // 4), replace=False)
    out = {}
    for i in free:
        side = space.high[i] if rng.random() < 0.5 else space.low[i]
        share = rng.uniform(0, RANDOMISED) if i not in odd else RANDOMISED + severity * (BEYOND - RANDOMISED)
        out[space.names[i]] = _possible(space.nominal[i], side, share)
    return out


def _possible(nominal: float, bound: float, share: float) -> float:
    """A share of the way from nominal to a bound; beyond a lower bound half of what is left, so that none reaches 0."""
    value = nominal + share * (bound - nominal)
    return float(value if share <= 1 or bound > nominal else bound * (1 - (share - 1)))
