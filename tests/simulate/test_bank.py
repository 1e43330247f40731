"""The bank of replays: what it tells of healthy and faulty machines, and against one replay's mean X."""

import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.rates import auroc
from nfc_gym.simulate.bank import ELSE, Fault, ReplayBank, faults_of
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.replay import Replay
from nfc_gym.simulate.trials import trials

JACKAL = "nfc_gym/JackalFlat-v0"


@pytest.fixture(scope="module")
def machine() -> Machine:
    return Machine(JACKAL)


@pytest.fixture(scope="module")
def bank(machine: Machine) -> ReplayBank:
    heavy, _, slippery, *_ = faults_of(machine)
    return ReplayBank(JACKAL, faults=[heavy, slippery], draws=8)


@pytest.fixture(scope="module")
def level(machine: Machine, bank: ReplayBank) -> ReplayBank:
    return bank.levelled(*windows(machine, 8, 20), rate=0.05)


def windows(machine: Machine, seed: int, n: int = 10, **scale: float) -> tuple[np.ndarray, np.ndarray]:
    by = np.array([scale.get(name, 1.0) for name in machine.space.names])
    made = trials(machine, np.tile(machine.space.nominal * by, (n, 1)), seed)
    return made["states"], made["actions"]


def test_the_fault_that_there_is_is_the_likeliest(machine: Machine, bank: ReplayBank) -> None:
    healthy, heavy = bank.gains(*windows(machine, 0)), bank.gains(*windows(machine, 1, base_mass=2.0))
    assert bank.names == ("base_mass x 1.6", "friction x 0.45", ELSE)
    assert np.median(healthy[:, :2].max(1)) < 0 < np.median(heavy.max(1))
    assert np.mean(heavy[:, :2].argmax(1) == 0) > 0.8
    # one size of a fault stands for others: half as much is found too
    lighter = bank.gains(*windows(machine, 2, base_mass=1.4))
    assert auroc(healthy[:, 0], lighter[:, 0])[0] > 0.85


def test_it_finds_what_a_mean_over_all_directions_hides(machine: Machine, level: ReplayBank) -> None:
    replay = Replay(JACKAL, draws=8)
    healthy, heavy = windows(machine, 3, 12), windows(machine, 4, 12, base_mass=1.5)
    alone = auroc(replay.score(*healthy), replay.score(*heavy))[0]
    assert auroc(level.score(*healthy), level.score(*heavy))[0] > alone + 0.03


def test_something_else_is_told_by_errors_that_no_fault_explains(machine: Machine, bank: ReplayBank) -> None:
    states, actions = windows(machine, 5)
    jumped = states.copy()
    jumped[:, 25:, :3] += 0.3  # the place jumps by 0.3 m
    assert (bank.gains(jumped, actions)[:, -1] > bank.gains(states, actions)[:, -1]).all()


def test_levels_give_each_fault_the_same_rate(machine: Machine, bank: ReplayBank) -> None:
    nominal = windows(machine, 6, 8)
    level = bank.levelled(*nominal, rate=0.25)
    assert (bank.offset == 0).all()  # the bank itself is as it was
    alone = bank.gains(*nominal) - level.offset
    assert ((alone > 0).sum(0) == 2).all()
    np.testing.assert_array_equal(level.score(*nominal), alone.max(1))
    with pytest.raises(InputError, match=r"do not show a share of 0\.001"):
        bank.levelled(*nominal, rate=0.001)


def test_an_effect_of_the_library_may_be_the_fault() -> None:
    quadcopter = Machine("nfc_gym/QuadcopterFlat-v0")
    weak = [f for f in faults_of(quadcopter) if f.lacks is not None]
    assert len(weak) == quadcopter.model.nu
    effect, theta = weak[0].lacks  # type: ignore[misc]
    nominal = np.tile(quadcopter.space.nominal, (12, 1))
    effect.bind(quadcopter.model)
    same = {"effect": effect, "theta": np.tile(theta, (12, 1))}
    bank = ReplayBank("nfc_gym/QuadcopterFlat-v0", faults=weak[:2], draws=8)
    found = trials(quadcopter, nominal, 0, **same)
    told = bank.gains(found["states"], found["actions"])
    # where no replay comes near, as from some of so few starts, errors are cut under all of them and tell of none
    assert np.median(told[:, 0]) > 10
    assert told[:, 1].max() < 5
    again = bank.gains(found["states"], found["actions"])  # hidden states of effects begin anew in each call
    np.testing.assert_array_equal(told, again)


def test_it_is_a_score_for_a_detector(machine: Machine, bank: ReplayBank) -> None:
    detector = WindowDetector(bank).calibrated(*windows(machine, 7, 12), rate=0.25)
    assert detector.threshold is not None
    with pytest.raises(InputError, match="no faults"):
        ReplayBank(JACKAL, faults=[])
    with pytest.raises(InputError, match="scale has shape"):
        ReplayBank(JACKAL, faults=[Fault("nothing", np.ones(3))])
