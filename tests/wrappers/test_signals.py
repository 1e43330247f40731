"""`PerturbSignals` on environments whose numbers are known."""

import gymnasium as gym
import numpy as np
import pytest
from fakes import NoModel, roll, same
from gymnasium import spaces

from nfc_gym.core import InputError
from nfc_gym.wrappers import PerturbSignals, VectorPerturbSignals


class Counting(gym.Env):
    """Observes how many steps were made, tenfold beside it, and what action came."""

    observation_space = spaces.Dict(
        {
            "count": spaces.Box(-np.inf, np.inf, (2,), np.float64),
            "action": spaces.Box(-np.inf, np.inf, (1,), np.float32),
        }
    )
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, end: int = 1000) -> None:
        self.end = end

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        self.count = 0
        return self._observe(np.zeros(1, np.float32)), {}

    def step(self, action):
        self.count += 1
        return self._observe(action), 0.0, self.count >= self.end, False, {}

    def _observe(self, action):
        return {"count": np.array([self.count, 10.0 * self.count]), "seen": 0, "action": action} | {}


class Plain(Counting):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def _observe(self, action):
        return np.array([self.count, 10.0 * self.count])


def test_bias_and_delay_of_an_observation() -> None:
    env = PerturbSignals(Counting(), {"count": {"bias": [0.5, -1.0], "delay": 2}})
    shown = [env.reset()[0]["count"]] + [env.step(np.zeros(1))[0]["count"] for _ in range(4)]
    np.testing.assert_array_equal(shown, [[0.5, -1], [0.5, -1], [0.5, -1], [1.5, 9], [2.5, 19]])
    again = env.reset()[0]["count"]
    np.testing.assert_array_equal(again, [0.5, -1])  # the past is forgotten


def test_motors_are_late_biased_and_stay_in_the_space() -> None:
    class Seen(Plain):
        def _observe(self, action):
            return np.array([action[0], 0.0])

    env = PerturbSignals(Seen(), {"action": {"bias": 0.2, "delay": 1}})
    env.reset()
    shown = [env.step(np.array([a], np.float32))[0][0] for a in (0.1, 0.3, 0.9, -0.5)]
    np.testing.assert_allclose(shown, [0.3, 0.3, 0.5, 1.0], rtol=1e-6)


def test_noise_has_the_spread_asked_for_and_a_seed_repeats_it() -> None:
    env = PerturbSignals(Plain(), {"observation": {"sd": [0.1, 0.0], "bias_sd": 0.0}})
    env.reset(seed=1)
    shown = np.array([env.step(np.zeros(1))[0] for _ in range(4000)])
    errors = shown[:, 0] - np.arange(1, 4001)
    assert errors.std() == pytest.approx(0.1, rel=0.05)
    assert abs(errors.mean()) < 0.01
    np.testing.assert_array_equal(shown[:, 1], 10.0 * np.arange(1, 4001))
    env.reset(seed=1)
    np.testing.assert_array_equal([env.step(np.zeros(1))[0] for _ in range(10)], shown[:10])


def test_a_drawn_bias_holds_for_an_episode() -> None:
    env = PerturbSignals(Plain(), {"observation": {"bias_sd": 1.0}})
    first = env.reset(seed=0)[0]
    np.testing.assert_allclose(env.step(np.zeros(1))[0] - first, [1, 10])
    others = np.array([env.reset()[0] for _ in range(2000)])
    np.testing.assert_allclose(others.std(0), 1, rtol=0.1)


def test_zeros_change_nothing_and_types_stay() -> None:
    noise = {"observation": {"sd": 0.0, "bias": 0.0, "delay": 0}, "action": {}}
    env, bare = PerturbSignals(gym.make("Ant-v5"), noise), gym.make("Ant-v5")
    same(roll(env, 5), roll(bare, 5))
    assert PerturbSignals(NoModel(), {"observation": {"sd": 0.1}}).reset()[0].dtype == np.float32


