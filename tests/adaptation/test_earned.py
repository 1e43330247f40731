"""What a robot earns as a sign: at home it seldom is one, where it earns less it soon is, and then the agent adapts."""

from pathlib import Path

import numpy as np
import pytest
from test_algorithm import CONFIG, Alarm, belief, same, state, world

from nfc_gym import InputError
from nfc_gym.adaptation import adapt, load_policy, ppo_agent
from nfc_gym.adaptation.earned import LAST, RATE, chance


def test_at_home_it_is_as_rare_as_said_and_where_half_is_lost_it_shows_within_five() -> None:
    rng = np.random.default_rng()
    alarms, found = [], []
    for _ in range(600):
        home = 3000 + 1200 * rng.standard_normal(64)
        alarms.append(chance(home, 3000 + 1200 * rng.standard_normal(5)) < RATE)
        found.append(chance(home, 1200 + 600 * rng.standard_normal(LAST)) < RATE)
    assert np.mean(alarms) < 2.5 * RATE  # of 64 returns the lowest ranks are coarse
    assert np.mean(found) > 0.8


def test_only_the_last_count_and_ranks_alone() -> None:
    home = np.arange(64.0)
    assert chance(home, [0.0, 0.0, *LAST * [50]]) == chance(home, LAST * [50])
    assert chance(home, [5, 6, 7]) == pytest.approx(chance(np.exp(home), np.exp([5, 6, 7])))
    assert chance(home, [1.0]) < RATE * 2 < chance(home, [30.0])


def test_too_little_earned_is_an_anomaly_that_no_detector_has_to_see(jackal: Path, tmp_path: Path) -> None:
    policy = load_policy(jackal)
    before = state(policy.network)
    usual = np.linspace(-5, 5, 64)
    rich = adapt(ppo_agent(policy), world(), belief(), Alarm(None), config=CONFIG, threads=1, home=usual - 1e4)
    assert rich.anomalies == 0
    assert same(state(policy.network), before)
    assert all(row["chance"] == 1.0 for row in rich.history)
    poor = adapt(ppo_agent(policy), world(), belief(), Alarm(None), config=CONFIG, threads=1, home=usual + 1e4)
    assert [row["anomalous"] for row in poor.history] == [True, True]
    assert poor.anomalies == 2
    assert not same(state(policy.network), before)


def test_few_returns_say_nothing_of_what_is_usual(jackal: Path) -> None:
    for home in (np.ones(39), np.full(64, np.nan)):
        with pytest.raises(InputError, match="want 40 or more"):
            adapt(ppo_agent(load_policy(jackal)), world(), belief(), Alarm(None), config=CONFIG, home=home)


def test_a_run_goes_on_with_the_returns_that_it_began_with(jackal: Path, tmp_path: Path) -> None:
    def run(home: np.ndarray | None) -> None:
        adapt(ppo_agent(load_policy(jackal)), world(), belief(), Alarm(None), config=CONFIG, folder=tmp_path, home=home)

    usual = np.linspace(-1e4, -9e3, 64)
    run(usual)
    run(usual)
    for other in (usual - 1.0, None):
        with pytest.raises(InputError, match="home"):
            run(other)
