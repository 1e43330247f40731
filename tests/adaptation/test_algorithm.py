"""Algorithm 1: nothing is touched without an anomaly, all is kept, a run that stopped ends as one that did not."""

import copy
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from rich.console import Console
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import (
    MLP,
    BatchRenorm1d,
    NormalParamExtractor,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss

from nfc_gym import InputError
from nfc_gym.adaptation import AdaptConfig, Agent, FineTuneConfig, adapt, load_policy, ppo_agent, sac_agent
from nfc_gym.adaptation.agent import OffPolicyConfig
from nfc_gym.adaptation.beliefs import Fixed
from nfc_gym.adaptation.choice import Choice
from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.network import ActorCritic
from nfc_gym.adaptation.optimise import optimise
from nfc_gym.adaptation.policy import Policy
from nfc_gym.adaptation.ppo import ONWARD
from nfc_gym.adaptation.sight import Sight
from nfc_gym.adaptation.trajectory import Trajectory, execute
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.envs.single import RobotEnv
from nfc_gym.wrappers import RandomizePsi

CONFIG = AdaptConfig(missions=2, worlds=8, steps=256, episode=40, judged=0)  # an iteration is of 256 steps
ONCE = replace(ONWARD, epochs=1, minibatches=2)


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Iterations of a quarter of the control steps."""
    monkeypatch.setattr("nfc_gym.adaptation.ppo._LONGEST", 32)


class Alarm:
    """A detector that finds the k-th transition of each episode unusual; None finds none so."""

    threshold = 1.0

    def __init__(self, at: int | None) -> None:
        self.at, self.count = at, 0

    def reset(self, rows: Any = None) -> None:
        self.count = 0

    def update(self, obs: Any, action: Any, next_obs: Any) -> float:
        self.count += 1
        return 2.0 if self.count == self.at else 0.1


def world(name: str = "JackalFlat", **kwargs: Any) -> gym.Env:
    """Other than the simulator: its base is heavy."""
    env = gym.make(f"nfc_gym/{name}-v0", context=["psi"], max_episode_steps=30, **kwargs)
    return RandomizePsi(env, {"base_mass": (30.0, 30.0)}) if name == "JackalFlat" else env


def belief(delta_s: bool = True) -> Fidelity:
    """Samples around the world's psi, and a residual of the speed."""
    rng, space = np.random.default_rng(0), gym.make("nfc_gym/JackalFlat-v0").unwrapped.psi_space
    psi = np.tile(space.nominal, (64, 1))
    psi[:, 0] = 30 + rng.standard_normal(64)
    residual = np.zeros((64, 15))
    residual[:, 4] = 0.01 * rng.standard_normal(64)
    return Fidelity(psi, residual) if delta_s else Fidelity(psi)


def nameless() -> gym.Env:
    """A world that `gym.make` did not make."""
    return gym.wrappers.TimeLimit(RobotEnv("nfc_gym.envs.jackal:Jackal", context=["psi"]), 30)


@dataclass(frozen=True)
class Counted(Fixed):
    """Knows how often it was asked."""

    asked: list[int] = field(default_factory=list)

    @property
    def count(self) -> int:
        return len(self.asked)

    def infer(self, trajectory: Trajectory) -> Any:
        self.asked.append(len(trajectory))
        return super().infer(trajectory)


def state(module: nn.Module) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in module.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(v, b[k]) for k, v in a.items())


def test_a_world_without_anomalies_changes_nothing(jackal: Path, tmp_path: Path) -> None:
    policy, said = load_policy(jackal), Console(record=True, width=200, file=open("/dev/null", "w"))  # noqa: SIM115
    before = state(policy.network)
    done = adapt(
        ppo_agent(policy), world(), belief(), Alarm(None), config=CONFIG, folder=tmp_path, threads=1, console=said
    )
    assert same(state(policy.network), before)
    assert (done.anomalies, len(done.dataset), done.belief) == (0, 2, None)
    assert "no anomaly in 2 trajectories: nothing was changed" in said.export_text()
    kept = Trajectory.load(tmp_path / "trajectory_00001.npz")
    np.testing.assert_array_equal(kept.states, done.dataset[1].states)
    assert len(kept) == 30
    assert kept.states.shape == (31, 15)


