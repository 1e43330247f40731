"""After a mission: false alarms fall where there were too many, psi is told better, and too little changes nothing."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from carts import QUICK, cart, everything, trajectory

from nfc_gym import InputError
from nfc_gym.adaptation import afterwards, learn_from_mission, load_policy
from nfc_gym.adaptation.afterwards import LearnConfig
from nfc_gym.adaptation.beliefs import Fixed, Sequential
from nfc_gym.adaptation.normal import Normal, quiet_trajectories, quiet_windows, stretches, windows_of
from nfc_gym.adaptation.trajectory import Dataset, Trajectory
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior
from nfc_gym.inference.rates import rate_above
from nfc_gym.inference.sequential import SequentialConfig
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig, train
from nfc_gym.physics.effects.saved import from_row
from nfc_gym.simulate import Simulator
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.replay import Replay

JACKAL, COPTER = "nfc_gym/JackalFlat-v0", "nfc_gym/QuadcopterFlat-v0"


def test_false_alarms_on_the_missions_own_motion_fall(detector: WindowDetector, tmp_path: Path) -> None:
    """Pushed harder than in training, normal motion alarms; afterwards it does as often as is wanted."""
    mission = [cart(400, 2000 + k, 4.0) for k in range(16)]
    before = {k: v.clone() for k, v in detector.scorer.state_dict().items()}
    config = LearnConfig(training=QUICK)
    learned = learn_from_mission(
        mission, detector=detector, environment=JACKAL, config=config, folder=tmp_path, device="cpu"
    )
    found = learned.report["detector"]
    assert found["changed"]
    assert found["false_alarms"]["before"][0] > 0.15
    assert found["false_alarms"]["after"][0] < 0.10
    fresh = windows_of([cart(400, 3000 + k, 4.0) for k in range(20)], 10, everything)
    states, actions = (np.concatenate([p[i] for p in fresh]) for i in (0, 1))
    old = rate_above(detector.scorer.score(states, actions), detector.threshold)[0]
    new = rate_above(learned.detector.scorer.score(states, actions), learned.detector.threshold)[0]
    assert new < 0.5 * old
    assert abs(new - 0.05) < 0.035, "on trajectories of no share"
    if found["weights"] == "trained further":
        assert found["finds_injected"]["after"][0] > found["finds_injected"]["before"][0] - 0.1
    assert all(torch.equal(v, before[k]) for k, v in detector.scorer.state_dict().items()), "the given one stays"
    again = learn_from_mission(
        mission, detector=detector, environment=JACKAL, config=config, folder=tmp_path, device="cpu"
    )
    np.testing.assert_array_equal(
        again.detector.scorer.score(states, actions), learned.detector.scorer.score(states, actions)
    )
    assert again.detector.threshold == learned.detector.threshold
    with pytest.raises(InputError, match=r"another mission or other settings \(seed\)"):
        learn_from_mission(mission, detector=detector, environment=JACKAL, config=LearnConfig(training=QUICK, seed=1),
                           folder=tmp_path)  # fmt: skip


class Loudest:
    """A scorer that cannot learn: the largest speed of a window."""

    horizon, states, actions = 10, 2, 1

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain

    def score(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self.gain * np.abs(states[:, :, 1]).max(1)


def test_a_scorer_that_cannot_learn_gets_a_threshold() -> None:
    mission = [cart(200, k, 4.0) for k in range(20)]
    learned = learn_from_mission(mission, detector=WindowDetector(Loudest()), environment=JACKAL)
    found = learned.report["detector"]
    assert found["rate"] == 0.05
    assert found["windows"] == {"fit": 200, "judge": 80, "limit": 120, "not_normal": 0}
    assert found["threshold_before"] == 1.0, "the mission's own, where the detector has none"
    assert found["false_alarms"]["after"][0] < found["false_alarms"]["before"][0]
    assert "weights" not in found


def test_too_little_changes_nothing_and_says_so(detector: WindowDetector) -> None:
    few = [cart(200, k, 4.0) for k in range(3)]
    learned = learn_from_mission(few, detector=detector, environment=JACKAL)
    assert learned.detector is detector
    assert not learned.report["detector"]["changed"]
    assert "60 normal windows: a false-positive rate of 0.05 takes 60" in learned.report["detector"]["why"]


def test_a_trajectory_with_an_alarm_is_not_normal_unless_told_so(detector: WindowDetector) -> None:
    t = trajectory(np.zeros((41, 2)), np.zeros((40, 1)), alarms=(15,))
    assert not quiet_trajectories(t).any()
    assert quiet_windows(t).sum() == 39
    assert stretches(t, 10, quiet_windows(t)) == [0, 20, 30]
    assert stretches(t, 10, quiet_trajectories(t)) == []
    loud = [cart(400, k, 4.0) for k in range(20)]
    alarmed = [trajectory(c.states, c.actions, alarms=(3,)) for c in loud]
    strict = learn_from_mission(alarmed, detector=detector, environment=JACKAL).report["detector"]
    assert not strict["changed"]
    assert strict["windows"]["not_normal"] == 800
    told = learn_from_mission(
        alarmed, detector=WindowDetector(Loudest()), environment=JACKAL, normal=quiet_windows
    ).report["detector"]
    assert told["changed"]
    with pytest.raises(InputError, match="one a control step, got"):
        learn_from_mission(loud, detector=detector, environment=JACKAL, normal=lambda t: np.ones(3, bool))


def test_what_was_found_is_given_back_for_the_same_flags_alone(detector: WindowDetector, tmp_path: Path) -> None:
    """Functions may share a name: what tells them apart is what they say of the mission."""
    mission = [cart(200, k, 4.0) for k in range(3)]

    def learned(normal: Normal, watch: WindowDetector = detector, beside: TensorWindows | None = None) -> Any:
        return learn_from_mission(
            mission, detector=watch, environment=JACKAL, normal=normal, beside=beside, folder=tmp_path
        ).report

    first = learned(lambda t: np.ones(len(t), bool))
    assert learned(everything) == json.loads(json.dumps(first))
    with pytest.raises(InputError, match=r"other settings \(normal\)"):
        learned(lambda t: np.zeros(len(t), bool))
    assert detector.calibration is not None
    limit = replace(detector.calibration, value=0.5)
    for other in (WindowDetector(detector.scorer, detector.calibration, 5), WindowDetector(detector.scorer, limit)):
        with pytest.raises(InputError, match=r"other settings \(detector\)"):
            learned(everything, other)
    windows = {"states": torch.zeros(4, 11, 2), "actions": torch.zeros(4, 10, 1), "psi": torch.zeros(4, 2)}
    with pytest.raises(InputError, match=r"other settings \(beside\)"):
        learned(everything, beside=TensorWindows(windows))


def test_training_goes_on_for_the_same_motion_alone(
    detector: WindowDetector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was killed between training and report is not taken for training on other flags."""
    mission = [cart(400, 2000 + k, 4.0) for k in range(16)]

    def learned(first: bool, folder: Path) -> Any:
        def half(t: Trajectory) -> np.ndarray:  # as many windows either way
            return (np.arange(len(t)) < len(t) // 2) == first

        config = LearnConfig(training=QUICK)
        return learn_from_mission(
            mission, detector=detector, environment=JACKAL, normal=half, config=config, folder=folder, device="cpu"
        ).report["detector"]

    with monkeypatch.context() as patch:
        patch.setattr(afterwards, "_keep", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            learned(True, tmp_path / "cut")
    assert learned(False, tmp_path / "cut") == learned(False, tmp_path / "whole")


def test_what_an_unknown_scorer_came_to_is_found_anew(tmp_path: Path) -> None:
    mission = [cart(200, k, 4.0) for k in range(20)]
    one, two = (
        learn_from_mission(mission, detector=WindowDetector(Loudest(g)), environment=JACKAL, folder=tmp_path)
        for g in (1.0, 2.0)
    )
    assert one.detector is not None
    assert two.detector is not None
    assert one.detector.threshold is not None
    assert two.detector.threshold == 2 * one.detector.threshold


def test_a_replay_under_another_belief_is_another_detector(tmp_path: Path) -> None:
    env = gym.make(JACKAL, context=["psi"], max_episode_steps=50)
    rng, mission = np.random.default_rng(0), []
    for k in range(24):
        states, actions = [env.reset(seed=k)[0]["proprio"]], rng.uniform(-1, 1, (50, 2))
        states += [env.step(a)[0]["proprio"] for a in actions]
        mission.append(trajectory(np.array(states, float), actions))
    heavy = np.tile(Machine(JACKAL).space.nominal, (2, 1))
    heavy[:, 0] *= 1.5
    drag = {"family": "drag_linear", "where": "base", "parameters": {"x": 8.0, "y": 8.0, "z": 8.0}}
    plain, config = Replay(JACKAL, draws=2), LearnConfig(rate=0.25)

    def learned(scorer: Replay) -> Any:
        return learn_from_mission(
            mission, detector=WindowDetector(scorer), environment=JACKAL, config=config, folder=tmp_path
        ).detector

    found = learned(plain)
    assert found.threshold is not None
    assert learned(Replay(JACKAL, draws=2, nthread=2)).threshold == found.threshold
    for other in (
        Replay(JACKAL, Fidelity(heavy), draws=2), Replay(JACKAL, draws=2, seed=1), Replay(JACKAL, draws=3),
        Replay(JACKAL, draws=2, motor=0.05), plain.under(np.ones(len(heavy[0])), from_row(drag)),
    ):  # fmt: skip
        with pytest.raises(InputError, match=r"other settings \(detector\)"):
            learned(other)


def flown(seed: int, steps: int = 200) -> Trajectory:
    """A quadcopter that a policy flies, as no training window of random excitation is."""
    env = gym.make(COPTER, context=["psi"], max_episode_steps=steps)
    data, policy = env.unwrapped.data, load_policy(COPTER)
    observation, _ = env.reset(seed=seed, options={"psi": {"base_mass": 0.9}})
    states, estimate, actions = [observation["proprio"]], [np.concatenate([data.qpos, data.qvel, data.act])], []
    for _ in range(steps):
        actions.append(policy(observation))
        observation, *_ = env.step(actions[-1])
        states.append(observation["proprio"])
        estimate.append(np.concatenate([data.qpos, data.qvel, data.act]))
    t = trajectory(np.array(states, float), np.array(actions, float))
    return Trajectory(t.states, t.actions, t.rewards, t.scores, 1.0, np.array(estimate), t.elevation)


@pytest.fixture(scope="module")
def mission() -> list[Trajectory]:
    return [flown(k) for k in range(4)]


@pytest.fixture(scope="module")
def posterior() -> NeuralPosterior:
    """Trained for seconds on random excitation."""
    torch.manual_seed(0)
    space = Machine(COPTER).space
    box = PriorBox("quadcopter", space.names, space.units, tuple(space.low), tuple(space.high), tuple(space.nominal))
    windows = TensorWindows(Simulator(COPTER, 0.0, jobs=1).draw(600, np.random.default_rng(0)))
    config = NetworkConfig(encoder="nn", density="mixture", width=64, features=0, hidden=64, components=2)
    network = Network(config, Sizes.of(windows.tensors), box)
    train(network, *windows.split(0.1), TrainConfig(epochs=25, batch=64, rate=2e-3, warmup=10, average=0.9))
    return NeuralPosterior(network)


def learn(mission: list[Trajectory], posterior: NeuralPosterior, folder: Path | None = None):
    config = LearnConfig(simulations=600, effects=0.0, training=TrainConfig(epochs=8, batch=64, rate=1e-3, average=0.9))
    return learn_from_mission(
        mission, posterior=posterior, environment=COPTER, config=config, folder=folder, jobs=1, device="cpu"
    )


def test_psi_is_told_better_from_motion_like_the_missions(
    mission: list[Trajectory], posterior: NeuralPosterior, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nfc_gym.adaptation.relearning._JUDGED", 100)
    before = {k: v.clone() for k, v in posterior.network.state_dict().items()}
    learned = learn(mission, posterior, tmp_path)
    found = learned.report["posterior"]
    (old, a), (new, b) = found["gain"]["before"], found["gain"]["after"]
    assert found["changed"]
    assert new > old + 2 * np.hypot(a, b)
    assert all(torch.equal(v, before[k]) for k, v in posterior.network.state_dict().items()), "the given one stays"
    scales = dict(learned.posterior.network.encoder.named_buffers())
    own = dict(posterior.network.encoder.named_buffers())
    assert scales
    assert all(torch.equal(v, own[k]) for k, v in scales.items()), "what its weights are made for"
    (tmp_path / "learned.json").unlink()  # as if it had been killed after training, before the end
    (tmp_path / "posterior.safetensors").unlink()
    again = learn(mission, posterior, tmp_path)
    assert json.loads(json.dumps(again.report)) == json.loads(json.dumps(learned.report))
    for k, v in again.posterior.network.state_dict().items():
        assert torch.equal(v, learned.posterior.network.state_dict()[k])


def test_a_robot_that_fell_before_a_window_was_full_has_shown_the_prior(
    posterior: NeuralPosterior, mission: list[Trajectory]
) -> None:
    whole = mission[0]
    short = replace(
        whole, states=whole.states[:7], actions=whole.actions[:6], rewards=whole.rewards[:6], scores=np.arange(6.0),
        estimate=whole.estimate[:7], maps=whole.maps[:0], looks=whole.looks[:0], ended=True,
    )  # fmt: skip
    psi = Fixed(posterior).infer(short).sample(4000, np.random.default_rng(0)).psi
    prior = posterior.prior
    assert psi is not None
    assert psi.min(0) == pytest.approx(prior.low, rel=0.01)
    assert psi.max(0) == pytest.approx(prior.high, rel=0.01)
    rounds = Sequential(posterior, simulate=None)
    assert rounds.infer(short).sample(3, np.random.default_rng(0)).psi is not None
    assert rounds.updated(short, posterior) is rounds, "there is no window to close in on"
    late = replace(whole, scores=np.concatenate([[9.0], np.zeros(len(whole) - 1)]))  # alarmed at once, and drove on
    seen = posterior.given(late.window()).sample(5, np.random.default_rng(1)).psi
    np.testing.assert_array_equal(Fixed(posterior).infer(late).sample(5, np.random.default_rng(1)).psi, seen)


def test_a_damaged_trajectory_is_refused(mission: list[Trajectory], tmp_path: Path) -> None:
    file = tmp_path / "trajectory.npz"
    mission[0].save(file)
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(InputError, match="truncated, or no trajectory"):
        Trajectory.load(file)


def test_rounds_of_a_trained_network_keep_its_scales(posterior: NeuralPosterior, mission: list[Trajectory]) -> None:
    network = copy.deepcopy(posterior.network)
    with torch.no_grad():  # so that there is something to learn
        for weight in network.parameters():
            weight.add_(0.1 * torch.randn_like(weight))
    own = {k: v.clone() for k, v in network.encoder.named_buffers()}
    first = {k: v.clone() for k, v in network.named_parameters()}
    rounds, training = (
        SequentialConfig(rounds=1, simulations=200),
        TrainConfig(epochs=5, batch=20, rate=1e-3, warmup=1, average=0.5),
    )
    simulate = Simulator(COPTER, 0.0, jobs=1, names=("states", "actions"))
    seen = replace(mission[0], scores=np.arange(200.0))
    after = Sequential(NeuralPosterior(network), simulate, rounds, training).updated(seen, posterior).posterior.network
    assert any((v != first[k]).any() for k, v in after.named_parameters()), "it has learned"
    assert all(torch.equal(v, own[k]) for k, v in after.encoder.named_buffers())
    assert all(torch.equal(v, first[k]) for k, v in network.named_parameters()), "what was believed stays believed"


def test_a_mission_too_short_for_the_posterior_is_said(mission: list[Trajectory], posterior: NeuralPosterior) -> None:
    short = [Trajectory(t.states[:41], t.actions[:40], t.rewards[:40], t.scores[:40], 1.0, t.estimate[:41],
                        t.elevation) for t in mission]  # fmt: skip
    learned = learn(short, posterior)
    assert learned.posterior is posterior
    assert "too little motion: 8 windows of 20 control steps" in learned.report["posterior"]["why"]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"simulations": 1}, "simulations is 1, want a whole number, 100 or more"),
        ({"simulations": 200.5}, "simulations is 200.5, want a whole number"),
        ({"seed": -1}, "seed is -1, want a whole number, 0 or more"),
        ({"rate": 0.0}, "rate must lie between 0 and 1, got 0"),
        ({"rate": 1}, "rate must lie between 0 and 1, got 1"),
        ({"rate": "a"}, "rate is 'a'; want a share, from 0 to 1"),
        ({"effects": 1.5}, "effects is 1.5; want a share, from 0 to 1"),
        ({"effects": float("nan")}, "effects is nan; want a share, from 0 to 1"),
        ({"motor": -0.1}, "motor is -0.1; want a share of the actions' range, 0 or more"),
    ],
)
def test_settings_that_cannot_be_are_named(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=f"learning: {told}"):
        LearnConfig(**wrong)


