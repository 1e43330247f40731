"""Recorded motion under the psi that it was recorded under is that motion; under another psi it is another."""

import gymnasium as gym
import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.simulate import Simulator
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.recorded import Recorded

torch = pytest.importorskip("torch")


def recorded(name: str, psi: dict[str, float], windows: int = 3) -> Recorded:
    """A robot that is commanded at random, its state as the simulation knows it."""
    machine, env = Machine(name), gym.make(name, context=["psi"])
    observation, _ = env.reset(seed=0, options={"psi": psi})
    rng, data, action = np.random.default_rng(1), env.unwrapped.data, np.zeros(machine.kind.action_size)
    states, starts, actions = [observation["proprio"]], [], []
    for _ in range(windows * machine.habit.horizon):
        starts.append(np.concatenate([data.qpos, data.qvel, data.act]))
        action = np.clip(0.9 * action + 0.2 * rng.standard_normal(len(action)), -1, 1).astype(np.float32)
        observation, _, ended, *_ = env.step(action)
        assert not ended
        states.append(observation["proprio"])
        actions.append(action)
    h = machine.habit.horizon
    at = np.arange(windows) * h
    every = [np.array([x[i : i + k] for i in at], float) for x, k in ((states, h + 1), (actions, h))]
    return Recorded(np.array(starts)[at], *every)


@pytest.mark.parametrize(
    ("name", "psi"),
    [
        ("nfc_gym/JackalFlat-v0", {"base_mass": 25.0}),
        ("nfc_gym/QuadrupedFlat-v0", {"base_mass": 7.0}),
        ("nfc_gym/QuadcopterFlat-v0", {}),
    ],
)
def test_the_same_psi_moves_the_same(name: str, psi: dict[str, float]) -> None:
    motion, space = recorded(name, psi, 1), Machine(name).space
    own = np.array([psi.get(n, v) for n, v in zip(space.names, space.nominal, strict=True)])
    again = Simulator(name, effects=0.0, motor=0.0, noise=0.0, jobs=1, recorded=motion)
    found = again(np.tile(own, (2, 1)), np.random.default_rng(0))
    np.testing.assert_allclose(found["actions"][0], motion.actions[0], atol=1e-6)
    np.testing.assert_allclose(found["states"][0], motion.states[0], atol=2e-3)
    far = np.clip(own * 1.3, space.low, space.high)
    other = again(far[None], np.random.default_rng(0))["states"][0]
    assert (
        np.abs(other[-1] - motion.states[0, -1]).max()
        > 10 * np.abs(found["states"][0, -1] - motion.states[0, -1]).max()
    )


def test_psi_is_the_priors_and_effects_are_labelled() -> None:
    name = "nfc_gym/JackalFlat-v0"
    found = Simulator(name, jobs=1, recorded=recorded(name, {}))
    batch = found.draw(64, np.random.default_rng(0))
    assert batch["psi"].shape == (64, 17)
    assert 0.4 < batch["psi"].mean() < 0.6
    assert batch["psi"].std() > 0.25
    struck = batch["family"] > 0
    assert 0.2 < struck.double().mean() < 0.8
    assert (batch["delta_s"][struck].abs().sum(1) > 0).any()
    assert (batch["delta_s"][~struck] == 0).all()
    assert len(torch.unique(batch["actions"], dim=0)) == 3, "each of some stretch of the motion"


def test_motion_of_another_robot_is_refused() -> None:
    motion = recorded("nfc_gym/JackalFlat-v0", {}, 1)
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="starts has shape"):
        Simulator("nfc_gym/AntFlat-v0", recorded=motion).draw(2, rng)
    with pytest.raises(InputError, match=r"0 maps for nfc_gym/JackalRough-v0; want some"):
        Simulator("nfc_gym/JackalRough-v0", recorded=motion).draw(2, rng)
    short = Recorded(motion.starts, motion.states[:, :-1], motion.actions)
    with pytest.raises(InputError, match="states has shape"):
        Simulator("nfc_gym/JackalFlat-v0", recorded=short).draw(2, rng)
