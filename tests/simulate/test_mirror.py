"""A window in a mirror is what the simulator makes of psi with its sides changed: robots are their own mirror image."""

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from nfc_gym.envs.mirror import jointwise
from nfc_gym.inference.windows import Batch
from nfc_gym.simulate.ceiling import replayed
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.trials import trials

Array = NDArray[np.float64]
ROBOTS = ("Jackal", "Ant", "Quadruped", "Humanoid", "Quadcopter")
STEPS = 12  # of control; contacts make rounding grow


def on_a_plane(start: Array, actions: Array) -> Batch:
    """A window for `replayed`; the solver's warm start, which belongs to one side, is left out."""
    where = {f"terrain_{name}": np.zeros(1, int) for name in ("kind", "seed", "difficulty")}
    return {"start": start[None], "actions": actions, **where}


def states(machine: Machine, start: Array, reflect: bool) -> Array:
    """The simulator's state with no warm start, as it is or in a mirror."""
    model, kind = machine.model, mujoco.mjtState.mjSTATE_INTEGRATION
    data, out = mujoco.MjData(model), np.empty_like(start, dtype=float)
    mujoco.mj_setState(model, data, start.astype(float), kind)
    data.qacc_warmstart[:] = 0
    if reflect:
        joints = jointwise(model, [model.joint(j).name for j in range(1, model.njnt)])
        data.qpos[:7] *= (1, -1, 1, 1, -1, 1, -1)
        data.qvel[:6] *= (1, -1, 1, -1, 1, -1)
        data.qpos[7:], data.qvel[6:] = joints(data.qpos[7:].copy()), joints(data.qvel[6:].copy())
        if model.na:
            data.act[:] = machine.mirror.actions(data.act.copy())
    mujoco.mj_getState(model, data, out, kind)
    return out


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_mirrored_window_is_what_mirrored_psi_makes(robot: str) -> None:
    machine, rng = Machine(f"nfc_gym/{robot}Flat-v0"), np.random.default_rng(3)
    space, image = machine.space, machine.mirror
    u = rng.uniform(0.2, 0.8, (2, len(space)))
    made = trials(machine, space.low + u * (space.high - space.low), seed=1)
    for i in range(len(made["start"])):
        start, actions = made["start"][i], made["actions"][i : i + 1, :STEPS]
        window = on_a_plane(states(machine, start, False), actions)
        mirrored = on_a_plane(states(machine, start, True), image.actions(actions))
        still = np.zeros((1, STEPS, machine.kind.action_size))
        seen = replayed(machine, window, u[i : i + 1], still, 1).reshape(STEPS, -1)
        found = replayed(machine, mirrored, u[i : i + 1, image.psi], still, 1).reshape(STEPS, -1)
        # Velocities of joints that bump against stops are the largest numbers, some tens.
        np.testing.assert_allclose(found, image.states(seen), atol=1e-6 * max(1.0, np.abs(seen).max()))
        assert np.abs(found - seen).max() > 1e-2  # it is not the same motion
