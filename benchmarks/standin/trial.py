"""One trial: draw a machine, size its effects, write logs, run the loop blind, compare with oracle and baselines."""

import json
import pickle
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nfc_gym.core.files import replacing
from nfc_gym.measured.bench import Bench, make_bench
from nfc_gym.measured.dataset import load
from nfc_gym.measured.export import unpack
from nfc_gym.measured.hidden import Array, Hidden
from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.standin import Machine, draw_psi
from nfc_gym.physics.rollout import Plant

from .case import chi2, oracle, sized, true_effects, write_case
from .kinds import Outside
from .outside import Both
from .robots import ROBOTS, Robot
from .row import NAN, Row, Task
from .score import estimates, misses_foretold, psi_estimates, score

LEAST, MOST = 1.3, 30.0  # X / X_null of what is hidden, log-uniform
_CASE = "case.pickle"  # of a trial under way
_PLACES = 3  # that are drawn until an effect acts: friction at a joint that these motions never turn is no effect
_NEAR = 0.9  # of the least X / X_null that counts as acting
Model = tuple[Plant, Array]


@dataclass(frozen=True)
class Case:
    """A machine whose logs lie in a folder: what it hides, how that is judged, X / X_null of it, and its mapping."""

    machine: Machine
    outside: Outside | None
    ratio: float
    mapping: Path

    @property
    def hidden(self) -> Hidden:
        """What the machine hides."""
        return self.machine.hidden


def begun(task: Task, folder: Path) -> tuple[Case, bool]:
    """The case of a trial, and whether an interrupted trial left it in the folder."""
    kept = folder / _CASE
    if kept.is_file():
        machine, ratio, mapping = pickle.loads(kept.read_bytes())
        return Case(machine, _outside(task), ratio, folder / mapping), True
    case = prepared(task, folder)
    with replacing(kept) as part:
        part.write_bytes(pickle.dumps((case.machine, case.ratio, case.mapping.name)))
    return case, False


def prepared(task: Task, folder: Path) -> Case:
    """Draw the machine of a trial and write its logs and mapping into an empty folder."""
    rng = np.random.default_rng(task.seed)
    kit = ROBOTS[task.robot].showing(task.families)
    psi = draw_psi(kit.psi, rng)
    row = Row(task.robot, task.group, list(task.families), task.seed)
    hidden, outside = _hide(row, task, kit, psi, rng, folder / "sizing"), _outside(task)
    machine = Machine(psi, hidden)
    seeds = [int(s) for s in rng.integers(2**31, size=task.size.logs)]
    exclude = outside.exclude if outside else ()
    mapping = write_case(folder, kit, machine, task.size.seconds, seeds, task.size.only, exclude)
    return Case(machine, outside, row.ratio, mapping)


def trial(task: Task, folder: Path, threads: int = 1) -> Row:
    """Run one trial in a folder, empty or of the same trial, interrupted: then it goes on from there."""
    began = time.process_time()
    kit, row = ROBOTS[task.robot], Row(task.robot, task.group, list(task.families), task.seed)
    case, resumed = begun(task, folder)
    machine, hidden, outside, psi = case.machine, case.hidden, case.outside, case.machine.psi
    done = folder / "report" / "report.json"
    if not done.is_file():
        close_loop(case.mapping, folder / "report", seed=task.seed % 2**31, jobs=threads)
    report = json.loads(done.read_text())
    row.hidden, row.seconds, row.ratio = hidden.text, report["seconds"], case.ratio
    score(row, report, hidden, outside)
    row.effect, row.psi = estimates(report, hidden), psi_estimates(report, psi, kit.weighed)
    if outside is None:
        _compare(row, task, folder, report, machine)
    row.cpu = NAN if resumed else time.process_time() - began  # of a process that was killed nobody knows
    return row


def _outside(task: Task) -> Outside | None:
    """How an effect is judged that the library has no law for."""
    kind = ROBOTS[task.robot].outside[task.families[0]] if task.group == "outside" else None
    return kind if isinstance(kind, Outside) else None


def _hide(row: Row, task: Task, kit: Robot, psi: dict[str, float], rng: np.random.Generator, folder: Path) -> Hidden:
    """What the machine hides, each effect sized alone."""
    table = kit.outside if task.group == "outside" else kit.named
    found, ratios = [], []
    for family in task.families:
        for _ in range(_PLACES):
            place, wanted = int(rng.integers(2**31)), float(np.exp(rng.uniform(np.log(LEAST), np.log(MOST))))
            hidden, ratio = sized(kit, psi, table[family], place, wanted, folder, task.size.tries)
            if ratio >= LEAST * _NEAR:
                break
        found.append(hidden)
        ratios.append(ratio)
    row.ratio = min(ratios, default=float("nan"))
    return found[0] if len(found) == 1 else Both(found) if found else Hidden()


def _compare(row: Row, task: Task, folder: Path, report: dict, machine: Machine) -> None:
    """Errors on the verification logs of all models over the oracle's: true effects, true psi, the package's model."""
    bench = make_bench(load(folder / "mapping.yaml"), 1)
    logs = {log.name: log for log in bench.dataset.logs}
    fitting, selecting = ([logs[n] for n in report["logs"][s]] for s in ("fit", "select"))
    problem = bench.problem([logs[n] for n in report["logs"]["verify"]])
    known = true_effects(bench, fitting, machine.hidden)
    best = oracle(bench, fitting, machine)
    if known is None or best is None:
        raise ValueError(f"{machine.hidden.text}: the library proposes no such effect for this model")
    row.foretold = misses_foretold(report, machine.hidden, known)
    row.oracle_x = chi2(problem, *best) / report["chi2"]["null"]
    fits = json.loads((folder / "report" / "fit.json").read_text())
    calibrated = unpack(fits["calibrated"], bench.plant)
    models = {"nominal": (bench.plant, bench.plant.null), "psi only": calibrated}
    models["after"] = unpack(fits["extended"], bench.plant)
    if task.baselines:
        models |= _baselines(row, bench, fitting, selecting, calibrated, machine.hidden)
    floor = group_errors(problem, *best)
    for name, model in models.items():
        row.errors[name] = float(np.exp(np.mean(np.log(group_errors(problem, *model) / floor))))


def _baselines(
    row: Row, bench: Bench, fitting: list, selecting: list, calibrated: Model, hidden: Hidden
) -> dict[str, Model]:
    """Other tools' models from the same logs; a baseline that fails is noted, and no reason to lose the trial."""
    found: dict[str, Model] = {}

    def sysid() -> None:
        from .sysid import identify

        found["sysid"] = bench.plant, identify(bench, fitting)

    def network() -> None:
        from .network import learn

        found["network"] = learn(bench, fitting, selecting, *calibrated, row.seed)

    def sparse() -> None:
        from .sparse import regress

        row.sindy = regress(bench, fitting, selecting, *calibrated).judged(hidden)

    for tool in (sysid, network, sparse):
        try:
            tool()
        except Exception as error:
            row.note += f" {tool.__name__}: {type(error).__name__}: {str(error)[:120]};"
    return found


def group_errors(problem: Problem, plant: Plant, x: Array) -> Array:
    """Root-mean-square error of each group of quantities at the longest horizon, each in its own unit."""
    residual = problem.residual(plant, x[None])[0]
    columns = problem.columns
    last = np.isclose(columns.horizon, columns.horizon.max())
    out = []
    for group in dict.fromkeys(columns.group):
        pick = np.array([g == group for g in columns.group]) & last
        values = residual[:, pick]
        out.append(np.sqrt(np.nanmean(np.where(np.isfinite(values), values, np.nan) ** 2)))
    return np.array(out)
