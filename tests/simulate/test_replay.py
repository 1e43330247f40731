"""The replay: against the Kalman filter in closed form, and on a Jackal with and without faults."""

import pickle
from copy import deepcopy

import gymnasium
import mujoco
import numpy as np
import pytest

from nfc_gym.core import Fidelity, InputError
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.rates import Threshold, auroc
from nfc_gym.physics.effects import build
from nfc_gym.simulate import start
from nfc_gym.simulate.bank import Fault, ReplayBank, faults_of
from nfc_gym.simulate.ensemble import innovation
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.replay import Replay
from nfc_gym.simulate.trials import trials
from nfc_gym.terrain import make
from nfc_gym.wrappers import MonitorAnomaly, VectorMonitorAnomaly

JACKAL = "nfc_gym/JackalFlat-v0"


@pytest.fixture(scope="module")
def machine() -> Machine:
    return Machine(JACKAL)


@pytest.fixture(scope="module")
def replay() -> Replay:
    return Replay(JACKAL)


def test_the_ensemble_is_a_kalman_filter_where_all_is_linear(monkeypatch: pytest.MonkeyPatch) -> None:
    """x ~ N(0, P), y = H x + noise: with many members X and the posterior are those of the closed form."""
    monkeypatch.setattr("nfc_gym.simulate.ensemble.DIAGONAL", 0.0)
    rng = np.random.default_rng(0)
    n, m, h = 120, 200, rng.standard_normal((3, 2))
    root = np.array([[1.0, 0.0], [0.5, 0.8]])
    members = rng.standard_normal((n, m, 2)) @ root.T
    y = np.array([1.0, -2.0, 0.5])
    eps = rng.standard_normal((m, 3))  # one for all windows, so made exactly standard: its own error is no average
    eps = (eps - eps.mean(0)) @ np.linalg.inv(np.linalg.cholesky(np.cov(eps.T))).T
    found = innovation(y - members @ h.T, eps)
    p = root @ root.T
    sigma = np.eye(3) + h @ p @ h.T
    assert found.squared.mean() == pytest.approx(y @ np.linalg.solve(sigma, y), rel=0.03)
    deviation = (members - members.mean(1, keepdims=True)) / np.sqrt(m - 1)
    moved = members + found.gain @ deviation
    k = p @ h.T @ np.linalg.inv(sigma)
    np.testing.assert_allclose(moved.mean((0, 1)), k @ y, atol=0.03)
    np.testing.assert_allclose(np.mean([np.cov(x.T) for x in moved], 0), p - k @ h @ p, atol=0.03)


def test_a_jackals_state_is_read_from_what_it_observes(machine: Machine) -> None:
    window = trials(machine, np.tile(machine.space.nominal, (4, 1)), 0, noise=0.0)
    nq = machine.model.nq
    true = window["start"][:, 1 : 1 + nq + machine.model.nv]
    found = start.observed(machine, window["states"][:, 0])
    np.testing.assert_allclose(found[:, :7], true[:, :7], atol=1e-6)
    np.testing.assert_allclose(found[:, nq : nq + 6], true[:, nq : nq + 6], atol=1e-5)
    wheels = found[:, nq + 6 :]
    assert np.corrcoef(wheels.ravel(), true[:, nq + 6 :].ravel())[0, 1] > 0.9


def test_start_noise_has_the_sizes_that_it_says(machine: Machine) -> None:
    nv, nq = machine.model.nv, machine.model.nq
    at = np.tile(np.concatenate([machine.model.qpos0, np.zeros(nv)]), (4000, 1))
    out = start.disturbed(machine, at, np.random.default_rng(0).standard_normal((4000, 2 * nv)))
    away = np.empty((4000, nv))
    for row, q in zip(away, out[:, :nq], strict=True):
        mujoco.mj_differentiatePos(machine.model, row, 1.0, machine.model.qpos0, q)
    position, velocity = start.spreads(machine)
    np.testing.assert_allclose(away.std(0), position, rtol=0.06)
    np.testing.assert_allclose(out[:, nq:].std(0), velocity, rtol=0.06)


@pytest.mark.parametrize("robot", ["Jackal", "Quadcopter"])
def test_what_no_sensor_tells_of_a_start_is_off_by_as_much_as_it_says(robot: str) -> None:
    machine = Machine(f"nfc_gym/{robot}Flat-v0")
    window = trials(machine, np.tile(machine.space.nominal, (200, 1)), 3, noise=0.0)
    nq, nv = machine.model.nq, machine.model.nv
    away = (start.observed(machine, window["states"][:, 0]) - window["start"][:, 1 : 1 + nq + nv])[:, nq + 6 :]
    claimed = start.spreads(machine, hidden=True)[1][6:]
    assert (claimed > 2 * start.spreads(machine)[1][6:]).all()
    np.testing.assert_allclose(np.sqrt((away**2).mean(0)), claimed, rtol=0.3)


