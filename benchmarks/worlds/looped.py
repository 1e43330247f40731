"""The measured loop as a way to a policy: named effects explain what was executed, and PPO learns in that model."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

from nfc_gym.adaptation import FineTuneConfig, hand_over, load_policy
from nfc_gym.adaptation.extended import read_found
from nfc_gym.adaptation.extension import Extension
from nfc_gym.adaptation.handover import POLICY
from nfc_gym.adaptation.logs import write_logs
from nfc_gym.adaptation.trajectory import execute
from nfc_gym.core.files import write_whole
from nfc_gym.measured.loop import close_loop

from .learning import EPISODE, Learned, opened
from .machines import SENSORS

if TYPE_CHECKING:
    from .methods import Job

# Of the state estimate, as `estimate.estimated` makes it.
NOISE = {
    "body:pos": SENSORS["pos"], "body:quat": SENSORS["quat"], "body:linvel": SENSORS["linvel"],
    "body:angvel": SENSORS["angvel"], "joint:pos": SENSORS["pos"], "joint:vel": SENSORS["vel"],
}  # fmt: skip
_LOGS, _REPORT = "logs", "report"
_FEW = 2  # episodes that judge inside `hand_over`, whose figures are not used: the table's own judge


class Unwatched:
    """A detector that sees nothing: what is executed is explained, anomalous or not."""

    def reset(self, rows: Any = None) -> None:
        """Nothing is remembered."""

    def update(self, obs: Any, action: Any, next_obs: Any) -> float:
        """Always 0."""
        return 0.0


def looped(job: Job) -> Learned:
    """Execute, close the loop on these logs, fine-tune in the model that was found.

    What was executed is kept as logs, so that a job that was interrupted goes on from these.
    """
    budget, environment = job.budget, f"nfc_gym/{job.world.place}-v0"
    returns = _executed(job, environment)
    report = _explained(job)
    found = {
        "verdict": report["verdict"], "claims": [claim["id"] for claim in report["effects"]],
        "chi2": report["chi2"], "loop_seconds": report["seconds"], "executed": returns,
    }  # fmt: skip
    extension = Extension(read_found(job.folder / _REPORT), environment)
    if not extension.effects and not extension.moved:
        policy = opened(job.nominal, budget.device)
        return Learned(policy, [], found | {"learned": "nothing: all is as the model has it"})
    config = FineTuneConfig(steps=budget.steps, envs=budget.envs, seed=job.seed, curve=max(2, budget.judged))
    told = hand_over(
        environment, job.folder / _REPORT, job.folder / "adapted", policy=job.nominal, config=config, episodes=_FEW,
        device=budget.device, threads=budget.threads,
    )  # fmt: skip
    adapted = load_policy(job.folder / "adapted" / POLICY, budget.device)
    learned = [effect["sentence"] for effect in told["effects"]]
    return Learned(adapted, [], found | {"learned": learned, "seconds": told["seconds"]})


def _executed(job: Job, environment: str) -> list[float]:
    """Returns of the episodes in the true world, whose logs lie in the job's folder afterwards."""
    done = job.folder / "executed.json"
    if done.is_file():
        return json.loads(done.read_text())
    world, policy = job.world, opened(job.nominal, job.budget.device)
    single, count = world.single(context=["psi"], **job.settings), job.budget.executed
    executed = [execute(policy, single, Unwatched(), 1.0, job.seed + k, EPISODE) for k in range(count)]
    joints = world.kind.compile(0).njnt > 1
    noise = {kind: sd for kind, sd in NOISE.items() if joints or not kind.startswith("joint")}
    shutil.rmtree(job.folder / _LOGS, ignore_errors=True)
    write_logs(executed, job.folder / _LOGS, environment=environment, noise=noise)
    returns = [trajectory.total for trajectory in executed]
    write_whole(done, json.dumps(returns))
    return returns


def _explained(job: Job) -> dict[str, Any]:
    """The loop's report; a finished one is read back."""
    done = job.folder / _REPORT / "report.json"
    if not done.is_file():
        mapping = job.folder / _LOGS / "mapping.yaml"
        close_loop(mapping, job.folder / _REPORT, seed=job.seed, jobs=job.budget.threads)
    return json.loads(done.read_text())
