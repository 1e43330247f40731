"""Ground that is not as the model has it: where it grips otherwise, how it gives way, how deep it lets things sink.

The ground is every colliding geom that stands still: those of the world and of bodies welded to it.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Scales
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.fields import ModelFields, names_of

_EDGE = 0.2  # of a patch's radius: the width over which its friction goes over into that outside


def ground_geoms(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Ids of the colliding geoms that stand still, (n,)."""
    still = np.asarray(model.body_weldid)[np.asarray(model.geom_bodyid)] == 0
    return np.flatnonzero(still & ((model.geom_contype | model.geom_conaffinity) != 0)).astype(np.intp)


def touching_geoms(model: mujoco.MjModel, ground: NDArray[np.intp]) -> NDArray[np.intp]:
    """Ids of the moving geoms that may touch the ground, (n,)."""
    kind, with_ = np.asarray(model.geom_contype), np.asarray(model.geom_conaffinity)
    meets = (kind[:, None] & with_[ground]) | (kind[ground] & with_[:, None])
    return np.setdiff1d(np.flatnonzero(meets.any(1)), ground).astype(np.intp)


class OnGround(Effect):
    """What the laws share: the ground, the geoms that touch it, and whose values rule where they meet."""

    def bind(self, model: mujoco.MjModel) -> None:
        self.ground = ground_geoms(model)
        self.touching = touching_geoms(model, self.ground)
        if not len(self.touching):
            raise InputError(f"{self.family}: nothing in the model can touch its ground (geoms that stand still)")
        if self.where != ("ground",):
            names = names_of(model, mujoco.mjtObj.mjOBJ_GEOM, model.ngeom)
            known = [names[g] for g in self.touching if names[g]]
            unknown = [n for n in self.where if n not in known]
            if unknown:
                raise InputError(
                    f"{self.family}: no geom {unknown[0]!r} touches the ground; there are: {', '.join(known)}"
                )
            self.touching = np.array([names.index(n) for n in self.where], np.intp)
        rank = np.asarray(model.geom_priority)
        self.above = rank[self.touching] - rank[self.ground].max()
        self.ruled = self.touching[self.above >= 0]

    def grip(self, fields: Mapping[str, Array], factor: Array, there: Array) -> None:
        """Give each geom that the ground does not rule a share of the sliding friction that it would meet there.

        Between geoms of one priority MuJoCo takes the larger friction: they take over the ground's, and the ground's
        is 0 for the step.

        Args:
          fields: has `geom_friction`, (..., ngeom, 3), which is written to.
          factor: (..., n) for each of the `ruled` geoms.
          there: (..., 1) whether any of the factors is another than 1.
        """
        equal = self.above[self.above >= 0] == 0
        sliding = fields["geom_friction"][..., 0]
        own = sliding[..., self.ruled]
        of_ground = sliding[..., self.ground].max(-1, keepdims=True)
        sliding[..., self.ruled] = np.where(there & equal, np.maximum(own, of_ground), own) * factor
        if equal.any():
            sliding[..., self.ground] = np.where(there, 0.0, sliding[..., self.ground])

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        return [cls(("ground",), cls.PARAMS)] if len(touching_geoms(model, ground_geoms(model))) else []


class FrictionPatch(OnGround):
    """A place on the ground, an ellipse in the world's x and y, where sliding friction is (1 - lost) of that elsewhere.

    The friction of each geom that touches the ground is written anew in every step, by where its middle is; the edge
    is a fifth of the radius wide. Between geoms of one priority MuJoCo takes the larger friction, so while a machine
    stands in the patch its geoms take over the ground's friction, and the ground's is 0. Geoms over which the ground
    has priority cannot be told apart and keep theirs. Named for single geoms, it is theirs alone.
    """

    family = "friction_patch"
    summary = "A patch of other friction"
    MODULATES = ("geom_friction",)
    PARAMS = (
        Param("lost", "1", -1.0, 0.98, probes=(0.6,), resolution=0.005, natural=True),
        Param("x", "m", -1e4, 1e4, probes=(0.0,), shape=True),
        Param("y", "m", -1e4, 1e4, probes=(0.0,), shape=True),
        Param("radius_x", "m", 1e-3, 1e4, probes=(1.0,), shape=True),
        Param("radius_y", "m", 1e-3, 1e4, probes=(1.0,), shape=True),
    )

    def modulate(self, ctx: Context, theta: Array, fields: Mapping[str, Array]) -> None:
        place = ctx.data("geom_xpos")[..., self.ruled, :2] - theta[..., None, 1:3]
        away = np.sqrt(((place / theta[..., None, 3:5]) ** 2).sum(-1))
        rise = np.minimum(np.maximum((1 + _EDGE / 2 - away) / _EDGE, 0.0), 1.0)
        lost = theta[..., 0:1] * rise * rise * (3 - 2 * rise)
        self.grip(fields, 1 - lost, (lost != 0).any(-1, keepdims=True))

    def say(self, theta: Array, sd: Array | None = None) -> str:
        how = "less" if theta[0] >= 0 else "more"
        return (
            f"{self.summary}: {100 * abs(theta[0]):.3g} % {how} within {theta[3]:.3g} m along x and {theta[4]:.3g} m "
            f"along y of ({theta[1]:.3g}, {theta[2]:.3g}) m."
        )

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        box = roamed(model, scales)
        if not super().propose(model, scales) or box is None:
            return []
        low, high = box
        size = np.maximum(high - low, 0.2)
        middles = [low + s * (high - low) for s in (0.5, 0.2, 0.8)]
        changes = {
            axis: {
                "probes": tuple(float(m[i]) for m in middles),
                "low": float(low[i] - size[i]),
                "high": float(high[i] + size[i]),
            }
            for i, axis in enumerate("xy")
        }
        for i, axis in enumerate(("radius_x", "radius_y")):
            changes[axis] = {
                "probes": (float(0.3 * size[i]),),
                "low": 0.02 * float(size[i]),
                "high": 4 * float(size[i]),
            }
        return [cls(("ground",), sized(cls.PARAMS, **changes))]


