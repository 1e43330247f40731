"""Orders of wrappers: those that make sense compose to the same world, the others are refused by name."""

import itertools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fakes import roll, same

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.core import Fidelity, InputError
from nfc_gym.wrappers import (
    ApplyEffects,
    Hallucinate,
    MonitorAnomaly,
    PerceiveTerrain,
    PerturbSignals,
    RandomizePsi,
    RecordLog,
    ResidualDynamics,
    ResidualTerrain,
)
from nfc_gym.wrappers.order import beneath

PAYLOAD = [
    {"family": "armature", "where": "hip_1", "parameters": {"inertia": 0.1}},
    {"family": "coulomb", "where": "ankle_1", "parameters": {"level": 0.3}},
    {"family": "drag_linear", "where": "torso", "parameters": {"x": 1.0, "y": 1.0, "z": 1.0}},
]


def test_what_acts_in_the_physics_commutes() -> None:
    """Psi, effects and residuals meet in one simulation, whichever is outermost."""
    wraps = [
        lambda e: RandomizePsi(e, {"torso": (0.25, 0.25)}),
        lambda e: ApplyEffects(e, PAYLOAD),
        lambda e: ResidualDynamics(e, 0.05 * np.ones(14)),
    ]
    rolls = []
    for order in itertools.permutations(wraps):
        env: Any = gym.make("Ant-v5")
        for wrap in order:
            env = wrap(env)
        rolls.append(roll(env, 5))
        assert env.unwrapped.model.dof_armature[6] == pytest.approx(1.1)
    for other in rolls[1:]:
        same(other, rolls[0])


def test_wrappers_of_gymnasium_may_stand_between(tmp_path: Path) -> None:
    env: Any = ApplyEffects(gym.make("Ant-v5"), PAYLOAD)
    env = gym.wrappers.RescaleAction(env, -1.0, 1.0)
    env = ResidualDynamics(env, 0.05 * np.ones(14))
    env = gym.wrappers.TimeLimit(gym.wrappers.FlattenObservation(env), 5)
    env = RecordLog(env, tmp_path)
    assert [type(w).__name__ for w in beneath(env)][:3] == ["RecordLog", "TimeLimit", "FlattenObservation"]
    roll(env, 5)
    env.close()
    assert (tmp_path / "episode_0000.parquet").is_file()


class Quiet:
    threshold = 1.0

    def reset(self, rows=None) -> None: ...

    def update(self, obs, action, next_obs):
        return 0.0


def _rough() -> gym.Env:
    return gym.make("nfc_gym/JackalRough-v0", terrain_pool=1)


GROUND = Fidelity(delta_e=np.zeros((2, 256, 256)))
PSI = Fidelity(psi=np.full((2, 1), 0.3))
WRONG = {
    "ApplyEffects twice": (lambda: ApplyEffects(ApplyEffects(gym.make("Ant-v5"), []), []), "all effects go to one"),
    "RandomizePsi twice": (
        lambda: RandomizePsi(RandomizePsi(_rough(), 0.5), 0.5),
        "RandomizePsi around RandomizePsi: psi is written by",
    ),
    "terrain twice": (
        lambda: ResidualTerrain(ResidualTerrain(_rough(), np.zeros((256, 256))), np.zeros((256, 256))),
        "the simulated terrain is written by",
    ),
    "terrain around hallucinated terrain": (
        lambda: ResidualTerrain(Hallucinate(_rough(), GROUND), np.zeros((256, 256))),
        "ResidualTerrain around Hallucinate",
    ),
    "psi around hallucinated psi": (
        lambda: RandomizePsi(Hallucinate(gym.make("Ant-v5"), PSI, space=["torso"]), space=["torso"]),
        "RandomizePsi around Hallucinate",
    ),
    "two hallucinations": (
        lambda: Hallucinate(Hallucinate(gym.make("Ant-v5"), PSI, space=["torso"]), Fidelity(delta_s=np.zeros((2, 14)))),
        "widened",
    ),
    "a detector above hallucinated actions": (
        lambda: MonitorAnomaly(Hallucinate(gym.make("Ant-v5"), PSI, space=["torso"]), Quiet()),
        "put Hallucinate around MonitorAnomaly",
    ),
    "a map over a perturbed map": (
        lambda: PerceiveTerrain(PerturbSignals(_rough(), {"elevation": {"sd": 0.1}})),
        "put PerturbSignals around PerceiveTerrain",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_orders_that_cannot_work_are_refused_at_construction(name: str) -> None:
    build, message = WRONG[name]
    with pytest.raises(InputError, match=message):
        build()


def test_noise_on_other_signals_may_stand_beneath_a_camera() -> None:
    PerceiveTerrain(PerturbSignals(_rough(), {"proprio": {"sd": 0.1}}))


def test_parts_that_do_not_meet_may_be_stacked() -> None:
    ResidualTerrain(Hallucinate(_rough(), Fidelity(delta_s=np.zeros((2, 10)))), np.zeros((256, 256)))
    ResidualDynamics(ResidualDynamics(gym.make("Ant-v5"), np.zeros(14)), np.zeros(14))


def test_two_residuals_add_up() -> None:
    half, whole = 0.05 * np.ones(14), 0.1 * np.ones(14)
    once = roll(ResidualDynamics(gym.make("Ant-v5"), whole), 5)
    twice = roll(ResidualDynamics(ResidualDynamics(gym.make("Ant-v5"), half), half), 5)
    np.testing.assert_allclose(twice[-1][0], once[-1][0], rtol=1e-6, atol=1e-8)


def test_noise_of_two_wrappers_of_a_kind_differs() -> None:
    noise = {"observation": {"sd": 1.0}}
    env = PerturbSignals(PerturbSignals(gym.make("Ant-v5"), noise), noise)
    env.reset(seed=0)
    outer, inner = env.rng.standard_normal(3), env.env.rng.standard_normal(3)
    assert (outer != inner).all()


@pytest.mark.parametrize(
    "wrap",
    [
        lambda e: ApplyEffects(e, PAYLOAD),
        lambda e: ResidualDynamics(e, 0.1 * np.ones(14)),
        lambda e: ResidualDynamics(e, 0.1 * np.ones(14), mode="state"),
        lambda e: RandomizePsi(e, space=["torso"]),
        lambda e: Hallucinate(e, PSI, space=["torso"]),
    ],
)
def test_a_wrapper_that_was_thrown_away_acts_no_more(wrap: Any) -> None:
    """Its environment goes on as if it had never been wrapped, alone or in another wrapper."""
    env = gym.make("Ant-v5")
    expected = roll(gym.make("Ant-v5"), 4)
    wrapped: Any = wrap(env)
    wrapped.reset(seed=1)
    wrapped.step(np.zeros(wrapped.action_space.shape))
    del wrapped
    same(roll(ResidualDynamics(env, np.zeros(14)), 4), expected)
    same(roll(ApplyEffects(env, []), 4), expected)
