"""TD-MPC2 learns: from a batch, from what an agent saw, in a run that stops, goes on and refuses."""

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from rail import batch, rails, tiny

from nfc_gym.core.errors import InputError

torch = pytest.importorskip("torch", reason="TD-MPC2 learns with torch")


def test_losses_fall_on_a_batch_that_stays() -> None:
    from tdmpc2.learner import Learner

    learner = Learner(tiny(dropout=0.0, rate=2e-3), 0.9)
    first = learner.update(batch())
    for _ in range(150):
        last = learner.update(batch())
    assert float(last["loss"]) < 0.7 * float(first["loss"])
    assert float(last["reward"]) < 0.7 * float(first["reward"])
    assert float(last["termination"]) < 0.5 * float(first["termination"])
    with torch.no_grad():
        model, known = learner.model, batch()
        z = model.encode(known["observation"][:, 0])
        guess = model.imagine(z, known["action"][:, 0]).reward
    assert np.corrcoef(guess.numpy(), known["reward"][:, 0].numpy())[0, 1] > 0.7


def test_a_loss_that_comes_apart_leaves_the_weights_as_they_were() -> None:
    from tdmpc2.learner import Learner

    from nfc_gym.adaptation.ppo import Diverged

    learner, bad = Learner(tiny(), 0.9), batch()
    learner.update(batch())
    before = {k: v.clone() for k, v in learner.model.state_dict().items()}
    bad["reward"][0, 0] = math.nan
    with pytest.raises(Diverged, match="update 1 is not finite"):
        learner.update(bad)
    assert all(torch.equal(v, before[k]) for k, v in learner.model.state_dict().items())


def test_targets_follow_and_the_scale_is_at_least_one() -> None:
    from tdmpc2.learner import Learner

    learner = Learner(tiny(), 0.9)
    old = [p.clone() for p in learner.model.targets.parameters()]
    learner.update(batch())
    for before, critic, target in zip(old, learner.model.critics.parameters(), learner.model.targets.parameters(),
                                      strict=True):  # fmt: skip
        assert target == pytest.approx(before + 0.01 * (critic.detach() - before), abs=1e-7)
        assert not target.requires_grad
    assert float(learner.model.scale) == 1
    learner.model.rescale(torch.linspace(0, 100, 1001))
    assert float(learner.model.scale) == pytest.approx(1 + 0.01 * (90 - 1), rel=1e-4)


def test_sequences_never_cross_two_episodes_and_an_end_comes_last() -> None:
    from tdmpc2.replay import Windows
    from tdmpc2.world_model import Sizes

    windows, t, episode, found = Windows(2, Sizes(2, 1), 3), np.zeros(2), np.zeros(2), []
    windows.begin(np.stack([episode, t], 1).astype(np.float32), np.ones(2, bool))
    for _ in range(40):
        t += 1
        ended = t == np.array([5, 2])  # the second one's episodes are too short for any sequence
        made = windows.step(t[:, None].astype(np.float32), t.astype(np.float32), ended,
                            np.stack([episode, t], 1).astype(np.float32))  # fmt: skip
        found += [] if made is None else [dict(zip(made, row, strict=True)) for row in zip(*made.values(), strict=True)]
        if ended.any():
            episode[ended] += 1
            t[ended] = 0
            windows.begin(np.stack([episode, t], 1).astype(np.float32), ended)
    assert len(found) == 8 * 3  # five steps an episode give three sequences
    for one in found:
        assert len(one["observation"][:, 0].unique()) == 1
        assert one["observation"][1:, 1] == pytest.approx(one["reward"])
        assert one["observation"][:-1, 1] == pytest.approx(one["reward"] - 1)
        assert one["action"][:, 0] == pytest.approx(one["reward"])
        assert not one["ended"][:-1].any()
        assert bool(one["ended"][-1]) == (float(one["reward"][-1]) == 5)


# ---- runs ----------------------------------------------------------------------------------------------------------


def small_run(envs: Any = None, **change: Any) -> Any:
    from tdmpc2.run import Run, Schedule

    given = {"first": 100, "ratio": 0.5, **change}
    return Run(envs or rails(), tiny(batch=64), 0.9, Schedule(**given), most=4000)


