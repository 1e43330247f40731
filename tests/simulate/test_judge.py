"""The judge of a bank's evidence, and the faulty windows that it learns from."""

import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.inference.rates import auroc
from nfc_gym.simulate.bank import ReplayBank, faults_of
from nfc_gym.simulate.faulty import faulty
from nfc_gym.simulate.judge import Judge
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.trials import trials

JACKAL = "nfc_gym/JackalFlat-v0"


def blows(rng: np.random.Generator, n: int, fault: float) -> np.ndarray:
    """Gains of two faults, of which the first may be there; and blows, which raise everything."""
    blow = 40.0 * rng.standard_exponential((n, 1)) * (rng.random((n, 1)) < 0.2)
    return 5.0 * rng.standard_normal((n, 3)) + blow * [1.0, 1.0, 2.0] + [fault, 0.0, 0.0]


def test_evidence_together_tells_a_fault_from_a_blow() -> None:
    rng = np.random.default_rng(0)
    judge = Judge.learned(blows(rng, 2000, 0.0), blows(rng, 2000, 25.0))
    healthy, broken = blows(rng, 4000, 0.0), blows(rng, 1000, 25.0)

    def found(score: np.ndarray, faulty_score: np.ndarray) -> float:
        return float(np.mean(faulty_score > np.quantile(score, 0.99)))

    assert found(judge.odds(healthy), judge.odds(broken)) > 0.9
    assert found(healthy.max(1), broken.max(1)) < 0.2  # what blows alone do sets the limit


def test_log_odds_are_those_of_the_densities() -> None:
    rng = np.random.default_rng(1)
    z = rng.standard_normal((2, 20_000, 1))
    # asinh(e / 10) is Gaussian with a mean of -1 or 1: the ratio's logarithm is twice the value
    judge = Judge.learned(10 * np.sinh(z[0] - 1), 10 * np.sinh(z[1][:2000] + 1))
    at = np.array([-1.0, 0.0, 0.5, 1.5])
    assert judge.odds(10 * np.sinh(at)[:, None]) == pytest.approx(2 * at, abs=0.25)


def test_bad_evidence() -> None:
    rng = np.random.default_rng(2)
    fine = rng.standard_normal((60, 3))
    far = np.where(rng.random((60, 3)) < 0.1, np.inf, fine + 50)  # replays that came apart
    judge = Judge.learned(fine, far)
    assert np.isfinite(judge.odds(far)).all()
    with pytest.raises(InputError, match=r"50 windows or more.*\(49, 3\)"):
        Judge.learned(fine[:49], far)
    with pytest.raises(InputError, match=r"faulty evidence .* without NaN"):
        Judge.learned(fine, np.where(fine > 1, np.nan, fine))
    with pytest.raises(InputError, match="3 and of 2 columns"):
        Judge.learned(fine, far[:, :2])
    with pytest.raises(InputError, match="has 2 columns"):
        judge.odds(fine[:, :2])


def test_a_bank_with_a_judge_finds_more() -> None:
    machine = Machine(JACKAL)
    heavy, _, slippery, *_ = faults_of(machine)
    bank = ReplayBank(JACKAL, faults=[heavy, slippery], draws=2)
    nominal = np.tile(machine.space.nominal, (50, 1))

    def evidence(found: dict) -> np.ndarray:
        return bank.evidence(found["states"], found["actions"])

    lessons = evidence(trials(machine, nominal, 0)), evidence(faulty(machine, nominal, 1))
    assert lessons[0].shape == (50, 5)
    judged = bank.judged(*lessons)
    assert bank.judge is None
    healthy, broken = trials(machine, nominal[:25], 2), faulty(machine, nominal[:25], 3)
    told = evidence(healthy)
    np.testing.assert_allclose(bank.gains(healthy["states"], healthy["actions"]), told[:, :3])
    scores = [judged.score(w["states"], w["actions"]) for w in (healthy, broken)]
    assert auroc(scores[0], scores[1])[0] > 0.7
    x = bank.believed.steps(healthy["states"], healthy["actions"])[:, 5:].mean(1)
    np.testing.assert_allclose(told[:, -1], bank.unexplained(x))


def test_faults_are_drawn_of_every_kind() -> None:
    machine = Machine(JACKAL)
    nominal = np.tile(machine.space.nominal, (40, 1))
    found = faulty(machine, nominal, 5)
    assert 30 <= len(found["psi"]) <= 40
    by = found["psi"] / machine.space.nominal
    names = np.array(machine.space.names)
    off = [set(names[np.abs(row - 1) > 1e-9]) for row in by]
    kinds = {frozenset(n.split("_")[-1] for n in row) for row in off}
    assert kinds == {frozenset({"mass"}), frozenset({"friction"}), frozenset({"damping"}), frozenset()}
    assert sum(not row for row in off) < 25  # of a kind each: effects of the library leave psi
    again = faulty(machine, nominal, 5)
    np.testing.assert_array_equal(found["states"], again["states"])
    with pytest.raises(InputError, match=r"psi has shape \(2,\)"):
        faulty(machine, nominal[0, :2], 5)
    with pytest.raises(InputError, match="n of 1 or more"):
        faulty(machine, nominal[:0], 5)
    for seed in range(6):  # a single row may have a fault of any kind
        assert len(faulty(machine, nominal[:1], seed)["psi"]) <= 1
