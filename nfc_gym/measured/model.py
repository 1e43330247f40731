"""The model that a mapping names: an MJCF or URDF file beside it, or the id of a robot of ours."""

from collections.abc import Collection
from pathlib import Path

import mujoco
import numpy as np

from nfc_gym import assets
from nfc_gym.core import InputError
from nfc_gym.physics.effects.lookup import one_command_each
from nfc_gym.physics.names import name_all, names
from nfc_gym.physics.quiet import compiled


def registered(name: str) -> str | None:
    """Robot of a registered id (`nfc_gym/JackalFlat-v0` -> `jackal`), or None."""
    short = name.rsplit("/", 1)[-1].lower()
    return next((r for r in assets.ROBOTS if short in (f"{r}flat-v0", r)), None)


def model_path(name: str, folder: Path) -> Path:
    """The model's file: a robot's of ours, or `folder / name`.

    Raises:
      InputError: there is no such file; with the models that lie there.
    """
    robot = registered(name)
    path = assets.path(robot) if robot else folder / name
    try:
        if path.is_file():
            return path
    except (OSError, ValueError) as e:  # too long for a name, or with a zero in it
        raise InputError(f"model {name[:80]!r}: no name of a file ({getattr(e, 'strerror', None) or e})") from None
    there = sorted(p.name for p in path.parent.glob("*") if p.suffix in (".xml", ".urdf"))
    rough = "" if "rough" not in name.lower() else " (on a plane: RecordLog writes that of rough ground with its logs)"
    raise InputError(
        f"model {name!r}: no such file in {folder}, and no robot has that id; "
        f"models there: {', '.join(there) or 'none'}; robots: {', '.join(assets.ROBOTS)}{rough}"
    )


def read_spec(name: str, folder: Path) -> mujoco.MjSpec:
    """The model as an editable `MjSpec` in which everything that a mapping may speak of has a name.

    Raises:
      InputError: there is no file, it cannot be parsed or does not compile.
    """
    path = model_path(name, folder)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as e:
        raise InputError(f"model {path}: not a model that MuJoCo can read: {_one_line(e)}") from None
    try:
        return name_all(spec)
    except UnicodeDecodeError:  # `compile_model` says which name it is
        return spec
    except (ValueError, mujoco.FatalError) as e:
        raise InputError(f"model {name}: does not compile: {_one_line(e)}") from None


def compile_model(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    """The compiled model, see `compile_told`."""
    return compile_told(spec, name)[0]


def compile_told(spec: mujoco.MjSpec, name: str) -> tuple[mujoco.MjModel, list[str]]:
    """The compiled model, and what MuJoCo remarked on it.

    Raises:
      InputError: it does not compile, in MuJoCo's own words, holds a number that is not finite or a name that is no
        text, has the flag `ipc`, or an actuator with several commands.
    """
    try:
        model, remarks = compiled(spec)
    except (ValueError, mujoco.FatalError) as e:
        raise InputError(f"model {name}: does not compile: {_one_line(e)}") from None
    try:
        model.names.decode()
    except UnicodeDecodeError as e:
        start, end = model.names.rfind(b"\0", 0, e.start) + 1, model.names.find(b"\0", e.start)
        raise InputError(f"model {name}: the name {model.names[start:end]!r} is not UTF-8; save the file so") from None
    if model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_IPC):
        raise InputError(f"model {name}: the flag 'ipc' keeps a state that no log shows; disable it")
    if not one_command_each(model):
        wide = next(
            n
            for n, c, f in zip(names(model).actuators, model.actuator_ctrlnum, model.actuator_outnum, strict=True)
            if c > 1 or f > 1
        )
        raise InputError(
            f"model {name}: the actuator {wide!r} has several commands or forces (`pid`, `orientation`), and a log one "
            "of each; put a `position` servo or motors in its place"
        )
    for owner, before in ((model.opt, "option "), (model, "")):
        for field in dir(owner):
            value = getattr(owner, field) if not field.startswith("_") else None
            if isinstance(value, float | np.ndarray) and np.asarray(value).dtype.kind == "f":
                odd = np.asarray(value)[~np.isfinite(value)]
                if odd.size:
                    raise InputError(f"model {name}: {before}{field} holds {odd.flat[0]}; want finite numbers")
    return model, remarks


def bare(spec: mujoco.MjSpec, named: Collection[str] = ()) -> mujoco.MjSpec:
    """A copy of a model without what is only looked at: it moves as the model does, to the bit, and sooner.

    A robot of the package has two geoms to show for each that touches, and each step would place them all.

    Args:
      spec: the model, with complete inertias. Where a range finder may see them, or `inertiafromgeom="true"` has
        inertias from geoms alone, the copy keeps all.
      named: objects that somebody asks for by name; a geom among them that is only looked at keeps all of them.
    """
    if any(s.type == mujoco.mjtSensor.mjSENS_RANGEFINDER for s in spec.sensors):
        return spec.copy()  # its ray ends on what is only looked at, too
    out = spec.copy()
    before = {g.name for g in out.geoms}
    try:
        out.discard_visual()
    except ValueError:  # inertiafromgeom="true": what is only looked at has mass, and MuJoCo cannot leave it behind
        return spec.copy()
    gone = before - {g.name for g in out.geoms}
    return spec.copy() if gone & set(named) else out


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