@pytest.mark.parametrize("hallucinate", [True, False])
def test_an_anomaly_adapts_the_policy_and_is_kept_like_the_rest(jackal: Path, hallucinate: bool) -> None:
    policy = load_policy(jackal)
    before = state(policy.network)
    config = replace(CONFIG, missions=1, hallucinate=hallucinate)
    done = adapt(ppo_agent(policy), world(), belief(), Alarm(20), config=config, threads=1)
    after = state(policy.network)
    assert done.anomalies == 1
    assert done.history[0]["width"] < 0.1, "of psi as the belief has it, over the prior's"
    assert (after["gaussian.body.0.weight"] != before["gaussian.body.0.weight"]).any()
    assert torch.equal(after["scale.mean"], before["scale.mean"])
    assert len(done.dataset[0].until_alarm()) == 20


def test_a_run_that_stopped_ends_as_one_that_did_not(jackal: Path, tmp_path: Path) -> None:
    whole, halves = load_policy(jackal), load_policy(jackal)
    config = replace(CONFIG, judged=2)
    one = adapt(ppo_agent(whole), world(), belief(), Alarm(9), config=config, folder=tmp_path / "a", threads=1)
    first = replace(config, missions=1)
    adapt(ppo_agent(halves), world(), belief(), Alarm(9), config=first, folder=tmp_path / "b", threads=1)
    fresh = load_policy(jackal)  # another process knows only the file that it was given
    two = adapt(ppo_agent(fresh), world(), belief(), Alarm(9), config=config, folder=tmp_path / "b", threads=1)
    assert same(state(whole.network), state(fresh.network))
    assert one.history == two.history
    other = replace(config, seed=1)
    with pytest.raises(InputError, match="another run"):
        adapt(ppo_agent(fresh), world(), belief(), Alarm(9), config=other, folder=tmp_path / "b", threads=1)
    wider = ppo_agent(Policy(fresh.sight, ActorCritic(replace(fresh.network.sizes, hidden=(24, 16)))))
    for given, sampled, odd in (
        (wider, belief(), "another agent"),
        (ppo_agent(load_policy("JackalFlat")), belief(False), "another agent and another posterior"),
    ):
        with pytest.raises(InputError, match=f"is of another run, with {odd}: give what that one began with"):
            adapt(given, world(), sampled, Alarm(9), config=config, folder=tmp_path / "b", threads=1)
    # What has learned in this folder, in this process, is the agent that began there; no belief is inferred in vain.
    shown, said = Counted(belief()), Console(record=True, width=200, file=open("/dev/null", "w"))  # noqa: SIM115
    again = adapt(
        ppo_agent(fresh), world(), shown, Alarm(9), config=config, folder=tmp_path / "b", threads=1, console=said
    )
    assert "finished before, at mission 2 of 2" in said.export_text()
    assert again.history == one.history
    assert shown.count == 1
    assert same(state(whole.network), state(fresh.network))


def test_settings_of_the_simulator_that_are_left_out_are_another_run(jackal: Path, tmp_path: Path) -> None:
    def run(settings: dict[str, Any] | None, missions: int) -> Any:
        config = replace(CONFIG, missions=missions)
        agent = ppo_agent(load_policy(jackal))
        return adapt(agent, world(), belief(), Alarm(None), config=config, folder=tmp_path, settings=settings)

    given = {"difficulty": 0.9, "terrain_pool": 2}
    run(given, 1)
    for now, told in (({"terrain_pool": 2}, ""), (None, "; terrain_pool 2, now not given")):
        with pytest.raises(InputError, match=rf"of another run \(difficulty 0\.9, now not given{told}\)"):
            run(now, 2)
    assert len(run(given, 2).history) == 2


