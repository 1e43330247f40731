"""Pretraining: a task that is learned in seconds, files, resuming, and a loss that comes apart."""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from nfc_gym import InputError
from nfc_gym.adaptation import load_policy, pretrain
from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.network import ActorCritic, Sizes
from nfc_gym.adaptation.policy import Policy, taught
from nfc_gym.adaptation.ppo import Diverged
from nfc_gym.adaptation.pretraining import ONWARD, RECIPES, Run, Training, recipe_of
from nfc_gym.adaptation.record import Episodes, Record
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.worlds import vector_env

SMALL = {"envs": 32, "horizon": 16, "threads": 1, "device": "cpu"}  # 512 steps an iteration


@pytest.fixture(autouse=True)
def _few_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nfc_gym.adaptation.pretraining.EPISODES", 2)
    monkeypatch.setattr("nfc_gym.adaptation.pretraining.vector_env", partial(vector_env, episode=100))


def weights(path: Path) -> dict[str, torch.Tensor]:
    with safe_open(path, "pt") as file:
        return {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 (no dict)


def test_a_rover_learns_to_approach_its_goal(tmp_path: Path) -> None:
    path = tmp_path / "jackal.safetensors"
    policy = pretrain("JackalFlat", path, steps=10_000, envs=32, threads=1, device="cpu")
    envs = VectorSight(vector_env("JackalFlat", 8, threads=1, episode=300))
    learned = evaluate(policy, envs).returns
    still = evaluate(lambda obs: np.zeros((8, 2), np.float32), envs).returns
    assert learned.mean() > still.mean() + 20.0  # three seeds earned 63 to 73 more
    assert (tmp_path / "jackal.safetensors.log" / "csv" / "scalars" / "return.csv").is_file()


def test_curves_go_into_tensorboard_s_event_files_too(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    record = Record(tmp_path, None)
    for step, value in ((0, 1.5), (4096, 2.5)):
        record.scalars(step, {"return": value})
    record._loggers[-1].experiment.flush()  # TensorBoard's writer does so every two minutes, and at the end
    (written,) = (tmp_path / "tensorboard").rglob("events.out.tfevents.*")
    events = EventAccumulator(str(written)).Reload()
    assert [(event.step, event.value) for event in events.Scalars("return")] == [(0, 1.5), (4096, 2.5)]
    assert (tmp_path / "csv" / "scalars" / "return.csv").is_file()


def test_a_policy_acts_the_same_from_its_file_and_through_torchrl(jackal: Path) -> None:
    policy = load_policy(jackal)
    env, plain = gym.make("nfc_gym/JackalFlat-v0"), gym.make("nfc_gym/JackalFlat-v0", context=[])
    policy.require(env)
    observation, flat = env.reset(seed=3)[0], plain.reset(seed=3)[0]
    action = policy(observation)
    np.testing.assert_array_equal(action, policy(flat))
    np.testing.assert_allclose(policy(np.stack([flat, flat])), np.stack([action, action]), atol=1e-6)
    step = torch.as_tensor(flat)
    np.testing.assert_allclose(policy.actor(observation=step)[0].detach(), action, atol=1e-6)
    assert env.action_space.contains(action)
    assert policy.about["training"]["environment"] == "nfc_gym/JackalFlat-v0"
    assert policy.about["nominal"]["episodes"] == 2


def test_a_task_other_than_the_first_is_what_is_trained_judged_and_resumed(tmp_path: Path) -> None:
    path = tmp_path / "p.safetensors"
    run = Run(
        Training(environment="nfc_gym/JackalFlat-v0", envs=16, task="figure8"),
        torch.device("cpu"),
        1,
        Record(None, None),
    )
    assert (run.envs.unwrapped.robot.task, run.recipe.episode) == ("figure8", 1000)
    policy = pretrain("JackalFlat", path, steps=512, task="figure8", **SMALL)
    assert policy.about["training"]["task"] == "figure8"
    with pytest.raises(InputError, match="another run"):
        pretrain("JackalFlat", path, steps=1024, **SMALL)
    with pytest.raises(InputError, match="it has: goal, figure8"):
        pretrain("JackalFlat", tmp_path / "q.safetensors", steps=512, task="fly", **SMALL)


def test_a_run_that_stopped_goes_on_and_one_with_other_arguments_does_not(tmp_path: Path) -> None:
    path = tmp_path / "p.safetensors"
    pretrain("JackalFlat", path, steps=512, **SMALL)
    first = weights(path)
    policy = pretrain("JackalFlat", path, steps=1024, **SMALL)
    assert policy.about["steps"] == 1024
    assert any((first[k] != v).any() for k, v in weights(path).items())
    count = policy.network.scale.count
    again = pretrain("JackalFlat", path, steps=1024, **SMALL)
    assert again.network.scale.count == count, "nothing was left to do"
    with pytest.raises(InputError, match=r"another run .*seed 0, now 1"):
        pretrain("JackalFlat", path, steps=1024, seed=1, **SMALL)


def test_another_policy_to_begin_with_is_another_run(
    tmp_path: Path, jackal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Told by its weights, wherever its file lies; a state of before that was written down is read as it was."""
    monkeypatch.setattr(Run, "save", lambda *_: None)  # whole episodes, to judge by
    other = load_policy(jackal)
    with torch.no_grad():
        next(other.network.parameters()).add_(0.01)
    other.save(tmp_path / "other.safetensors")
    (tmp_path / "copy.safetensors").write_bytes(jackal.read_bytes())
    run = partial(pretrain, "JackalFlat", tmp_path / "p.safetensors", steps=16, envs=1, threads=1, device="cpu")
    run(start=jackal)
    run(start=tmp_path / "copy.safetensors")
    told = r"another run \(start 'nfc_gym/JackalFlat-v0, weights \w+', now "
    with pytest.raises(InputError, match=told + "'nfc_gym/JackalFlat-v0, weights"):
        run(start=tmp_path / "other.safetensors")
    with pytest.raises(InputError, match=told + "not given"):
        run()
    state = tmp_path / "p.safetensors.training"
    with safe_open(state, "pt") as file:
        metadata = file.metadata()
    before = json.loads(metadata["state"])
    del before["of"]["start"]
    save_file(weights(state), state, {**metadata, "state": json.dumps(before)})
    run(start=jackal)


@pytest.mark.parametrize("robot", RECIPES)
def test_going_on_from_weights_explores_no_more_than_from_nothing(robot: str) -> None:
    environment = f"nfc_gym/{robot.capitalize()}Rough-v0"
    first, onward = (recipe_of(environment, there).ppo for there in (False, True))
    assert onward.entropy == min(first.entropy, ONWARD.entropy)
    assert onward.rate == ONWARD.rate < first.rate


def test_the_state_on_disk_is_all_that_going_on_needs(tmp_path: Path) -> None:
    """Weights, moments, step sizes and scales come back to the bit."""
    run = Run(Training(environment="nfc_gym/JackalFlat-v0", envs=16), torch.device("cpu"), 1, Record(None, None))
    batch = next(run.batches(16))
    run.iterate(batch)
    run.save_state(tmp_path / "state")
    other = Run(run.training, torch.device("cpu"), 1, Record(None, None))
    other.load_state(tmp_path / "state")
    torch.manual_seed(1)
    run.iterate(batch)
    torch.manual_seed(1)
    other.iterate(batch)
    assert run.steps == other.steps
    assert all(torch.equal(v, other.network.state_dict()[k]) for k, v in run.network.state_dict().items())


def test_a_loss_that_comes_apart_leaves_the_last_good_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "p.safetensors"
    pretrain("JackalFlat", path, steps=512, **SMALL)
    good, learn = weights(path), Run.iterate

    def broken(self: Run, batch):
        learn(self, batch)
        batch["next", "reward"][0, 0] = float("nan")
        return learn(self, batch)

    monkeypatch.setattr(Run, "iterate", broken)
    with pytest.raises(Diverged, match=r"not finite.*weights of step 512"):
        pretrain("JackalFlat", path, steps=2048, **SMALL)
    assert all(torch.equal(v, good[k]) for k, v in weights(path).items())
    assert "not finite" in load_policy(path).about["diverged"]


def test_rough_ground_begins_with_a_flat_policy(tmp_path: Path, jackal: Path) -> None:
    """Whatever the cells of elevation show, the first actions and values are the flat policy's."""
    flat = load_policy(jackal)
    envs = VectorSight(vector_env("JackalRough", 2, threads=1, terrain_pool=1))
    sizes = Sizes(envs.sight.size, 17, 2, flat.network.sizes.hidden)
    network = ActorCritic(sizes)
    assert taught(network, envs.sight, flat) == 17
    seen = torch.randn(5, envs.sight.size)
    psi = torch.rand(5, 17)
    torch.testing.assert_close(network.gaussian(seen)[0], flat.network.gaussian(seen[:, :17])[0])
    torch.testing.assert_close(network.value(seen, psi), flat.network.value(seen[:, :17], psi))
    with pytest.raises(InputError, match="sees cells that this one does not"):
        taught(ActorCritic(flat.network.sizes), flat.sight, Policy(envs.sight, network))
    with pytest.raises(InputError, match=r"layers \(256, 128\)"):
        taught(ActorCritic(Sizes(17, 17, 2, (8,))), flat.sight, flat)
    again = pretrain("JackalFlat", tmp_path / "p.safetensors", steps=512, start=jackal, **SMALL)
    assert again.about["started_from"] == {"environment": "nfc_gym/JackalFlat-v0", "steps": 512}
    assert again.network.scale.count > flat.network.scale.count
    assert again.about["ppo"] == asdict(ONWARD) != flat.about["ppo"]


def test_bad_input_is_named(tmp_path: Path, jackal: Path) -> None:
    policy = load_policy(jackal)
    for other, says in (("AntFlat", "cannot act in AntFlat"), ("QuadcopterFlat", "proprio 15, goal 2")):
        with pytest.raises(InputError, match=says):
            policy.require(gym.make(f"nfc_gym/{other}-v0"))
    with pytest.raises(InputError, match=r"ends in \.safetensors"):
        pretrain("JackalFlat", tmp_path / "policy.pt", steps=10)
    with pytest.raises(InputError, match="strictly inside"):
        pretrain("JackalFlat", tmp_path / "p.safetensors", steps=10, spread=1.0)
    with pytest.raises(InputError, match="paper, small"):
        pretrain("JackalFlat", tmp_path / "p.safetensors", steps=10, net="large")
    with pytest.raises(InputError, match="no such file"):
        load_policy(tmp_path / "missing.safetensors")


def test_files_that_are_no_policies_are_refused(tmp_path: Path, jackal: Path) -> None:
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(jackal.read_bytes()[:1000])
    with pytest.raises(InputError, match="truncated"):
        load_policy(cut)
    foreign = tmp_path / "foreign.safetensors"
    save_file({"x": torch.zeros(1)}, foreign, {"format": "other"})
    with pytest.raises(InputError, match="format 'other'"):
        load_policy(foreign)
    with safe_open(jackal, "pt") as file:
        about = json.loads(file.metadata()["about"])
    about["sizes"]["hidden"] = [8]
    wrong = tmp_path / "wrong.safetensors"
    save_file(weights(jackal), wrong, {"format": "nfc_gym-policy-1", "about": json.dumps(about)})
    with pytest.raises(InputError, match="no policy that this version knows"):
        load_policy(wrong)


def test_episodes_are_counted_across_batches() -> None:
    from tensordict import TensorDict

    episodes = Episodes()
    for done_at in (None, 1):
        done = torch.zeros(2, 3, 1, dtype=torch.bool)
        if done_at is not None:
            done[0, done_at] = True
        after = TensorDict({"reward": torch.ones(2, 3, 1), "done": done, "success": done[..., 0]}, [2, 3])
        episodes.see(TensorDict({"next": after}, [2, 3]))
    assert episodes.means() == {"return": 5.0, "length": 5.0, "success": 1.0}
    assert episodes.count == 1
    assert episodes.first is None, "the other simulation's first episode has not ended"
    done = torch.ones(2, 1, 1, dtype=torch.bool)
    after = TensorDict({"reward": torch.ones(2, 1, 1), "done": done, "success": done[..., 0]}, [2, 1])
    episodes.see(TensorDict({"next": after}, [2, 1]))
    assert episodes.first == (5.0 + 7.0) / 2


def test_what_was_measured_of_other_weights_is_not_said_of_these(tmp_path: Path) -> None:
    policy = load_policy("nfc_gym/JackalFlat-v0")
    policy.save(tmp_path / "same.safetensors")
    same = load_policy(tmp_path / "same.safetensors").about
    assert (same["nominal"], same["steps"]) == (policy.about["nominal"], policy.about["steps"])
    with torch.no_grad():
        next(policy.network.parameters()).add_(0.01)
    policy.save(tmp_path / "other.safetensors")
    other = load_policy(tmp_path / "other.safetensors").about
    assert not {"nominal", "steps"} & other.keys()
    assert other["before"]["nominal"] == same["nominal"]
    assert other["before"]["weights"] == same["weights"] != other["weights"]
    assert other["training"] == same["training"]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"steps": 0}, "steps is 0, want a whole number, 1 or more"),
        ({"steps": 1.5}, "steps is 1.5, want a whole number"),
        ({"envs": 0}, "envs is 0, want a whole number, 1 or more"),
        ({"seed": -1}, "seed is -1, want a whole number, 0 or more"),
        ({"horizon": -1}, "horizon is -1, want a whole number, 0 or more"),
        ({"threads": -1}, "threads is -1, want a whole number, 0 or more"),
        ({"seconds": float("nan")}, "seconds is nan; want a number, 0 or more"),
        ({"spread": "a"}, "--spread a: psi is drawn strictly inside the prior"),
    ],
)
def test_numbers_that_cannot_be_are_named(tmp_path: Path, wrong: dict, told: str) -> None:
    with pytest.raises(InputError, match=told):
        pretrain("JackalFlat", tmp_path / "p.safetensors", **({"steps": 100, **SMALL} | wrong))
    assert not list(tmp_path.iterdir())


def test_a_run_that_is_refused_leaves_nothing(tmp_path: Path, jackal: Path) -> None:
    with pytest.raises(InputError, match="start: a policy of nfc_gym/JackalFlat-v0"):
        pretrain("AntFlat", tmp_path / "p.safetensors", steps=100, start=jackal, **SMALL)
    assert not list(tmp_path.iterdir())
