"""Random stacks of wrappers around a batch: each row is the single environment in the same stack, to the bit."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fakes import same
from gymnasium.vector import AutoresetMode

import nfc_gym.wrappers

N, STEPS = 3, 30
JOINT = {"Jackal": "rear_left_wheel", "Ant": "front_left_hip", "Quadruped": "FL_knee"}
MOTOR = {"Jackal": "front_left", "Ant": "front_left_hip"}


class Largest:
    """Scores a transition by its largest action."""

    threshold = 0.5

    def reset(self, rows: Any = None) -> None: ...

    def update(self, obs: Any, action: Any, next_obs: Any) -> Any:
        return np.abs(action).max(-1)


def arguments(robot: str, key: str, model: Any, space: Any, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Wrappers that draw nothing, with arguments under which they act."""
    effects = [{"family": "coulomb", "where": JOINT[robot], "parameters": {"level": 0.5}}] if robot in JOINT else []
    if robot in MOTOR:
        effects.append({"family": "delay", "where": MOTOR[robot], "parameters": {"delay": 0.017}})
    fault = {"bias": 0.03, "delay": int(rng.integers(3))}
    return {
        "RandomizePsi": {"distribution": space.low + (space.high - space.low) * rng.random(len(space))},
        "ResidualDynamics": {
            "source": 0.05 * rng.standard_normal(model.nv),
            "mode": str(rng.choice(["force", "state"])),
        },
        "ResidualTerrain": {"source": 0.1 * rng.random((256, 256))},
        "ApplyEffects": {"effects": effects},
        "PerturbSignals": {"noise": {key: fault, "action": {"bias": 0.1, "delay": int(rng.integers(3))}}},
        "MonitorAnomaly": {"detector": Largest()},
    }


def row(result: Any, k: int) -> dict[str, Any]:
    """What a batch says of one row: an observation or an `info`, less Gymnasium's masks and the last episode's."""
    if not isinstance(result, dict):
        return result[k]
    return {key: row(value, k) for key, value in result.items() if not key.startswith(("_", "final_"))}


class Pairs:
    """A batch in a stack of wrappers, and single environments in the same stack, led through the same."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.mode = rng, list(AutoresetMode)[rng.integers(3)]
        robot = str(rng.choice(["Jackal", "Ant", "Quadcopter", "Quadruped", "Humanoid"]))
        self.rough = bool(rng.random() < 0.5)
        name = f"nfc_gym/{robot}{'Rough' if self.rough else 'Flat'}-v0"
        context = [["psi"], ["psi", "elevation"], []][rng.integers(3)]
        kwargs: dict[str, Any] = {
            "context": context,
            "terrain_pool": 2,
            "max_episode_steps": int(rng.integers(3, STEPS)),
        }
        if context and rng.random() < 0.3:
            kwargs["elevation_hz"] = 10
        bare = gym.make(name, **kwargs).unwrapped
        self.space = bare.psi_space
        given = arguments(robot, "proprio" if context else "observation", bare.model, self.space, rng)
        if not self.rough:
            del given["ResidualTerrain"]
        self.stack = [str(w) for w in rng.permutation(list(given)) if rng.random() < 0.6]
        batch: Any = gym.make_vec(name, num_envs=N, autoreset_mode=self.mode, nthread=1, **kwargs)
        self.each: list[Any] = [gym.make(name, **kwargs) for _ in range(N)]
        for wrapper in self.stack:
            batch = getattr(nfc_gym.wrappers, f"Vector{wrapper}")(batch, **given[wrapper])
            self.each = [getattr(nfc_gym.wrappers, wrapper)(env, **given[wrapper]) for env in self.each]
        self.batch, self.done = batch, np.zeros(N, bool)

    def reset(self, mask: np.ndarray | None, seed: Any) -> None:
        """All, or some in the midst of their episodes, perhaps with psi and ground of their own."""
        options: dict[str, Any] = {} if mask is None else {"reset_mask": mask.copy()}
        if mask is not None and self.rng.random() < 0.5:
            options["psi"] = self.space.low + (self.space.high - self.space.low) * self.rng.random((N, len(self.space)))
        if self.rough and self.rng.random() < 0.5:
            options["terrain_id"] = self.rng.integers(0, 2, N)
        observation, info = self.batch.reset(seed=seed, options=dict(options))
        for k in range(N) if mask is None else np.flatnonzero(mask):
            own = {name: value[k] for name, value in options.items() if name != "reset_mask"}
            one = self.each[k].reset(seed=None if seed is None else seed + int(k), options=own or None)
            same((row(observation, k), row(info, k)), one)
            self.done[k] = False

    def step(self) -> None:
        action = self.rng.uniform(-1.3, 1.3, self.batch.action_space.shape)
        observation, reward, terminated, truncated, info = self.batch.step(action)
        for k, env in enumerate(self.each):
            now = (row(observation, k), row(info, k))
            if self.done[k] and self.mode is AutoresetMode.NEXT_STEP:
                same(now, env.reset())
                assert (reward[k], terminated[k], truncated[k]) == (0, False, False)
                self.done[k] = False
                continue
            own, *rest, told = env.step(action[k])
            assert (reward[k], terminated[k], truncated[k]) == tuple(rest)
            self.done[k] = rest[1] or rest[2]
            if self.done[k] and self.mode is AutoresetMode.SAME_STEP:
                same((info["final_obs"][k], row(info["final_info"], k)), (own, told))
                same(now, env.reset())
            else:
                same(now, (own, told))


@pytest.mark.parametrize("trial", range(12))
def test_a_row_is_the_single_environment_in_the_same_stack(trial: int) -> None:
    rng = np.random.default_rng(trial)
    pairs = Pairs(rng)
    pairs.reset(None, seed=int(rng.integers(1000)))
    for _ in range(STEPS):
        ended = pairs.done if pairs.mode is AutoresetMode.DISABLED else np.zeros(N, bool)
        mask = ended | (rng.random(N) < 0.5) if rng.random() < 0.1 else ended.copy()
        if mask.any():
            pairs.reset(mask, seed=None)
        pairs.step()