def endless(named: bool = True) -> gym.Env:
    """A world whose episodes nothing ends."""
    if not named:
        return RobotEnv("nfc_gym.envs.jackal:Jackal", context=["psi"])
    return RandomizePsi(gym.make("nfc_gym/JackalFlat-v0", context=["psi"], max_episode_steps=-1), 0.5)


@pytest.mark.parametrize(("named", "episode", "length"), [(True, 7, 7), (False, 7, 7), (True, None, 1000)])
def test_a_world_without_a_time_limit_has_episodes_of_the_simulators_length(
    jackal: Path, named: bool, episode: int | None, length: int
) -> None:
    config, agent = replace(CONFIG, missions=1, episode=episode), ppo_agent(load_policy(jackal))
    done = adapt(agent, endless(named), belief(), Alarm(None), config=config, environment="JackalFlat")
    assert len(done.dataset[0]) == length
    assert not done.dataset[0].ended


def test_an_episode_that_nothing_would_end_is_not_begun() -> None:
    with pytest.raises(InputError, match="the world has no time limit, its episode may never end"):
        execute(lambda o: np.zeros(2), endless(), Alarm(None), 1.0, 0)
    assert len(execute(lambda o: np.zeros(2), endless(), Alarm(None), 1.0, 0, longest=3)) == 3
    assert len(execute(lambda o: np.zeros(2), gym.wrappers.TimeLimit(endless(), 4), Alarm(None), 1.0, 0)) == 4
    envs = gym.make_vec(
        "nfc_gym/JackalFlat-v0", num_envs=2, context=["psi"], autoreset_mode="Disabled", max_episode_steps=-1
    )
    assert evaluate(lambda o: np.zeros((2, 2)), envs, longest=5).lengths.tolist() == [5, 5]


@pytest.mark.parametrize(
    ("there", "given", "episode", "task"),
    [
        (world, {}, 30, None),
        (lambda: world(task="figure8"), {}, 30, "figure8"),
        (nameless, {"environment": "JackalFlat"}, 1000, None),
    ],
)
def test_what_is_imagined_is_as_the_world(
    jackal: Path, monkeypatch: pytest.MonkeyPatch, there: Any, given: dict[str, Any], episode: int, task: str | None
) -> None:
    """Its task, and the length of its episodes where it says it."""

    class Asked(Exception):
        pass

    def asked(*_: Any, **how: Any) -> Any:
        assert how["episode"] == episode
        assert how["settings"].get("task") == task
        raise Asked

    monkeypatch.setattr("nfc_gym.adaptation.algorithm.imagined", asked)
    config = replace(CONFIG, episode=None)
    with pytest.raises(Asked):
        adapt(ppo_agent(load_policy(jackal)), there(), belief(), Alarm(5), config=config, threads=1, **given)


@pytest.mark.parametrize(
    ("judged", "changes"),
    [
        pytest.param([3, 1, 1, 2], False, id="learning made it worse"),
        pytest.param([3, 1, 4, 2], True, id="better on the way"),
        pytest.param([1, 2, 2, 3, 1, 5, 2, 2, 2], False, id="the given ones again"),
        pytest.param([1, 2, 2, 3, 4, 1, 2, 2, 2], True, id="what was learned before"),
        pytest.param([3, 1, 1, 2, 5, 3, 1, 1, 1], True, id="what was learned, but not deployed then"),
    ],
)
def test_the_best_weights_of_all_missions_are_deployed(
    jackal: Path, monkeypatch: pytest.MonkeyPatch, judged: list[int], changes: bool
) -> None:
    """By what is foretold of where learning has come to, of those that earlier missions left, and at three points."""
    values = iter(judged)
    judge = lambda *_: SimpleNamespace(returns=np.full(2, float(next(values))))  # noqa: E731
    monkeypatch.setattr("nfc_gym.adaptation.algorithm.evaluate", judge)
    policy = load_policy(jackal)
    before = state(policy.network)
    config = replace(CONFIG, judged=2, steps=3 * 256, missions=1 + (len(judged) > 4))
    done = adapt(ppo_agent(policy, ONCE), world(), belief(), Alarm(20), config=config, threads=1)
    assert same(state(policy.network), before) != changes
    assert done.history[-1]["chosen"] == max(judged[4:] or judged)


