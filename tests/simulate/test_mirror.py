"""A window in a mirror is what the simulator makes of psi with its sides, or ends, changed: robots are own images."""

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from nfc_gym.envs.mirror import ENDS, SIDES, Mirror, Plane, jointwise
from nfc_gym.inference.windows import Batch
from nfc_gym.simulate.ceiling import replayed
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.trials import trials

Array = NDArray[np.float64]
IMAGES = [
    *((robot, SIDES) for robot in ("Jackal", "Ant", "Quadruped", "Humanoid", "Quadcopter")),
    *((robot, ENDS) for robot in ("Jackal", "Ant", "Quadcopter")),
]
STEPS = 12  # of control; contacts make rounding grow


def on_a_plane(start: Array, actions: Array) -> Batch:
    """A window for `replayed`; the solver's warm start, which belongs to one side, is left out."""
    where = {f"terrain_{name}": np.zeros(1, int) for name in ("kind", "seed", "difficulty")}
    return {"start": start[None], "actions": actions, **where}


def states(machine: Machine, start: Array, plane: Plane | None) -> Array:
    """The simulator's state with no warm start, as it is or in a mirror."""
    model, kind = machine.model, mujoco.mjtState.mjSTATE_INTEGRATION
    data, out = mujoco.MjData(model), np.empty_like(start, dtype=float)
    mujoco.mj_setState(model, data, start.astype(float), kind)
    data.qacc_warmstart[:] = 0
    if plane is not None:
        joints = jointwise(plane, model, [model.joint(j).name for j in range(1, model.njnt)])
        moves = [1 - 2 * (axis == plane.normal) for axis in "xyz"]
        turns = [-sign for sign in moves]
        data.qpos[:7] *= (*moves, 1, *turns)
        data.qvel[:6] *= (*moves, *turns)
        data.qpos[7:], data.qvel[6:] = joints(data.qpos[7:].copy()), joints(data.qvel[6:].copy())
        if model.na:
            data.act[:] = image_of(machine, plane).actions(data.act.copy())
    mujoco.mj_getState(model, data, out, kind)
    return out


def image_of(machine: Machine, plane: Plane) -> Mirror:
    """The machine's in that mirror."""
    return machine.mirrors[machine.kind.planes.index(plane)]


@pytest.mark.parametrize(("robot", "plane"), IMAGES, ids=[f"{robot}-{plane.normal}" for robot, plane in IMAGES])
def test_the_mirrored_window_is_what_mirrored_psi_makes(robot: str, plane: Plane) -> None:
    machine, rng = Machine(f"nfc_gym/{robot}Flat-v0"), np.random.default_rng(3)
    space, image = machine.space, image_of(machine, plane)
    u = rng.uniform(0.2, 0.8, (2, len(space)))
    made = trials(machine, space.low + u * (space.high - space.low), seed=1)
    for i in range(len(made["start"])):
        start, actions = made["start"][i], made["actions"][i : i + 1, :STEPS]
        window = on_a_plane(states(machine, start, None), actions)
        mirrored = on_a_plane(states(machine, start, plane), image.actions(actions))
        still = np.zeros((1, STEPS, machine.kind.action_size))
        seen = replayed(machine, window, u[i : i + 1], still, 1).reshape(STEPS, -1)
        found = replayed(machine, mirrored, u[i : i + 1, image.psi], still, 1).reshape(STEPS, -1)
        expected = image.states(seen)
        if plane is ENDS:  # who turns his back on a target has it ahead in this mirror
            found[:, machine.aims] = expected[:, machine.aims]
        # Velocities of joints that bump against stops are the largest numbers, some tens.
        np.testing.assert_allclose(found, expected, atol=1e-6 * max(1.0, np.abs(seen).max()))
        assert np.abs(found - seen).max() > 1e-2  # it is not the same motion
