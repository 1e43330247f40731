"""States of actuators, made for roll-outs that start in the middle of a log."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.recurrence import FORGOTTEN, chased

Array = NDArray[np.float64]
_INTEGRATOR, _AFFINE = int(mujoco.mjtDyn.mjDYN_INTEGRATOR), int(mujoco.mjtBias.mjBIAS_AFFINE)
_NONE: Mapping[str, Array] = {}
# Model fields that decide what becomes of commands before actuators feel them.
LED_BY = tuple(f"actuator_{n}" for n in ("dynprm", "ctrllimited", "ctrlrange", "actlimited", "actrange", "delay"))
_JOINT, _SLIDE = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtJoint.mjJNT_SLIDE)


def integrators(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Actuators that integrate their commands, (n,)."""
    return np.flatnonzero(model.actuator_dyntype == _INTEGRATOR)


def on_servos(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Those integrators whose state is the target of a position servo (`intvelocity`): the joint shows where it is."""
    of = integrators(model)
    gain, bias = model.actuator_gainprm[of], model.actuator_biasprm[of]
    plain = model.actuator_gaintype[of] == int(mujoco.mjtGain.mjGAIN_FIXED)
    servo = (model.actuator_biastype[of] == _AFFINE) & (gain[:, 0] != 0) & (bias[:, 1] != 0)
    return of[plain & servo]


class Activations:
    """States of a model's actuators, stepped outside of a simulation.

    Args:
      model: MuJoCo's dynamics of the types `filter` and `filterexact` are followed, and taken as exact, and those of
        the type `integrator`.
      dt: step, s.
      fields: model fields of each simulation, (..., nu, k), where they differ from the model's (`ModelFields.touched`).
    """

    def __init__(self, model: mujoco.MjModel, dt: float, fields: Mapping[str, Array] = _NONE) -> None:
        self._dt, self._sums, self._servos = dt, integrators(model), on_servos(model)
        self._model, self._fields = model, fields
        kinds = [int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)]
        filters = np.flatnonzero(np.isin(model.actuator_dyntype, kinds))
        self._of, self._filters = np.concatenate([filters, self._sums]), len(filters)
        self._at = model.actuator_actadr[self._of]
        self._clip, self._bound = (self._ends(self._of, kind) for kind in ("ctrl", "act"))
        self._late = np.maximum(self._field("actuator_dynprm")[..., filters, 0], 1e-9)
        self._keep = np.exp(-dt / self._late)
        self._carried, self._reach = _carried(model, self._servos), self._ends(self._servos, "act")
        self._targets, self._count = model.actuator_actadr[self._servos], model.na

    def __bool__(self) -> bool:
        """Whether the model has any."""
        return len(self._of) > 0

    @property
    def differ(self) -> bool:
        """Whether the same commands may lead to other states in some simulations than in others."""
        return bool(self) and any(name in self._fields for name in LED_BY)

    @property
    def span(self) -> float:
        """Seconds of past commands that the filters' states depend on."""
        return FORGOTTEN * float(np.max(self._late, initial=0.0))

    def _field(self, name: str) -> Array:
        return self._fields.get(name, getattr(self._model, name))

    def _ends(self, of: NDArray[np.intp], kind: str) -> tuple[Array, Array]:
        """(low, high) of actuators' `ctrl` or `act` ranges, infinite where there are none."""
        limited = self._field(f"actuator_{kind}limited")[..., of].astype(bool)
        ends = self._field(f"actuator_{kind}range")[..., of, :]
        return np.where(limited, ends[..., 0], -np.inf), np.where(limited, ends[..., 1], np.inf)

    def advance(self, ctrl: Array, act: Array, settle: bool = False, dt: float | None = None) -> None:
        """One step of the states (..., na) under commands (..., nu), in place.

        Args:
          settle: the commands have been held for ever; integrators stay as they are.
          dt: of a coarse step before the history, s, in which integrators stay as they are; default as of all.
        """
        if not self:
            return
        wish, old, cut = np.clip(ctrl[..., self._of], *self._clip), act[..., self._at], self._filters
        new = wish.copy()
        if not settle:
            keep = self._keep if dt is None else np.exp(-dt / self._late)
            new[..., :cut] += keep * (old[..., :cut] - wish[..., :cut])
        still = settle or dt is not None
        new[..., cut:] = old[..., cut:] if still else old[..., cut:] + self._dt * wish[..., cut:]
        act[..., self._at] = np.clip(new, *self._bound)

    def course(self, ctrl: Array) -> Array:
        """States (..., T, na) as each of the commands (..., T, nu) comes: settled at the first, then by `advance`."""
        out = np.zeros((*ctrl.shape[:-1], self._count))
        if not self:
            return out
        self.advance(ctrl[..., 0, :], out[..., 0, :], settle=True)
        least, most = (end[..., None, :] for end in self._clip)
        wish, cut, at = np.clip(ctrl[..., :-1, self._of], least, most), self._filters, self._at
        start = out[..., 0, at]
        sums = np.cumsum(np.concatenate([start[..., None, cut:], self._dt * wish[..., cut:]], -2), -2)
        filtered = chased(wish[..., :cut], np.broadcast_to(self._keep, start[..., :cut].shape), start[..., :cut])
        led = np.concatenate([filtered, sums[..., 1:, :]], -1)
        low, high = (end[..., None, :] for end in self._bound)
        if (led >= low).all() and (led <= high).all():
            out[..., 1:, at] = led
            return out
        for k in range(ctrl.shape[-2] - 1):  # a bound holds one back, and it goes on from there
            out[..., k + 1, :] = out[..., k, :]
            self.advance(ctrl[..., k, :], out[..., k + 1, :])
        return out

    def begin(self, batch: Batch, fields: ModelFields) -> None:
        """Bring the integrators of servos to where their joints show them to be, in every simulation of a batch.

        Commands before a log are unknown, and so is what was gathered of them. The servo's joint stands where its
        target is, but for what the servo carries: gravity and the joint's own passive forces, taken as balanced.

        Args:
          batch: at the states to begin from.
          fields: of the batch, as they are written now.
        """
        if not len(self._servos):
            return
        for name in ("qfrc_bias", "qfrc_passive", "actuator_length", "actuator_velocity"):
            batch.bind(name)  # what is bound before a call is filled by it
        batch.forward()
        gain, bias = (
            fields.touched.get(name, fields.nominal(name)) for name in ("actuator_gainprm", "actuator_biasprm")
        )
        self.hold(batch, batch.qfrc_bias - batch.qfrc_passive, gain, bias)

    def hold(self, engine: Any, load: Array, gain: Array, bias: Array) -> None:
        """Set the states of servos' integrators such that the servos carry what moves their joints, in place.

        Args:
          engine: a batch or an `MjData`, with `act`, and `actuator_length` and `actuator_velocity` computed.
          load: (..., nv) generalised forces that actuators and contacts make together.
          gain, bias: (..., nu, n) parameters of the actuators' laws.
        """
        of = self._servos
        if not len(of):
            return
        own, length, speed = bias[..., of, :], engine.actuator_length[..., of], engine.actuator_velocity[..., of]
        law = own[..., 0] + own[..., 1] * length + own[..., 2] * speed
        held = (load @ self._carried.T - law) / gain[..., of, 0]
        engine.act[..., self._targets] = np.clip(held, *self._reach)


def _carried(model: mujoco.MjModel, of: NDArray[np.intp]) -> Array:
    """(n, nv) share of a joint's load in each actuator's force; 0 where another moves the same joint, or no joint."""
    out = np.zeros((len(of), model.nv))
    at_joints = model.actuator_trntype == _JOINT
    for i, a in enumerate(of):
        joint = model.actuator_trnid[a, 0]
        alone = np.count_nonzero(at_joints & (model.actuator_trnid[:, 0] == joint)) == 1
        if at_joints[a] and alone and int(model.jnt_type[joint]) >= _SLIDE and model.actuator_gear[a, 0] != 0:
            out[i, model.jnt_dofadr[joint]] = 1 / model.actuator_gear[a, 0]
    return out
