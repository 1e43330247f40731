"""`MonitorAnomaly`: the detector sees each transition once, and its word is in `info`."""

import gymnasium as gym
import numpy as np
import pytest
from fakes import NoModel, roll, same
from test_signals import Plain

from nfc_gym.core import InputError, register_loader
from nfc_gym.wrappers import MonitorAnomaly, VectorMonitorAnomaly


class Jump:
    """Scores how far the first number went, and counts the steps since the last reset."""

    threshold = 1.5

    def __init__(self) -> None:
        self.seen: list = []

    def reset(self, rows=None) -> None:
        self.seen.append(("reset", None if rows is None else rows.tolist()))

    def update(self, obs, action, next_obs):
        self.seen.append((obs[..., 0].tolist(), np.asarray(action)[..., 0].tolist(), next_obs[..., 0].tolist()))
        return abs(next_obs[..., 0] - obs[..., 0])


class Leaping(Plain):
    """Its count leaps at the third step."""

    def step(self, action):
        self.count += 4 if self.count == 2 else 0
        return super().step(action)


def test_transitions_scores_and_threshold() -> None:
    detector = Jump()
    env = MonitorAnomaly(Leaping(), detector)
    infos = [env.reset()[1]] + [env.step(np.array([k]))[4] for k in range(4)]
    assert [float(i["anomaly_score"]) for i in infos] == [0, 1, 1, 5, 1]
    assert [bool(i["anomaly"]) for i in infos] == [False, False, False, True, False]
    assert detector.seen == [("reset", None), (0, 0, 1), (1, 1, 2), (2, 2, 7), (7, 3, 8)]
    assert all(isinstance(v, np.generic | np.ndarray) and v.shape == () for i in infos for v in i.values())
    assert MonitorAnomaly(Leaping(), Jump(), threshold=9.0).threshold == 9.0


def test_vectors_of_monitored_environments_have_masks_of_bools() -> None:
    envs = gym.vector.SyncVectorEnv([lambda: MonitorAnomaly(Leaping(), Jump())] * 2)
    for info in (envs.reset()[1], envs.step(np.zeros((2, 1)))[4]):
        assert info["anomaly"].dtype == bool
        assert info["anomaly_score"].dtype == float


def test_nothing_else_changes() -> None:
    env = MonitorAnomaly(gym.make("Ant-v5"), Jump())
    same(roll(env, 4), roll(gym.make("Ant-v5"), 4))


def test_rows_are_scored_together_and_forgotten_alone() -> None:
    detector = Jump()
    vector = gym.vector.SyncVectorEnv([lambda: Leaping(2), lambda: Leaping()])
    env = VectorMonitorAnomaly(vector, detector)
    _, info = env.reset()
    np.testing.assert_array_equal(info["anomaly"], [False, False])
    scores, flags = [], []
    for _ in range(4):
        info = env.step(np.zeros((2, 1)))[4]
        scores.append(info["anomaly_score"].tolist())
        flags.append(info["anomaly"].tolist())
    # the first row's third observation begins its next episode: no transition, no score
    assert scores == [[1, 1], [1, 1], [0, 5], [1, 1]]
    assert flags == [[False, False], [False, False], [False, True], [False, False]]
    assert [s for s in detector.seen if s[0] == "reset"] == [("reset", None), ("reset", [True, False])]
    assert info["_anomaly"].all()


def test_rows_that_are_not_reset_are_remembered() -> None:
    detector = Jump()
    mode = gym.vector.AutoresetMode.DISABLED
    env = VectorMonitorAnomaly(gym.vector.SyncVectorEnv([Leaping, Leaping], autoreset_mode=mode), detector)
    env.reset()
    options = {"reset_mask": np.array([True, False])}
    env.reset(options=options)
    assert detector.seen == [("reset", None), ("reset", [True, False])]
    assert options["reset_mask"].tolist() == [True, False]


def test_a_detector_in_a_file_is_opened_by_its_suffix(tmp_path) -> None:
    register_loader(".jump", lambda path: Jump())  # type: ignore[arg-type,return-value]
    path = tmp_path / "detector.jump"
    path.touch()
    env = MonitorAnomaly(gym.make("Ant-v5"), path)
    assert '"detector.jump"' not in env.spec.to_json()
    assert str(path) in env.spec.to_json()


