"""`nfc-gym learn`: a mission's folder in, a detector with fewer false alarms out; it resumes, and refuses by name."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from carts import BOX, cart, everything
from typer.testing import CliRunner, Result

from nfc_gym import InputError
from nfc_gym.adaptation import afterwards, gathered, resume
from nfc_gym.adaptation.afterwards import Learned
from nfc_gym.adaptation.normal import quiet_windows, windows_of, with_beside
from nfc_gym.adaptation.trajectory import Dataset
from nfc_gym.cli import app
from nfc_gym.inference import detector_file
from nfc_gym.inference.config import Sizes
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.faults import FaultClassifier, FaultConfig

TRAJECTORIES = 16


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory, detector: WindowDetector) -> Path:
    """What `adapt` leaves of a mission of a cart that is pushed harder than the detector has seen."""
    folder = tmp_path_factory.mktemp("mission")
    dataset = Dataset(folder)
    for k in range(TRAJECTORIES):
        dataset.add(cart(400, 2000 + k, 4.0))
    of = {"environment": "nfc_gym/JackalFlat-v0"}
    resume.save(folder / gathered.STATE, {"none": torch.nn.Linear(1, 1)}, None, {"t": TRAJECTORIES}, of)
    detector_file.save(folder / "given.safetensors", detector)
    return folder


def call(mission: Path, out: Path, *more: str) -> Result:
    words = ["learn", str(mission), "--out", str(out), "--epochs", "3", "--device", "cpu", *more]
    return CliRunner().invoke(app, words)


def plain(text: str) -> str:
    return " ".join(re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", text).split())


def test_a_detector_learns_from_a_missions_folder_and_the_same_call_goes_on(
    mission: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = ("--detector", str(mission / "given.safetensors"))
    with monkeypatch.context() as patch:
        patch.setattr(afterwards, "_keep", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        killed = call(mission, tmp_path / "out", *given)
    assert killed.exit_code == 3
    assert "the same command goes on" in killed.stderr
    done = call(mission, tmp_path / "out", *given)
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "out" / "learned.json").read_text())["detector"]
    before, after = (report["false_alarms"][k][0] for k in ("before", "after"))
    assert after < 0.5 * before
    said = plain(done.stdout)
    assert f"{before:.4g} (standard error" in said
    assert f"{after:.4g} (standard error" in said
    assert "detector: changed" in said
    kept = detector_file.load(tmp_path / "out" / "detector.safetensors")
    assert kept.threshold == report["threshold"]["value"]

    again = call(mission, tmp_path / "out", *given)
    assert again.stdout == done.stdout
    whole = call(mission, tmp_path / "whole", *given)  # as if nothing had been killed
    assert whole.exit_code == 0
    other = detector_file.load(tmp_path / "whole" / "detector.safetensors")
    windows = windows_of([cart(400, 7, 4.0)], 10, everything)[0]
    assert (kept.scorer.score(*windows) == other.scorer.score(*windows)).all()
    same = call(mission, tmp_path / "out", *given, "--normal", "windows")
    assert same.stdout == done.stdout, "where nothing alarmed both rules take the same for normal"
    changed = call(mission, tmp_path / "out", *given, "--seed", "7")
    assert changed.exit_code == 2
    assert "another mission or other settings (seed)" in plain(changed.stderr)


def test_a_fault_classifier_gets_a_threshold_of_the_missions_own_motion(mission: Path, tmp_path: Path) -> None:
    windows = windows_of([cart(400, k, 1.0) for k in range(10)], 10, everything)
    states, actions = (np.concatenate([w[i] for w in windows]) for i in (0, 1))
    config = FaultConfig(("none", "push"), encoder="nn", width=32, summaries=False, hidden=32)
    net = FaultClassifier(config, Sizes(10, 2, 1), BOX, seed=1)
    first, second = (torch.as_tensor(x, dtype=torch.float32) for x in (states, actions))
    net.encoder.fit(first, second, None)
    detector_file.save(tmp_path / "given.safetensors", WindowDetector(net).calibrated(states, actions, 0.05))
    given = ("--detector", str(tmp_path / "given.safetensors"))
    done = call(mission, tmp_path / "out", *given)
    assert done.exit_code == 0, done.output
    kept = detector_file.load(tmp_path / "out" / "detector.safetensors")
    report = json.loads((tmp_path / "out" / "learned.json").read_text())["detector"]
    assert kept.threshold == report["threshold"]["value"] != report["threshold_before"]
    np.testing.assert_array_equal(kept.scorer.score(states, actions), net.score(states, actions))
    again = call(mission, tmp_path / "out", *given)
    assert again.stdout == done.stdout


def test_options_reach_what_learns(mission: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[dict[str, Any]] = []
    report = {"posterior": {"changed": True, "gain": {"before": [0.125, 0.02], "after": [0.25, 0.03]}}}

    def learn_from_mission(given: Path, **options: Any) -> Learned:
        calls.append({"mission": given, **options})
        return Learned(None, None, report)

    monkeypatch.setattr(afterwards, "learn_from_mission", learn_from_mission)
    words = ["--posterior", "p.safetensors", "--detector", "d.safetensors", "--normal", "windows"]
    words += ["--simulations", "200", "--effects", "0.25"]
    done = call(mission, tmp_path, *words, "--rate", "0.01", "--seed", "4", "--jobs", "2", "--environment", "AntFlat")
    assert done.exit_code == 0, done.output
    assert "posterior gain over the prior, nats a parameter 0.125 (standard error 0.02)" in plain(done.stdout)
    assert "posterior: changed" in done.stdout
    (options,) = calls
    config, _ = options.pop("config"), options.pop("console")
    assert (config.rate, config.simulations, config.effects, config.seed) == (0.01, 200, 0.25, 4)
    assert config.training.epochs == 3
    assert options == {
        "mission": mission, "posterior": Path("p.safetensors"), "detector": Path("d.safetensors"),
        "environment": "AntFlat", "normal": quiet_windows, "beside": None, "folder": tmp_path, "jobs": 2,
        "device": "cpu",
    }  # fmt: skip


def test_what_cannot_be_learned_is_said(mission: Path, tmp_path: Path) -> None:
    given = ("--detector", str(mission / "given.safetensors"))
    few = call(mission, tmp_path, *given, "--rate", "0.001")  # takes 3000 normal windows
    assert few.exit_code == 0
    assert "detector: not changed: 640 normal windows: a false-positive rate of 0.001 takes 3000" in plain(few.stdout)
    assert not (tmp_path / "detector.safetensors").exists()
    for folder, more, words in (
        (mission, (), "give --posterior FILE, --detector FILE or both"),
        (tmp_path, given, "no mission; want a folder that `adapt(..., folder=...)` wrote"),
        (mission, ("--posterior", str(mission / "given.safetensors")), "format 'nfc_gym-detector-1'"),
        (mission, (*given, "--beside", str(tmp_path)), "manifest.json"),
        (mission, (*given, "--rate", "2"), "rate is 2.0; want a share, from 0 to 1"),
        (mission, (*given, "--rate", "0"), "rate must lie between 0 and 1, got 0"),
        (mission, (*given, "--simulations", "200"), "--simulations 200 is for the posterior: give --posterior FILE"),
        (mission, (*given, "--effects", "0.5"), "--effects 0.5 is for the posterior"),
        (mission, ("--posterior", "p", "--rate", "0.01"), "--rate 0.01 is for the detector: give --detector FILE too"),
        (mission, ("--posterior", "p", "--normal", "windows"), "--normal windows is for the detector"),
    ):
        refused = call(folder, tmp_path / "other", *more)
        assert refused.exit_code == 2, refused.output
        assert words in plain(refused.stderr)


def test_windows_of_another_length_cannot_be_learned_from_beside() -> None:
    def windows(steps: int) -> TensorWindows:
        parts = {"states": torch.zeros(4, steps + 1, 2), "actions": torch.zeros(4, steps, 1), "psi": torch.zeros(4, 2)}
        return TensorWindows(parts)

    assert len(with_beside(windows(10), windows(10), 0)) == 8
    with pytest.raises(InputError, match=r"beside: 'states' of a window has shape \(21, 2\), where .* have \(11, 2\)"):
        with_beside(windows(10), windows(20), 0)


def test_the_help_teaches() -> None:
    text = plain(CliRunner().invoke(app, ["learn", "--help"], terminal_width=120).output)
    assert "Example: nfc-gym learn runs/axle --posterior jackal.safetensors --detector" in text
    assert "grows surer of them, right or wrong" in text
