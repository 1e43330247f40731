"""Tasks with goals: Jackal and Quadcopter reach and follow them, and the goal-conditioned interface."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from nfc_gym.envs import jackal, quadcopter
from nfc_gym.envs.path import figure_eight
from nfc_gym.envs.robot import goal_reward
from nfc_gym.envs.rotations import axes, to_robot, to_world, turned, yaw
from nfc_gym.envs.vector import RobotVectorEnv


def made(name: str, **kwargs: Any) -> gymnasium.Env:
    return gymnasium.make(f"nfc_gym/{name}-v0", **({"terrain_pool": 2, "context": ["psi"]} | kwargs))


def steer(goal: np.ndarray) -> np.ndarray:
    """A driver: turns to the goal (ahead, left), and drives once it roughly faces it."""
    ahead, left = goal
    bearing = np.arctan2(left, ahead)
    speed = np.clip(1.5 * ahead, -1, 1) if abs(bearing) < 0.5 else 0.0
    return np.array([speed, np.clip(1.2 * bearing, -1, 1)])


@pytest.mark.parametrize("name", ["JackalFlat", "JackalRough"])
def test_a_simple_driver_reaches_goals(name: str) -> None:
    env = made(name, difficulty=0.3)
    reached = 0
    for seed in range(4):
        obs, info = env.reset(seed=seed)
        start, progress = info["distance"], 0.0
        assert jackal.NEAREST <= start <= jackal.FARTHEST
        for _ in range(700):
            obs, _, terminated, _, info = env.step(steer(obs["goal"]))
            progress += info["reward/progress"] * 0.02
            assert not terminated
        assert progress == pytest.approx(start - info["distance"], abs=1e-9), "progress adds up to the way made good"
        assert (info["reward/arrival"] > 0) == info["success"] == (info["distance"] < 0.3)
        reached += bool(info["success"])
    assert reached >= (4 if name == "JackalFlat" else 3)


def test_jackals_actions_are_forward_speed_and_yaw_rate() -> None:
    env = made("JackalFlat")
    env.reset(seed=0)
    env.step([0.5, 0.0])
    np.testing.assert_allclose(env.unwrapped.data.ctrl, 1.0 / 0.098)
    env.step([0.0, 0.25])
    np.testing.assert_allclose(env.unwrapped.data.ctrl, np.array([-1, 1, -1, 1]) * 0.37559 / 2 / 0.098)
    for _ in range(100):
        obs, *_ = env.step([0.5, 0.0])
    np.testing.assert_allclose(obs["proprio"][4:7], [1.0, 0, 0], atol=0.03)
    for _ in range(100):
        obs, *_ = env.step([0.0, 0.5])
    assert obs["proprio"][9] > 0.8, "turns left; skid steering gives less than the 2 rad/s of wheels that grip"
    for turn, rate in ((0.5, 1.2), (1.0, 2.6)):  # what docs/environments.md says of a turn on the spot
        env.reset(seed=0)
        rates = [env.step([0.0, turn])[0]["proprio"][9] for _ in range(150)]
        assert np.mean(rates[50:]) == pytest.approx(rate, abs=0.05)


def test_a_jackal_that_tips_or_leaves_the_map_ends() -> None:
    env = made("JackalFlat")
    for qpos, ended in (((0, 0), False), ((12.5, 0), True), ((0, -12.5), True)):
        env.reset(seed=0)
        env.unwrapped.data.qpos[:2] = qpos
        assert env.step(np.zeros(2))[2] == ended
    env.reset(seed=0)
    env.unwrapped.data.qpos[2:7] = 0.25, np.cos(0.75), np.sin(0.75), 0, 0  # rolled by 1.5 rad
    assert env.step(np.zeros(2))[2]


def test_figure_eight_is_followed() -> None:
    """The point starts at the robot, moves as the curve says, and a simple driver stays within reach of it."""
    env = made("JackalFlat", task="figure8")
    obs, info = env.reset(seed=0)
    assert info["distance"] == pytest.approx(0, abs=1e-9)
    assert "reward/tracking" in info
    farthest, driven = 0.0, 0.0
    for _ in range(1000):
        obs, _, terminated, truncated, info = env.step(steer(4 * obs["goal"]))
        assert not terminated
        farthest = max(farthest, float(info["distance"]))
        driven += abs(float(obs["proprio"][4])) * 0.02
    assert truncated
    assert farthest < 1.0
    assert driven > 16, "a lap of 18 m"
    assert info["distance"] < 0.7, "back at the crossing after one lap of 20 s"


def test_the_curve_closes_and_crosses_in_the_middle() -> None:
    lap = np.linspace(0, 1, 1001)
    x, y = figure_eight(lap, 4.0, 1.0, 2.0, np.pi / 2)
    np.testing.assert_allclose([x[0], x[500], x[-1]], 1.0, atol=1e-12)
    np.testing.assert_allclose([y[0], y[500], y[-1]], 2.0, atol=1e-12)
    assert y.max() - y.min() == pytest.approx(8.0, abs=1e-4), "its length runs along the heading"
    assert x.max() - x.min() == pytest.approx(4.0, abs=1e-4)


def fly(obs: np.ndarray) -> np.ndarray:
    """A pilot: thrust for the height, tilt for the way, damped by speeds and rates; keeps its heading."""
    offset, quat, velocity, rates = obs[:3], obs[3:7].astype(float), obs[7:10], obs[10:13]
    frame = axes(quat)
    wish = to_robot(axes(turned(np.array([1.0, 0, 0, 0]), yaw(quat))), 1.0 * np.clip(offset, -1.5, 1.5) - velocity)
    pitch = np.arctan2(-frame.zx, frame.zz)
    roll = np.arctan2(frame.zy, frame.zz)
    tilt = np.clip(0.25 * wish[:2], -0.35, 0.35)
    about_y = 0.8 * (tilt[0] - pitch) - 0.12 * rates[1]
    about_x = 0.8 * (-tilt[1] - roll) - 0.12 * rates[0]
    lift = 0.5 + 0.35 * wish[2] / 1.5
    about_z = -0.1 * rates[2]
    left, right = np.array([1, -1, 1, -1]), np.array([-1, 1, 1, -1])  # signs of roll, and of the rotors' spin
    rear = np.array([-1, -1, 1, 1])
    return np.clip(2 * (lift + about_x * left + about_y * rear + about_z * right) - 1, -1, 1)


def test_a_simple_pilot_reaches_goals() -> None:
    env = made("QuadcopterFlat")
    reached = 0
    for seed in range(4):
        obs, info = env.reset(seed=seed)
        for _ in range(600):
            obs, _, terminated, _, info = env.step(fly(obs["proprio"]))
            if terminated:
                break
        reached += bool(info["success"])
    assert reached >= 3


def test_a_quadcopter_ends_where_it_should() -> None:
    env = made("QuadcopterFlat")

    def ends(change: Any) -> bool:
        env.reset(seed=0)
        change(env.unwrapped.data)
        return env.step(np.zeros(4))[2]

    def put(x: float, y: float, z: float) -> Any:
        return lambda data: data.qpos.__setitem__(slice(3), (x, y, z))

    env.reset(seed=0)
    goal, start = env.unwrapped._view.task["goal"], env.unwrapped._view.task["start"]
    assert not ends(lambda data: None)
    assert ends(put(0, 0, 0.05)), "on the ground"
    half = (goal + start) / 2
    across = np.cross(goal - start, [0, 0, 1])
    across /= np.linalg.norm(across)
    assert not ends(put(*(half + 7.8 * across)))
    assert ends(put(*(half + 8.2 * across)))
    assert not ends(put(*(goal + 7.8 * (goal - start) / np.linalg.norm(goal - start))))
    assert ends(put(*(goal + np.array([0, 0, 8.5]))))
    for angle, ended in ((2.4, False), (2.6, True)):
        turn = (np.cos(angle / 2), np.sin(angle / 2), 0, 0)
        assert ends(lambda data, turn=turn: data.qpos.__setitem__(slice(3, 7), turn)) == ended


def test_obstacles_are_flown_into_and_goals_lie_above_them() -> None:
    env = made("QuadcopterRough", difficulty=1.0)
    for seed in range(20):
        env.reset(seed=seed)
        own = env.unwrapped
        goal = own._view.task["goal"]
        assert goal[2] >= own._ground(goal[:2]) + quadcopter.ABOVE - 1e-9
        assert own.data.ncon == 0
    row, column = np.unravel_index(own.heightfield.heights.argmax(), (256, 256))
    own.data.qpos[:3] = -12.75 + 0.1 * column, -12.75 + 0.1 * row, own.heightfield.heights.max() - 0.3
    assert env.step(np.zeros(4))[2]


@pytest.mark.parametrize("task", quadcopter.Quadcopter.tasks)
def test_a_quadcopter_starts_above_ground_that_is_raised(task: str) -> None:
    """Above any map that is given, and above a residual beneath the start that is not seen."""
    env = made("QuadcopterRough", task=task)
    hill = np.zeros((256, 256))
    hill[118:138, 118:138] = 3.0  # m, 2 m wide, in the middle
    grounds = {"heightfield": np.full((256, 256), 3.0), "terrain_residual": hill}
    for name, ground in grounds.items():
        for seed in range(4):
            env.reset(seed=seed, options={name: ground})
            x, y, z = env.unwrapped.data.qpos[:3]
            assert z >= env.unwrapped._ground(np.array((x, y))) + quadcopter.ABOVE - 1e-9
            assert not any(env.step(np.zeros(4))[2] for _ in range(20)), (name, seed)


def test_the_quadcopter_follows_a_figure_eight() -> None:
    env = made("QuadcopterFlat", task="figure8")
    _, info = env.reset(seed=0)
    assert info["distance"] == pytest.approx(0, abs=1e-12)
    _, _, _, _, info = env.step(np.zeros(4))
    assert 0.01 < info["distance"] < 0.06, "the point has moved by 0.02 s of its way"


@pytest.mark.parametrize("name", ["JackalFlat", "QuadcopterRough"])
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_the_goal_interface(name: str, reward_type: str) -> None:
    """The contract of gymnasium-robotics' `GoalEnv`: reward and ends are functions of goals and info."""
    env = made(name, goal_conditioned=True, reward_type=reward_type)
    obs, info = env.reset(seed=0)
    assert set(obs) == {"observation", "achieved_goal", "desired_goal", "psi"}
    own = env.unwrapped
    rows = []
    for _ in range(40):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert reward == own.compute_reward(obs["achieved_goal"], obs["desired_goal"], info)
        assert terminated == own.compute_terminated(obs["achieved_goal"], obs["desired_goal"], info)
        assert truncated == own.compute_truncated(obs["achieved_goal"], obs["desired_goal"], info)
        rows.append((obs["achieved_goal"], obs["desired_goal"], info, reward, terminated))
        if terminated:
            obs, _ = env.reset()
    achieved, desired, infos, rewards, ends = (list(column) for column in zip(*rows, strict=True))
    np.testing.assert_array_equal(own.compute_reward(np.array(achieved), np.array(desired), infos), rewards)
    np.testing.assert_array_equal(own.compute_terminated(np.array(achieved), np.array(desired), infos), ends)
    same = own.compute_reward(np.array(achieved), np.array(achieved), infos)
    np.testing.assert_array_equal(same, np.zeros(len(rows)))