def test_spaces_hold_what_comes_out() -> None:
    env = PerturbSignals(NoModel(), {"observation": {"sd": 10.0}})
    env.reset(seed=0)
    for _ in range(20):
        assert env.step(np.zeros(1))[0] in env.observation_space


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_rows_of_a_vector_environment_forget_on_their_own(mode) -> None:
    makers = [lambda end=end: Plain(end) for end in (3, 5)]
    env = VectorPerturbSignals(gym.vector.SyncVectorEnv(makers, autoreset_mode=mode), {"observation": {"delay": 2}})
    shown = [env.reset()[0][:, 0]]
    done = np.zeros(2, bool)
    for _ in range(6):
        if mode is gym.vector.AutoresetMode.DISABLED and done.any():
            shown.append(env.reset(options={"reset_mask": done})[0][:, 0])
        observation, _, ended, truncated, _ = env.step(np.zeros((2, 1)))
        done = ended | truncated
        shown.append(observation[:, 0])
    # Two steps late, the first value in between. The rows end after 3 and 5 steps.
    expected = {
        gym.vector.AutoresetMode.NEXT_STEP: ([0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 2, 3, 0]),
        gym.vector.AutoresetMode.SAME_STEP: ([0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 2, 0, 0]),
        # a reset of one row shows the other as it was before
        gym.vector.AutoresetMode.DISABLED: ([0, 0, 0, 1, 0, 0, 0, 0, 1], [0, 0, 0, 1, 1, 2, 3, 0, 0]),
    }[mode]
    np.testing.assert_array_equal(np.array(shown).T, expected)


