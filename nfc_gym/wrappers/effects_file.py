"""`effects.yaml`: what a model lacks and `model.xml` does not carry, and the model that it was found for."""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError, MissingExtra

# Fields by which a compiled model is known again where no file of it is at hand.
_TELLING = (
    "body_parentid", "body_mass", "body_inertia", "body_pos", "body_ipos", "jnt_type", "jnt_axis", "jnt_stiffness",
    "qpos_spring", "dof_damping", "dof_dampingpoly", "dof_armature", "dof_frictionloss", "geom_type", "geom_size",
    "geom_friction", "geom_solref", "geom_margin", "actuator_gear", "actuator_gainprm", "actuator_biasprm",
    "actuator_ctrlrange", "actuator_forcelimited", "actuator_forcerange", "actuator_dyntype", "actuator_dynprm",
    "actuator_delay",
)  # fmt: skip
_TELLING_OPTIONS = ("timestep", "gravity", "density", "viscosity", "wind", "impratio")
_ROUNDED = 1e-5  # MJCF text has six digits


def read_effects(path: str | os.PathLike[str]) -> dict[str, Any]:
    """An `effects.yaml`: `version`, which is 1, `effects`, a list of rows, and perhaps `model_sha256` and `psi`.

    Raises:
      InputError: no such file, no YAML, another version, or keys that are missing.
      MissingExtra: no YAML reader is installed.
    """
    try:
        import yaml
    except ImportError:
        raise MissingExtra("reading effects.yaml needs pyyaml: pip install 'nfc_gym[measured]'") from None
    path = Path(path)
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror})") from None
    except (yaml.YAMLError, ValueError, RecursionError) as e:
        raise InputError(f"{path}: is no YAML ({str(e).splitlines()[0]})") from None
    if not isinstance(data, dict) or not isinstance(data.get("effects"), list):
        raise InputError(f"{path}: an effects.yaml has `version: 1` and `effects`, a list; this has {_keys(data)}")
    if "version" not in data:
        raise InputError(f"{path}: does not say its version; add the line `version: 1`")
    if data["version"] != 1:
        raise InputError(f"{path}: version {data['version']!r} of effects.yaml; this package reads version 1")
    return data


def _keys(data: Any) -> str:
    return ", ".join(map(str, data)) or "nothing" if isinstance(data, dict) else f"no keys but {data!r:.60}"


def psi_said(path: str | os.PathLike[str], data: Mapping[str, Any]) -> dict[str, float]:
    """What an `effects.yaml` that was written by hand says of psi, by name; {} where it says nothing.

    Raises:
      InputError: `psi` is no mapping of names to finite numbers.
    """
    given = data.get("psi") or {}
    if not isinstance(given, Mapping):
        raise InputError(f"{path}: psi is a mapping of names to numbers, and not {given!r}")
    for name, value in given.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{path}: psi {name} is {value!r}, want a finite number")
    return {str(k): float(v) for k, v in given.items()}


def check_model(env: Any, path: str | os.PathLike[str]) -> None:
    """Refuse an `effects.yaml` that was made for another model than the environment's.

    The environment's model file must have the digest that the file names. Where the environment has no model file, its
    compiled model must be that of the `model.xml` beside the file, which must have that digest.

    Raises:
      InputError: it was made for another model, or that cannot be told.
    """
    path = Path(path)
    wanted = str(read_effects(path).get("model_sha256"))
    advice = f"make the environment from {path.with_name('model.xml')}, or say any_model=True"
    base = env.unwrapped
    file = getattr(base, "fullpath", None)
    if file is not None and Path(file).is_file():
        if _digest(Path(file)) != wanted:
            raise InputError(f"{path} was made for a model whose SHA-256 is {wanted}, not for {file}; {advice}")
        return
    beside = path.with_name("model.xml")
    if not beside.is_file() or _digest(beside) != wanted:
        raise InputError(f"{path}: {beside} is absent or another model than the one it was made for; {advice}")
    theirs, mine = mujoco.MjModel.from_xml_path(str(beside)), base.model
    pairs = [(name, getattr(theirs, name), getattr(mine, name)) for name in _TELLING]
    pairs += [(f"option {name}", getattr(theirs.opt, name), getattr(mine.opt, name)) for name in _TELLING_OPTIONS]
    for name, a, b in pairs:
        if np.shape(a) != np.shape(b) or not np.allclose(a, b, rtol=_ROUNDED, atol=1e-9):
            raise InputError(
                f"{path} was made for {beside}, which differs from the environment's model in {name}; {advice}"
            )


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
