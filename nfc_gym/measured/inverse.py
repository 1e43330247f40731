"""Inverse problems: the actuator forces that a measured motion needs, against measured ones."""

import copy
from collections.abc import Sequence
from functools import cache, cached_property

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.instant import InstantProblem, Track
from nfc_gym.measured.recent import Recent
from nfc_gym.physics.effects.base import Context, Effect, Forces, overrides
from nfc_gym.physics.effects.drive import arm_of
from nfc_gym.physics.effects.lookup import actuator_names
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import resolve, write_field
from nfc_gym.physics.past import trace
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_NO_CUT = 1e10  # dry friction, N or N m, that no motion overcomes
_WALKED = 200_000_000  # bytes of inverse dynamics that a problem remembers
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
        require_told_apart(model, self.actuators)
        return found

    @cached_property
    def _walked(self) -> Recent:
        """Inverse dynamics along tracks, which most candidates' fits ask for at the same psi."""
        return Recent(_WALKED)

    def describe(self, model: mujoco.MjModel) -> list[tuple[str, str, str, str]]:
        """One column an actuator."""
        moments, names = levers(model), actuator_names(model)
        hinges = model.jnt_type[model.dof_jntid] == int(mujoco.mjtJoint.mjJNT_HINGE)
        turning = [bool(hinges[moments[a] != 0].all()) for a in self.actuators]
        kinds = [("torque", "N m") if turns else ("force", "N") for turns in turning]
        at = [names[a] for a in self.actuators]
        return [(*kind, f"actuator:{name}", f"force:{name}") for kind, name in zip(kinds, at, strict=True)]

    def evaluate(self, plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Array]:
        """See `InstantProblem`."""
        parts = [actuator_forces(plant, x[some], tracks, self._walked) for some in self.turns(len(x), tracks)]
        return [np.concatenate(forces)[..., self.actuators] for forces in zip(*parts, strict=True)]


def levers(model: mujoco.MjModel) -> Array:
    """(nu, nv) generalised force of one unit of each actuator's force, of those on joints and on fixed tendons.

    Zero for others, whose levers depend on the motion, and for what acts on more than one degree of freedom of a joint.
    """
    arms = [arm_of(model, a) for a in range(model.nu)]
    rows = [np.zeros(model.nv) if of is None else of for of in arms]
    return np.reshape(rows, (model.nu, model.nv)) * model.actuator_gear[:, :1]


def require_told_apart(model: mujoco.MjModel, actuators: Sequence[int]) -> None:
    """Refuse actuators whose forces the motion does not tell: of a moving lever, or beside others at the same joints.

    Raises:
      InputError: naming the actuator, what stands in the way, and what to do.
    """
    moments, names = levers(model), actuator_names(model)
    size = np.linalg.norm(moments, axis=1, keepdims=True)
    alike = moments / np.where(size > 0, size, 1)
    mixed = np.abs(alike @ np.linalg.pinv(alike)) > 1e-6  # (nu, nu): whose forces are taken for whose
    still, reach = size[:, 0] > 0, _reach(model)
    for a in actuators:
        refused = f"force:{names[a]} cannot be compared with `segments.mode: inverse`"
        if not still[a]:
            raise InputError(
                f"{refused}: it is read of actuators on hinges, on slides and on fixed tendons of these; leave the "
                "channel out, or use `mode: rollout`"
            )
        beside = (mixed[a] & still) | (~still & (reach & (moments[a] != 0)).any(1))
        others = ", ".join(str(names[b]) for b in np.flatnonzero(beside) if b != a)
        if others:
            raise InputError(
                f"{refused}: {others} can move the same joint, and the motion tells only what they do together; give "
                "each joint one actuator, or use `mode: rollout`"
            )


def _reach(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """(nu, nv) degrees of freedom that each actuator can push, at a pose without any symmetry."""
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, np.random.default_rng(0).normal(size=model.nv), 1.0)
    mujoco.mj_fwdPosition(model, data)
    out = np.zeros((model.nu, model.nv), bool)
    for a, (first, count) in enumerate(zip(data.moment_rowadr, data.moment_rownnz, strict=True)):
        out[a, data.moment_colind[first : first + count]] = True
    return out


