"""Where a window may have begun: the states of the simulator that its first observation leaves open, on a plane.

Windows that were simulated say how starts x go with first observations y and with psi. Of those that were seen most
like the window at hand each start is moved along a regression from its own y and psi to those that are asked for,
x + B (y' - y, psi' - psi): where that is linear, draws of p(x | y', psi') with whatever spread it has (Beaumont, Zhang
and Balding 2002). Most alike are those of which a regression over all windows expects the same start (Fearnhead and
Prangle 2012). How high a robot stands is no such thing: whether a foot touches the ground decides what it does next.
So a start that touched the ground does so again, as deep as before.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.quadcopter import Quadcopter
from nfc_gym.envs.runner import Runner
from nfc_gym.inference.windows import Batch
from nfc_gym.physics.state import quat_multiply, quat_to_vector, rotate, rotate_back, vector_to_quat
from nfc_gym.physics.state import yaw as yaw_of
from nfc_gym.simulate.machine import Machine

Array = NDArray[np.float64]
LEAST = 200  # windows that starts are learned from
_NEAR = 0.2  # of all windows: those that starts are taken from, the nearest,
_EACH = 4  # and no fewer for each number that a regression is made on
_TOUCHES = 0.01  # m above the ground, below which a start touches it
_YAW = 7  # entry of a runner's `proprio`
_GOAL = (0, 1, 2)  # entries of a Quadcopter's


class Likely:
    """Starts that a first observation leaves open.

    Args:
      machine: the robot, on a plane.
      windows: simulated, as of `simulate.Simulator.draw` with `states`, `start` and `psi` among its names.
      first: (s,) `proprio` as observed.

    Raises:
      InputError: rough ground, too few windows, or an observation of another robot.
    """

    def __init__(self, machine: Machine, windows: Batch, first: Array) -> None:
        if machine.rough:
            raise InputError(f"{machine.environment}: where a window may have begun is told on a plane only")
        seen = np.concatenate([np.asarray(first, float)[None], np.asarray(windows["states"], float)[:, 0]])
        n, size = len(seen) - 1, machine.kind.proprio_size
        if n < LEAST or np.shape(first) != (size,) or not np.isfinite(seen).all():
            raise InputError(
                f"starts of {machine.environment}: want {LEAST} windows or more and a finite observation of {size} "
                f"entries, got {n} and shape {np.shape(first)}"
            )
        self.machine, self.first = machine, seen[0]
        starts, self._above = _known(machine, np.asarray(windows["start"], float))
        told, psi = _level(machine, seen), np.asarray(windows["psi"], float)
        expected = told @ _slopes(told[1:], starts).T
        scale = np.maximum((starts - expected[1:]).std(0) + 1e-3 * starts.std(0), 1e-9)
        away = np.square((expected[1:] - expected[0]) / scale).sum(1)
        inputs = np.concatenate([told[1:], psi], 1)
        near = np.argsort(away)[: max(LEAST, round(_NEAR * n), _EACH * inputs.shape[1])]
        self._slope = _slopes(inputs[near], starts[near])
        self._seen, self._at = inputs[near], told[0]
        self._starts, self._above = starts[near], self._above[near]

    def draw(self, u: Array, rng: np.random.Generator) -> Array:
        """(n, nq + nv + na) positions, velocities and actuators' states, one for each psi u (n, d), 0 to 1."""
        rows = rng.integers(len(self._starts), size=len(u))
        wanted = np.concatenate([np.broadcast_to(self._at, (len(u), len(self._at))), u], 1)
        own = self._starts[rows] + (wanted - self._seen[rows]) @ self._slope.T
        yaw, place = _heading(self.machine, self.first, len(u), rng)
        out = _placed(self.machine, own, yaw, place, self._above[rows])
        if quat := _quat(self.machine):  # which of the two that say the same is observed has no meaning, but is seen
            out[:, 3:7] *= np.where(out[:, 3:7] @ self.first[quat] < 0, -1.0, 1.0)[:, None]
        return out


def _slopes(inputs: Array, outputs: Array) -> Array:
    """(k, m) of a least-squares plane through outputs (n, k) over inputs (n, m); 0 for an input that never varies."""
    middle, spread = inputs.mean(0), inputs.std(0)
    varies = spread > 1e-9
    scaled = (inputs - middle)[:, varies] / spread[varies]
    out = np.zeros((outputs.shape[1], inputs.shape[1]))
    solved = np.linalg.lstsq(scaled, outputs - outputs.mean(0), rcond=1e-6)[0]
    out[:, varies] = solved.T / spread[varies]
    return out


