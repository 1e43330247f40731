"""The robots: one folder each with its MJCF (`<robot>.xml`) and its prior over physical parameters (`psi.toml`).

Everything here is data. `restitution.toml` maps a coefficient of restitution to the damping ratio of a contact;
`policies` holds pretrained policies, which `nfc_gym.adaptation` reads.
"""

from pathlib import Path

from nfc_gym.core.errors import InputError

ROBOTS = ("ant", "humanoid", "jackal", "quadcopter", "quadruped")

_HERE = Path(__file__).resolve().parent


def path(robot: str) -> Path:
    """The robot's MJCF file; `psi.toml` lies beside it.

    Args:
      robot: one of `ROBOTS`.

    Raises:
      InputError: no robot has that name.
    """
    if robot not in ROBOTS:
        raise InputError(f"no robot is called {robot!r}; the robots are {', '.join(ROBOTS)}")
    return _HERE / robot / f"{robot}.xml"


def policy(environment: str) -> Path:
    """Where the pretrained policy of an environment, `AntFlat-v0`, lies if there is one."""
    return _HERE / "policies" / f"{environment}.safetensors"