def actuator_forces(plant: Plant, x: Array, tracks: Sequence[Track], walked: Recent | None = None) -> list[Array]:
    """Forces of actuators that measured motions need, at parameter vectors.

    Generalised forces come from `mj_inverse`, less what force effects add; dry friction that depends on the actuator's
    own load is iterated to consistency. Those of the joints become those of the actuators by their `levers`, in the
    sense of least squares where a tendon pulls at joints that need more than it can give.

    Args:
      plant: the machine.
      x: (P, size).
      tracks: of one step dt; those of one name are the same track.
      walked: remembers inverse dynamics from call to call.

    Returns:
      (P, T, nu) for each track.
    """
    psi, thetas = plant.split(x)
    walked = Recent(_WALKED) if walked is None else walked
    edits = [theta for e, theta in zip(plant.effects, thetas, strict=True) if overrides(e, "model")]
    same = [row.tobytes() for row in np.concatenate([psi, *edits], -1)]  # parameter vectors of one and the same model
    parts: list[_Needed] = []
    for t in tracks:
        motions: dict[bytes, _Motion] = {}
        for key, row in zip(same, x, strict=True):
            if key not in motions:
                motions[key] = _Motion(plant, row, t, walked)
            parts.append(_Needed(plant, row, motions[key]))
    if any(overrides(e, "force") for e in plant.effects):
        _push(plant, x, tracks, parts)
    count = len(x)
    needs = [part.actuation() for part in parts]
    return [np.stack(needs[i : i + count]) for i in range(0, len(needs), count)]


def _push(plant: Plant, x: Array, tracks: Sequence[Track], parts: Sequence["_Needed"]) -> None:
    """Take what the effects' forces do off what is needed, of all parameter vectors and tracks at once."""
    count, model = len(x), plant.model
    lengths = [len(t.time) for t in tracks]
    ends = count * np.cumsum([0, *lengths])
    order = [a + np.arange(n)[:, None] + n * np.arange(count) for a, n in zip(ends[:-1], lengths, strict=True)]
    join = lambda name: np.concatenate([np.tile(getattr(t, name), (count, 1)) for t in tracks])  # noqa: E731
    signals = {k: np.concatenate([np.tile(t.exogenous[k], count) for t in tracks]) for k in tracks[0].exogenous}
    data = lambda name: np.concatenate([part.data(name) for part in parts])  # noqa: E731
    nominal = lambda name: np.concatenate([part.motion.nominal(name) for part in parts])  # noqa: E731
    ctx = Context(model, tracks[0].dt, join("qpos"), join("qvel"), join("ctrl"), signals, cache(data), cache(nominal))
    out = Forces(np.zeros((ends[-1], model.nv)), np.zeros((ends[-1], model.nbody, 6)))
    rows = np.concatenate([np.repeat(x, n, 0) for n in lengths])
    for effect, theta in zip(plant.effects, plant.split(rows)[1], strict=True):
        if overrides(effect, "force"):
            ctx.memory = trace(effect, ctx, theta, order) if overrides(effect, "follow") else None
            effect.force(ctx, theta, out)
    cuts = np.cumsum(np.repeat(lengths, count))[:-1]
    for part, qfrc, xfrc in zip(parts, np.split(out.qfrc, cuts), np.split(out.xfrc, cuts), strict=True):
        part.force = part.force - qfrc - part.motion.carried(xfrc)


class _Needed:
    """What one parameter vector (size,) needs along one track.

    Attributes:
      force: (T, nv) generalised forces.
    """

    def __init__(self, plant: Plant, x: Array, motion: "_Motion") -> None:
        self.plant, self.motion, self._thetas = plant, motion, plant.split(x)[1]
        self._load: Array | None = None
        rubbing = [(e, th) for e, th in zip(plant.effects, self._thetas, strict=True) if overrides(e, "friction")]
        self.force = self._rubbed(rubbing) if rubbing else motion.bare
        self._load = self.force

    def _rubbed(self, rubbing: Sequence[tuple[Effect, Array]]) -> Array:
        motion, t = self.motion, self.motion.track
        count = len(t.time)
        ctx = Context(self.plant.model, t.dt, t.qpos, t.qvel, t.ctrl, t.exogenous, self.data, motion.nominal)
        force = np.zeros((count, 0))
        for _ in range(_LOAD_PASSES):
            level = np.tile(motion.friction, (count, 1))
            for effect, theta in rubbing:
                dofs, more = effect.friction(ctx, np.broadcast_to(theta, (count, len(theta))))
                level[:, dofs] += more
            force = motion.inverse(level)
            if self._load is None:  # no law asked for the actuators' own load
                break
            self._load = force
        return force

    def data(self, name: str) -> Array:
        """A derived field (T, ...); the actuators' own load is what was found so far."""
        if name != "qfrc_actuator":
            return self.motion.data(name)
        if self._load is None:
            self._load = self.motion.bare
        return self._load

    def actuation(self) -> Array:
        """(T, nu) forces of the actuators, effects on these included."""
        motion, t = self.motion, self.motion.track
        out = self.force @ np.linalg.pinv(levers(motion.model))
        # From the force back to the command: what acts last on the way there is undone first.
        pairs = [(e, th) for e, th in zip(self.plant.effects, self._thetas, strict=True) if overrides(e, "demand")]
        ctx = Context(motion.model, t.dt, t.qpos, t.qvel, t.ctrl, t.exogenous, self.data, motion.nominal)
        for effect, theta in reversed(sorted(pairs, key=lambda pair: pair[0].on_command)):
            out = effect.demand(out, theta, ctx)
        return out


