"""TD-MPC2: its mathematics on cases whose answer is known, and that a run learns, stops, goes on and refuses."""

import json
import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from nfc_gym.core.errors import InputError

torch = pytest.importorskip("torch", reason="TD-MPC2 learns with torch")
pytest.importorskip("torchrl", reason="TD-MPC2 keeps what it saw in TorchRL's replay buffer")


class Rail(gymnasium.Env):
    """A point on a rail, moved by its action; the nearer to the middle the better. Beyond `edge` the episode ends."""

    def __init__(self, length: int = 20, edge: float = 10.0, high: float = 1.0) -> None:
        self.observation_space = spaces.Dict({"observation": spaces.Box(-np.inf, np.inf, (2,), np.float32)})
        self.action_space = spaces.Box(-high, high, (1,), np.float32)
        self.length, self.edge = length, edge

    def _seen(self) -> dict[str, Any]:
        return {"observation": np.array([self.x, 1.0], np.float32)}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.uniform(-1, 1)), 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x, self.t = self.x + 0.3 * float(action[0]), self.t + 1
        return self._seen(), 1 - abs(self.x), abs(self.x) > self.edge, self.t >= self.length, {}


def rails(n: int = 4, mode: AutoresetMode = AutoresetMode.DISABLED, **change: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Rail(**change) for _ in range(n)], autoreset_mode=mode)


def tiny(observation: int = 2, action: int = 1, **change: Any) -> Any:
    from dataclasses import replace

    from tdmpc2.settings import settings_of
    from tdmpc2.world_model import Sizes, WorldModel

    torch.manual_seed(0)
    settings = replace(settings_of("tiny", action, episodic=True), **change)
    return WorldModel(Sizes(observation, action), settings).eval()


def batch(n: int = 16) -> Any:
    from tensordict import TensorDict

    draw = torch.Generator().manual_seed(0)
    seen = torch.rand(n, 4, 2, generator=draw)
    return TensorDict(
        {
            "observation": seen,
            "action": torch.rand(n, 3, 1, generator=draw) * 2 - 1,
            "reward": seen[:, :-1, 0],
            "ended": torch.zeros(n, 3, dtype=torch.bool),
        },
        [n],
    )


# ---- mathematics ---------------------------------------------------------------------------------------------------


def test_numbers_come_back_from_symlog_and_from_two_bins() -> None:
    from tdmpc2.networks import TwoHot, symexp, symlog

    x = torch.tensor([-2e4, -3.0, -0.01, 0.0, 0.5, 1.0, 1e3, 2e4])
    assert symexp(symlog(x)) == pytest.approx(x, rel=1e-5)
    assert float(symlog(torch.tensor(math.e - 1))) == pytest.approx(1)
    coder = TwoHot(101, 10.0)
    weights = coder.encode(x)
    assert weights.sum(-1) == pytest.approx(torch.ones(8), rel=1e-5)
    assert int((weights > 0).sum(-1).max()) <= 2
    assert coder.decode((weights + 1e-30).log()) == pytest.approx(x, rel=1e-3, abs=1e-4)
    beyond = coder.encode(torch.tensor([1e9, -1e9]))  # cut at the outermost bins
    assert beyond[0, -1] == beyond[1, 0] == 1


def test_cross_entropy_is_least_where_the_prediction_is_the_number() -> None:
    from tdmpc2.networks import TwoHot

    coder, x = TwoHot(101, 10.0), torch.tensor([0.7, -12.0])
    right = (coder.encode(x) + 1e-12).log()
    entropy = -(coder.encode(x) * (coder.encode(x) + 1e-12).log()).sum(-1)
    assert coder.loss(right, x) == pytest.approx(entropy, abs=1e-4)
    assert coder.loss(torch.zeros(2, 101), x) == pytest.approx(torch.full((2,), math.log(101)), rel=1e-5)


