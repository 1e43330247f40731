"""A robot in an upright mirror along its way: left is right, and what turns one way turns the other.

Each of the robots is its own mirror image, but for psi, which changes sides with the parts that it belongs to. So a
window of motion in a mirror is a window of the same simulator, whose psi is known: what a network learns from one it
may learn from the other. How entries go over into one another follows from their names (`components`), where parts of
the two sides are called alike, and from the model: joints' axes and the frames of sensors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.components import OBSERVED

Array = NDArray[np.float64]
_ACROSS = np.diag([1.0, -1.0, 1.0])  # of vectors; what turns goes with it to the other side of the mirror as well
_SIDES = {"left": "right", "right": "left", "FL": "FR", "FR": "FL", "RL": "RR", "RR": "RL"}
_SIGNS = {
    **{("vector", axis): 1 - 2 * (axis == "y") for axis in "xyz"},
    **{("axial", axis): 2 * (axis == "y") - 1 for axis in "xyz"},
    **{("quat", axis): 1 - 2 * (axis in "xz") for axis in "wxyz"},
}


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
    names: Sequence[str], psi: Sequence[str], parts: Sequence[Signed], actions: Signed, model: mujoco.MjModel
) -> Mirror:  # fmt: skip
    """The mirror of a robot.

    Args:
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
            other = opposite(of)
            index[i], sign[i] = at[f"joint:{other}:{quantity}"], joint_sign(model, of, other)
        else:
            what, _, axis = quantity.rpartition(".")
            what = {"quat": "quat", "angvel": "axial"}.get(what.removesuffix("@body"), "vector")
            sign[i] = _SIGNS[what, axis]
    seen, whole = np.flatnonzero([name == OBSERVED for name in names]), together(parts)
    index[seen], sign[seen] = seen[whole.index], whole.sign
    place = {name: i for i, name in enumerate(psi)}
    return Mirror(Signed(index, sign), actions, np.array([place[opposite(name)] for name in psi]))


def opposite(name: str) -> str:
    """What the part of that name is called on the other side; one in the middle is its own opposite."""
    return "_".join(_SIDES.get(word, word) for word in name.split("_"))


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


def jointwise(model: mujoco.MjModel, joints: Sequence[str]) -> Signed:
    """An angle, a speed or a torque of each joint."""
    others = [opposite(name) for name in joints]
    signs = [joint_sign(model, *pair) for pair in zip(joints, others, strict=True)]
    return Signed(np.array([list(joints).index(name) for name in others]), np.array(signs))


def joint_sign(model: mujoco.MjModel, one: str, other: str) -> float:
    """Whether a hinge and its opposite turn the same way about their axes, 1, or opposite ways, -1, in the mirror."""
    data = _at_rest(model)
    axes = [data.xaxis[model.joint(name).id] for name in (one, other)]
    return _whole(-_ACROSS @ axes[0] @ axes[1])


def sensorwise(model: mujoco.MjModel, sensors: Sequence[str]) -> Signed:
    """Forces and torques (3) of sites, in the sites' own frames, one sensor after the other."""
    data, index, signs = _at_rest(model), [], []
    for name in sensors:
        sensor, other = model.sensor(name), model.sensor(opposite(name))
        here, there = (data.site_xmat[int(s.objid[0])].reshape(3, 3) for s in (other, sensor))
        turns = int(sensor.type[0]) == int(mujoco.mjtSensor.mjSENS_TORQUE)
        across = there.T @ (-_ACROSS if turns else _ACROSS) @ here  # other's entries -> this one's, in the mirror
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
