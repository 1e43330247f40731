"""A detector made in one call: it finds what it was shown, its file holds all of it, and a stopped run goes on."""

from pathlib import Path

import numpy as np
import pytest

from nfc_gym.core import InputError, load_source
from nfc_gym.inference import detector_file
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.faults import FaultClassifier, FaultConfig
from nfc_gym.inference.train import TrainConfig
from nfc_gym.simulate import fault_kinds, faulty
from nfc_gym.simulate import watch as module
from nfc_gym.simulate.faulty import nominal
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.trials import trials
from nfc_gym.simulate.watch import watch

JACKAL = "nfc_gym/JackalFlat-v0"
SMALL = FaultConfig(encoder="nn", width=64, hidden=64)
QUICK = TrainConfig(epochs=8, batch=64, rate=2e-3, warmup=10, seed=3)


def made(out: Path, **more: object) -> module.Watch:
    return watch(JACKAL, out, windows=600, rate=0.05, training=QUICK, config=SMALL, **more)  # type: ignore[arg-type]


def test_it_finds_slippery_ground_and_a_run_that_was_stopped_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, simulated = tmp_path / "watch.safetensors", []
    lesson = faulty._made

    def stopped(environment: str, psi: np.ndarray, seed: int, at: int) -> dict[str, np.ndarray]:
        if simulated:
            raise KeyboardInterrupt
        simulated.append(at)
        return lesson(environment, psi, seed, at)

    monkeypatch.setattr(faulty, "_made", stopped)
    with pytest.raises(KeyboardInterrupt):
        made(out)

    def counted(environment: str, psi: np.ndarray, seed: int, at: int) -> dict[str, np.ndarray]:
        simulated.append(at)
        return lesson(environment, psi, seed, at)

    monkeypatch.setattr(faulty, "_made", counted)
    found = made(out)
    assert simulated == [0, 500]  # the first part was kept
    detector = load_source(out)  # as MonitorAnomaly opens it
    assert isinstance(detector, WindowDetector)
    assert isinstance(detector.scorer, FaultClassifier)
    assert detector.calibration == found.detector.calibration

    machine = Machine(JACKAL)
    psi = np.tile(machine.space.nominal, (60, 1))
    slippery = psi * [0.3 if n.endswith("_friction") else 1.0 for n in machine.space.names]
    broken, sound = trials(machine, slippery, 1), nominal(JACKAL, psi, 2)
    assert detector.threshold is not None
    alarms = [detector.scorer.score(w["states"], w["actions"]) >= detector.threshold for w in (broken, sound)]
    assert alarms[0].mean() > 0.8
    assert alarms[1].mean() < 0.2
    kinds = detector.scorer.told(broken["states"], broken["actions"]).mean(0)
    assert kinds.argmax() == fault_kinds.KINDS.index("friction")
    np.testing.assert_array_equal(
        detector.scorer.score(broken["states"], broken["actions"]),
        found.detector.scorer.score(broken["states"], broken["actions"]),
    )
    with pytest.raises(InputError, match="want a detector with a Contrast or a FaultClassifier"):
        detector_file.save(tmp_path / "other.safetensors", WindowDetector(detector.scorer))


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ends in \.safetensors"):
        made(tmp_path / "watch.pt")
    with pytest.raises(InputError, match="width is a share"):
        made(tmp_path / "watch.safetensors", width=2.0)
    with pytest.raises(InputError, match="false-positive rate"):
        watch(JACKAL, tmp_path / "watch.safetensors", rate=0.0)
    with pytest.raises(InputError, match="is rough"):
        watch("nfc_gym/JackalRough-v0", tmp_path / "watch.safetensors", windows=4, rate=0.5)
