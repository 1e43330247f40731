"""The contrastive detector: its injections, what it learns, and its file."""

from pathlib import Path

import numpy as np
import pytest
import torch
from problems import box, motion_windows

from nfc_gym.core import InputError, load_source
from nfc_gym.inference import detector_file
from nfc_gym.inference.contrast import Contrast, ContrastConfig
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.injections import KINDS, LEAST, injected
from nfc_gym.inference.rates import auroc
from nfc_gym.inference.train import TrainConfig, train


@pytest.mark.parametrize("kind", range(len(KINDS)), ids=KINDS)
def test_an_injected_window_differs_in_units_of_the_spread(kind: int) -> None:
    x = torch.randn(500, 12, 4).cumsum(1) * torch.tensor([1.0, 100.0, 0.01, 0.0])
    x[250:] = x[250:, :1]  # signals that stand still have no spread of their own
    spread = torch.tensor([2.0, 200.0, 0.02, 0.0])
    change = injected(x, spread, torch.full((500,), kind)) - x
    assert (change[..., 3] == 0).all()
    sizes = (change[..., :3] / spread[:3]).abs().amax((1, 2))
    assert sizes.min() >= LEAST * 0.9
    assert sizes.max() < 40
    # in units of the spread no channel is disturbed more than others
    typical = (change[250:, :, :3].abs() / spread[:3]).mean((0, 1))
    assert typical.max() / typical.min() < 1.6


def test_kinds_are_what_they_are_called() -> None:
    x, spread = torch.zeros(200, 40, 1), torch.ones(1)
    made = {name: injected(x, spread, torch.full((200,), k))[..., 0] for k, name in enumerate(KINDS)}
    assert ((made["global"] != 0).sum(1) <= 3).all()
    trend = made["trend"].abs().diff(dim=1)
    assert (trend >= 0).all()
    season = made["seasonal"]
    assert ((season > 0).any(1) & (season < 0).any(1)).all()
    flat = made["shapelet"]
    assert (flat.abs().amax(1, keepdim=True) == flat.abs()).logical_or(flat == 0).all()


@pytest.fixture(scope="module")
def trained() -> Contrast:
    torch.manual_seed(0)
    windows = motion_windows(1000)
    net = Contrast.of(windows.tensors, box(2), ContrastConfig(features=16), channels=("position", "velocity"))
    train(net, *windows.split(0.1), TrainConfig(epochs=3, batch=64, rate=2e-3, warmup=10, muon=False))
    return net


def test_it_finds_disturbances_in_windows_it_has_not_seen(trained: Contrast) -> None:
    """Untrained it is near chance; trained it is far beyond, on every kind."""
    t = motion_windows(600, seed=9).tensors
    states, actions = t["states"], t["actions"]
    plain = trained.score(states.numpy(), actions.numpy())
    areas = {}
    for k, name in enumerate(KINDS):
        target = injected(states[:, -trained.span :], trained.spread, torch.full((600,), k))
        struck = torch.cat([states[:, : -trained.span], target], 1)
        areas[name] = auroc(plain, trained.score(struck.numpy(), actions.numpy()))[0]
    assert min(areas.values()) > 0.7, areas
    assert np.mean(list(areas.values())) > 0.8, areas


def test_its_file_holds_all_and_refuses_others(trained: Contrast, tmp_path: Path) -> None:
    t = motion_windows(600, seed=5).tensors
    states, actions = t["states"].numpy(), t["actions"].numpy()
    detector = WindowDetector(trained, every=2).calibrated(states[:300], actions[:300], 0.02)
    path = tmp_path / "detector.safetensors"
    detector_file.save(path, detector, notes={"why": "test"})
    again = load_source(path)  # as MonitorAnomaly opens it
    assert isinstance(again, WindowDetector)
    assert isinstance(again.scorer, Contrast)
    assert (again.calibration, again.every) == (detector.calibration, 2)
    assert (again.scorer.horizon, again.scorer.channels) == (10, ("position", "velocity"))
    np.testing.assert_array_equal(again.scorer.score(states, actions), trained.score(states, actions))
    with pytest.raises(InputError, match="of the robot 'toy', not of 'other'"):
        detector_file.load(path, box(2, robot="other"))
    with pytest.raises(InputError, match="a threshold"):
        detector_file.save(path, WindowDetector(trained))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="truncated"):
        load_source(path)


def test_bad_input_is_refused(trained: Contrast) -> None:
    with pytest.raises(InputError, match="5 steps; this detector needs 10"):
        trained.score(np.zeros((3, 6, 2)), np.zeros((3, 5, 1)))
    with pytest.raises(InputError, match="holds nan"):
        trained.score(np.full((3, 11, 2), np.nan), np.zeros((3, 10, 1)))
    with pytest.raises(InputError, match="temperature"):
        ContrastConfig(temperature=0.0)