@pytest.mark.parametrize(
    ("returns", "begins", "deployed"),
    [
        pytest.param({0.0: [1, 2, 3], 1.0: [4, 6, 7]}, 1.0, 1.0, id="clearly better"),
        pytest.param({0.0: [1, 2, 3], 1.0: [9, 1, 2]}, 0.0, 1.0, id="better, perhaps"),
        pytest.param({0.0: [1, 2, 3], 1.0: [1, 2, 3]}, 0.0, 0.0, id="as good"),
    ],
)
def test_learning_goes_on_from_where_it_was_unless_that_is_clearly_worse(
    returns: dict[float, list[int]], begins: float, deployed: float
) -> None:
    weights = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(weights.weight)
    agent: Any = SimpleNamespace(weights=weights)
    choice = Choice(agent, lambda: np.array(returns[weights.weight.item()], float), [{"weight": torch.ones(1, 1)}])
    assert weights.weight.item() == begins
    choice.take()
    assert weights.weight.item() == deployed
    assert choice.best == np.mean(returns[deployed])


def test_sac_adapts_too(jackal: Path) -> None:
    policy = load_policy(jackal)
    before = state(policy.network.gaussian)
    agent = sac_agent(policy, OffPolicyConfig(batch=64, updates=2, critic_first=4))
    done = adapt(agent, world(), belief(False), Alarm(20), config=CONFIG, threads=1)
    assert done.anomalies == 2
    assert not same(state(policy.network.gaussian), before)
    assert all(v.isfinite().all() for v in policy.network.state_dict().values())


def test_an_agent_of_a_script_that_knows_nothing_of_us() -> None:
    """Written against `GymEnv("nfc_gym:nfc_gym/JackalFlat-v0", context=[])` alone."""
    net = nn.Sequential(nn.Linear(17, 32), nn.Tanh(), nn.Linear(32, 4), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]), in_keys=["loc", "scale"],
        distribution_class=TanhNormal, return_log_prob=True,
    )  # fmt: skip
    critic = ValueOperator(nn.Linear(17, 1), in_keys=["observation"])
    before = copy.deepcopy(net.state_dict())
    agent = Agent(actor, lambda a, size: ClipPPOLoss(a, critic, entropy_bonus=False), Sight.of(world()))
    adapt(agent, world(), belief(), Alarm(20), config=CONFIG, threads=1)
    assert any((before[k] != v).any() for k, v in net.state_dict().items())


def scripted(inner: nn.Module) -> Agent:
    """An agent of a script with a layer of its own."""
    net = nn.Sequential(nn.Linear(17, 8), inner, nn.Linear(8, 4), NormalParamExtractor())
    body = TensorDictModule(net, ["observation"], ["loc", "scale"])
    actor = ProbabilisticActor(
        body, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    )  # fmt: skip
    critic = ValueOperator(nn.Linear(17, 1), in_keys=["observation"])
    return Agent(actor, lambda a, size: ClipPPOLoss(a, critic, entropy_bonus=False), Sight.of(world()))