def test_a_run_learns_to_stay_in_the_middle_of_a_rail() -> None:
    from dataclasses import replace

    from tdmpc2.agent import Agent
    from tdmpc2.run import Run, Schedule
    from tdmpc2.settings import NETS
    from tdmpc2.world_model import Sizes, WorldModel

    from nfc_gym.adaptation.evaluate import evaluate

    torch.manual_seed(0)
    settings = replace(NETS["tiny"], samples=64, elites=8, iterations=3, batch=64, rate=1e-3)
    model = WorldModel(Sizes(2, 1), settings).eval()
    run = Run(rails(8), model, 0.9, Schedule(first=400, ratio=0.4), most=1200)
    run.train(1200)
    agent, rng = Agent(model, 0.9), np.random.default_rng(0)
    agent.begin(16)
    learned = evaluate(agent, rails(16), seed=5).returns.mean()
    random = evaluate(lambda seen: rng.uniform(-1, 1, (16, 1)), rails(16), seed=5).returns.mean()
    assert learned > random + 4
    assert learned > 13  # of 20 at most; standing still where one begins earns 10


def test_a_run_goes_on_from_its_state_to_the_same_bits(tmp_path: Path) -> None:
    whole = small_run()
    whole.train(160, state=tmp_path / "x.training")
    kept = whole.chance.get_extra_state()
    resumed = small_run()
    resumed.load(tmp_path / "x.training")
    assert (resumed.steps, resumed.learner.updates) == (whole.steps, whole.learner.updates) == (160, 80)
    ends = []
    for run in (resumed, whole):  # the one that was loaded has the generators' state from the file
        if run is whole:
            run.chance.set_extra_state(kept)
        run._collector = None  # episodes begin anew
        run.train(200)
        ends.append(run.model.state_dict())
    assert all(torch.equal(v, ends[1][k]) for k, v in ends[0].items())
    other = small_run(ratio=0.25)
    with pytest.raises(InputError, match="of another run"):
        other.load(tmp_path / "x.training")


def test_what_is_there_is_kept_on_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    from tdmpc2 import run as module

    monkeypatch.setattr(module, "KEEP_EVERY", -1.0)
    run, kept = small_run(first=8), []
    run.train(20, kept=lambda: kept.append(run.learner.updates))
    # Two updates for each control step of four simulations, from the third on, which completes the first sequences.
    assert kept == [0, 0, 6, 8, 10]


def test_an_agent_s_file_acts_as_it_did(tmp_path: Path) -> None:
    from tdmpc2.agent import Agent, load_agent

    agent = Agent(tiny(), 0.9, about={"steps": 7})
    agent.save(tmp_path / "a.safetensors")
    again = load_agent(tmp_path / "a.safetensors")
    assert (again.gamma, again.about["steps"], again.model.settings) == (0.9, 7, agent.model.settings)
    seen, actions = {"observation": np.random.default_rng(0).normal(size=(5, 2))}, []
    for one in (agent, again):
        one.begin(5)
        torch.manual_seed(3)
        actions.append(np.array([one(seen) for _ in range(2)]))
    assert np.array_equal(*actions)
    assert np.abs(actions[0]).max() <= 1
    (tmp_path / "b.safetensors").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"b\.safetensors"):
        load_agent(tmp_path / "b.safetensors")


@pytest.mark.parametrize(
    ("envs", "words"),
    [
        (lambda: rails(1, high=2.0), "rescale them"),
        (lambda: rails(1, AutoresetMode.NEXT_STEP), "autoreset_mode='Disabled'"),
        (lambda: gymnasium.make_vec("CartPole-v1", 1), "under 'observation'"),
    ],
)
def test_environments_that_it_cannot_learn_in_are_refused(envs: Any, words: str) -> None:
    from tdmpc2.collecting import sizes_of

    with pytest.raises(InputError, match=words):
        sizes_of(envs())


def test_a_run_refuses_an_environment_of_other_sizes() -> None:
    from tdmpc2.run import Run, Schedule

    with pytest.raises(InputError, match="ratio -1"):
        Schedule(ratio=-1)

    run = Run(rails(), tiny(action=2), 0.9, Schedule())
    with pytest.raises(InputError, match="action=2"):
        run.train(10)
