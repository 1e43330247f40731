"""A mission's trajectories as logs: what the measured loop reads back is what was estimated and commanded."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="logs are Parquet")
pytest.importorskip("torchrl", reason="missions run on TorchRL")

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.adaptation.logs import SHORTEST, write_logs
from nfc_gym.adaptation.trajectory import Dataset, Trajectory, execute
from nfc_gym.core.errors import InputError

JACKAL = "nfc_gym/JackalFlat-v0"


class Quiet:
    """A detector that sees nothing."""

    def reset(self, rows: Any = None) -> None:
        """Nothing is kept."""

    def update(self, obs: Any, action: Any, next_obs: Any) -> float:
        return 0.0


def driven(seed: int, steps: int = 60, environment: str = JACKAL) -> Trajectory:
    rng = np.random.default_rng(seed)
    world = gymnasium.make(environment, context=["psi"])
    return execute(lambda _: rng.uniform(-1, 1, world.action_space.shape), world, Quiet(), 1.0, seed, steps)


def test_the_measured_loop_reads_back_what_was_estimated_and_commanded(tmp_path: Path) -> None:
    from nfc_gym.measured.dataset import load

    runs = [driven(seed) for seed in range(3)]
    mapping = write_logs(runs, tmp_path / "logs", environment=JACKAL, noise={"body:pos": 0.02, "joint:vel": 0.3})
    dataset = load(mapping)
    assert len(dataset.logs) == 3
    log, run = dataset.logs[0], runs[0]
    assert len(log.time) == len(run)
    assert np.diff(log.time) == pytest.approx(0.02)
    assert log.channels["body:base:pos"].values == pytest.approx(run.estimate[:-1, :3], abs=1e-12)
    speed = log.channels["joint:front_left_wheel:vel"].values
    assert np.ravel(speed) == pytest.approx(run.estimate[:-1, 11 + 6], abs=1e-12)
    # Wheel speeds of both sides differ by the turn that was commanded.
    left, right = (log.controls[f"ctrl:{side}"] for side in ("front_left", "front_right"))
    assert np.sign(right - left) == pytest.approx(np.sign(run.actions[:, 1]))
    text = mapping.read_text()
    assert "noise: 0.02" in text
    assert "noise: 0.3" in text
    assert "sensor:" not in text


def test_a_missions_folder_is_enough(tmp_path: Path) -> None:
    import torch

    from nfc_gym.adaptation import resume
    from nfc_gym.adaptation.gathered import STATE

    gathered = Dataset(tmp_path / "mission")
    for seed in range(2):
        gathered.add(driven(seed))
    gathered.add(driven(9))  # of a mission that was interrupted before it counted this one
    of = {"environment": JACKAL}
    resume.save(tmp_path / "mission" / STATE, {"none": torch.nn.Linear(1, 1)}, None, {"t": 2}, of)
    write_logs(tmp_path / "mission", tmp_path / "logs")
    assert len(list((tmp_path / "logs").glob("*.parquet"))) == 2


def test_a_simulation_with_its_own_psi_explains_its_own_logs(tmp_path: Path) -> None:
    from nfc_gym.measured.bench import make_bench
    from nfc_gym.measured.dataset import load

    bench = make_bench(load(write_logs([driven(s) for s in range(3)], tmp_path / "logs", environment=JACKAL)), 1)
    problem = bench.problem(list(bench.dataset.logs))
    residual = problem.residual(bench.plant, bench.plant.null[None])
    # The same model, states and commands: what is left is the solver, which does not begin from its last solution here.
    assert np.nanmax(np.abs(residual)) < 1e-4


def test_what_cannot_be_written_is_refused_by_name(tmp_path: Path) -> None:
    run = driven(0)
    with pytest.raises(InputError, match="say which simulator's mission"):
        write_logs([run], tmp_path / "whose")
    with pytest.raises(InputError, match="no mission; want a folder"):
        write_logs(tmp_path, tmp_path / "none")
    with pytest.raises(InputError, match="rough ground"):
        write_logs([run], tmp_path / "rough", environment="nfc_gym/JackalRough-v0")
    with pytest.raises(InputError, match=f"no trajectory of {SHORTEST} control steps"):
        write_logs([driven(0, SHORTEST - 1)], tmp_path / "short", environment=JACKAL)
    with pytest.raises(InputError, match="AntFlat-v0 wants"):
        write_logs([run], tmp_path / "ant", environment="nfc_gym/AntFlat-v0")
    with pytest.raises(InputError, match="noise of 'wheel:vel': the channels are body:angvel"):
        write_logs([run], tmp_path / "noise", environment=JACKAL, noise={"wheel:vel": 0.1})
    with pytest.raises(InputError, match="noise of 'body:pos' is -1"):
        write_logs([run], tmp_path / "noise", environment=JACKAL, noise={"body:pos": -1.0})
    left = [f for name in ("short", "ant", "noise") if (tmp_path / name).exists() for f in (tmp_path / name).iterdir()]
    assert not left
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="full is not empty"):
        write_logs([run], tmp_path / "full", environment=JACKAL)