def base_on_ground(model: mujoco.MjModel) -> int | None:
    """Id of the base that has most geoms to stand on; None where nothing touches the ground."""
    standing = np.asarray(model.body_rootid)[model.geom_bodyid[touching_geoms(model, ground_geoms(model))]].tolist()
    return max(set(standing), key=standing.count) if standing else None


def roamed(model: mujoco.MjModel, scales: Scales) -> tuple[Array, Array] | None:
    """Least and largest x and y in the world, (2,) each, of the base that has most geoms to stand on.

    None where no base moves freely in x and y, on a free joint or on two slides, or where its motion is unknown.
    """
    root = base_on_ground(model)
    if root is None or scales.low is None or scales.high is None:
        return None
    found: list[tuple[int, float]] = []  # coordinate, and what is to be added to it
    for j in np.flatnonzero(np.asarray(model.body_rootid)[model.jnt_bodyid] == root):
        at, kind = int(model.jnt_qposadr[j]), int(model.jnt_type[j])
        if kind == int(mujoco.mjtJoint.mjJNT_FREE):
            found = [(at, 0.0), (at + 1, 0.0)]
        elif kind == int(mujoco.mjtJoint.mjJNT_SLIDE) and len(found) < 2 and model.jnt_axis[j][len(found)] > 0.99:
            found.append((at, float(model.body_pos[root][len(found)])))
    if len(found) < 2:
        return None
    low, high = ([float(end[at]) + offset for at, offset in found] for end in (scales.low, scales.high))
    return np.array(low), np.array(high)


class Compliance(OnGround):
    """Ground contact that is softer: its natural frequency over 1 + softness, its damping ratio times 1 + damping.

    MuJoCo's own contact says both through `solref`, in either of its forms; they are written to whoever rules the
    contact: what touches the ground where that has priority or the direct form, else both. A mass that rests on a
    contact of frequency f and impedance d sinks by (1 - d) g / (2 pi f)^2, as on a spring of stiffness
    m (2 pi f)^2 / (1 - d). Softer contact also creeps more under a sideways load.

    Single geoms can be softer only where their own values rule. Where the ground's do, or the mean of both, a geom
    would need a higher priority, and with it friction and condim of its own towards all that it touches: another model
    even where the effect vanishes, which is for the model's author to decide.
    """

    family = "compliance"
    summary = "Soft ground"
    remark = "of single geoms where their own values rule: by a `priority` above the ground's, or a direct `solref`"
    PARAMS = (
        Param("softness", "1", -0.5, 30.0, probes=(1.0, 4.0), resolution=0.02, floor=-1.0),
        Param("damping", "1", -0.9, 10.0, probes=(-0.5, 1.0), resolution=0.02, floor=-1.0),
    )

    def bind(self, model: mujoco.MjModel) -> None:
        super().bind(model)
        direct = np.asarray(model.geom_solref)[:, 0] < 0
        own = (self.above > 0) | ((self.above == 0) & direct[self.touching] & ~direct[self.ground].any())
        self.soft = self.touching[own]
        if not own.all():  # the rest is ruled by the ground, alone or by the mean of both
            if self.where != ("ground",):
                raise InputError(
                    f"compliance: the ground has a say in the contact of {self.place}: name `ground`, or give geoms a "
                    "higher `priority` than the ground's in the model: their own solref, solimp, friction then rule"
                )
            self.soft = np.concatenate([self.soft, self.ground, self.touching[~own & (self.above == 0)]])

    def model(self, fields: ModelFields, theta: Array) -> None:
        softer, damped = 1 + theta[..., 0:1], 1 + theta[..., 1:2]
        solref = fields["geom_solref"]
        first, second = solref[..., self.soft, 0], solref[..., self.soft, 1]
        direct = first < 0
        # time constant 1 / (frequency * ratio) and ratio, or minus frequency^2 and minus 2 * ratio * frequency
        solref[..., self.soft, 0] = np.where(direct, first / softer**2, first * softer / damped)
        solref[..., self.soft, 1] = np.where(direct, second * damped / softer, second * damped)