@pytest.mark.parametrize("inner", [nn.Dropout(0.5), nn.BatchNorm1d(8), BatchRenorm1d(8)])
def test_what_is_executed_is_not_explored_and_leaves_no_trace_in_the_actor(inner: nn.Module) -> None:
    agent = scripted(inner)
    before, seen = state(agent.actor), np.ones((3, 17), np.float32)
    np.testing.assert_array_equal(agent(seen), agent(seen))
    assert agent(seen[0]).shape == (2,)
    adapt(agent, world(), belief(), Alarm(None), config=CONFIG, threads=1)
    assert same(state(agent.actor), before)
    assert inner.training, "as it was: learning goes on in it"


@pytest.mark.parametrize("kept", [True, False])
def test_layers_without_a_size_are_named(kept: bool) -> None:
    """TorchRL's `MLP` is lazy unless it is told what comes in."""
    critic = ValueOperator(MLP(out_features=1, num_cells=[8]), in_keys=["observation"])
    agent = scripted(nn.Tanh())
    agent.loss = lambda a, size: ClipPPOLoss(a, critic)
    agent.weights = nn.ModuleList([agent.actor, critic]) if kept else None
    with pytest.raises(InputError, match=f"weight' of its `{'weights' if kept else 'loss'}` has no size yet: call"):
        adapt(agent, world(), belief(), Alarm(20), config=CONFIG, threads=1)


def test_policy_opt_of_one_seed_is_the_same_whatever_was_drawn_before(jackal: Path) -> None:
    """With critics that the loss makes anew, too."""
    found = []
    for drawn in (0, 1):
        torch.manual_seed(drawn)
        policy = load_policy(jackal)
        envs = gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=4, context=["psi"], autoreset_mode="Disabled", nthread=1)
        optimise(sac_agent(policy, OffPolicyConfig(batch=64, updates=2, critic_first=2)), envs, 64, seed=3)
        found.append(state(policy.network))
    assert same(*found)


