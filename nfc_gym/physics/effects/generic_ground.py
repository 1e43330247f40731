"""A generic alternative for what moves on the ground: its grip, as a smooth function of the place.

Where a floor is slippery in places, no force on a joint is wrong: every foot's friction is, here and there. Beside the
smooth forces of `generic` this one says that the ground, and not the machine, is what the model lacks.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Mapping

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Context, Effect, Scales
from nfc_gym.physics.effects.ground import OnGround, roamed
from nfc_gym.physics.effects.param import Param

_MOST = 3.0  # of the logarithm of a grip's factor
_EDGE = 1.2  # half-widths of the ground that the logs roamed, beyond which the grip stays as it is there


class GenericGrip(OnGround):
    """Sliding friction times exp(sum_k c_k phi_k(x, y)): polynomials of degree two of the world's x and y.

    They have no constant: friction that is everywhere another one is the model's own parameter, and no matter of place.
    """

    family = "generic_grip"
    summary = "Friction of the ground that depends on the place"
    generic = True
    patchy = True
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
