"""TD-MPC2 in the package's environments, in hidden worlds and in the tasks of its authors."""

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rail import tiny

from nfc_gym.core.errors import InputError


def model_file(folder: Path, place: str = "JackalFlat") -> str:
    """A world model with weights as they are drawn."""
    from tdmpc2.agent import Agent
    from worlds.world import World

    from nfc_gym.adaptation.sight import Sight

    env = World(place, "nominal", 0).make(1, context=["psi"])
    path, sight = folder / f"{place}.safetensors", Sight.of(env)
    Agent(tiny(sight.size, env.unwrapped.robot.action_size), 0.99, sight).save(path)
    return str(path)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judged in 150 control steps: planning takes its time."""
    from tdmpc2 import pretraining
    from worlds.world import World

    monkeypatch.setitem(World.make.__kwdefaults__, "max_episode_steps", 150)
    monkeypatch.setattr(pretraining, "vector_env", partial(pretraining.vector_env, episode=150))


def pretrained(folder: Path, steps: int) -> Any:
    from tdmpc2.pretraining import Pretraining, pretrain

    few = Pretraining(envs=8, first=80, net="tiny", episodes=1)
    return pretrain("JackalFlat", folder / "m.safetensors", few, steps=steps, threads=1, device="cpu")


def test_pretraining_is_kept_and_goes_on(tmp_path: Path) -> None:
    from tdmpc2.agent import load_agent

    first = pretrained(tmp_path, 160)
    assert (first.about["steps"], first.about["updates"]) == (160, 40)
    again = pretrained(tmp_path, 320)
    assert (again.about["steps"], again.about["updates"]) == (320, 80)
    kept = load_agent(tmp_path / "m.safetensors")
    assert kept.sight == again.sight
    assert kept.about["nominal"] == again.about["nominal"]
    assert again.sight.size == again.model.sizes.observation == 17


def test_a_world_model_of_another_robot_is_refused(tmp_path: Path) -> None:
    from tdmpc2.agent import load_agent
    from worlds.world import World

    agent = load_agent(model_file(tmp_path))
    with pytest.raises(InputError, match="plans actions of 2 entries"):
        agent.require(World("AntFlat", "nominal", 0).make(1, context=["psi"]))
    with pytest.raises(InputError, match="cannot act in"):
        agent.require(World("JackalRough", "nominal", 0).make(1, context=["psi"]))


def test_in_a_hidden_world_it_learns_from_what_was_executed_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from worlds import learning, planned
    from worlds.learning import Budget
    from worlds.methods import Job, run
    from worlds.world import World

    for module in (learning, planned):
        monkeypatch.setattr(module, "EPISODE", 150)
    file = model_file(tmp_path)
    before = Path(file).read_bytes()
    budget = Budget(envs=4, steps=800, seconds=60.0, executed=1, judged=1, points=1, threads=1, ratio=0.5)
    job = Job(World("JackalFlat", "axle", 0), 0, "JackalFlat", None, None, budget, None, tmp_path / "states", file)
    cell = run("tdmpc2", job, 2)
    assert cell["notes"]["steps"] == 150  # one episode's
    assert cell["notes"]["updates"] == 75
    assert [s for s, _ in cell["curve"]] == [0, 150]
    assert len(cell["episodes"]["returns"]) == 2
    assert cell["hertz"] > 1
    assert Path(file).read_bytes() == before
    json.dumps(cell, allow_nan=False)


def test_suite_tasks_are_as_the_authors_ran_them() -> None:
    pytest.importorskip("dm_control", reason="tasks of the DeepMind Control Suite")
    from tdmpc2.collecting import sizes_of
    from tdmpc2.suite import PUBLISHED, suite_envs
    from tdmpc2.world_model import Sizes

    envs = suite_envs("cartpole-swingup", 2)
    assert sizes_of(envs) == Sizes(5, 1)
    first = envs.reset(seed=0)[0]["observation"]
    assert np.array_equal(envs.reset(seed=0)[0]["observation"], first)
    over = [envs.step(np.zeros((2, 1)))[3] for _ in range(500)]
    assert over[-1].all()
    assert not np.any(over[:-1])
    assert set(PUBLISHED) == {"cartpole-swingup", "pendulum-swingup", "reacher-easy"}
    with pytest.raises(InputError, match="cartpole-swingup"):
        suite_envs("cartpole-sleep", 1)


def test_a_pretraining_that_comes_apart_says_so_and_keeps_its_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tdmpc2.agent import load_agent
    from tdmpc2.learner import Learner

    from nfc_gym.adaptation.ppo import Diverged

    whole = Learner.update

    def update(self: Any, steps: Any) -> Any:
        if self.updates == 10:
            steps["reward"][...] = math.nan
        return whole(self, steps)

    monkeypatch.setattr(Learner, "update", update)
    with pytest.raises(Diverged, match=r"update 10 is not finite.*m\.safetensors holds the weights of step"):
        pretrained(tmp_path, 160)
    kept = load_agent(tmp_path / "m.safetensors")
    assert "update 10" in kept.about["diverged"]
    assert all(v.isfinite().all() for v in kept.model.state_dict().values())