def test_a_jackal_whose_height_is_guessed_stands_on_its_wheels(machine: Machine) -> None:
    window = trials(machine, np.tile(machine.space.nominal, (200, 1)), 3, noise=0.0)
    nq, nv = machine.model.nq, machine.model.nv
    true, eps = window["start"][:, 1 : 1 + nq + nv], np.random.default_rng(0).standard_normal((200, 2 * nv))
    eps[:, 3:6] = 0.0  # the angles as they are
    out = start.disturbed(machine, true, eps, hidden=True)
    assert np.std(true[:, 2]) > 0.002
    assert np.std(out[:, 2] - true[:, 2]) < 0.0025
    assert np.std(start.disturbed(machine, true, eps)[:, 2] - true[:, 2]) > 0.015  # as measured


def test_nominal_windows_score_about_one_and_faults_higher(machine: Machine, replay: Replay) -> None:
    nominal, slippery = machine.space.nominal, machine.space.nominal.copy()
    slippery[[i for i, n in enumerate(machine.space.names) if n.endswith("friction")]] *= 0.3
    plain = trials(machine, np.tile(nominal, (10, 1)), 1)
    faulty = trials(machine, np.tile(slippery, (6, 1)), 2)
    a, b = (replay.score(w["states"], w["actions"]) for w in (plain, faulty))
    assert 0.9 < np.median(a) < 1.3
    assert auroc(a, b)[0] > 0.95
    np.testing.assert_array_equal(replay.score(plain["states"][:3], plain["actions"][:3]), a[:3])
    # under a belief that has the slippery wheels, the same windows are what was to be expected
    knowing = Replay(JACKAL, Fidelity(psi=slippery))
    c = knowing.score(faulty["states"], faulty["actions"])
    assert np.median(c) < 1.5
    assert np.median(b) > 2 * np.median(c)


def test_a_lost_axle_is_found_under_the_wrapper(machine: Machine, replay: Replay) -> None:
    """End to end with observations of the environment; the threshold lies between the two, far from either."""
    lost = {"front_left_wheel_damping": 0.0, "rear_left_wheel_damping": 0.0}
    alarms, rng = [], np.random.default_rng(0)
    for psi in ({}, lost):
        env = gymnasium.make(JACKAL, context=["psi"])
        noisy = gymnasium.wrappers.TransformObservation(
            env, lambda o: o | {"proprio": o["proprio"] + machine.noise * rng.standard_normal(15)}, None
        )
        detector = WindowDetector(replay, Threshold(2.0, 0.01, 300, 0.0, 0.02), every=25)
        watched = MonitorAnomaly(noisy, detector)
        watched.reset(seed=0, options={"psi": psi})
        infos = [watched.step(np.array([0.4, 0.5 * np.sin(t / 8)], np.float32))[4] for t in range(76)]
        assert not any(i["anomaly"] for i in infos[:49])
        alarms.append(bool(infos[-1]["anomaly"]))
        env.close()
    assert alarms == [False, True]


def test_bad_input_is_refused(machine: Machine, replay: Replay) -> None:
    with pytest.raises(InputError, match="20 steps; this detector needs 50"):
        replay.score(np.zeros((1, 21, 15)), np.zeros((1, 20, 2)))
    with pytest.raises(InputError, match="another robot"):
        replay.score(np.zeros((1, 51, 52)), np.zeros((1, 50, 8)))
    with pytest.raises(InputError, match="needs a `ground`"):
        Replay("nfc_gym/JackalRough-v0")
    with pytest.raises(InputError, match="psi of shape"):
        Replay(JACKAL, Fidelity(psi=np.ones(3)))
    with pytest.raises(InputError, match="give `start`"):
        Replay("nfc_gym/AntFlat-v0", draws=2).score(np.zeros((1, 51, 52)), np.zeros((1, 50, 8)))
    with pytest.raises(InputError, match="start must be finite"):
        replay.score(np.zeros((1, 51, 15)), np.zeros((1, 50, 2)), np.zeros((1, 3)))
    with pytest.raises(InputError, match=r"replay: draws is 2\.5, want a whole number, 2 or more"):
        Replay(JACKAL, draws=2.5)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"replay: motor is -0\.1, want a share from 0 to 1"):
        Replay(JACKAL, motor=-0.1)


def test_a_replay_that_has_scored_is_pickled_and_copied(machine: Machine, replay: Replay) -> None:
    """With its threshold, and a bank of them, one of which has an effect."""
    windows = trials(machine, np.tile(machine.space.nominal, (20, 1)), 3)
    states, actions = windows["states"], windows["actions"]
    detector = WindowDetector(replay).calibrated(states, actions, 0.2)
    again = pickle.loads(pickle.dumps(detector))
    assert again.threshold == detector.threshold
    np.testing.assert_array_equal(again.scorer.score(states[:2], actions[:2]), replay.score(states[:2], actions[:2]))
    weak = Fault("weak", np.ones(17), build("loss", machine.model.actuator(0).name, {"fraction": 0.3}))
    bank = ReplayBank(JACKAL, faults=[*faults_of(machine)[:1], weak], draws=4)
    expected = bank.gains(states[:2], actions[:2])
    for other in (pickle.loads(pickle.dumps(bank)), deepcopy(bank)):
        np.testing.assert_array_equal(other.gains(states[:2], actions[:2]), expected)


