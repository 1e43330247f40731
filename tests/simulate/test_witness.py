"""A structure head from windows to a word: trained, opened, asked about motion, and refused where it knows nothing."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="the head is a network")

from nfc_gym.cli.measured import consulted
from nfc_gym.core import InputError
from nfc_gym.inference import checkpoint
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.network import Network
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig
from nfc_gym.simulate import simulate
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.teach import train_structure
from nfc_gym.simulate.witness import Witness, heads

TINY = NetworkConfig(encoder="nn", density="mixture", components=1, width=8, features=8, hidden=8)
ROBOT = "nfc_gym/QuadcopterFlat-v0"


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("head")
    simulate(ROBOT, 48, folder / "windows", seed=1, jobs=1, effects=0.75)
    out = folder / "head.safetensors"
    train_structure(folder / "windows", out, TrainConfig(epochs=1, batch=16), config=TINY, noise=0.5, repeats=1)
    return out


def hover(machine: Machine, count: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    home = machine.settings.robot(machine.model).home
    return np.tile(home, (count, steps + 1, 1)), np.zeros((count, steps + 1, machine.model.nv))


def test_a_head_answers_with_a_probability_for_each_family(head: Path) -> None:
    witness = Witness(head)
    machine, h = witness.machine, witness.horizon
    motion = hover(machine, 5, h)
    sent = {f"ctrl:{machine.model.actuator(i).name}": np.full((5, h), 2.4) for i in range(machine.model.nu)}
    told = witness(motion, motion, sent, {"body:base:linvel": 0.01}, seed=2)
    assert tuple(told) == witness.families
    assert sum(told.values()) == pytest.approx(1)
    assert told == witness(motion, motion, sent, {"body:base:linvel": 0.01}, seed=2)
    shares = witness.notes["shares"]
    assert len(shares) == len(witness.families)
    assert sum(shares) == pytest.approx(1)


def test_another_training_is_no_continuation(head: Path) -> None:
    before = head.read_bytes()
    with pytest.raises(InputError, match=r"of another run \(noise 0\.5, now 0\.4\)"):
        train_structure(
            head.parent / "windows", head, TrainConfig(epochs=1, batch=16), config=TINY, noise=0.4, repeats=1
        )
    assert head.read_bytes() == before


def test_noise_that_the_log_has_already_is_not_added(head: Path) -> None:
    witness = Witness(head)
    lacking = witness._lacking({"body:base:angvel@body": 0.015, "body:base:linvel": 0.0, "body:base:quat": 0.003})
    of = dict(zip(witness.machine.state_names, lacking, strict=True))
    assert of["body:base:angvel@body.x"] == pytest.approx(0, abs=1e-9)  # 0.5 times the 0.03 of the manifest
    assert of["body:base:linvel.x"] == pytest.approx(0.025)
    assert of["body:base:quat.w"] == pytest.approx(np.sqrt(0.0025**2 - 0.0015**2))


def test_another_robots_motion_is_refused(head: Path) -> None:
    witness = Witness(head)
    motion = np.zeros((2, 21, 7)), np.zeros((2, 21, 6))
    with pytest.raises(InputError, match="15 positions and 14 velocities"):
        witness(motion, motion, {}, {})


def test_close_loop_takes_a_head_for_a_head_and_a_posterior_for_a_posterior(head: Path, tmp_path: Path) -> None:
    assert heads(head) == (True, False)
    belief, witness = consulted(head)
    assert belief is None
    assert witness is not None
    machine = Machine(ROBOT)
    network = Network(TINY, Sizes(20, 21, 4), PriorBox.of(machine.space, "quadcopter"))
    plain = tmp_path / "psi.safetensors"
    checkpoint.save(plain, network)
    assert consulted(plain) == (plain, None)
    with pytest.raises(InputError, match="holds no structure head"):
        Witness(plain)
    assert consulted(None) == (None, None)


def test_windows_without_effects_or_on_rough_ground_teach_nothing(tmp_path: Path) -> None:
    simulate(ROBOT, 24, tmp_path / "none", seed=1, jobs=1, effects=0.0)
    with pytest.raises(InputError, match="no window has an effect"):
        train_structure(tmp_path / "none", tmp_path / "head.safetensors", TrainConfig(epochs=1), config=TINY)
    simulate("nfc_gym/JackalRough-v0", 8, tmp_path / "rough", seed=1, jobs=1)
    with pytest.raises(InputError, match="flat ground"):
        train_structure(tmp_path / "rough", tmp_path / "head.safetensors", TrainConfig(epochs=1), config=TINY)