def test_settings_of_a_part_that_is_left_out_are_not_compared(tmp_path: Path) -> None:
    mission = [cart(200, k, 4.0) for k in range(3)]

    def learned(**settings: Any) -> Any:
        return learn_from_mission(
            mission, detector=watch, environment=JACKAL, config=LearnConfig(**settings), folder=tmp_path
        ).report

    watch = WindowDetector(Replay(JACKAL, draws=2))
    first = learned()
    assert {"simulations", "effects", "motor"}.isdisjoint(first["of"])
    assert learned(simulations=200, effects=0.1, motor=0.0) == json.loads(json.dumps(first))
    with pytest.raises(InputError, match=r"other settings \(rate\)"):
        learned(rate=0.1)


def test_bad_input_is_named(mission: list[Trajectory], posterior: NeuralPosterior, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no mission; want a folder"):
        learn_from_mission(tmp_path, posterior=posterior)
    with pytest.raises(InputError, match="give a posterior, a detector or both"):
        learn_from_mission(mission, environment=JACKAL)
    with pytest.raises(InputError, match="say which simulator's mission"):
        learn_from_mission(mission, posterior=posterior)
    with pytest.raises(InputError, match="the mission has no trajectory"):
        learn_from_mission(Dataset(), posterior=posterior, environment=JACKAL)
    with pytest.raises(InputError, match="the posterior is of 'quadcopter'"):
        learn_from_mission(mission, posterior=posterior, environment="AntFlat")
    (tmp_path / "learned.json").write_text("{")
    with pytest.raises(InputError, match="no report of what was learned"):
        learn(mission, posterior, tmp_path)
