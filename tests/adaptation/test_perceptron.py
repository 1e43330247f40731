"""A policy as plain arrays: the same actions without torch, in any process, for `nfc-gym simulate`."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from nfc_gym.adaptation import load_policy
from nfc_gym.adaptation.network import ActorCritic, Sizes
from nfc_gym.adaptation.policy import Policy
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.worlds import vector_env
from nfc_gym.cli import app
from nfc_gym.core.errors import InputError
from nfc_gym.simulate import simulate

JACKAL = "nfc_gym/JackalFlat-v0"


def test_it_acts_as_the_policy_does(jackal: Path) -> None:
    policy = load_policy(jackal)
    arrays = pickle.loads(pickle.dumps(policy.perceptron()))
    seen = 10 * torch.randn(50, 17).numpy()  # beyond where observations are cut
    np.testing.assert_allclose(arrays(seen), policy(seen), atol=1e-5)
    assert np.ptp(arrays(seen)) > 0.01
    assert arrays.digest == policy.perceptron().digest
    with torch.no_grad():
        policy.network.gaussian.body[0].bias[0] += 1e-3
    assert arrays.digest != policy.perceptron().digest


def test_windows_are_moved_by_it(tmp_path: Path, jackal: Path) -> None:
    """The file, on two processes, makes what its arrays make in this one."""
    moved = {"seed": 3, "effects": 0.0, "policy_share": 1.0, "per_shard": 4}
    here = simulate(JACKAL, 8, tmp_path / "here", policy=load_policy(jackal).perceptron(), jobs=1, **moved)
    apart = simulate(JACKAL, 8, tmp_path / "apart", policy=load_policy(jackal).perceptron(), jobs=2, **moved)
    np.testing.assert_array_equal(here[:]["actions"], apart[:]["actions"])
    alone = simulate(JACKAL, 8, tmp_path / "alone", jobs=1, **{**moved, "policy_share": 0.0})
    assert not np.array_equal(here[:]["actions"], alone[:]["actions"])


def test_on_rough_ground_it_sees_where_each_window_is(tmp_path: Path) -> None:
    """A policy that answers to one cell of elevation alone: its actions differ from window to window."""
    envs = VectorSight(vector_env("JackalRough", 2, threads=1, terrain_pool=1))
    network = ActorCritic(Sizes(envs.sight.size, 17, 2, (4,)))
    for layer in (network.gaussian.body[0], network.gaussian.body[2]):
        torch.nn.init.zeros_(layer.weight)
    network.gaussian.body[0].weight.data[0, -1] = 1.0
    network.gaussian.body[2].weight.data[:, 0] = 1.0
    policy = Policy(envs.sight, network)
    observation, _ = envs.reset(seed=0)
    np.testing.assert_allclose(policy.perceptron()(observation["observation"]), policy(observation), atol=1e-6)
    rough = "nfc_gym/JackalRough-v0"
    moved = {"jobs": 1, "effects": 0.0, "policy_share": 1.0}
    first = simulate(rough, 4, tmp_path / "a", policy=policy.perceptron(), **moved)[:]["actions"]
    network.gaussian.body[0].weight.data[0, -1] = -1.0
    other = simulate(rough, 4, tmp_path / "b", policy=policy.perceptron(), **moved)[:]["actions"]
    assert np.abs(first - other).max() > 0.05
    with pytest.raises(InputError, match="looks at elevation, and nfc_gym/JackalFlat-v0 is flat"):
        simulate(JACKAL, 4, tmp_path / "c", policy=policy.perceptron(), **moved)


def test_the_command_takes_the_file(tmp_path: Path, jackal: Path) -> None:
    call = ["simulate", JACKAL, "--windows", "4", "--jobs", "1", "--policy", str(jackal)]
    done = CliRunner().invoke(app, [*call, "--out", str(tmp_path / "a")])
    assert done.exit_code == 0, done.output
    assert "4 windows in" in done.output
    call[1] = "nfc_gym/AntFlat-v0"
    wrong = CliRunner().invoke(app, [*call, "--out", str(tmp_path / "b")])
    assert wrong.exit_code == 2
    assert "policy of nfc_gym/JackalFlat-v0: fails on observations of nfc_gym/AntFlat-v0" in wrong.output
