"""One thread and one seed, so that runs agree to the bit; a policy of the Jackal, as `nfc-gym pretrain` makes it."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from nfc_gym.inference.detector import WindowDetector

sys.path.insert(0, str(Path(__file__).parent))  # `carts`: importlib mode does not add the folder

torch = pytest.importorskip("torch", reason="needs PyTorch: pip install 'nfc_gym[rl]'")
pytest.importorskip("torchrl", reason="needs TorchRL: pip install 'nfc_gym[rl]'")
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _own_seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def detector() -> "WindowDetector":
    """Of `carts`, trained and calibrated on gentle pushes; those that learn from it leave it as it is."""
    from carts import watcher

    return watcher()


@pytest.fixture(scope="session")
def jackal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a policy that has learned for a second."""
    from nfc_gym.adaptation import pretrain

    path = tmp_path_factory.mktemp("policies") / "jackal.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nfc_gym.adaptation.pretraining.EPISODES", 2)
        pretrain("JackalFlat", path, steps=2048, envs=32, threads=1, device="cpu")
    return path