class _Motion:
    """Inverse dynamics of one model along a track, with the derived fields that effects may read."""

    def __init__(self, plant: Plant, x: Array, t: Track, walked: Recent) -> None:
        self.model, self.track, self._walked = copy.copy(plant.model), t, walked
        self._fields: dict[str, Array] = {}
        fields = ModelFields(self.model, plant.model)
        for (name, of), values in t.known.items():
            write_field(fields, resolve(self.model, name, of), values[0])
        plant.write(fields, x)
        fields.commit()
        self.friction = self.model.dof_frictionloss.copy()
        # A walk is the same under any dry friction.
        edited = {k: v.tobytes() for k, v in fields.touched.items() if k != "dof_frictionloss"}
        self._question = t.name, plant.model, tuple(sorted(edited.items()))

    @cached_property
    def _solved(self) -> tuple[Array, Array]:
        """(T, nv) each: generalised forces without dry friction, and the friction that would hold each joint."""
        free, holding, bias, passive = self._walked(self._question, self._walk)
        self._fields |= {"qfrc_bias": bias, "qfrc_passive": passive}
        return free + holding, holding

    def _walk(self) -> Array:
        """(4, T, nv): forces that are needed, friction that would hold each joint, `qfrc_bias` and `qfrc_passive`.

        MuJoCo's friction of a joint is the force that would hold it, cut at `frictionloss`, and in inverse dynamics no
        joint's depends on another's: one pass with no cut tells what is needed under any.
        """
        m, t = self.model, self.track
        d = mujoco.MjData(m)
        out = np.zeros((4, len(t.time), m.nv))
        free, holding, bias, passive = out
        # Each look at a field of `MjData` makes a new view, which costs as much as the dynamics of a small machine.
        qpos, qvel, qacc = d.qpos, d.qvel, d.qacc
        needed, its_bias, its_passive = d.qfrc_inverse, d.qfrc_bias, d.qfrc_passive
        m.dof_frictionloss[:] = _NO_CUT
        for k, state in enumerate(zip(t.qpos, t.qvel, t.qacc, strict=True)):
            qpos[:], qvel[:], qacc[:] = state
            mujoco.mj_inverse(m, d)
            if d.nf:  # the model may have switched friction off
                holding[k] = d.efc_force[d.ne : d.ne + m.nv]
            free[k], bias[k], passive[k] = needed, its_bias, its_passive
        m.dof_frictionloss[:] = self.friction
        return out

    def inverse(self, friction: Array) -> Array:
        """(T, nv) generalised forces with dry friction (nv,) or (T, nv)."""
        free, holding = self._solved
        return free - np.clip(holding, -friction, friction)

    @cached_property
    def bare(self) -> Array:
        """(T, nv) generalised forces without the effects' friction."""
        return self.inverse(self.friction)

    def nominal(self, name: str) -> Array:
        """A model field (T, ...) as it was before any friction of effects."""
        owner = self.model.opt if name.startswith("opt.") else self.model
        field = self.friction if name == "dof_frictionloss" else getattr(owner, name.removeprefix("opt."))
        return np.broadcast_to(field, (len(self.track.time), *np.shape(field)))

    def data(self, name: str) -> Array:
        """A derived field (T, ...) of positions and velocities, computed along the track when first asked for."""
        if name in ("qfrc_bias", "qfrc_passive"):
            _ = self._solved
        if name not in self._fields:
            batch = self._placed()
            values = batch.bind(name)
            batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
            self._fields[name] = values.copy()
        return self._fields[name]

    def _placed(self) -> Batch:
        batch = Batch(self.model, len(self.track.time))
        batch.qpos[...], batch.qvel[...] = self.track.qpos, self.track.qvel
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
