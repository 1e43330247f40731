"""One thread and one seed, so that runs agree to the bit; a policy of the Jackal, as `nfc-gym pretrain` makes it."""

import sys
from functools import partial
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
    """The file of a policy that has learned from 512 steps."""
    from nfc_gym.adaptation import pretrain
    from nfc_gym.adaptation.worlds import vector_env

    path = tmp_path_factory.mktemp("policies") / "jackal.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nfc_gym.adaptation.pretraining.EPISODES", 2)
        patch.setattr("nfc_gym.adaptation.pretraining.vector_env", partial(vector_env, episode=100))
        pretrain("JackalFlat", path, steps=512, envs=32, horizon=16, threads=1, device="cpu")
    return path