def test_a_delay_longer_than_any_episode_keeps_no_more_than_was_seen() -> None:
    env = PerturbSignals(Counting(), {"count": {"delay": 10**12}})
    shown = [env.reset()[0]["count"][0]] + [env.step(np.zeros(1))[0]["count"][0] for _ in range(5)]
    assert shown == [0.0] * 6
    assert len(env.channels["count"].past) == 6


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ({"proprio": {}}, "observation, action"),
        ({"observation": {"variance": 1}}, "sd, bias, bias_sd, delay"),
        ({"observation": {"sd": -1.0}}, "below 0"),
        ({"observation": {"bias": [1.0, 2.0, 3.0]}}, r"\(2,\)"),
        ({"action": {"delay": 0.5}}, "delay"),
        ({"action": {"delay": "a"}}, "delay, in control steps, is 'a', want a whole number"),
        ({"action": {"sd": "a"}}, "sd is a finite number or .* got 'a'"),
        ({"action": {"sd": True}}, "sd is a finite number or .* got True"),
        ({"action": {"bias": "0.1"}}, "bias is a finite number or .* got '0.1'"),
        ({"action": {"bias": 1e39}}, "bias is a finite number .* as float32 holds them, got 1e\\+39"),
        ({"action": 5}, "action is 5; want a fault as a mapping, such as"),
        (None, "noise is None; want signal -> fault, such as"),
    ],
)
def test_bad_input_is_refused_by_name(noise, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PerturbSignals(Plain(), noise)


def test_keys_that_are_no_numbers_are_refused() -> None:
    class Discrete(Plain):
        action_space = spaces.Discrete(3)

    with pytest.raises(InputError, match="no Box"):
        PerturbSignals(Discrete(), {"action": {"sd": 1.0}})


class Whole(gym.Env):
    """Observes one whole number."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, dtype: type[np.integer], value: int, low: int, high: int) -> None:
        self.observation_space, self.value = spaces.Box(low, high, (1000,), dtype), value

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        return np.full(1000, self.value, self.observation_space.dtype), {}


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64])
def test_whole_numbers_are_rounded(dtype: type[np.integer]) -> None:
    seen, _ = PerturbSignals(Whole(dtype, 100, 0, 255), {"observation": {"sd": 3.0}}).reset(seed=0)
    assert seen.dtype == dtype
    assert abs(seen.mean() - 100) < 0.3
    for bias, expected in ((0.6, 101), (-0.4, 100), (1e3, 255), (-1e3, 0)):
        seen, _ = PerturbSignals(Whole(dtype, 100, 0, 255), {"observation": {"bias": bias}}).reset(seed=0)
        np.testing.assert_array_equal(seen, expected)


@pytest.mark.parametrize("dtype", [np.uint64, np.int64, np.int16])
def test_whole_numbers_stay_in_what_their_type_holds(dtype: type[np.integer]) -> None:
    info = np.iinfo(dtype)
    for bias, end in ((1e30, int(info.max)), (-1e30, int(info.min))):
        env = PerturbSignals(Whole(dtype, 5, int(info.min), int(info.max)), {"observation": {"bias": bias}})
        seen, _ = env.reset(seed=0)
        np.testing.assert_allclose(seen.astype(float), float(end), rtol=1e-12)


def test_one_bound_is_kept_too() -> None:
    class Below(Plain):
        observation_space = spaces.Box(-np.inf, 1.0, (2,), np.float64)

    env = PerturbSignals(Below(), {"observation": {"bias": 5.0}})
    assert env.reset()[0] in env.observation_space


@pytest.mark.parametrize("fault", [{"delay": 1}, {"bias": 0.1}])
@pytest.mark.parametrize("action", [0.0, np.zeros((1, 1)), np.zeros(3), None, "a"])
def test_a_wrong_action_does_not_become_a_right_one(action, fault) -> None:
    env = PerturbSignals(Plain(), {"action": fault})
    env.reset()
    with pytest.raises(InputError, match=r"action has shape .*, want \(1,\)|action is .*, want numbers"):
        env.step(action)


def test_a_step_before_the_first_reset_is_refused() -> None:
    with pytest.raises(gym.error.ResetNeeded, match="before the first reset"):
        PerturbSignals(Plain(), {"observation": {"sd": 1.0}}).step(np.zeros(1))


def test_a_last_observation_takes_nothing_from_the_other_rows() -> None:
    """Whose noise is what it would be, had no episode ended."""
    mode, noise = gym.vector.AutoresetMode.SAME_STEP, {"observation": {"sd": 0.1}}
    ends = VectorPerturbSignals(gym.vector.SyncVectorEnv([lambda: Plain(2), Plain], autoreset_mode=mode), noise)
    runs = VectorPerturbSignals(gym.vector.SyncVectorEnv([Plain, Plain], autoreset_mode=mode), noise)
    same(ends.reset(seed=1)[0], runs.reset(seed=1)[0])
    for k in range(5):
        (seen, *_, info), (expected, *_) = ends.step(np.zeros((2, 1))), runs.step(np.zeros((2, 1)))
        same(seen[1], expected[1])
        if k % 2:
            error = info["final_obs"][0] - [2.0, 20.0]
            assert (abs(error) > 0).all()
            assert (abs(error) < 0.6).all()


def test_a_mask_that_its_owner_clears_afterwards_was_a_mask() -> None:
    mode = gym.vector.AutoresetMode.DISABLED
    env = VectorPerturbSignals(gym.vector.SyncVectorEnv([Counting] * 2, autoreset_mode=mode), {"action": {"delay": 3}})
    env.reset()
    for _ in range(5):
        env.step(np.ones((2, 1), np.float32))
    mask = np.array([True, False])
    env.reset(options={"reset_mask": mask})
    mask[:] = False
    observation, *_ = env.step(np.full((2, 1), -1, np.float32))
    np.testing.assert_array_equal(observation["action"], [[-1], [1]])  # a new episode's first command, and a late one


def test_rows_that_are_reset_one_after_the_other_all_forget() -> None:
    shown = []
    for masks in ([[True, True, False]], [[True, False, False], [False, True, False]]):
        envs = gym.vector.SyncVectorEnv([Counting] * 3, autoreset_mode=gym.vector.AutoresetMode.DISABLED)
        env = VectorPerturbSignals(envs, {"action": {"delay": 2}})
        env.reset(seed=0)
        for _ in range(3):
            env.step(np.full((3, 1), 0.5, np.float32))
        for mask in masks:
            env.reset(options={"reset_mask": np.array(mask)})
        shown.append([env.step(np.full((3, 1), -0.5, np.float32))[0]["action"][:, 0] for _ in range(3)])
    np.testing.assert_array_equal(shown[0], [[-0.5, -0.5, 0.5], [-0.5, -0.5, 0.5], [-0.5, -0.5, -0.5]])
    np.testing.assert_array_equal(shown[1], shown[0])
