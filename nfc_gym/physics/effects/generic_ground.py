"""Generic alternatives for what moves on the ground: its grip by place, and what a wheel does as it turns.

Where a floor is slippery in places, no force on a joint is wrong: every foot's friction is, here and there. Where a
wheel is out of true or out of round, no torque about its axle is: the vehicle is pushed where that wheel stands, and
whatever turns or heels it most would be blamed. Beside the smooth forces of `generic` these say that the ground, or
one wheel on it, is what the model lacks.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Mapping

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.ground import OnGround, roamed
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.effects.slip import headed, wheels
from nfc_gym.physics.fields import names_of

_MOST = 3.0  # of the logarithm of a grip's factor
_EDGE = 1.2  # half-widths of the ground that the logs roamed, beyond which the grip stays as it is there


class GenericGrip(OnGround):
    """Sliding friction times exp(sum_k c_k phi_k(x, y)): polynomials of degree two of the world's x and y.

    They have no constant: friction that is everywhere another one is the model's own parameter, and no matter of place.
    """

    family = "generic_grip"
    summary = "Friction of the ground that depends on the place"
    generic = True
    patchy = wordless = True
    MODULATES = ("geom_friction",)
    PARAMS = tuple(Param(f"c{k}", "1", -3.0, 3.0, probes=(0.1,)) for k in range(5))
    middle, reach = np.zeros(2), np.ones(2)

    def basis(self, place: Array) -> Array:
        """(..., 5) functions of places (..., 2), m."""
        u, v = np.moveaxis(np.clip((place - self.middle) / self.reach, -_EDGE, _EDGE), -1, 0)
        return np.stack([u, v, u * u, u * v, v * v], -1)

    def modulate(self, ctx: Context, theta: Array, fields: Mapping[str, Array]) -> None:
        share = (theta[..., None, :] * self.basis(ctx.data("geom_xpos")[..., self.ruled, :2])).sum(-1)
        self.grip(fields, np.exp(np.clip(share, -_MOST, _MOST)), (theta != 0).any(-1, keepdims=True))

    def say(self, theta: Array, sd: Array | None = None) -> str:
        turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)  # half-way out: what lies further was seldom seen
        place = self.middle + 0.5 * self.reach * np.stack([np.cos(turn), np.sin(turn)], -1)
        more = np.exp(np.clip(self.basis(place) @ theta, -_MOST, _MOST)) - 1
        ends = [(more[i], *place[i]) for i in (int(more.argmin()), int(more.argmax()))]
        where = [f"{abs(m):.1%} {'more' if m > 0 else 'less'} about ({x:.1f}, {y:.1f}) m" for m, x, y in ends]
        return f"{self.summary}: {' and '.join(where)} than in the middle of what the logs roamed."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        box = roamed(model, scales)
        if not super().propose(model, scales) or box is None:
            return []
        effect = cls(("ground",), cls.PARAMS)
        effect.middle, effect.reach = (box[0] + box[1]) / 2, np.maximum(box[1] - box[0], 0.2) / 2
        return [effect]


class GenericTread(Effect):
    """A force on a wheel, ahead, across and up, that repeats with its turn: a cosine and a sine of its angle each.

    Ahead and across are level, and turn with the wheel's axle about the vertical; the force acts at the wheel's centre
    of mass. It does not push the wheel about its axle, as the forces of `generic` do.
    """

    family = "generic_tread"
    summary = "A force under a wheel that repeats with its turn"
    generic = True
    wordless = True
    WAYS = ("ahead", "across", "up")
    PARAMS = tuple(Param(f"{way}_{w}", "N", -1e6, 1e6, probes=(0.1,)) for way in WAYS for w in ("cosine", "sine"))

    def bind(self, model: mujoco.MjModel) -> None:
        known = _wheels(model)
        unknown = [n for n in self.where if n not in known]
        if unknown:
            raise InputError(
                f"{self.family}: {unknown[0]!r} is no wheel's joint; there are: {', '.join(known) or 'none'}"
            )
        self.joints = np.array([known[n][0] for n in self.where], np.intp)
        self.bodies = np.asarray(model.jnt_bodyid)[self.joints].astype(np.intp)
        self.angles = np.asarray(model.jnt_qposadr)[self.joints].astype(np.intp)

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        angle = ctx.q[..., self.angles]
        cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
        for i, way in enumerate(headed(ctx, self.joints)):
            size = theta[..., None, 2 * i : 2 * i + 1] * cosine + theta[..., None, 2 * i + 1 : 2 * i + 2] * sine
            out.xfrc[..., self.bodies, :3] += size * way

    def say(self, theta: Array, sd: Array | None = None) -> str:
        sizes = np.hypot(theta[::2], theta[1::2])
        told = ", ".join(f"{size:.3g} N {way}" for size, way in zip(sizes, self.WAYS, strict=True))
        return f"{self.summary}, {self.place}: {told}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        gravity = float(np.linalg.norm(model.opt.gravity))
        for joint, (_, share) in _wheels(model).items():
            size = {"probes": (0.1 * share * gravity,), "low": -3 * share * gravity, "high": 3 * share * gravity}
            out.append(cls((joint,), sized(cls.PARAMS, **{p.name: size for p in cls.PARAMS})))
        return out if gravity > 0 else []


def _wheels(model: mujoco.MjModel) -> dict[str, tuple[int, float]]:
    """Named joints of wheels -> id, and the mass that each carries of its vehicle, kg."""
    joints = sorted({int(model.body_jntadr[model.geom_bodyid[g]]) for g in wheels(model)})
    roots = [int(model.body_rootid[model.jnt_bodyid[j]]) for j in joints]
    named = names_of(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt)
    return {
        named[j]: (j, float(model.body_subtreemass[r]) / roots.count(r))
        for j, r in zip(joints, roots, strict=True)
        if named[j]
    }