@pytest.mark.parametrize("vector", [False, True])
def test_a_monitor_is_refused_before_the_first_step(replay: Replay, vector: bool) -> None:
    make_, monitor = (gymnasium.make_vec, VectorMonitorAnomaly) if vector else (gymnasium.make, MonitorAnomaly)
    ant = Replay("nfc_gym/AntFlat-v0", draws=2)
    for name, context, scorer, message in (
        ("AntFlat", ["psi"], ant, "does not determine its state"),
        ("QuadcopterFlat", ["psi"], replay, r"an observation must have 15 entries, and here it has shape \(21,\)"),
        ("JackalFlat", [], replay, 'make the environment with context=\\["psi"\\]'),
    ):
        with pytest.raises(InputError, match=message):
            monitor(make_(f"nfc_gym/{name}-v0", context=context), WindowDetector(scorer), threshold=1.0)
    monitor(make_(JACKAL, context=["psi"]), WindowDetector(replay), threshold=1.0)


def test_every_row_of_a_vector_environment_is_replayed_on_its_own_ground() -> None:
    """Two Jackals on two maps: nothing unusual where each is replayed on its own, much where the maps change places."""
    env = gymnasium.make_vec("nfc_gym/JackalRough-v0", num_envs=2, context=["psi"], terrain_pool=2)
    last = env.reset(seed=3, options={"terrain_id": np.array([0, 1]), "psi": {}})[0]["proprio"]
    inner, rng, scores = env.unwrapped, np.random.default_rng(1), []
    noise = Machine("nfc_gym/JackalRough-v0").noise
    own, other = (
        WindowDetector(Replay("nfc_gym/JackalRough-v0", ground=inner.maps, standing=who))
        for who in (env, lambda: 1 - inner.terrain_id)
    )
    for t in range(50):
        action = np.array([[0.8, 0.3 * np.sin(t / 9)], [0.8, -0.3 * np.sin(t / 9)]], np.float32)
        seen = env.step(action)[0]["proprio"] + noise * rng.standard_normal((2, 15))
        scores = [d.update(last, action, seen) for d in (own, other)]
        last = seen
    env.close()
    assert scores[0].shape == (2,)
    assert (scores[0] < 1.1).all()
    assert (scores[1] > 1.2 * scores[0]).all()


def test_several_maps_ask_for_whose_is_whose() -> None:
    maps = [make("rough", 0.3, seed) for seed in (0, 1)]
    several = Replay("nfc_gym/JackalRough-v0", draws=2, ground=maps)
    windows = np.tile(np.eye(15)[0], (1, 51, 1)), np.zeros((1, 50, 2))
    with pytest.raises(InputError, match="2 maps: say `which`"):
        several.score(*windows)
    with pytest.raises(InputError, match="0 to 1"):
        several.score(*windows, which=np.array([2]))


class Where(Replay):
    """Scores a window by the map that it would be replayed on, 1 to as many as there are."""

    def score(self, states, actions, start=None, which=None):
        return 1.0 + which


@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_an_episodes_last_window_is_replayed_on_the_ground_that_it_was_driven_on(mode: str) -> None:
    """Also where the row stands on the next episode's already, as after a step that resets it."""
    made = {"context": ["psi"], "terrain_pool": 4, "autoreset_mode": mode, "max_episode_steps": 50}
    env = gymnasium.make_vec("nfc_gym/JackalRough-v0", num_envs=3, **made)
    inner, scored = env.unwrapped, 0
    where = Where("nfc_gym/JackalRough-v0", draws=2, ground=inner.maps, standing=env)
    env = VectorMonitorAnomaly(env, WindowDetector(where), threshold=9.0)
    env.reset(seed=3)
    for _ in range(2):
        done, moved, last = np.zeros(3, bool), np.zeros(3, bool), {}
        while not done.all():
            ground = inner.terrain_id
            _, _, terminated, truncated, info = env.step(np.zeros((3, 2)))
            done = terminated | truncated
            last = info["final_info"] if mode == "SameStep" and done.any() else info
            moved = inner.terrain_id != ground
        np.testing.assert_array_equal(last["anomaly_score"], 1.0 + ground)
        assert moved.any() == (mode == "SameStep"), "other seeds would prove nothing"
        scored += 1
        if mode == "NextStep":
            env.step(np.zeros((3, 2)))
        elif mode == "Disabled":
            env.reset()
    assert scored == 2


def test_rows_whose_maps_nobody_knows_are_refused() -> None:
    maps = [make("rough", 0.3, seed) for seed in (0, 1)]
    others = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")])
    with pytest.raises(InputError, match="standing is SyncVectorEnv, want a vector environment that"):
        Replay("nfc_gym/JackalRough-v0", draws=2, ground=maps, standing=others)