def _known(machine: Machine, start: Array) -> tuple[Array, Array]:
    """(n, 1 + 3 + hinges + nv + na) starts whichever way they face, and (n,) m, how far above the ground they are."""
    model = machine.model
    data, kind = mujoco.MjData(model), mujoco.mjtState.mjSTATE_INTEGRATION
    out, above = np.empty((len(start), model.nv - 2 + model.nv + model.na)), np.empty(len(start))
    geoms, floor = touching(model)
    for i, state in enumerate(np.ascontiguousarray(start)):
        mujoco.mj_setState(model, data, state, kind)
        above[i] = lowest(model, data, geoms, floor)
        quat = data.qpos[3:7]
        tilt = quat_multiply(_turn(-yaw_of(quat)), quat)
        speed = rotate_back(quat, data.qvel[:3])
        out[i] = np.concatenate([data.qpos[2:3], quat_to_vector(tilt), data.qpos[7:], speed, data.qvel[3:], data.act])
    return out, above


def _placed(machine: Machine, own: Array, yaw: Array, place: Array, above: Array) -> Array:
    """(n, nq + nv + na) of what `_known` makes of them."""
    model = machine.model
    joints, hinges = 4, model.nq - 7
    quat = quat_multiply(_turn(yaw), vector_to_quat(own[:, 1:joints]))
    moving = own[:, joints + hinges :].copy()
    moving[:, :3] = rotate(quat, moving[:, :3])
    out = np.concatenate([place, own[:, :1], quat, own[:, joints : joints + hinges], moving], 1)
    data, (geoms, floor) = mujoco.MjData(model), touching(model)
    for row, wanted in zip(out, above, strict=True):
        data.qpos[:] = row[: model.nq]
        is_at = lowest(model, data, geoms, floor)
        if wanted < _TOUCHES or is_at < 0:
            row[2] += wanted - is_at
    return out


def touching(model: mujoco.MjModel) -> tuple[list[int], int]:
    """Geoms that the plane stops, and the plane."""
    floor = int(np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))[0])
    with_floor = (model.geom_contype & model.geom_conaffinity[floor]) | (
        model.geom_conaffinity & model.geom_contype[floor]
    )
    return [int(g) for g in np.flatnonzero(with_floor) if g != floor], floor


def lowest(model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int], floor: int) -> float:
    """m between the plane and the lowest of some geoms."""
    mujoco.mj_kinematics(model, data)
    return min(mujoco.mj_geomDistance(model, data, floor, g, 10.0, None) for g in geoms)


def _turn(yaw: Array) -> Array:
    """Quaternions (..., 4) of turns about the vertical."""
    zero = np.zeros_like(yaw)
    return np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], -1)


def _quat(machine: Machine) -> list[int]:
    """Entries of `proprio` that are the attitude; none where it does not hold that."""
    return [i for i, name in enumerate(machine.state_names) if ":quat." in name]


def _level(machine: Machine, seen: Array) -> Array:
    """What first observations (n, s) tell of the robot itself, as if it faced along x at the origin of a plane."""
    names, out = machine.state_names, seen.copy()
    if quat := _quat(machine):
        back = _turn(-yaw_of(seen[:, quat]))
        level = quat_multiply(back, seen[:, quat])
        out[:, quat] = level * np.where(level[:, :1] < 0, -1, 1)
        for what in ("linvel", "angvel"):
            at = [i for i, name in enumerate(names) if f":{what}." in name]
            if at:
                out[:, at] = rotate(back, seen[:, at])
    nowhere = {i for i, name in enumerate(names) if name.endswith((":pos.x", ":pos.y"))}
    if issubclass(machine.kind, Runner):
        nowhere |= {_YAW, *machine.aims}
    elif issubclass(machine.kind, Quadcopter):
        nowhere |= {*_GOAL}
    return np.delete(out, sorted(nowhere), 1)


def _heading(machine: Machine, first: Array, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """(n,) rad and (n, 2) m: which way the robot may have faced, and where it was, as far as that was observed."""
    yaw, names, noise = np.zeros(n), machine.state_names, machine.noise
    if quat := _quat(machine):
        yaw = yaw_of(first[quat] + noise[quat] * rng.standard_normal((n, 4)))
    elif issubclass(machine.kind, Runner):
        yaw = first[_YAW] + noise[_YAW] * rng.standard_normal(n)
    at = [i for i, name in enumerate(names) if name.endswith((":pos.x", ":pos.y"))]
    place = first[at] + noise[at] * rng.standard_normal((n, 2)) if len(at) == 2 else np.zeros((n, 2))
    return yaw, place