def test_observations_of_goal_conditioned_environments_hold_nothing_of_the_goal() -> None:
    for name in ("JackalFlat", "QuadcopterFlat"):
        env = made(name, goal_conditioned=True)
        a, _ = env.reset(seed=0)
        own = env.unwrapped
        own._view.task["goal"] = own._view.task["goal"] + 1.0
        own._view.now = own.robot.derive(own._view)
        b = own._observation()
        np.testing.assert_array_equal(a["observation"], b["observation"])
        np.testing.assert_allclose(b["desired_goal"], a["desired_goal"] + 1, atol=1e-5)


def test_goal_conditioned_vectors_equal_single_environments() -> None:
    envs = gymnasium.make_vec("nfc_gym/QuadcopterFlat-v0", num_envs=2, goal_conditioned=True, context=["psi"])
    env = made("QuadcopterFlat", goal_conditioned=True)
    many, one = envs.reset(seed=1)[0], env.reset(seed=2)[0]
    for _ in range(10):
        many, reward, *_ = envs.step(np.zeros((2, 4)))
        one, own, *_ = env.step(np.zeros(4))
        assert reward[1] == own
        for key in one:
            np.testing.assert_array_equal(many[key][1], one[key])
    np.testing.assert_array_equal(
        envs.unwrapped.compute_reward(many["achieved_goal"], many["desired_goal"], {}), reward
    )


