"""The model that a mapping names: an MJCF or URDF file beside it, or a registered environment's id."""

from pathlib import Path

import gymnasium
import mujoco

from nfc_gym.core import InputError


def model_path(name: str, folder: Path) -> Path:
    """The model's file: `folder / name`, or the file of a registered MuJoCo environment.

    Raises:
      InputError: no such file, and no such environment whose model is a file.
    """
    path = folder / name
    if path.is_file():
        return path
    if name.split(":")[-1] not in gymnasium.registry and ":" not in name:
        there = (
            sorted(p.name for p in path.parent.glob("*") if p.suffix in (".xml", ".urdf"))
            if path.parent.is_dir()
            else []
        )
        raise InputError(
            f"model {name!r}: no such file in {folder}, nor a registered environment; "
            f"models there: {', '.join(there) or 'none'}"
        )
    try:
        env = gymnasium.make(name)
    except (gymnasium.error.Error, ImportError) as e:
        raise InputError(f"model {name!r}: the environment cannot be made: {e}") from None
    file = getattr(env.unwrapped, "fullpath", None)
    env.close()
    if file is None:
        raise InputError(f"model {name!r}: the environment does not say which model file it uses; name the file itself")
    return Path(file)


def load_spec(name: str, folder: Path) -> mujoco.MjSpec:
    """The model as an editable `MjSpec`; raises `InputError` where there is no file or it cannot be parsed."""
    path = model_path(name, folder)
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as e:
        raise InputError(f"model {path}: not a model that MuJoCo can read: {_one_line(e)}") from None


def load_model(name: str, folder: Path) -> mujoco.MjModel:
    """The compiled model; raises `InputError` with MuJoCo's own words where it does not compile."""
    spec = load_spec(name, folder)
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as e:
        raise InputError(f"model {folder / name}: does not compile: {_one_line(e)}") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
