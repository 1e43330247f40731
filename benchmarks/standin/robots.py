"""What a trial needs to know of a robot: its stand-in, its effects, and the mapping of its logs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import yaml

from nfc_gym.measured import standin
from nfc_gym.measured.demo import body_channels, jackal_mapping
from nfc_gym.measured.hidden import Array, Kind
from nfc_gym.measured.standin import Machine

from . import quadcopter


@dataclass(frozen=True)
class Robot:
    """One stand-in.

    Attributes:
      psi: nominal values of the true parameters, by the mapping's names.
      kinds: effects by family, with the range of sizes that is searched for a wanted X / X_null.
      log: machine, seconds and seed to columns.
      mapping: mapping file, given the weighed mass.
    """

    psi: Mapping[str, float]
    kinds: Mapping[str, Kind]
    log: Callable[[Machine, float, int], dict[str, Array]]
    mapping: Callable[[float], str]


def quadcopter_mapping(weighed: float) -> str:
    """Mapping file of the stand-in's logs: the chassis was weighed; four arms and four mounts of one make.

    The mounts' angle sensors are logged too: arms that start a prediction bent by an unknown angle kick the chassis.
    """
    rotors = list(quadcopter.ROTORS)
    mounts = [f"{r}_mount_{axis}" for r in rotors for axis in "xy"]
    mapping = {
        "version": 1,
        "model": "quadcopter",
        "parameters": [
            {"name": "base_mass", "field": "body_mass", "of": ["base"], "unit": "kg", "nominal": round(weighed, 4)}
            | {"low": 0.4, "high": 1.0, "anchored": True, "reason": "weighed"},
            {"name": "arm_mass", "field": "body_mass", "of": [f"{r}_arm" for r in rotors], "tied": True}
            | {"unit": "kg", "low": 0.06, "high": 0.16},
            {"name": "mount_stiffness", "field": "jnt_stiffness", "of": mounts, "tied": True}
            | {"unit": "N m/rad", "low": 1.5, "high": 10.0},
        ],
        "logs": [{"path": "logs/*.csv"}],
        "time": {"column": "time", "unit": "s"},
        "controls": {f"ctrl:{r}": {"column": f"{r}_thrust", "unit": "N"} for r in rotors},
        "channels": body_channels(quadcopter.NOISE)
        | {
            f"joint:{r}_mount_{axis}:pos": {"column": f"{r}_{axis}", "unit": "rad", "noise": quadcopter.NOISE["mount"]}
            for r in rotors
            for axis in "xy"
        },
        "exogenous": {"exo:supply": {"column": "volts", "unit": "V"}},
        "segments": {"length": 0.4, "history": 0.5, "horizons": [0.05, 0.1, 0.2, 0.4]},
    }
    return yaml.safe_dump(mapping, sort_keys=False, default_flow_style=None, width=120)


def _wide(kind: Kind, low: float, high: float) -> Kind:
    return Kind(kind.make, low, high, kind.unit)


_J = standin.JACKAL_KINDS
# The demo's sizes are those that anybody would notice; trials go down to what hardly shows.
ROBOTS: dict[str, Robot] = {
    "jackal": Robot(
        standin.JACKAL_PSI,
        {
            "loss": _wide(_J["loss"], 0.01, 0.98),
            "payload": _wide(_J["payload"], 0.05, 12.0),
            "delay": _wide(_J["delay"], 0.001, 0.1),
            "lag": _wide(_J["lag"], 0.001, 0.1),
            "coulomb": _wide(_J["coulomb"], 0.02, 5.0),
            "slope": _wide(_J["slope"], 0.001, 0.2),
        },
        standin.drive_jackal,
        jackal_mapping,
    ),
    "quadcopter": Robot(quadcopter.PSI, quadcopter.KINDS, quadcopter.fly, quadcopter_mapping),
}
