"""Other packages' checks, wrappers and algorithms on the environments, bare and wrapped."""

import multiprocessing
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from cases import BASE, IDS, ONE_MAP, SINGLE, made, play, robot_of, same, wrapped

from nfc_gym.wrappers import VectorPerturbSignals, VectorRandomizePsi

JACKAL, ANT = "nfc_gym/JackalFlat-v0", "nfc_gym/AntFlat-v0"
GOALS = [name for name in IDS if robot_of(name) in ("Jackal", "Quadcopter")]


@pytest.fixture
def torch() -> Any:
    """PyTorch on one thread, seeded."""
    found = pytest.importorskip("torch", reason="needs PyTorch: pip install 'nfc_gym[rl]'")
    found.set_num_threads(1)
    found.manual_seed(0)
    return found


@pytest.fixture
def torchrl(torch: Any) -> Any:
    pytest.importorskip("torchrl", reason="needs TorchRL: pip install 'nfc_gym[rl]'")
    import torchrl.collectors
    import torchrl.envs

    return torchrl


@pytest.fixture
def sb3(torch: Any) -> Any:
    return pytest.importorskip("stable_baselines3", reason="needs Stable-Baselines3: pip install 'nfc_gym[sb3]'")


# ---- Gymnasium ------------------------------------------------------------------------------------------------------


def test_gymnasiums_wrappers(sources: Path) -> None:
    """Observations normalised, actions rescaled, frames stacked, episodes cut, around a wrapped environment."""
    bare = made(ANT, context=["psi"])
    env: Any = wrapped("RandomizePsi", made(ANT, context=[]), sources, null=True)
    env = gym.wrappers.RescaleAction(env, -10.0, 10.0)
    env = gym.wrappers.TimeLimit(env, 4)
    env = gym.wrappers.FrameStackObservation(env, 3)
    first, _ = env.reset(seed=0)
    start = bare.reset(seed=0)[0]["proprio"]
    np.testing.assert_array_equal(first, np.stack([start] * 3))
    action = np.linspace(-1, 1, 8, dtype=np.float32)
    for k in range(4):
        frames, _, _, truncated, _ = env.step(10 * action)
        np.testing.assert_allclose(frames[-1], bare.step(action)[0]["proprio"], rtol=1e-4, atol=1e-4)
        assert truncated == (k == 3)
    normal = gym.wrappers.NormalizeObservation(made(ANT, context=[]))
    seen = np.array([result[0] for result in play(normal, 0, 300)])
    assert np.isfinite(seen).all()
    assert np.abs(seen[-150:].mean(0)).mean() < 0.5
    assert seen in gym.spaces.Box(-np.inf, np.inf, seen.shape, seen.dtype.type)


def test_gymnasiums_vector_wrappers_and_vectorisations() -> None:
    envs = gym.make_vec(JACKAL, num_envs=3, context=[], max_episode_steps=5)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(gym.wrappers.vector.NormalizeObservation(envs))
    envs.reset(seed=0)
    for _ in range(7):
        obs, _, _, truncated, info = envs.step(np.zeros((3, 2), np.float32))
        assert ("episode" in info) == bool(truncated.any())
    assert obs.shape == (3, 17)
    parallel = gym.make_vec(f"nfc_gym:{JACKAL}", num_envs=2, vectorization_mode="async")
    ours = gym.make_vec(JACKAL, num_envs=2)
    same(dict(sorted(parallel.reset(seed=9)[0].items())), dict(sorted(ours.reset(seed=9)[0].items())))
    parallel.close()


def test_flat_observations_have_one_order_in_every_form() -> None:
    """Also through normalisation, as single-file code stacks it, one environment and the batch."""
    one = gym.wrappers.FlattenObservation(made(BASE, context=["psi"]))
    envs = gym.make_vec(BASE, num_envs=2, context=["psi"], nthread=1, terrain_pool=2)
    many = gym.wrappers.vector.FlattenObservation(envs)
    parts = one.env.reset(seed=3)[0]
    flat = np.concatenate([parts[key] for key in sorted(parts)])
    same(one.reset(seed=3)[0], flat)
    same(many.reset(seed=3)[0][0], flat)
    normal = gym.wrappers.vector.NormalizeObservation(many)
    normal.reset(seed=3)
    assert normal.step(np.zeros((2, 2), np.float32))[0] in normal.observation_space


