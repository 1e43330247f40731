"""Copies and pickles of what is wrapped around environments that keep their model: edits do not add up."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fakes import FakeEnv, Own

from nfc_gym.wrappers import ApplyEffects, RandomizePsi


class Kept(FakeEnv):
    """Copied with its model as it is, as most people's `MujocoEnv` are."""

    __reduce__ = object.__reduce__
    __getstate__ = object.__getstate__  # type: ignore[assignment]

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


ROTOR = {"family": "armature", "where": "hinge", "parameters": {"inertia": 0.1}}
THICK = {"family": "damping_poly", "where": "hinge", "parameters": {"linear": 0.2, "quadratic": 0.1, "cubic": 0.0}}
LATE = {"family": "delay", "where": "twist", "parameters": {"delay": 0.03}}


@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("make", [Kept, Own])
def test_a_copy_of_a_copy_has_the_effects_once(make: Callable[[], Any], again: Callable[[Any], Any]) -> None:
    env = ApplyEffects(make(), [ROTOR, THICK, LATE])

    def run(env: Any) -> list[np.ndarray]:
        return [env.reset(seed=0)[0], *(env.step(np.array([0.5]))[0] for _ in range(6))]

    expected = run(env)
    for _ in range(3):
        env = again(env)
        np.testing.assert_array_equal(run(env), expected)
        assert env.unwrapped.model.dof_armature[-1] == 0.1


def test_a_copys_prior_is_that_of_the_nominal_model() -> None:
    env = RandomizePsi(Kept(), 1.0, space=["cube"])
    for seed in range(4):
        env.reset(seed=seed)
        np.testing.assert_allclose([*env.psi_space.low, *env.psi_space.high], [0.5, 1.5])
        env = copy.deepcopy(env)


def test_a_copy_of_the_bare_environment_steps_without_the_hooks() -> None:
    env = ApplyEffects(Own(), [LATE])
    env.reset(seed=0)
    bare, late = copy.deepcopy(env.unwrapped), env
    for each in (bare, late):
        each.reset(seed=0)
        each.step(np.array([0.0]))
        each.step(np.array([1.0]))
    assert bare.data.qvel[-1] > 1e-3, "the command came at once"
    assert abs(late.unwrapped.data.qvel[-1]) < 1e-6