def test_latent_states_are_points_of_simplices() -> None:
    from tdmpc2.networks import SimNorm

    x = torch.randn(5, 3, 32)
    out = SimNorm(8)(x)
    assert out.shape == x.shape
    assert out.unflatten(-1, (4, 8)).sum(-1) == pytest.approx(torch.ones(5, 3, 4), rel=1e-5)
    assert out[..., :8] == pytest.approx(x[..., :8].softmax(-1))
    model = tiny()
    z = model.next(model.encode(torch.randn(6, 2)), torch.zeros(6, 1)).detach()
    assert z.unflatten(-1, (-1, 8)).sum(-1) == pytest.approx(torch.ones(6, 2), rel=1e-5)


def test_critics_together_are_what_each_is_alone() -> None:
    from tdmpc2.networks import Critics

    torch.manual_seed(0)
    critics = Critics(3, 4, (8, 8), 5, 0.0)
    for p in critics.parameters():
        torch.nn.init.normal_(p)
    x = torch.randn(2, 6, 4)
    whole = critics(x).detach()
    assert whole.shape == (3, 2, 6, 5)
    assert critics(x, torch.tensor([2, 0])).detach() == pytest.approx(whole[[2, 0]], rel=1e-4, abs=1e-5)
    a, b, c = critics.layers
    y = x @ a.weight[1] + a.bias[1]
    y = torch.nn.functional.mish(torch.nn.functional.layer_norm(y, (8,)) * a.gain[1] + a.shift[1])
    y = y @ b.weight[1] + b.bias[1]
    y = torch.nn.functional.mish(torch.nn.functional.layer_norm(y, (8,)) * b.gain[1] + b.shift[1])
    assert (y @ c.weight[1] + c.bias[1]).detach() == pytest.approx(whole[1], rel=1e-4, abs=1e-4)
    x.requires_grad_()
    critics(x, frozen=True).sum().backward()
    assert x.grad is not None
    assert all(p.grad is None for p in critics.parameters())


def test_the_prior_s_entropy_is_that_of_a_squashed_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    from torch.distributions import Normal, TanhTransform, TransformedDistribution

    model = tiny(action=2)
    raw = torch.tensor([[0.3, -1.0, -0.2, 0.4]])
    monkeypatch.setattr(model.prior, "forward", lambda state: raw)
    torch.manual_seed(1)
    action, entropy = model.propose(torch.zeros(1, 16))
    std = (-10 + 6 * (raw[:, 2:].tanh() + 1)).exp()
    known = TransformedDistribution(Normal(raw[:, :2], std), [TanhTransform()]).log_prob(action).sum(-1)
    assert entropy == pytest.approx(-known, rel=1e-4)


def test_the_discount_is_as_published() -> None:
    from tdmpc2.settings import discount

    assert discount(500) == pytest.approx(0.99)
    assert discount(1000) == pytest.approx(0.995)
    assert discount(25) == 0.95


# ---- planning ------------------------------------------------------------------------------------------------------


class Plain:
    """A model that is known: the state moves by a tenth of the action, and a quadratic reward has its best action."""

    def __init__(self, best: Any, cliff: float = math.inf) -> None:
        self.best, self.cliff = best, cliff

    def encode(self, observation: Any) -> Any:
        return observation

    def act(self, state: Any) -> Any:
        return torch.zeros(*state.shape[:-1], 2)

    def imagine(self, state: Any, action: Any) -> Any:
        from tdmpc2.world_model import Imagined

        after = state + 0.1 * action.sum(-1, keepdim=True)
        best = self.best[:, None].expand_as(action)
        return Imagined(after, -(action - best).square().sum(-1), after[..., 0] > self.cliff)

    def value(self, state: Any) -> Any:
        return torch.zeros(state.shape[:-1])


def planner(model: Any, rows: int, **change: Any) -> Any:
    from dataclasses import replace

    from tdmpc2.planner import Planner
    from tdmpc2.settings import Settings

    return Planner(model, replace(Settings(), **change), 0.99, 2, rows)


def test_plans_of_many_robots_find_each_its_own_optimum() -> None:
    torch.manual_seed(0)
    best = torch.tensor([[0.5, -0.3], [-0.8, 0.1], [0.0, 0.9]])
    plans = planner(Plain(best), 3, iterations=12, temperature=8.0)
    action = plans.plan(torch.zeros(3, 1))
    assert (action - best).abs().max() < 0.1
    assert (plans.mean - best[:, None]).abs().max() < 0.1  # at every step of the horizon


