"""Policies by name: `random`, `falco`, or one that `nfc-gym pretrain` made."""

import time
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from nfc_gym.core.errors import InputError

from .falco import Falco
from .judge import Episodes, Policy, Uniform, judge
from .world import World

NAMED = ("random", "falco")
LONG = 1500  # control steps that are given for a lap of the figure of eight
TIMED = (5, 100, 1.0)  # decisions that warm up, those that are timed at most, and s after which no more are
LAPS = {"jackal": 20.0, "quadcopter": 10.0}  # s, after which the point that is to be followed begins its second


def player(name: str, world: World, seed: int) -> Policy:
    """A policy for a world's robot.

    Args:
      name: one of `NAMED`, the path of a policy's safetensors file, or the id of an environment whose policy comes with
        the package.
      world: where it is to act.
      seed: of what it draws.

    Raises:
      InputError: Falco drives a Jackal alone; no such policy.
    """
    if name == "random":
        return Uniform(world.kind.action_size, seed)
    if name == "falco":
        if world.robot != "jackal":
            raise InputError(f"falco drives a Jackal; {world.place} is none")
        return Falco()
    from nfc_gym.adaptation.policy import load_policy

    try:
        return load_policy(name)
    except InputError as error:
        raise InputError(f"policy {name!r} is neither falco nor random, nor a file or an id: {error}") from None


def seen_by(policy: Policy, world: World, num_envs: int, **settings: Any) -> VectorEnv:
    """A world as a policy looks at it: Falco at the whole map, those of the package at what they were trained on."""
    task = {"task": "figure8", "max_episode_steps": LONG, **settings} if settings.get("task") == "figure8" else settings
    if isinstance(policy, Falco):
        every = policy.gains.replan  # it looks at the map where it plans
        fresh = {} if world.engine != "mujoco" else {"elevation_hz": 50 / every}
        return world.make(num_envs, context=["elevation"], **fresh, **task)
    if isinstance(policy, Uniform):
        return world.make(num_envs, context=["psi"], **task)
    from nfc_gym.adaptation.sight import VectorSight

    return VectorSight(world.make(num_envs, context=world.context, autoreset_mode=AutoresetMode.DISABLED, **task))


def play(policy: Policy, world: World, episodes: int, seed: int, **settings: Any) -> Episodes:
    """Episodes of a policy in a world, all at once."""
    env = seen_by(policy, world, episodes, **settings)
    try:
        return judge(policy, env, seed, LAPS[world.robot] if settings.get("task") == "figure8" else None)
    finally:
        env.close()


def control_rate(policy: Policy, world: World, **settings: Any) -> float:
    """Decisions a second [Hz] that a policy makes for one robot, on this machine; simulating is not counted."""
    env = seen_by(policy, world, 1, **settings)
    begin = getattr(policy, "begin", None)
    if begin is not None:
        begin(1)
    observation, _ = env.reset(seed=0)
    warm, most, limit = TIMED
    spent, made = 0.0, -warm
    while made < most and spent < limit:
        began = time.perf_counter()
        action = np.asarray(policy(observation), float)
        spent += time.perf_counter() - began if made >= 0 else 0.0
        made += 1
        observation, _, ended, truncated, _ = env.step(action)
        if (ended | truncated).any():
            observation, _ = env.reset(seed=0)
    env.close()
    return made / spent
