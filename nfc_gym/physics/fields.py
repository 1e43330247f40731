"""`ModelFields`: one door to the fields of a single `MjModel` or of every simulation of a `mujoco.batch.Batch`.

Whoever writes a parameter or an effect writes it once, against arrays with any leading batch shape; writes start from
the nominal model, so that repeated randomisation never compounds, and derived constants follow at `commit`.
"""

import copy
from collections.abc import Mapping

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError

# Which kind of named object a field's rows belong to, by the field's prefix.
_KINDS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "qpos": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "servo": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
}
_DOFS = {0: 6, 1: 3, 2: 1, 3: 1}  # by mjtJoint: free, ball, slide, hinge
_SETCONST = frozenset(mujoco.MjModel._setconst_inputs)


def names_of(model: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> list[str]:
    """Names of all objects of a kind, in id order; unnamed ones are the empty string."""
    return [mujoco.mj_id2name(model, kind, i) or "" for i in range(count)]


def object_id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    """Id of a named object; an unknown name raises `InputError` listing what exists."""
    found = mujoco.mj_name2id(model, kind, name)
    if found < 0:
        word = str(kind).split("mjOBJ_")[-1].lower().rstrip(">")
        exist = []
        for i in range(100_000):
            other = mujoco.mj_id2name(model, kind, i)
            if other is None:
                break
            exist.append(other)
        raise InputError(f"the model has no {word} named {name!r}; it has: {', '.join(exist) or 'none'}")
    return found


def rows_of(model: mujoco.MjModel, field: str, names: tuple[str, ...]) -> NDArray[np.intp]:
    """Row indices of `field` that belong to the named objects (joints' dofs for `dof_*`, coordinates for `qpos_*`)."""
    prefix = field.split("_", 1)[0]
    if prefix not in _KINDS:
        raise InputError(
            f"field {field!r}: rows are addressed by name for fields of {', '.join(sorted(_KINDS))}, or use opt.*"
        )
    ids = [object_id(model, _KINDS[prefix], name) for name in names]
    if prefix == "dof":
        return np.concatenate(
            [np.arange(model.jnt_dofadr[j], model.jnt_dofadr[j] + _DOFS[int(model.jnt_type[j])]) for j in ids]
        )
    if prefix == "qpos":
        return np.array([model.jnt_qposadr[j] for j in ids], np.intp)
    return np.array(ids, np.intp)


class ModelFields:
    """Fields of one model, or per simulation of a batch, written from nominal.

    Args:
      target: the `MjModel` to edit in place, or the `Batch` whose fields become per simulation.
      nominal: the unedited model; default a copy of the target's model as it is now.
    """

    def __init__(self, target: mujoco.MjModel | Batch, nominal: mujoco.MjModel | None = None) -> None:
        self._target = target
        self.batched = isinstance(target, Batch)
        model = target.model if isinstance(target, Batch) else target
        self.nominal_model = nominal if nominal is not None else copy.copy(model)
        self._arrays: dict[str, NDArray] = {}
        self._scalars: set[str] = set()  # options of one model that are plain numbers: written back at `commit`
        self._dirty = False
        self._scratch: mujoco.MjData | None = None

    @property
    def count(self) -> int | None:
        """How many simulations' fields these are; None for one model's own."""
        return self._target.nsim if isinstance(self._target, Batch) else None

    def own(self, values: NDArray) -> NDArray:
        """Of values (n, ...), one row for each simulation of the batch, those of the simulations of these fields."""
        return values

    def nominal(self, name: str) -> NDArray:
        """The field in the unedited model, without batch dimension."""
        return np.asarray(
            getattr(self.nominal_model.opt, name[4:]) if name.startswith("opt.") else getattr(self.nominal_model, name)
        )

    def __getitem__(self, name: str) -> NDArray:
        """Live array of the field: its own shape for one model, `(nsim, ...)` for a batch."""
        if name in _SETCONST:
            self._dirty = True
        return self._live(name)

    def _live(self, name: str) -> NDArray:
        """The same to be read alone: nothing counts as written."""
        if name not in self._arrays:
            if isinstance(self._target, Batch):
                self._arrays[name] = self._target.expand(name)
            else:
                owner = self._target.opt if name.startswith("opt.") else self._target
                value = getattr(owner, name.removeprefix("opt."))
                if not isinstance(value, np.ndarray):
                    self._scalars.add(name)
                self._arrays[name] = np.asarray(value, float) if name in self._scalars else value
        return self._arrays[name]

    @property
    def touched(self) -> Mapping[str, NDArray]:
        """Fields that were asked for so far, as they are now: none of the others differs from nominal."""
        return self._arrays

    def restore(self) -> None:
        """Every field touched so far goes back to its nominal value."""
        for name, array in self._arrays.items():
            array[...] = self.nominal(name)
            self._dirty = self._dirty or name in _SETCONST

    def commit(self) -> None:
        """Recompute the constants that MuJoCo derives from the fields written since the last commit."""
        if not isinstance(self._target, Batch):
            for name in self._scalars:
                setattr(self._target.opt, name[4:], float(self._arrays[name]))
        if not self._dirty:
            return
        if isinstance(self._target, Batch):
            self._target.set_const()
        else:
            if self._scratch is None:  # made once: that takes longer than all else here
                self._scratch = mujoco.MjData(self._target)
            mujoco.mj_resetData(self._target, self._scratch)
            mujoco.mj_setConst(self._target, self._scratch)
        self._dirty = False

    def rows(self, ids: NDArray[np.intp]) -> "RowFields":
        """The same fields of some of a batch's simulations, (k,) ids in ascending order."""
        return RowFields(self, ids)


class RowFields(ModelFields):
    """Fields of some simulations of a batch: copies (k, ...), which `commit` puts into their rows.

    Args:
      whole: the fields of all simulations; what is touched here counts as touched there.
      ids: (k,) simulations, ascending.
    """

    def __init__(self, whole: ModelFields, ids: NDArray[np.intp]) -> None:
        self._whole, self._ids = whole, ids
        self._target, self.nominal_model, self.batched = whole._target, whole.nominal_model, True
        self._arrays = {name: array[ids] for name, array in whole._arrays.items()}
        self._dirty = whole._dirty  # something was written there that nobody committed

    @property
    def count(self) -> int | None:
        """How many simulations' fields these are."""
        return len(self._ids)

    def own(self, values: NDArray) -> NDArray:
        """See `ModelFields`."""
        return values[self._ids]

    def __getitem__(self, name: str) -> NDArray:
        """Copy of the simulations' values, (k, ...), to be written before `commit`."""
        if name not in self._arrays:
            self._arrays[name] = self._whole._live(name)[self._ids]
        return self._arrays[name]

    def restore(self) -> None:
        """Every field touched so far goes back to its nominal value."""
        for name, array in self._arrays.items():
            array[...] = self.nominal(name)

    def commit(self) -> None:
        """Put the values into the batch, and recompute what MuJoCo derives from those that are others than before."""
        for name, values in self._arrays.items():
            live = self._whole._live(name)
            self._dirty = self._dirty or (name in _SETCONST and not np.array_equal(live[self._ids], values))
            live[self._ids] = values
        if self._dirty:
            self._target.set_const(self._ids)
        self._dirty = False
