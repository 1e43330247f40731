"""Mass that the model has not, or has elsewhere: payload, shift of the centre of mass, scaled inertia.

Payload and shift move a body off the place that MuJoCo's "simple body" short cut was compiled for; such bodies must be
compiled with `simple="false"` (`complete_inertia` does it to a spec), else `bind` raises.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Effect, Scales
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import body_ids, gyration, moving_bodies, sized
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.state import quat_multiply, rotate_back

_NO_MASS = 1e-9  # kg: a lighter lump has no place
_REACHES = (0.8, 0.4, 0.2, 0.1, 0.05)  # of the way to the edge of where a lump may lie: where fits start
_GROWTH = (1.0, 2.0, 4.0)  # of the moments: what a straight line says of them is too little where bodies touch
_TURNING = 1  # a simple body that may turn; of one that only slides, 2, the place of its mass does nothing
_SWEEPS = 6  # cyclic Jacobi on 3 x 3 converges quadratically; six sweeps reach the last bit


def complete_inertia(spec: mujoco.MjSpec) -> None:
    """Compile the bodies of a spec without the "simple body" short cut, so that centres of mass may move afterwards.

    Those that only slide keep it: they hide where their mass is, and MuJoCo makes what touches or couples them softer
    or harder by whether they have it (of a body that slides along one axis, it takes a third of the mobility without).
    """
    for body in spec.bodies:
        if body.name != "world" and _turns(body):
            body.simple = 0


def _turns(body: mujoco.MjsBody) -> bool:
    """Whether a joint turns a body or one that carries it; so it counts, too, where none moves it."""
    joints = []
    while body.name != "world":
        joints += body.joints
        body = body.parent
    return not joints or any(j.type != mujoco.mjtJoint.mjJNT_SLIDE for j in joints)


def principal(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues (..., 3) and rotation quaternion (..., 4) of symmetric matrices (..., 3, 3), by Jacobi rotations.

    A diagonal matrix gives its own diagonal and exactly no rotation, and a matrix close to it a small rotation: unlike
    a library's sorted eigenvectors, the result is continuous in the payload.
    """
    a = np.array(matrix, float)
    quat = np.zeros((*a.shape[:-2], 4))
    quat[..., 0] = 1.0
    for _ in range(_SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            a, turn = _jacobi(a, p, q)
            quat = quat_multiply(quat, turn)
    return np.stack([a[..., i, i] for i in range(3)], -1), quat


def _jacobi(a: Array, p: int, q: int) -> tuple[Array, Array]:
    """One rotation in the plane (p, q) that clears a[p, q]; also as a quaternion."""
    gap, off = a[..., q, q] - a[..., p, p], 2 * a[..., p, q]
    size = np.abs(gap) + np.sqrt(gap**2 + off**2)
    sign = np.where(gap < 0, -1.0, 1.0)
    tangent = np.where(size > 0, sign * off / np.where(size > 0, size, 1.0), 0.0)
    cosine = 1 / np.sqrt(1 + tangent**2)
    sine = tangent * cosine
    rotation = np.zeros_like(a)
    rotation[...] = np.eye(3)
    rotation[..., p, p], rotation[..., q, q] = cosine, cosine
    rotation[..., p, q], rotation[..., q, p] = sine, -sine
    turned = np.swapaxes(rotation, -1, -2) @ a @ rotation
    turned[..., p, q] = turned[..., q, p] = 0.0
    half = np.arctan(tangent) / 2
    quat = np.zeros((*a.shape[:-2], 4))
    quat[..., 0] = np.cos(half)
    axis, direction = {(0, 1): (3, -1.0), (0, 2): (2, 1.0), (1, 2): (1, -1.0)}[(p, q)]
    quat[..., axis] = direction * np.sin(half)
    return turned, quat


def turns(model: mujoco.MjModel, name: str) -> bool:
    """Whether a body can rotate in the world: one that only slides hides where its mass is."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    while body > 0:
        first = int(model.body_jntadr[body])
        kinds = model.jnt_type[first : first + int(model.body_jntnum[body])] if first >= 0 else []
        if any(int(k) != int(mujoco.mjtJoint.mjJNT_SLIDE) for k in kinds):
            return True
        body = int(model.body_parentid[body])
    return False


def _complete(model: mujoco.MjModel) -> list[str]:
    """Moving bodies whose centre of mass may be moved (see `complete_inertia`)."""
    names = moving_bodies(model)
    return [n for n, b in zip(names, body_ids(model, names), strict=True) if model.body_simple[b] != _TURNING]


class Moved(Effect):
    """What the three share: named bodies."""

    def bind(self, model: mujoco.MjModel) -> None:
        self.bodies = body_ids(model, self.where)

    def _refuse_simple(self, model: mujoco.MjModel) -> None:
        for name, body in zip(self.where, self.bodies, strict=True):
            if model.body_simple[body] == _TURNING:
                raise InputError(
                    f"{self.family} at body {name!r}: the model was compiled with MuJoCo's simple-body "
                    "short cut, which fixes the centre of mass; compile it with simple='false' "
                    "(inertial.complete_inertia does so to a spec)"
                )


class Payload(Moved):
    """A point mass fixed to a body at (x, y, z) of the body's frame, m."""

    family = "payload"
    summary = "Point mass carried"
    PARAMS = (
        Param("mass", "kg", 0.0, 1e3, probes=(0.1,)),
        Param("x", "m", -1.0, 1.0, probes=(0.0, 0.1), shape=True),
        Param("y", "m", -1.0, 1.0, probes=(0.0, 0.1), shape=True),
        Param("z", "m", -1.0, 1.0, probes=(0.0, 0.1), shape=True),
    )

    def chart(self, theta: Array) -> Array:
        """Mass and first moments (m, m x, m y, m z): a body's motion shows these, and the place only through them."""
        return np.concatenate([theta[..., :1], theta[..., :1] * theta[..., 1:]], -1)

    def unchart(self, coordinates: Array) -> Array:
        mass = coordinates[..., :1]
        return np.concatenate([mass, coordinates[..., 1:] / np.where(np.abs(mass) > _NO_MASS, mass, _NO_MASS)], -1)

    def starts(self, theta: Array) -> Array:
        """The same moments about the middle of the body with other masses: lighter and farther out, heavier and nearer.

        A body whose own mass is free takes up what a lump weighs, and the motion then shows little but its moments.
        """
        middle, reach = (self.high + self.low)[1:] / 2, (self.high - self.low)[1:] / 2
        moments = np.outer(_GROWTH, theta[0] * (theta[1:] - middle))
        masses = (np.abs(moments) / reach).max(-1)[:, None] / np.array(_REACHES)
        places = middle + moments[:, None] / np.maximum(masses, _NO_MASS)[..., None]
        possible = (masses > _NO_MASS) & (masses < self.high[0])
        return np.column_stack([masses[possible], places[possible]])

    def outlying(self, theta: Array) -> float:
        """Of the way from the middle of the body to the edge of where a lump may lie: bodies are as large as that."""
        middle, reach = (self.high + self.low)[1:] / 2, (self.high - self.low)[1:] / 2
        return float(np.linalg.norm((theta[1:] - middle) / reach))

    def bind(self, model: mujoco.MjModel) -> None:
        super().bind(model)
        self._refuse_simple(model)

    def model(self, fields: ModelFields, theta: Array) -> None:
        for b in self.bodies:
            add_point_mass(fields, int(b), theta[..., 0], theta[..., 1:4])

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        names = _complete(model)
        for name, b in zip(names, body_ids(model, names), strict=True):
            mass, centre, extent = float(model.body_mass[b]), model.body_ipos[b], gyration(model, int(b))
            sizes = {"mass": {"probes": (0.15 * mass,), "high": 3 * mass, "resolution": 2e-3 * mass}}
            for axis, c in zip("xyz", centre.tolist(), strict=True):
                sizes[axis] = {"probes": (c, c + extent), "low": c - 5 * extent, "high": c + 5 * extent}
            out.append(cls((name,), sized(cls.PARAMS, **sizes)))
        return out


def add_point_mass(fields: ModelFields, body: int, mass: Array, place: Array) -> None:
    """Fix a point mass (...,), kg, at `place` (..., 3) of a body's frame: mass, centre and principal inertia, in place.

    About the common centre the two add mu (|d|^2 1 - d d'), mu the reduced mass and d the way from the old centre. What
    holds a body up against gravity (`gravcomp`, a share of its weight) does not grow with what is put on it; MuJoCo
    has it act at the common centre. Of a simple body, which only slides, the mass alone counts.
    """
    masses = fields["body_mass"]
    old = masses[..., body].copy()
    whole = old + mass
    share = (mass / np.where(whole > 0, whole, 1.0))[..., None]  # nothing that is put on nothing lies nowhere
    masses[..., body] = whole
    if fields.nominal_model.body_gravcomp[body]:
        fields["body_gravcomp"][..., body] *= 1 - share[..., 0]
    if fields.nominal_model.body_simple[body]:
        return
    iposes, inertias, iquats = fields["body_ipos"], fields["body_inertia"], fields["body_iquat"]
    quat = iquats[..., body, :]
    d = rotate_back(quat, place - iposes[..., body, :])
    reduced = (share[..., 0] * old)[..., None, None]
    outer = d[..., :, None] * d[..., None, :]
    matrix = reduced * ((d**2).sum(-1)[..., None, None] * np.eye(3) - outer)
    diagonal = np.arange(3)
    matrix[..., diagonal, diagonal] += inertias[..., body, :]
    moments, turn = principal(matrix)
    iposes[..., body, :] += share * (place - iposes[..., body, :])
    iquats[..., body, :] = quat_multiply(quat, turn)
    inertias[..., body, :] = moments


class ComShift(Moved):
    """Centre of mass moved by (x, y, z) along the body's axes, m; mass and inertia about it stay."""

    family = "com_shift"
    summary = "Centre of mass shifted"
    kin = ("payload",)  # what is left of a load whose weight a mass of psi has taken up
    PARAMS = tuple(Param(axis, "m", -0.5, 0.5, probes=(0.01,), resolution=2e-4) for axis in "xyz")

    def bind(self, model: mujoco.MjModel) -> None:
        super().bind(model)
        self._refuse_simple(model)

    def model(self, fields: ModelFields, theta: Array) -> None:
        fields["body_ipos"][..., self.bodies, :] += theta[..., None, :]

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        names = [n for n in _complete(model) if turns(model, n)]
        for name, b in zip(names, body_ids(model, names), strict=True):
            extent = gyration(model, int(b))
            size = {"probes": (0.2 * extent,), "low": -3 * extent, "high": 3 * extent, "resolution": 5e-3 * extent}
            out.append(cls((name,), sized(cls.PARAMS, x=size, y=size, z=size)))
        return out


class Inertia(Moved):
    """Principal moments of inertia times (x, y, z), in the order of the model's inertial frame; the mass stays."""

    family = "inertia"
    summary = "Principal moments of inertia scaled"
    PARAMS = tuple(Param(axis, "1", 0.3, 3.0, null=1.0, probes=(1.2,), resolution=0.005) for axis in "xyz")

    def model(self, fields: ModelFields, theta: Array) -> None:
        fields["body_inertia"][..., self.bodies, :] *= theta[..., None, :]

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        return [cls((name,), cls.PARAMS) for name in moving_bodies(model) if turns(model, name)]