def test_videos_are_recorded(tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="Gymnasium's RecordVideo needs moviepy: pip install 'nfc_gym[test]'")
    env: Any = made("nfc_gym/AntRough-v0", render_mode="rgb_array", width=64, height=64, max_episode_steps=3)
    env.reset(seed=0)
    try:
        env.render()
    except Exception as error:  # no graphics library at all
        pytest.skip(f"cannot render here: {error}")
    env = gym.wrappers.RecordVideo(env, str(tmp_path / "videos"), disable_logger=True)
    play(env, 0, 4)
    env.close()
    videos = sorted(tmp_path.glob("videos/*.mp4"))
    assert [v.name for v in videos] == ["rl-video-episode-0.mp4", "rl-video-episode-1.mp4"]
    assert all(v.stat().st_size > 500 for v in videos)


@pytest.mark.parametrize("name", GOALS)
def test_gymnasium_robotics_takes_it_for_a_goal_environment(name: str) -> None:
    core = pytest.importorskip("gymnasium_robotics.core", reason="needs gymnasium-robotics: pip install 'nfc_gym[rl]'")
    env = made(name, goal_conditioned=True).unwrapped
    for method in ("compute_reward", "compute_terminated", "compute_truncated"):
        assert callable(getattr(core.GoalEnv, method))
        assert callable(getattr(env, method))


@pytest.mark.parametrize("goals", [False, True])
def test_gymnasium_is_a_direct_base_of_what_is_made(goals: bool) -> None:
    """By which skrl's `wrap_env` knows what it was given, looking at the outermost and the bare environment."""
    for made_by in (gym.make, gym.make_vec):
        bare = made_by(JACKAL, goal_conditioned=goals, context=["psi"]).unwrapped
        assert any(base.__module__.startswith("gymnasium.") for base in type(bare).__bases__)


# ---- Stable-Baselines3 ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDS)
def test_stable_baselines_check(name: str, sb3: Any) -> None:
    from stable_baselines3.common.env_checker import check_env

    for context in ([], ["psi"]):
        check_env(made(name, context=context))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*unconventional shape.*")  # of the map: no picture, no vector
        check_env(made(name))
    if name in GOALS:
        check_env(made(name, goal_conditioned=True, context=["psi"]).unwrapped)


@pytest.mark.parametrize(("policy", "context"), [("MlpPolicy", []), ("MultiInputPolicy", ["psi"])])
@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_stable_baselines_trains(algorithm: str, policy: str, context: list[str], sb3: Any) -> None:
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env(JACKAL, n_envs=2, env_kwargs={"context": context, "max_episode_steps": 50}, seed=0)
    sizes = {"PPO": {"n_steps": 64, "n_epochs": 2}, "SAC": {"learning_starts": 100, "train_freq": 8}}[algorithm]
    model = getattr(sb3, algorithm)(
        policy, envs, batch_size=64, policy_kwargs={"net_arch": [32]}, seed=0, device="cpu", **sizes
    )
    before = {k: v.clone() for k, v in model.policy.state_dict().items()}
    model.learn(300)
    after = model.policy.state_dict()
    assert all(v.isfinite().all() for v in after.values())
    assert any((before[k] != v).any() for k, v in after.items())
    assert len(model.ep_info_buffer) >= 4
    assert {round(e["l"]) for e in model.ep_info_buffer} <= set(range(1, 51))
    envs.close()


# ---- TorchRL --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDS)
def test_torchrls_specs(name: str, torch: Any, torchrl: Any) -> None:
    env = torchrl.envs.GymEnv(f"nfc_gym:{name}", terrain_pool=1)
    torchrl.envs.check_env_specs(env)
    steps = env.rollout(3)
    assert steps["proprio"].dtype == torch.float32
    assert not torch.equal(steps["next", "proprio"][0], steps["next", "proprio"][1]), "arrays are not reused"


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrls_specs_of_vectors(mode: str, torchrl: Any) -> None:
    for name in (BASE, ANT):
        many = torchrl.envs.GymWrapper(gym.make_vec(name, num_envs=2, autoreset_mode=mode, terrain_pool=1))
        torchrl.envs.check_env_specs(many)
        assert many.rollout(3).shape == (2, 3)


