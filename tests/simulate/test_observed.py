"""A recorded log becomes what the environment had observed: the same numbers, and clear words where it cannot."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import nfc_gym  # noqa: F401 (registers the environments)
from nfc_gym.core import InputError
from nfc_gym.measured.dataset import load
from nfc_gym.measured.states import estimate_states
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.observed import commands, observed
from nfc_gym.wrappers import RecordLog


def recorded(folder: Path, robot: str, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions of one episode, which RecordLog writes into a folder."""
    env = RecordLog(gym.make(f"nfc_gym/{robot}Flat-v0", context=()), folder)
    seen, done = [env.reset(seed=4)[0]], []
    rng = np.random.default_rng(1)
    for _ in range(steps):
        done.append(np.clip(0.2 * rng.standard_normal(env.action_space.shape), -1, 1).astype(np.float32))
        seen.append(env.step(done[-1])[0])
    env.close()
    return np.array(seen), np.array(done)


# What no log says: where the craft was to fly, how fast the quadruped was to walk.
TASK = {"Jackal": [], "Quadcopter": [0, 1, 2], "Quadruped": [9, 10, 11]}


@pytest.mark.parametrize("robot", TASK)
def test_a_log_gives_back_what_was_observed(tmp_path: Path, robot: str) -> None:
    seen, done = recorded(tmp_path, robot, 12)
    machine = Machine(f"nfc_gym/{robot}Flat-v0")
    log = load(tmp_path / "mapping.yaml").logs[0]
    states = estimate_states(machine.model, log, raw=True)
    given, actions = observed(machine, log.time, states.qpos, states.qvel, commands(machine, log.controls))
    n = len(actions)
    assert given.shape == (n + 1, len(machine.state_names))
    assert actions == pytest.approx(done[:n], abs=1e-5)
    width = len(machine.state_names)
    own = [i for i in range(width) if i not in TASK[robot]]
    assert given[:, own] == pytest.approx(seen[: n + 1, :width][:, own], abs=1e-4)


def test_robots_that_feel_forces_are_refused() -> None:
    with pytest.raises(InputError, match="contact forces"):
        observed(Machine("nfc_gym/AntFlat-v0"), np.arange(3) * 0.02, *np.zeros((3, 3, 15)))


def test_other_rates_and_impossible_commands_are_refused() -> None:
    machine = Machine("nfc_gym/JackalFlat-v0")
    qpos = np.tile(machine.model.qpos0, (5, 1))
    qvel, ctrl = np.zeros((5, machine.model.nv)), np.zeros((5, machine.model.nu))
    with pytest.raises(InputError, match="record at 50 Hz"):
        observed(machine, np.arange(5) * 0.033, qpos, qvel, ctrl)
    ctrl[2, 0] = 5.0  # one wheel alone
    with pytest.raises(InputError, match="off what any action makes"):
        observed(machine, np.arange(5) * 0.02, qpos, qvel, ctrl)
    with pytest.raises(InputError, match=r"ctrl:.* is missing"):
        commands(machine, {})


def test_infer_takes_the_folder_of_a_recording(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="the posterior is a network")
    from typer.testing import CliRunner

    from nfc_gym.cli import app
    from nfc_gym.inference import checkpoint
    from nfc_gym.inference.config import NetworkConfig, Sizes
    from nfc_gym.inference.network import Network
    from nfc_gym.inference.space import PriorBox

    recorded(tmp_path / "log", "Jackal", 20)
    machine = Machine("nfc_gym/JackalFlat-v0")
    config = NetworkConfig(encoder="nn", width=8, features=8, hidden=8, depth=1)
    network = Network(config, Sizes(6, 15, 2), PriorBox.of(machine.space, "jackal"))
    file = tmp_path / "posterior.safetensors"
    checkpoint.save(file, network, notes={"environment": machine.environment})

    def run(*more: str) -> tuple[int, str]:
        out = CliRunner().invoke(app, ["infer", str(file), str(tmp_path / "log"), *more])
        return out.exit_code, out.output

    code, said = run("--out", str(tmp_path / "psi.npz"), "--samples", "50")
    assert (code, said.count("base_mass")) == (0, 1)
    with np.load(tmp_path / "psi.npz") as drawn:
        assert drawn["psi"].shape == (50, 17)
    code, said = run("--until", "0.06")
    assert code == 2
    assert "3 steps; this network was trained on windows of 6" in " ".join(said.split())
    code, said = run("--log", "another")
    assert code == 2
    assert "no log 'another'" in said
    checkpoint.save(file, network)
    assert "does not say of which environment" in " ".join(run()[1].split())
