"""A generic alternative for a body that is more than one: a force of something inside it that moves.

What slides on a deck, slops in a tank or swings on a short line has degrees of freedom that the model lacks. It lags
behind the body that carries it, pulls it back for that, and then leans on it from another place: to the model, a force
and a torque that follow how the body's own speed changed lately. No joint is there to push, and whatever else slows the
body down, wind or a slope, would be blamed.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from typing import Any

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.fields import names_of
from nfc_gym.physics.state import rotate, rotate_back

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_SHARE = 0.05  # of a body's mass that a typical thing in it has
_MOST = 20.0  # typical sizes up to which a fit may go: all of the mass


class GenericInner(Effect):
    """A force along a body's x and y, and torques about its y and x, that go with how its speed changed lately.

    Each is in proportion to the body's speed along its own x (y) less what that was on the average of the last 0.1 and
    0.4 s, with the weights of a first-order lag. Over short times that is the acceleration. Force and torque have sizes
    of their own: what moves does so at some height, and its weight rests on another place than before.
    """

    family = "generic_inner"
    summary = "Something that moves in a body"
    generic = True
    patchy = wordless = True
    FORGETTING = np.array([0.1, 0.4])
    PARAMS = tuple(
        Param(f"{what}_{axis}_{pace}", unit, -1e6, 1e6, probes=(0.1,))
        for what, unit in (("force", "N s/m"), ("torque", "N s"))
        for axis in "xy"
        for pace in ("fast", "slow")
    )

    def bind(self, model: mujoco.MjModel) -> None:
        known = _floating(model)
        if self.where[0] not in known:
            raise InputError(
                f"{self.family}: {self.where[0]!r} is no free joint; there are: {', '.join(known) or 'none'}"
            )
        joint = known[self.where[0]]
        self.dof, self.quat = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint]) + 3

    def rest(self, ctx: Context, theta: Array) -> Any:
        return np.repeat(self._speed(ctx), len(self.FORGETTING), -1)

    def follow(self, ctx: Context, theta: Array, memory: Any) -> Any:
        speed = self._speed(ctx)
        return speed + np.exp(-ctx.dt / self.FORGETTING) * (memory - speed)

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        late = self._speed(ctx) - ctx.memory
        parts = theta.reshape(*theta.shape[:-1], 2, 2, len(self.FORGETTING)) * late[..., None, :, :]
        push, turn = np.moveaxis(parts.sum(-1), -2, 0)
        level = np.concatenate([push, np.zeros_like(push[..., :1])], -1)
        out.qfrc[..., self.dof : self.dof + 3] += rotate(ctx.q[..., self.quat : self.quat + 4], level)
        out.qfrc[..., self.dof + 3] -= turn[..., 1]
        out.qfrc[..., self.dof + 4] += turn[..., 0]

    def _speed(self, ctx: Context) -> Array:
        """(..., 2, 1) speed along the body's own x and y, m/s."""
        quat, speed = ctx.q[..., self.quat : self.quat + 4], ctx.v[..., self.dof : self.dof + 3]
        return rotate_back(quat, speed)[..., :2, None]

    def say(self, theta: Array, sd: Array | None = None) -> str:
        return f"{self.summary}, {self.place}: it follows the body's speed late, and leans on it elsewhere then."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for name, joint in _floating(model).items():
            body = int(model.jnt_bodyid[joint])
            mass = float(model.body_subtreemass[body])
            arm = float(np.sqrt(model.body_inertia[body].max() / max(float(model.body_mass[body]), 1e-9)))
            typical = np.outer([_SHARE * mass, _SHARE * mass * arm], np.tile(1 / cls.FORGETTING, 2)).ravel()
            sizes = zip(cls.PARAMS, typical, strict=True)
            rows = {
                p.name: {"probes": (float(t),), "low": -_MOST * float(t), "high": _MOST * float(t)} for p, t in sizes
            }
            out.append(cls((name,), sized(cls.PARAMS, **rows)))
        return out


def _floating(model: mujoco.MjModel) -> dict[str, int]:
    """Named free joints -> id."""
    named = names_of(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt)
    return {n: j for j, n in enumerate(named) if n and int(model.jnt_type[j]) == _FREE}