@pytest.mark.parametrize("name", SINGLE)
def test_torchrls_specs_of_wrapped_environments(name: str, torchrl: Any, sources: Path) -> None:
    env = torchrl.envs.GymWrapper(wrapped(name, gym.make(BASE, **ONE_MAP), sources))
    torchrl.envs.check_env_specs(env)
    assert env.rollout(3).shape == (3,)


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrls_specs_of_wrapped_vectors(mode: str, torchrl: Any) -> None:
    envs = VectorRandomizePsi(gym.make_vec(JACKAL, num_envs=2, autoreset_mode=mode, context=["psi"]), 0.5)
    many = torchrl.envs.GymWrapper(VectorPerturbSignals(envs, {"proprio": {"sd": 0.1}}))
    torchrl.envs.check_env_specs(many)
    assert many.rollout(3).shape == (2, 3)


def test_torchrls_workers_and_collector(torch: Any, torchrl: Any) -> None:
    """Workers know nothing, import the package by the id's prefix, and step as an environment in this process does."""
    multiprocessing.set_forkserver_preload(["torchrl.envs"])  # once for both, and none of this package
    make = partial(torchrl.envs.GymEnv, f"nfc_gym:{JACKAL}", context=["psi"])

    def rolled(env: Any) -> tuple[Any, Any]:
        env.set_seed(0, static_seed=True)
        step, seen, rewards = env.reset(), [], []
        for action in torch.linspace(-1, 1, 8).reshape(4, 2):
            step = env.step(step.set("action", action.expand(*env.batch_size, 2).clone()))
            seen.append(step["next", "proprio"].clone())
            rewards.append(step["next", "reward"].clone())
            step = torchrl.envs.step_mdp(step)
        return torch.stack(seen), torch.stack(rewards)

    one, reward = rolled(make())
    workers = torchrl.envs.ParallelEnv(2, make, mp_start_method="forkserver")
    try:
        many, theirs = rolled(workers)
        for row in range(2):
            assert torch.equal(many[:, row], one)
            assert torch.equal(theirs[:, row], reward)
        collector = torchrl.collectors.Collector(workers, frames_per_batch=40, total_frames=80)
        batches = list(collector)
        assert [b.numel() for b in batches] == [40, 40]
        assert all(torch.isfinite(b["next", "reward"]).all() for b in batches)
    finally:
        workers.close(raise_if_closed=False)


# ---- one file -------------------------------------------------------------------------------------------------------


def test_a_single_file_ppo_learns_on_the_vector_engine(torch: Any) -> None:
    n, horizon, discount, trace = 64, 32, 0.98, 0.95
    envs = gym.make_vec(JACKAL, num_envs=n, context=[], max_episode_steps=150, autoreset_mode="SameStep")
    actor, critic = (
        torch.nn.Sequential(torch.nn.Linear(17, 64), torch.nn.Tanh(), torch.nn.Linear(64, k)) for k in (2, 1)
    )
    spread = torch.nn.Parameter(torch.full((2,), -0.5))
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters(), spread], lr=2e-3)

    def tensor(array: Any) -> Any:
        return torch.as_tensor(array, dtype=torch.float32)

    def policy(obs: Any) -> Any:
        return torch.distributions.Independent(torch.distributions.Normal(actor(obs), spread.exp()), 1)

    obs, progress = tensor(envs.reset(seed=0)[0]), []
    for _ in range(16):
        steps = []
        for _ in range(horizon):
            action = policy(obs).sample()
            after, reward, ended, truncated, _ = envs.step(action.numpy())
            steps.append((obs, action, tensor(reward), tensor(ended | truncated)))
            obs = tensor(after)
        seen, action, reward, done = (torch.stack(column) for column in zip(*steps, strict=True))
        progress.append(float(reward.mean()))
        with torch.no_grad():
            value = critic(torch.cat([seen, obs[None]]))[..., 0]
            error = reward + discount * (1 - done) * value[1:] - value[:-1]
            advantage = error.clone()
            for t in reversed(range(horizon - 1)):
                advantage[t] += discount * trace * (1 - done[t]) * advantage[t + 1]
            target, old = advantage + value[:-1], policy(seen).log_prob(action)
            advantage = (advantage - advantage.mean()) / advantage.std()
        for _ in range(6):
            ratio = (policy(seen).log_prob(action) - old).exp()
            gain = torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
            loss = ((critic(seen)[..., 0] - target) ** 2).mean() - gain
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    assert np.mean(progress[-5:]) > np.mean(progress[:5]) + 0.2  # m towards the goal a control step, times its weight
