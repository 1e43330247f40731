"""A mission's trajectories as logs of the measured loop: what a robot did while it was adapted is data to explain."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nfc_gym.adaptation.gathered import read_mission
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.envs.robot import DT
from nfc_gym.envs.simulations import Simulations
from nfc_gym.simulate.machine import Machine
from nfc_gym.wrappers.record_folder import LogFolder
from nfc_gym.wrappers.simulation import simulation_of

Array = NDArray[np.float64]
SHORTEST = 50  # control steps of a log: of less, no segment and its start could be told apart


def write_logs(
    mission: str | Path | Iterable[Trajectory], folder: str | Path, *, environment: str | None = None,
    noise: Mapping[str, float] | None = None,
) -> Path:  # fmt: skip
    """Write what was executed as logs that `nfc-gym close-loop` reads.

    Args:
      mission: the `folder` of `adapt`, or trajectories, with state estimates. Of those of fewer than `SHORTEST` control
        steps, as of a robot that fell at once, none is written.
      environment: id of the simulator, on flat ground: what the logs are compared with; default the mission's own, if
        its folder says so.
      folder: for `model.xml`, `mapping.yaml`, `episode_0000.parquet`, ...; new or empty.
      noise: standard deviations of the estimates by kind of channel (`body:pos`, `body:quat`, `body:linvel`,
        `body:angvel`, `joint:pos`, `joint:vel`) [m, rad, m/s, rad/s]; default those of a simulation without noise.

    Returns:
      The mapping file, in which psi of the environment is what may be calibrated.

    Raises:
      InputError: no mission, or it does not say whose; no trajectory is long enough, or one has no estimates of this
        robot's state; rough ground, of which no model is known; a folder that is not empty; noise that is none, or of a
        kind of channel that no log has.
    """
    own: str | None = None
    if isinstance(mission, str | Path):
        mission, own = read_mission(mission)
    environment = environment or own
    if environment is None:
        raise InputError("write_logs: say which simulator's mission this was: environment='nfc_gym/...'")
    folder, machine = Path(folder), Machine(environment)
    name = machine.environment
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty: choose a new folder for the logs")
    if machine.rough:
        raise InputError(f"{name}: logs on rough ground need a model of it; only flat ground can be written")
    for kind, sd in (noise or {}).items():
        if not (np.isfinite(sd) and sd > 0):
            raise InputError(f"noise of {kind!r} is {sd}; want a standard deviation, finite and above 0")
    # All is looked at before anything is written: what is refused leaves no half of a folder behind.
    sims = machine.simulations(1, 1, [])
    records = [_record(trajectory, machine, sims) for trajectory in mission if len(trajectory) >= SHORTEST]
    if not records:
        raise InputError(f"no trajectory of {SHORTEST} control steps or more: there is nothing to explain")
    env = gymnasium.make(name, context=[])
    try:
        env.reset(seed=0)
        log = LogFolder(env, simulation_of(env, "write_logs"), folder, None, noise)
        # What a robot feels is not part of a state estimate.
        log.columns = [column for column in log.columns if not column.name.startswith("sensor:")]
        log.describe()
        for record in records:
            log.write(record)
    finally:
        env.close()
    return folder / "mapping.yaml"


def _record(trajectory: Trajectory, machine: Machine, sims: Simulations) -> dict[str, Array]:
    model, steps = machine.model, len(trajectory)
    wanted = (steps + 1, model.nq + model.nv + model.na)
    if trajectory.estimate.shape != wanted:
        raise InputError(f"state estimates of shape {trajectory.estimate.shape}; {machine.environment} wants {wanted}")
    state = trajectory.estimate[:-1]
    ctrl = np.concatenate([sims.robot.actuate(action[None], sims.view) for action in trajectory.actions])
    return {
        "time": np.arange(steps, dtype=float) * DT, "qpos": state[:, : model.nq],
        "qvel": state[:, model.nq : model.nq + model.nv], "ctrl": ctrl, "sensordata": np.zeros((steps, 0)),
    }  # fmt: skip