@pytest.mark.parametrize("judged", [0, 2])
def test_a_loss_that_comes_apart_leaves_the_policy_as_it_was(jackal: Path, judged: int) -> None:
    policy = load_policy(jackal)
    agent, before = ppo_agent(policy), state(policy.network)

    class Broken(ClipPPOLoss):
        def forward(self, tensordict: Any) -> Any:
            out = super().forward(tensordict)
            self.seen = getattr(self, "seen", 0) + 1
            return out if self.seen < 10 else out.apply(lambda x: x * float("nan"))

    agent.loss = lambda actor, size: Broken(actor, policy.network.critic, functional=False)
    config = replace(CONFIG, judged=judged)
    done = adapt(agent, world(), belief(), Alarm(20), config=config, threads=1)
    assert "not finite" in done.history[0]["diverged"]
    assert same(state(policy.network), before)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"judged": 1}, "judged is 1; want 0, or 2 episodes"),
        ({"judged": -2}, "judged is -2; want 0, or 2 episodes"),
        ({"judged": 2.5}, "judged is 2.5; want 0, or 2 episodes"),
        ({"judged": "4"}, "judged is '4'; want 0, or 2 episodes"),
        ({"missions": 0}, "missions is 0, want a whole number, 1 or more"),
        ({"worlds": -1}, "worlds is -1, want a whole number, 1 or more"),
        ({"steps": 1.5}, "steps is 1.5, want a whole number"),
        ({"episode": 0}, "episode is 0, want a whole number"),
        ({"seed": -1}, "seed is -1, want a whole number, 0 or more"),
        ({"beta": -1.0}, "beta is -1.0; want a number of standard deviations"),
        ({"beta": "a"}, "beta is 'a'; want a number of standard deviations"),
        ({"beta": float("inf")}, "beta is inf; want a number of standard deviations"),
        ({"parts": 5}, "parts is 5; want parts of the belief"),
        ({"parts": ()}, "parts is \\(\\); want parts of the belief"),
        ({"parts": "psi"}, "parts is 'psi'; want parts of the belief"),
        ({"parts": ("mass",)}, "no part 'mass' of a belief; there are: psi, delta_s, delta_e, effects, noise"),
    ],
)
def test_settings_that_cannot_be_are_named(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        AdaptConfig(**wrong)


def test_numbers_of_numpy_are_kept_as_plain_ones() -> None:
    one, half = np.int64(2), np.float32(0.5)
    for config in (AdaptConfig(worlds=one, judged=one, beta=half), FineTuneConfig(envs=one, vary=half)):
        assert json.loads(json.dumps(asdict(config)))["seed"] == 0


def test_what_does_not_fit_is_named(jackal: Path, tmp_path: Path) -> None:
    policy = load_policy(jackal)
    agent = ppo_agent(policy)
    with pytest.raises(InputError, match=r"want an Agent.*got Policy; ppo_agent"):
        adapt(policy, world(), belief(), Alarm(None))  # type: ignore[arg-type]
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file is a file"):
        adapt(agent, world(), belief(), Alarm(None), folder=tmp_path / "file")
    net = nn.Sequential(nn.Linear(agent.sight.size - 4, 4), NormalParamExtractor())
    unlike = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    with pytest.raises(InputError, match="does not take an observation of"):
        adapt(Agent(unlike, agent.loss, agent.sight), world(), belief(), Alarm(None))
    with pytest.raises(InputError, match="another robot than nfc_gym/AntFlat-v0"):
        adapt(agent, world("AntFlat"), belief(), Alarm(None))
    with pytest.raises(InputError, match="single"):
        adapt(agent, gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=2), belief(), Alarm(None))
    with pytest.raises(InputError, match="a posterior has sample"):
        adapt(agent, world(), object(), Alarm(None))
    with pytest.raises(InputError, match="reset"):
        adapt(agent, world(), belief(), object())
    with pytest.raises(InputError, match="not of delta_e"):
        adapt(agent, world(), belief(), Alarm(None), config=AdaptConfig(parts=("delta_e",)), threads=1)
    with pytest.raises(InputError, match=r"the task 'goal', and the world's is 'figure8': leave it out"):
        adapt(agent, world(task="figure8"), belief(), Alarm(None), settings={"task": "goal"})
    with pytest.raises(InputError, match=r"names no simulator: give its id, as in environment='nfc_gym/JackalFlat-v0'"):
        adapt(agent, nameless(), belief(), Alarm(None))
    with pytest.raises(InputError, match="psi has 3 entries, the world's 17: base_mass, "):
        adapt(agent, world(), Fidelity(np.ones((4, 3))), Alarm(None))
    with pytest.raises(InputError, match="must return a Fidelity"):
        adapt(agent, world(), SimpleNamespace(sample=lambda n, rng: np.ones((n, 17))), Alarm(None))
    with pytest.raises(InputError, match="folder /proc/none cannot be written"):
        adapt(agent, world(), belief(), Alarm(None), folder="/proc/none")
    wide = Agent(agent.actor, agent.loss, agent.sight)
    narrow = gym.wrappers.RescaleAction(world(), -1.0, 1.0)
    narrow.action_space = gym.spaces.Box(-1, 1, (3,))
    with pytest.raises(InputError, match="2 entries"):
        adapt(wide, narrow, belief(), Alarm(None))


def test_policy_opt_takes_any_vector_environment(jackal: Path) -> None:
    agent = ppo_agent(load_policy(jackal))
    before = copy.deepcopy(agent.actor.state_dict())
    envs = gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=4, context=["psi"], autoreset_mode="Disabled", nthread=1)
    optimise(agent, envs, 256)
    assert not same(before, agent.actor.state_dict())


class Says(Alarm):
    """A detector that always says the same."""

    def __init__(self, score: Any, threshold: float = 1.0) -> None:
        self.score, self.threshold = score, threshold

    def update(self, obs: Any, action: Any, next_obs: Any) -> Any:
        return self.score