def test_bad_input_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="update"):
        MonitorAnomaly(NoModel(), object())  # type: ignore[arg-type]
    silent = Jump()
    silent.threshold = None  # type: ignore[assignment]
    with pytest.raises(InputError, match="threshold"):
        MonitorAnomaly(NoModel(), silent)


class Picky(Jump):
    """Knows `proprio` of the Jackal."""

    def update(self, obs, action, next_obs):
        next_obs = next_obs["proprio"] if isinstance(next_obs, dict) else next_obs
        if next_obs.shape[-1] != 15:
            raise InputError(f"an observation must have 15 entries, got {next_obs.shape}")
        return np.zeros(next_obs.shape[:-1])


@pytest.mark.parametrize("vector", [False, True])
def test_an_observation_with_the_goal_in_it_is_told_of(vector: bool) -> None:
    def env(context: list[str]):
        if vector:
            return VectorMonitorAnomaly(gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=2, context=context), Picky())
        return MonitorAnomaly(gym.make("nfc_gym/JackalFlat-v0", context=context), Picky())

    for context in (["psi"], []):
        monitored = env(context)
        monitored.reset(seed=0)
        if context:
            monitored.step(np.zeros(monitored.action_space.shape))
            continue
        with pytest.raises(InputError, match=r'15 entries.*make the environment with context=\["psi"\]'):
            monitored.step(np.zeros(monitored.action_space.shape))


def test_a_score_that_is_no_number_is_no_healthy_one() -> None:
    class Broken(Jump):
        def update(self, obs, action, next_obs):
            return super().update(obs, action, next_obs) * np.nan

    env = MonitorAnomaly(Plain(), Broken())
    env.reset()
    with pytest.raises(InputError, match="score is nan, want a number"):
        env.step(np.zeros(1))
    envs = VectorMonitorAnomaly(gym.vector.SyncVectorEnv([Plain, Plain]), Broken())
    envs.reset()
    with pytest.raises(InputError, match="score of simulation 0 is nan"):
        envs.step(np.zeros((2, 1)))
    with pytest.raises(InputError, match=r"threshold of the score must be a number, .* got 'a'"):
        MonitorAnomaly(Plain(), Jump(), threshold="a")  # type: ignore[arg-type]


class Leap(Jump):
    """Leaps are NaN; so is what lies between two episodes."""

    def update(self, obs, action, next_obs):
        score = super().update(obs, action, next_obs)
        return np.where(next_obs[..., 0] < obs[..., 0], np.nan, score)


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_an_episodes_last_transition_counts_and_the_gap_to_the_next_does_not(mode: str) -> None:
    mode = gym.vector.AutoresetMode(mode)
    makes = [lambda: Leaping(7), lambda: Leaping(2)]  # the first one's leap ends its episode
    ours = VectorMonitorAnomaly(gym.vector.SyncVectorEnv(makes, autoreset_mode=mode), Leap())
    alone = [lambda make=make: MonitorAnomaly(make(), Leap()) for make in makes]
    theirs = gym.vector.SyncVectorEnv(alone, autoreset_mode=mode)
    ours.reset()
    theirs.reset()
    ends = 0
    for _ in range(8):
        actions = np.zeros((2, 1))
        info, wanted = ours.step(actions)[4], theirs.step(actions)[4]
        np.testing.assert_array_equal(info["anomaly"], wanted["anomaly"].astype(bool))
        np.testing.assert_array_equal(info["anomaly_score"], wanted["anomaly_score"])
        assert ("final_info" in info) == ("final_info" in wanted)
        for key in ("anomaly", "anomaly_score") if "final_info" in info else ():
            last, expected = info["final_info"], wanted["final_info"]
            rows = last[f"_{key}"]
            np.testing.assert_array_equal(rows, expected[f"_{key}"])
            np.testing.assert_array_equal(last[key][rows], expected[key][rows].astype(last[key].dtype))
            ends += bool(last["anomaly"][0])
    assert (ends > 0) == (mode is gym.vector.AutoresetMode.SAME_STEP)


@pytest.mark.parametrize("score", ["x", None, np.ones(2)])
def test_what_is_no_score_is_told(score) -> None:
    class Odd(Jump):
        def update(self, obs, action, next_obs):
            return score

    env = MonitorAnomaly(Plain(), Odd())
    env.reset()
    with pytest.raises(InputError, match=r"MonitorAnomaly: the detector's score is .*, want a number"):
        env.step(np.zeros(1))