def test_what_is_left_of_a_plan_is_begun_from_and_forgotten_with_the_episode() -> None:
    plans = planner(
        Plain(torch.zeros(2, 2)), 2, iterations=1, samples=2, priors=1, elites=1, max_std=1e-6, min_std=1e-6
    )
    plans.mean = torch.tensor([[[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]] * 2)
    plans.model.act = lambda state: torch.full((*state.shape[:-1], 2), 5.0)  # so that no prior is ever an elite
    plans.plan(torch.zeros(2, 1), fresh=torch.tensor([False, True]))
    assert plans.mean[0] == pytest.approx(torch.tensor([[0.2, 0.2], [0.3, 0.3], [0.0, 0.0]]), abs=1e-4)
    assert plans.mean[1].abs().max() < 1e-4


def test_nothing_is_earned_after_an_episode_s_end() -> None:
    model = Plain(torch.zeros(1, 2), cliff=0.15)
    plans = planner(model, 1)
    flat = torch.zeros(1, 1, 3, 2)
    over = flat.clone()
    over[0, 0, 0] = 1.0  # over the cliff at once: the first step's reward counts, the later ones do not
    over[0, 0, 1] = -1.0
    assert float(plans.worth(torch.zeros(1, 1), over)) == pytest.approx(-2.0)
    assert float(planner(Plain(torch.zeros(1, 2)), 1).worth(torch.zeros(1, 1), over)) == pytest.approx(-2 - 0.99 * 2)
    assert float(plans.worth(torch.zeros(1, 1), flat)) == 0


# ---- learning ------------------------------------------------------------------------------------------------------


def test_losses_fall_on_a_batch_that_stays() -> None:
    from tdmpc2.learner import Learner

    learner = Learner(tiny(dropout=0.0, rate=2e-3), 0.9)
    first = learner.update(batch())
    for _ in range(300):
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
        found += [] if made is None else list(made)
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

    given = {"first": 200, "ratio": 0.5, **change}
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
    run = Run(rails(8), model, 0.9, Schedule(first=400, ratio=0.4), most=1600)
    run.train(1600)
    agent, rng = Agent(model, 0.9), np.random.default_rng(0)
    agent.begin(16)
    learned = evaluate(agent, rails(16), seed=5).returns.mean()
    random = evaluate(lambda seen: rng.uniform(-1, 1, (16, 1)), rails(16), seed=5).returns.mean()
    assert learned > random + 4
    assert learned > 13  # of 20 at most; standing still where one begins earns 10


def test_a_run_goes_on_from_its_state_to_the_same_bits(tmp_path: Path) -> None:
    whole = small_run()
    whole.train(300, state=tmp_path / "x.training")
    kept = whole.chance.get_extra_state()
    resumed = small_run()
    resumed.load(tmp_path / "x.training")
    assert (resumed.steps, resumed.learner.updates) == (whole.steps, whole.learner.updates) == (300, 150)
    ends = []
    for run in (resumed, whole):  # the one that was loaded has the generators' state from the file
        if run is whole:
            run.chance.set_extra_state(kept)
        run._collector = None  # episodes begin anew
        run.train(400)
        ends.append(run.model.state_dict())
    assert all(torch.equal(v, ends[1][k]) for k, v in ends[0].items())
    other = small_run(ratio=0.25)
    with pytest.raises(InputError, match="of another run"):
        other.load(tmp_path / "x.training")


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


# ---- the package's environments ------------------------------------------------------------------------------------


def model_file(folder: Path, place: str = "JackalFlat") -> str:
    """A world model with weights as they are drawn."""
    from tdmpc2.agent import Agent
    from worlds.world import World

    from nfc_gym.adaptation.sight import Sight

    env = World(place, "nominal", 0).make(1, context=["psi"])
    path, sight = folder / f"{place}.safetensors", Sight.of(env)
    Agent(tiny(sight.size, env.unwrapped.robot.action_size), 0.99, sight).save(path)
    return str(path)


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
