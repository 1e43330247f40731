"""Residual dynamics: what delta_s means for the physical state, and how it is injected.

delta_s of the paper has the observation's components. Only those that are physical state can be injected, and they live
in tangent space: a velocity residual dv becomes the generalised force M dv / T over the control step T, so that
contacts answer to it and positions follow; a quaternion's residual becomes the rotation vector 2 vec(q* dq).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.fields import object_id
from nfc_gym.physics.state import quat_conjugate, quat_multiply, rotate, rotate_back

Array = NDArray[np.float64]
OBSERVED = "obs"
_FORM = re.compile(
    r"^(joint):(?P<joint>.+):(?P<jq>pos|vel)$"
    r"|^(body):(?P<body>.+):(?P<bq>pos|quat|linvel|angvel)(?P<own>@body)?\.(?P<axis>[wxyz])$"
)
_GRAMMAR = (
    "joint:<name>:pos|vel, body:<name>:pos|linvel|angvel.x|y|z (world frame; with @body before the dot, the body's "
    "own), "
    f"body:<name>:quat.w|x|y|z, or {OBSERVED} for what is no physical state"
)


@dataclass(frozen=True)
class _Vector:
    """Components of delta_s that form one vector of a free body."""

    quantity: str
    own_frame: bool
    qpos: int
    dof: int
    places: dict[int, int]  # axis -> component of delta_s


class Components:
    """What each entry of delta_s is, bound to a model.

    Args:
      model: the environment's model.
      names: one a component, in order; see `InputError` for the grammar. None with `size` nv means the velocities, with
        2 nv the tangent positions and then the velocities.
      size: length of delta_s.

    Raises:
      InputError: a name of another form or of nothing in the model, or a size that needs names.
    """

    def __init__(self, model: mujoco.MjModel, names: Sequence[str] | None, size: int) -> None:
        self.size, self.nv = size, int(model.nv)
        self.pairs: list[tuple[int, int]] = []  # (place in the tangent vector of 2 nv, component)
        self.vectors: dict[tuple[int, str, bool], _Vector] = {}
        self.observed = np.array([], np.intp)
        if names is None:
            self._plain(size)
        else:
            self._named(model, list(names))
        self.to = np.array([t for t, _ in self.pairs], np.intp)
        self.of = np.array([i for _, i in self.pairs], np.intp)
        self.direct = names is None  # velocities, or all of the tangent vector, in its order

    def _plain(self, size: int) -> None:
        if size not in (self.nv, 2 * self.nv):
            raise InputError(
                f"delta_s has {size} entries; without names for them it must have nv = {self.nv} (velocities) or "
                f"2 nv = {2 * self.nv} (tangent positions, velocities)"
            )
        self.pairs = [(self.nv + i if size == self.nv else i, i) for i in range(size)]

    def _named(self, model: mujoco.MjModel, names: list[str]) -> None:
        if len(names) != self.size:
            raise InputError(f"{len(names)} components are named where delta_s has {self.size} entries")
        self.observed = np.array([i for i, n in enumerate(names) if n == OBSERVED], np.intp)
        for i, name in enumerate(names):
            if name == OBSERVED:
                continue
            match = _FORM.match(name) if isinstance(name, str) else None
            if match is None:
                raise InputError(f"component {name!r} of delta_s: want {_GRAMMAR}")
            if match["joint"] is not None:
                joint = object_id(model, mujoco.mjtObj.mjOBJ_JOINT, match["joint"])
                if int(model.jnt_type[joint]) < int(mujoco.mjtJoint.mjJNT_SLIDE):
                    raise InputError(f"component {name!r} of delta_s: that joint is no hinge or slide; want {_GRAMMAR}")
                dof = int(model.jnt_dofadr[joint])
                self.pairs.append((dof if match["jq"] == "pos" else self.nv + dof, i))
            else:
                self._body(model, name, match, i)

    def _body(self, model: mujoco.MjModel, name: str, match: re.Match[str], i: int) -> None:
        body = object_id(model, mujoco.mjtObj.mjOBJ_BODY, match["body"])
        joint = int(model.body_jntadr[body])
        if joint < 0 or int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_FREE):
            raise InputError(f"component {name!r} of delta_s: body {match['body']!r} has no free joint")
        axis = "wxyz".index(match["axis"]) - (0 if match["bq"] == "quat" else 1)
        if axis < 0:
            raise InputError(f"component {name!r} of delta_s: only quaternions have a w; want {_GRAMMAR}")
        key = (body, match["bq"], match["own"] is not None)
        qpos, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self.vectors.setdefault(key, _Vector(match["bq"], key[2], qpos, dof, {})).places[axis] = i

    def velocity(self, qpos: Array, delta_s: Array) -> Array:
        """The velocities (..., nv) alone."""
        if self.direct:
            return delta_s[..., -self.nv :]
        return self.tangent(qpos, delta_s)[..., self.nv :]

    def tangent(self, qpos: Array, delta_s: Array) -> Array:
        """Tangent vector (..., 2 nv), positions then velocities, of delta_s (..., size) at configuration (..., nq)."""
        if self.direct and self.size == 2 * self.nv:
            return delta_s
        out = np.zeros((*delta_s.shape[:-1], 2 * self.nv))
        out[..., self.to] = delta_s[..., self.of]
        for vector in self.vectors.values():
            part = np.zeros((*delta_s.shape[:-1], 4 if vector.quantity == "quat" else 3))
            for axis, component in vector.places.items():
                part[..., axis] = delta_s[..., component]
            self._add(out, qpos, vector, part)
        return out

    def _add(self, out: Array, qpos: Array, vector: _Vector, part: Array) -> None:
        quat = qpos[..., vector.qpos + 3 : vector.qpos + 7]
        linear, angular = slice(vector.dof, vector.dof + 3), slice(vector.dof + 3, vector.dof + 6)
        position, velocity = out[..., : self.nv], out[..., self.nv :]
        if vector.quantity == "quat":
            position[..., angular] += 2 * quat_multiply(quat_conjugate(quat), part)[..., 1:]
        elif vector.quantity == "pos":
            position[..., linear] += rotate(quat, part) if vector.own_frame else part
        elif vector.quantity == "linvel":
            velocity[..., linear] += rotate(quat, part) if vector.own_frame else part
        else:
            velocity[..., angular] += part if vector.own_frame else rotate_back(quat, part)
