"""The fault classifier: it comes to the likelihood ratio, names kinds, and refuses what is not its own."""

import numpy as np
import pytest
import torch
from problems import box

from nfc_gym.core import InputError
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.faults import FaultClassifier, FaultConfig
from nfc_gym.inference.train import TrainConfig, train

SHIFTS = torch.tensor([[0.0, 0.0], [1.5, 0.0], [0.0, -1.0]])
PLAIN = FaultConfig(kinds=("none", "push", "pull"), encoder="nn", width=64, summaries=False, hidden=64)


def shifted(n: int, seed: int) -> TensorWindows:
    """White states whose steps a fault shifts; a half of the windows has none."""
    g = torch.Generator().manual_seed(seed)
    kind = torch.where(torch.rand(n, generator=g) < 0.5, 0, torch.randint(1, 3, (n,), generator=g))
    first = torch.zeros(n, 1, 2)
    states = torch.cat([first, torch.randn(n, 1, 2, generator=g) + SHIFTS[kind][:, None]], 1)
    return TensorWindows({"states": states, "actions": torch.zeros(n, 1, 1), "psi": torch.rand(n, 2, generator=g),
                          "family": kind})  # fmt: skip


@pytest.fixture(scope="module")
def trained() -> FaultClassifier:
    windows = shifted(5000, 0)
    net = FaultClassifier.of(windows.tensors, box(2), PLAIN, channels=("left", "right"))
    train(net, *windows.split(0.1), TrainConfig(epochs=8, batch=256, rate=2e-3, warmup=10))
    return net


def test_its_score_is_the_likelihood_ratio(trained: FaultClassifier) -> None:
    windows = shifted(2000, 1).tensors
    x = windows["states"][:, 1].double()
    each = [x @ m - m @ m / 2 for m in SHIFTS.double()]  # log of the density over that without a fault
    exact = torch.logaddexp(each[1], each[2]) + np.log(0.5)  # of a half each
    found = trained.score(windows["states"].numpy(), windows["actions"].numpy())
    assert np.abs(found - exact.numpy()).mean() < 0.15
    assert np.corrcoef(found, exact.numpy())[0, 1] > 0.98
    told = trained.told(windows["states"].numpy(), windows["actions"].numpy())
    assert told.sum(1) == pytest.approx(1)
    assert np.log(1 - told[:, 0]) - np.log(told[:, 0]) == pytest.approx(found)
    strong = (x[:, 0] > 2.5) & (x[:, 1] > 0)
    assert (told[strong.numpy()].argmax(1) == 1).all()


def test_a_threshold_keeps_its_rate(trained: FaultClassifier) -> None:
    def sound(seed: int) -> tuple[np.ndarray, np.ndarray]:
        windows = shifted(4000, seed).tensors
        rows = windows["family"] == 0
        return windows["states"][rows].numpy(), windows["actions"][rows].numpy()

    detector = WindowDetector(trained).calibrated(*sound(2), rate=0.05)
    assert detector.threshold is not None
    assert (trained.score(*sound(3)) >= detector.threshold).mean() == pytest.approx(0.05, abs=0.02)


def test_what_is_refused(trained: FaultClassifier) -> None:
    with pytest.raises(InputError, match="this detector needs 1"):
        trained.score(np.zeros((3, 1, 2)), np.zeros((3, 0, 1)))
    with pytest.raises(InputError, match=r"states must have shape \(n, time, 2\)"):
        trained.score(np.zeros((3, 2, 4)), np.zeros((3, 1, 1)))
    windows = shifted(100, 0)
    windows.tensors["family"][3] = 7
    net = FaultClassifier.of(windows.tensors, box(2), PLAIN)
    with pytest.raises(InputError, match="kind of fault 7, and the classifier knows 0 to 2: none, push, pull"):
        net.fit_scales(windows.tensors)
    for kinds in ("none", ("none",), ("none", "none")):
        with pytest.raises(InputError, match="kinds are two names or more"):
            FaultConfig(kinds=kinds)  # type: ignore[arg-type]
