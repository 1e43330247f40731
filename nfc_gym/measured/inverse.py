"""Inverse problems: the actuator forces that a measured motion needs, against measured ones."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.instant import InstantProblem, Track
from nfc_gym.physics.effects.base import Context, Forces, actuator_names, overrides
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import resolve, write_field
from nfc_gym.physics.past import trace
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_LOAD_PASSES = 3  # friction that depends on the actuator's load, and a load that includes the friction: iterations


class InverseProblem(InstantProblem):
    """Actuator forces needed for the measured motion, against `force:<actuator>` channels."""

    def compared(self, model: mujoco.MjModel, log: Log) -> list[str]:
        """The force channels."""
        found = [c for c in log.channels if c.startswith("force:")]
        if not found:
            raise InputError(
                "segments.mode inverse compares actuator forces: map at least one channel force:<actuator>"
            )
        self.actuators = [actuator_names(model).index(c.removeprefix("force:")) for c in found]
        return found

    def describe(self, model: mujoco.MjModel) -> list[tuple[str, str, str]]:
        """One column an actuator."""
        hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
        kinds = [int(model.jnt_type[model.actuator_trnid[a, 0]]) for a in self.actuators]
        return [
            ("torque", "N m", f"actuator:{actuator_names(model)[a]}")
            if k == hinge
            else ("force", "N", f"actuator:{actuator_names(model)[a]}")
            for a, k in zip(self.actuators, kinds, strict=True)
        ]

    def evaluate(self, plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Array]:
        """See `InstantProblem`."""
        return [np.stack([actuator_forces(plant, row, t)[:, self.actuators] for row in x]) for t in tracks]


def actuator_forces(plant: Plant, x: Array, t: Track) -> Array:
    """(T, nu) forces of joint actuators that the measured motion of a track needs at parameters x (size,).

    Generalised forces come from `mj_inverse`, less what force effects add; dry friction that depends on the actuator's
    own load is iterated to consistency. Each joint is taken to have one actuator.
    """
    model, data = copy.copy(plant.model), mujoco.MjData(plant.model)
    fields = ModelFields(model, plant.model)
    for (name, of), values in t.known.items():
        write_field(fields, resolve(model, name, of), values[0])
    plant.write(fields, x)
    fields.commit()
    thetas = plant.split(x)[1]
    base = model.dof_frictionloss.copy()
    motion = _Motion(model, data, t)
    rubbing = [(e, th) for e, th in zip(plant.effects, thetas, strict=True) if overrides(e, "friction")]
    ctx = Context(
        plant.model,
        t.dt,
        t.qpos,
        t.qvel,
        t.ctrl,
        t.exogenous,
        motion.data,
        lambda name: _tile(base if name == "dof_frictionloss" else getattr(model, name), len(t.time)),
    )
    force = None if rubbing else motion.inverse(None)
    for _ in range(_LOAD_PASSES if rubbing else 0):
        level = np.tile(base, (len(t.time), 1))
        for effect, theta in rubbing:
            dofs, more = effect.friction(ctx, np.broadcast_to(theta, (len(t.time), len(theta))))
            level[:, dofs] += more
        force = motion.inverse(level)
        if not motion.load_read:
            break
        motion.fields["qfrc_actuator"] = force
    assert force is not None
    pushing = [(e, th) for e, th in zip(plant.effects, thetas, strict=True) if overrides(e, "force")]
    if pushing:
        motion.fields["qfrc_actuator"] = force
        out = Forces(np.zeros((len(t.time), model.nv)), np.zeros((len(t.time), model.nbody, 6)))
        moments = np.arange(len(t.time))[:, None]
        for effect, theta in pushing:
            values = np.broadcast_to(theta, (len(t.time), len(theta)))
            ctx.memory = trace(effect, ctx, values, [moments]) if overrides(effect, "follow") else None
            effect.force(ctx, values, out)
        force = force - out.qfrc - motion.carried(out.xfrc)
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    actuation = force[:, dofs] / model.actuator_gear[:, 0]
    for effect, theta in zip(plant.effects, thetas, strict=True):
        if overrides(effect, "demand"):
            actuation = effect.demand(actuation, theta, t.exogenous, t.dt)
    return actuation


def _tile(a: Array, rows: int) -> Array:
    return np.broadcast_to(a, (rows, *np.shape(a)))


class _Motion:
    """Inverse dynamics along a track, with the derived fields that effects may read."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, t: Track) -> None:
        self.model, self._data, self._track = model, data, t
        self.fields: dict[str, Array] = {}
        self.load_read = False  # whether a law asked for the actuators' own load, which then must be made consistent

    def inverse(self, friction: Array | None) -> Array:
        """(T, nv) generalised forces; `friction` (T, nv) overrides the dry friction sample by sample."""
        m, d, t = self.model, self._data, self._track
        out, bias, passive = (np.empty((len(t.time), m.nv)) for _ in range(3))
        # Each look at a field of `MjData` makes a new view, which costs as much as the dynamics of a small machine.
        qpos, qvel, qacc, level = d.qpos, d.qvel, d.qacc, m.dof_frictionloss
        needed, its_bias, its_passive = d.qfrc_inverse, d.qfrc_bias, d.qfrc_passive
        for k, state in enumerate(zip(t.qpos, t.qvel, t.qacc, strict=True)):
            qpos[:], qvel[:], qacc[:] = state
            if friction is not None:
                level[:] = friction[k]
            mujoco.mj_inverse(m, d)
            out[k], bias[k], passive[k] = needed, its_bias, its_passive
        self.fields |= {"qfrc_bias": bias, "qfrc_passive": passive}
        return out

    def data(self, name: str) -> Array:
        """A derived field (T, ...) of positions and velocities, computed along the track when first asked for."""
        if name == "qfrc_actuator":
            self.load_read = True
            if name not in self.fields:
                self.fields[name] = self.inverse(None)
        if name not in self.fields:
            batch = self._placed()
            values = batch.bind(name)
            batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
            self.fields[name] = values.copy()
        return self.fields[name]

    def _placed(self) -> Batch:
        batch = Batch(self.model, len(self._track.time))
        batch.qpos[...], batch.qvel[...] = self._track.qpos, self._track.qvel
        return batch

    def carried(self, wrenches: Array) -> Array:
        """(T, nv) generalised forces of body wrenches (T, nbody, 6) at the centres of mass."""
        if not wrenches.any():
            return np.zeros((len(wrenches), self.model.nv))
        batch = self._placed()
        smooth, passive, bias, actuator = (batch.bind(f"qfrc_{n}") for n in ("smooth", "passive", "bias", "actuator"))
        batch.xfrc_applied[...] = wrenches
        batch.forward()
        return smooth - passive + bias - actuator  # MuJoCo's sum of forces, less everything but the wrenches
