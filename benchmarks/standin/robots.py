"""What a trial needs to know of a robot: its stand-in, its effects, and the mapping of its logs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from nfc_gym.measured import standin
from nfc_gym.measured.demo import jackal_mapping
from nfc_gym.measured.hidden import Array, Kind
from nfc_gym.measured.standin import Machine

from . import ant, kinds, quadcopter, quadruped, wider
from .mappings import ant_mapping, quadcopter_mapping, quadruped_mapping


@dataclass(frozen=True)
class Robot:
    """One stand-in.

    Attributes:
      psi: nominal values of the true parameters, by the mapping's names.
      weighed: the one of them that the mapping declares as known.
      kinds: effects of the library by family, with the range of sizes that is searched for a wanted X / X_null.
      wider: further effects of the library, of which only those trials are made that are asked for.
      outside: effects that the library has no law for.
      log: machine, seconds and seed to columns.
      mapping: mapping file, given the weighed mass.
      goal: share of single effects to be named right.
      seconds: goal of the loop's time on two cores that do nothing else.
    """

    psi: Mapping[str, float]
    weighed: str
    kinds: Mapping[str, Kind]
    wider: Mapping[str, Kind]
    outside: Mapping[str, kinds.Outside]
    log: Callable[[Machine, float, int], dict[str, Array]]
    mapping: Callable[[float], str]
    goal: float
    seconds: float

    @property
    def named(self) -> dict[str, Kind]:
        """All effects that the library has a law for."""
        return {**self.kinds, **self.wider}

    def showing(self, families: Sequence[str]) -> "Robot":
        """The robot in a motion that shows these effects: its own, unless one of them wants another."""
        wanted = [k.log for f in families if isinstance(k := self.wider.get(f), wider.Moved) and k.log]
        return replace(self, log=wanted[0]) if wanted else self


ROBOTS: dict[str, Robot] = {
    "quadcopter": Robot(
        quadcopter.PSI,
        "base_mass",
        kinds.QUADCOPTER,
        wider.QUADCOPTER,
        kinds.QUADCOPTER_OUTSIDE,
        quadcopter.fly,
        quadcopter_mapping,
        0.95,
        60.0,
    ),
    "jackal": Robot(
        standin.JACKAL_PSI,
        "base_mass",
        kinds.JACKAL,
        wider.JACKAL,
        kinds.JACKAL_OUTSIDE,
        standin.drive_jackal,
        jackal_mapping,
        0.90,
        180.0,
    ),
    "quadruped": Robot(
        quadruped.PSI,
        "base_mass",
        kinds.QUADRUPED,
        wider.QUADRUPED,
        kinds.QUADRUPED_OUTSIDE,
        quadruped.log,
        quadruped_mapping,
        0.85,
        360.0,
    ),
    "ant": Robot(ant.PSI, "torso_mass", kinds.ANT, wider.ANT, kinds.ANT_OUTSIDE, ant.log, ant_mapping, 0.85, 360.0),
}
