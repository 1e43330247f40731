"""Mapping files of the stand-ins' logs; the Jackal's is the demo's own."""

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from nfc_gym.measured.demo import body_channels

from . import ant, legged, quadcopter, quadruped


def quadcopter_mapping(weighed: float) -> str:
    """The chassis was weighed; four arms and four mounts of one make.

    The mounts' angle sensors are logged too: arms that start a prediction bent by an unknown angle kick the chassis.
    """
    rotors = list(quadcopter.ROTORS)
    mounts = [f"{r}_mount_{axis}" for r in rotors for axis in "xy"]
    return _text(
        "quadcopter",
        [
            _weighed("base", weighed, 0.4, 1.0),
            _tied("arm_mass", "body_mass", [f"{r}_arm" for r in rotors], "kg", 0.06, 0.16),
            _tied("mount_stiffness", "jnt_stiffness", mounts, "N m/rad", 1.5, 10.0),
        ],
        {f"ctrl:{r}": {"column": f"{r}_thrust", "unit": "N"} for r in rotors},
        body_channels(quadcopter.NOISE)
        | {
            f"joint:{r}_mount_{axis}:pos": {"column": f"{r}_{axis}", "unit": "rad", "noise": quadcopter.NOISE["mount"]}
            for r in rotors
            for axis in "xy"
        },
        {"exogenous": {"exo:supply": {"column": "volts", "unit": "V"}}},
    )


def quadruped_mapping(weighed: float) -> str:
    """The trunk was weighed; legs of one make share masses, the abduction servos' gain and the feet's friction."""
    legs = quadruped.LEGS
    return _text(
        "quadruped",
        [
            _weighed("base", weighed, 3.5, 10.5),
            _tied("thigh_mass", "body_mass", [f"{leg}_thigh" for leg in legs], "kg", 0.6, 1.5),
            _tied("shank_mass", "body_mass", [f"{leg}_shank" for leg in legs], "kg", 0.08, 0.35),
            _tied("hip_stiffness", "servo_kp", [f"{leg}_abduction" for leg in legs], "N m/rad", 15.0, 60.0),
            _tied("foot_friction", "geom_friction[0]", [f"{leg}_foot" for leg in legs], "1", 0.2, 1.5),
        ],
        {f"ctrl:{j}": {"column": f"{j}_command", "unit": "rad"} for j in quadruped.JOINTS},
        _legged_channels(quadruped.JOINTS, "base"),
    )


def ant_mapping(weighed: float) -> str:
    """The torso was weighed; legs of one make share masses, springs and the feet's friction."""
    legs = ant.LEGS
    return _text(
        "ant",
        [
            _weighed("torso", weighed, 1.5, 6.0),
            _tied("hip_mass", "body_mass", [f"{leg}_hip" for leg in legs], "kg", 0.15, 0.6),
            _tied("leg_mass", "body_mass", [f"{leg}_leg" for leg in legs], "kg", 0.2, 0.8),
            _tied("foot_mass", "body_mass", [f"{leg}_foot" for leg in legs], "kg", 0.3, 1.2),
            _tied("hip_stiffness", "jnt_stiffness", [f"{leg}_hip" for leg in legs], "N m/rad", 1.0, 20.0),
            _tied("ankle_stiffness", "jnt_stiffness", [f"{leg}_ankle" for leg in legs], "N m/rad", 1.0, 20.0),
            _tied("foot_friction", "geom_friction[0]", [f"{leg}_foot" for leg in legs], "1", 0.2, 1.5),
        ],
        {f"ctrl:{j}": {"column": f"{j}_command", "unit": "1"} for j in ant.JOINTS},
        _legged_channels(ant.JOINTS, "torso"),
    )


def _text(
    model: str,
    parameters: list[dict[str, Any]],
    controls: dict[str, Any],
    channels: dict[str, Any],
    more: Mapping[str, Any] | None = None,
) -> str:
    segments: dict[str, Any] = {"length": 0.4, "history": 0.5, "horizons": [0.05, 0.1, 0.2, 0.4]}
    mapping = {
        "version": 1,
        "model": model,
        "parameters": parameters,
        "logs": [{"path": "logs/*.csv"}],
        "time": {"column": "time", "unit": "s"},
        "controls": controls,
        "channels": channels,
        **(more or {}),
        "segments": segments,
    }
    return yaml.safe_dump(mapping, sort_keys=False, default_flow_style=None, width=120)


def _weighed(body: str, mass: float, low: float, high: float) -> dict[str, Any]:
    bounds = {"unit": "kg", "nominal": round(mass, 4), "low": low, "high": high}
    return {"name": f"{body}_mass", "field": "body_mass", "of": [body], **bounds, "anchored": True, "reason": "weighed"}


def _tied(name: str, field: str, of: Sequence[str], unit: str, low: float, high: float) -> dict[str, Any]:
    return {"name": name, "field": field, "of": list(of), "tied": True, "unit": unit, "low": low, "high": high}


def _legged_channels(joints: Sequence[str], body: str) -> dict[str, Any]:
    noise = legged.NOISE
    angles = {f"joint:{j}:pos": {"column": f"{j}_angle", "unit": "rad", "noise": noise.angle} for j in joints}
    speeds = {f"joint:{j}:vel": {"column": f"{j}_speed", "unit": "rad/s", "noise": noise.speed} for j in joints}
    return body_channels(noise.body, body) | angles | speeds
