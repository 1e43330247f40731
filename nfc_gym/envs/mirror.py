"""A robot in an upright mirror: along its way left is right, across it front is rear.

Each of the robots is its own mirror image along its way, but for psi, which changes sides with the parts that it
belongs to; some are across it too. So a window of motion in a mirror is a window of the same simulator, whose psi is
known: what a network learns from one it may learn from the other. How entries go over into one another follows from
their names (`components`), where parts that change places are called alike, and from the model: joints' axes and the
frames of sensors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.components import OBSERVED

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plane:
    """Where the mirror stands, upright through the robot's middle.

    Attributes:
      normal: axis of the robot that changes its direction.
      places: words in names of parts, and those that they become.
    """

    normal: str
    places: Mapping[str, str]

    def vector(self, axis: str) -> int:
        """Sign of that entry (x, y or z) of what has a direction: a velocity, a force."""
        return -1 if axis == self.normal else 1

    def axial(self, axis: str) -> int:
        """Sign of that entry of what turns: rates, torques, the vector part of a quaternion."""
        return -self.vector(axis)

    @property
    def across(self) -> Array:
        """(3, 3) what it does to vectors."""
        return np.diag([float(self.vector(axis)) for axis in "xyz"])

    def opposite(self, name: str) -> str:
        """What the part of that name becomes; one in the middle is its own opposite."""
        return "_".join(self.places.get(word, word) for word in name.split("_"))


SIDES = Plane("y", {"left": "right", "right": "left", "FL": "FR", "FR": "FL", "RL": "RR", "RR": "RL"})
ENDS = Plane("x", {"front": "rear", "rear": "front"})


@dataclass(frozen=True)
class Signed:
    """Entries that change places and signs.

    Attributes:
      index: (k,) of the entry that goes to each place.
      sign: (k,) 1 or -1.
    """

    index: NDArray[np.intp]
    sign: Array

    def __call__(self, values: NDArray) -> NDArray:
        """(..., k) values in the mirror."""
        return values[..., self.index] * self.sign.astype(values.dtype)


class Mirror(NamedTuple):
    """How a robot's windows look in a mirror.

    Attributes:
      states: entries of `proprio`.
      actions: of the action.
      psi: (d,) index of the parameter that goes to each place.
    """

    states: Signed
    actions: Signed
    psi: NDArray[np.intp]


def mirror(
    plane: Plane, names: Sequence[str], psi: Sequence[str], parts: Sequence[Signed], actions: Signed,
    model: mujoco.MjModel,
) -> Mirror:  # fmt: skip
    """A mirror of a robot.

    Args:
      plane: where it stands.
      names: of the entries of `proprio`, see `components`.
      psi: names of the parameters.
      parts: what stands behind the entries that are only observed, one part after the other.
      actions: of the action.
      model: of the robot.
    """
    at = {name: i for i, name in enumerate(names) if name != OBSERVED}
    index, sign = np.arange(len(names)), np.ones(len(names))
    for name, i in at.items():
        kind, of, quantity = name.split(":")
        if kind == "joint":
            other = plane.opposite(of)
            index[i], sign[i] = at[f"joint:{other}:{quantity}"], joint_sign(plane, model, of, other)
        else:
            what, _, axis = quantity.rpartition(".")
            turns = what.removesuffix("@body") in ("quat", "angvel")
            sign[i] = 1 if axis == "w" else plane.axial(axis) if turns else plane.vector(axis)
    seen, whole = np.flatnonzero([name == OBSERVED for name in names]), together(parts)
    index[seen], sign[seen] = seen[whole.index], whole.sign
    place = {name: i for i, name in enumerate(psi)}
    return Mirror(Signed(index, sign), actions, np.array([place[plane.opposite(name)] for name in psi]))


def fixed(*signs: int) -> Signed:
    """Entries that keep their places."""
    return Signed(np.arange(len(signs)), np.array(signs, float))


def together(parts: Sequence[Signed]) -> Signed:
    """Parts that follow one another, as one."""
    begins = np.cumsum([0, *(len(p.index) for p in parts)])
    return Signed(
        np.concatenate([p.index + begin for p, begin in zip(parts, begins[:-1], strict=True)]).astype(np.intp),
        np.concatenate([p.sign for p in parts]),
    )


def jointwise(plane: Plane, model: mujoco.MjModel, joints: Sequence[str]) -> Signed:
    """An angle, a speed or a torque of each joint."""
    others = [plane.opposite(name) for name in joints]
    signs = [joint_sign(plane, model, *pair) for pair in zip(joints, others, strict=True)]
    return Signed(np.array([list(joints).index(name) for name in others]), np.array(signs))


def joint_sign(plane: Plane, model: mujoco.MjModel, one: str, other: str) -> float:
    """Whether a hinge and its opposite turn the same way about their axes, 1, or opposite ways, -1, in the mirror."""
    data = _at_rest(model)
    axes = [data.xaxis[model.joint(name).id] for name in (one, other)]
    return _whole(-plane.across @ axes[0] @ axes[1])


def sensorwise(plane: Plane, model: mujoco.MjModel, sensors: Sequence[str]) -> Signed:
    """Forces and torques (3) of sites, in the sites' own frames, one sensor after the other."""
    data, index, signs = _at_rest(model), [], []
    for name in sensors:
        sensor, other = model.sensor(name), model.sensor(plane.opposite(name))
        here, there = (data.site_xmat[int(s.objid[0])].reshape(3, 3) for s in (other, sensor))
        turns = int(sensor.type[0]) == int(mujoco.mjtSensor.mjSENS_TORQUE)
        across = there.T @ (-plane.across if turns else plane.across) @ here  # other's entries -> this one's
        entry = np.abs(across).argmax(1)
        index.extend(3 * list(sensors).index(other.name) + entry)
        signs.extend(_whole(across[row, column]) for row, column in enumerate(entry))
    return Signed(np.array(index), np.array(signs))


def _at_rest(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


def _whole(value: float) -> float:
    """1 or -1, where a model is its own mirror image."""
    assert abs(abs(value) - 1) < 1e-6, f"not a mirror image: {value}"
    return float(np.sign(value))