def test_goal_reward_by_hand() -> None:
    achieved, desired = np.array([[0.0, 0, 0], [3, 4, 0]]), np.array([[0.0, 0, 0.2], [0, 0, 0]])
    np.testing.assert_array_equal(goal_reward(achieved, desired, 0.3, "sparse"), [0, -1])
    np.testing.assert_allclose(goal_reward(achieved, desired, 0.3, "dense"), [-0.2, -5], rtol=1e-6)


def test_rotations_agree_with_each_other() -> None:
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(50, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    vector = rng.normal(size=(50, 3))
    frame = axes(quat)
    np.testing.assert_allclose(to_world(frame, to_robot(frame, vector)), vector, atol=1e-12)
    np.testing.assert_allclose(np.arctan2(frame.yx, frame.xx), yaw(quat), atol=1e-12)
    angle = rng.uniform(-1, 1, 50)
    about_z = turned(np.array([1.0, 0, 0, 0]), angle)
    np.testing.assert_allclose(yaw(about_z), angle, atol=1e-12)
    np.testing.assert_array_equal(np.array(axes(quat[7])), np.array(frame)[:, 7])


def test_places_of_goals_can_be_read_back() -> None:
    envs = gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=3, context=["psi"])
    observation, _ = envs.reset(seed=0)
    base = envs.unwrapped
    turn = 2 * np.arctan2(*observation["proprio"][:, [3, 0]].T)  # upright at the start: yaw alone
    ahead, left = observation["goal"].T
    gap = np.stack([np.cos(turn) * ahead - np.sin(turn) * left, np.sin(turn) * ahead + np.cos(turn) * left], 1)
    assert base.places == pytest.approx(observation["proprio"][:, 10:12] + gap, abs=1e-4)


def test_a_subclass_sets_the_size_of_the_figure_of_eight() -> None:
    class Small(jackal.Jackal):
        loop, lap = 1.5, 10.0

    envs = RobotVectorEnv(Small, num_envs=1, task="figure8", context=["psi"])
    envs.reset(seed=0)
    places = [envs.places[0]]
    for _ in range(500):
        envs.step(np.zeros((1, 2)))
        places.append(envs.places[0])
    away = np.linalg.norm(np.array(places) - places[0], axis=1)
    assert away[-1] == pytest.approx(0, abs=1e-6)  # a lap of 10 s
    assert away.max() == pytest.approx(1.5, abs=1e-3)
