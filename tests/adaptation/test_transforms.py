"""The widened action as two keys of TorchRL's."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torchrl.envs import GymWrapper, TransformedEnv, check_env_specs

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.adaptation.transforms import SplitPiH
from nfc_gym.core.errors import InputError
from nfc_gym.wrappers import Hallucinate, VectorHallucinate

ID = "nfc_gym/JackalFlat-v0"


def posterior() -> np.ndarray:
    """Draws of psi around nominal."""
    env = gym.make(ID, context=["psi"])
    space = env.unwrapped.psi_space  # type: ignore[attr-defined]
    env.close()
    rng = np.random.default_rng(0)
    return np.clip(space.nominal * (1 + 0.02 * rng.standard_normal((64, len(space)))), space.low, space.high)


def single() -> Any:
    return Hallucinate(gym.make(ID, context=["psi"], max_episode_steps=20), posterior())


def several() -> Any:
    envs = gym.make_vec(ID, num_envs=2, context=["psi"], autoreset_mode="Disabled", max_episode_steps=20)
    return VectorHallucinate(envs, posterior())


@pytest.mark.parametrize("make", [single, several])
def test_the_robot_s_own_action_and_pi_h_are_two_keys(make: Any) -> None:
    wide = make()
    own, size = wide.own, wide.belief.size
    env = TransformedEnv(GymWrapper(wide), SplitPiH(own))
    check_env_specs(env)
    assert {str(key) for key in env.action_keys} == {"action", "pi_h"}
    assert env.full_action_spec["action"].shape[-1] == own == 2
    assert env.full_action_spec["pi_h"].shape[-1] == size == 17
    steps = env.rollout(30, break_when_any_done=False)  # past an episode's end
    assert steps["action"].shape[-1] == own
    assert steps["pi_h"].shape[-1] == size
    env.close()


def test_the_world_is_the_one_that_pi_h_asks_for() -> None:
    wide = single()
    env = TransformedEnv(GymWrapper(wide), SplitPiH(wide.own))
    psi = []
    for h in (-1.0, 0.0, 1.0):
        step = env.reset()
        env.step(step.set("action", torch.zeros(2)).set("pi_h", torch.full((17,), h)))
        psi.append(wide.unwrapped.psi.copy())
        np.testing.assert_allclose(psi[-1], wide.belief.at(np.full(17, h), wide.beta).psi)
    assert not np.allclose(psi[0], psi[1])
    assert not np.allclose(psi[2], psi[1])
    env.close()


def test_an_action_that_is_not_widened_is_told() -> None:
    env = TransformedEnv(GymWrapper(gym.make(ID, context=["psi"])), SplitPiH(2))
    with pytest.raises(InputError, match="own is 2"):
        _ = env.full_action_spec
    with pytest.raises(InputError, match="SplitPiH: own"):
        SplitPiH(0)
