"""What a mission gathered, as `adapt(..., folder=...)` kept it."""

from pathlib import Path

from nfc_gym.adaptation import resume
from nfc_gym.adaptation.trajectory import Dataset, Trajectory
from nfc_gym.core.errors import InputError

STATE = "state.safetensors"  # of a mission, which `adapt` keeps beside its trajectories


def read_mission(folder: str | Path) -> tuple[list[Trajectory], str | None]:
    """Its trajectories, and the simulator's id where the folder says it.

    Raises:
      InputError: no folder of a mission, or a damaged file.
    """
    path = Path(folder)
    state = path / STATE
    if not state.is_file():
        raise InputError(f"{path}: no mission; want a folder that `adapt(..., folder=...)` wrote")
    environment = resume.described(state).get("environment")
    return list(Dataset(path, int(resume.plain(state)["t"]))), environment