@pytest.mark.parametrize("score", [float("nan"), "x", None, np.ones(2)])
def test_what_is_no_score_is_no_healthy_one(jackal: Path, score: Any) -> None:
    with pytest.raises(InputError, match="the detector's score"):
        adapt(ppo_agent(load_policy(jackal)), world(), belief(), Says(score), config=CONFIG)


@pytest.mark.parametrize("reward", [float("nan"), "x", np.ones(2)])
def test_a_reward_that_is_no_number_is_told(jackal: Path, reward: Any) -> None:
    class Odd(gym.Wrapper):
        def step(self, action: Any) -> Any:
            observation, given, *rest = self.env.step(action)
            self.count = getattr(self, "count", 0) + 1
            return observation, reward if self.count == 4 else given, *rest

    with pytest.raises(InputError, match=r"reward at step 3 is .*, want a finite number"):
        adapt(ppo_agent(load_policy(jackal)), Odd(world()), belief(), Alarm(None), config=CONFIG)


@pytest.mark.parametrize(
    ("score", "threshold", "told", "anomalous"),
    [(1.0, 4.0, 0.25, False), (-0.5, 0.0, -0.5, False), (-3.0, -2.0, -3.0, False), (2.0, -2.0, 2.0, True)],
)
def test_any_finite_threshold_will_do(
    jackal: Path, monkeypatch: pytest.MonkeyPatch, score: float, threshold: float, told: float, anomalous: bool
) -> None:
    """Where none is above 0 there is no share of it, and the score itself is written down."""
    monkeypatch.setattr("nfc_gym.adaptation.algorithm.optimise", lambda *_, **__: {})
    config = replace(CONFIG, missions=1)
    done = adapt(ppo_agent(load_policy(jackal)), world(), belief(), Says(score, threshold), config=config, threads=1)
    assert done.history[0]["score"] == told
    assert done.history[0]["anomalous"] is anomalous


def _acting(head: type, size: int, keys: tuple[str, ...] = ("observation",)) -> ProbabilisticActor:
    class Body(nn.Linear):
        def forward(self, observation: Any, *_: Any) -> Any:
            return super().forward(observation)

    body = TensorDictModule(Body(17, size), list(keys), ["logits"])
    return ProbabilisticActor(body, in_keys=["logits"], distribution_class=head, return_log_prob=True)


@pytest.mark.parametrize("head", [OneHotCategorical, torch.distributions.OneHotCategorical, Categorical])
def test_actors_that_choose_are_refused(head: type) -> None:
    agent = Agent(_acting(head, 2), lambda *_: None, Sight.of(world()))  # type: ignore[arg-type,return-value]
    with pytest.raises(InputError, match=f"actions must be a continuous vector.*{head.__name__}"):
        adapt(agent, world(), belief(), Alarm(None))


def test_actors_that_want_more_than_an_observation_are_refused_by_name() -> None:
    recurrent = _acting(TanhNormal, 2, ("observation", "h", "is_init"))
    agent = Agent(recurrent, lambda *_: None, Sight.of(world()))  # type: ignore[arg-type,return-value]
    with pytest.raises(InputError, match=r"the actor wants 'h', 'is_init', .*recurrent"):
        adapt(agent, world(), belief(), Alarm(None))


def test_what_is_imagined_has_other_draws_than_what_is_executed(jackal: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []

    class Asked(Exception):
        pass

    def asked(*_: Any, seed: int, **__: Any) -> Any:
        seeds.append(seed)
        raise Asked

    class Told(gym.Wrapper):
        def reset(self, *, seed: int | None = None, **how: Any) -> Any:
            seeds.append(-1 if seed is None else seed)
            return self.env.reset(seed=seed, **how)

    monkeypatch.setattr("nfc_gym.adaptation.algorithm.imagined", asked)
    with pytest.raises(Asked):
        adapt(ppo_agent(load_policy(jackal)), Told(world()), belief(), Alarm(5), config=CONFIG, threads=1)
    assert len(set(seeds)) == len(seeds) == 2
