"""One trial: draw a machine, size its effect, write logs, run the loop blind, compare with oracle and baselines."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench, candidates, make_bench
from nfc_gym.measured.dataset import load
from nfc_gym.measured.demo import judge, write_log
from nfc_gym.measured.export import unpack
from nfc_gym.measured.hidden import Array, Hidden
from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.metric import metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.standin import Machine, draw_psi
from nfc_gym.measured.verdict import mean_square
from nfc_gym.physics.rollout import Plant

from .robots import ROBOTS, Robot
from .sysid import identify


@dataclass(frozen=True)
class Size:
    """How long a trial is: logs, seconds of each, and which effects compete (empty: all)."""

    logs: int = 8
    seconds: float = 5.0
    only: tuple[str, ...] = ()


@dataclass
class Row:
    """Outcome of a trial.

    Attributes:
      ratio: X / X_null of the effect under the true psi without it; nan for nulls.
      outcome: right, wrong or missed.
      false_claims: effects claimed that are not there (an equivalent of a right claim is none).
      errors: error over the oracle's by stage (nominal, psi only, sysid, after), at the longest horizon, geometric mean
        over the groups of quantities.
      oracle_x: X of the oracle over X_null on the verification logs, about 1 if both codes mean the same effect.
    """

    robot: str
    family: str
    hidden: str
    seed: int
    ratio: float
    outcome: str = ""
    false_claims: int = 0
    claims: list[str] = field(default_factory=list)
    verdict: str = ""
    errors: dict[str, float] = field(default_factory=dict)
    oracle_x: float = float("nan")
    seconds: float = float("nan")
    note: str = ""


def trial(robot: str, family: str, seed: int, folder: Path, size: Size, jobs: int = 1) -> Row:
    """Run one trial in an empty folder. `family` is one of the robot's kinds, or `none`."""
    rng = np.random.default_rng(seed)
    kit = ROBOTS[robot]
    psi = draw_psi(kit.psi, rng)
    place, wanted = int(rng.integers(2**31)), float(np.exp(rng.uniform(np.log(1.3), np.log(30))))
    (folder / "logs").mkdir(parents=True)
    hidden, ratio = Hidden(), float("nan")
    if family != "none":
        hidden, ratio = sized(kit, psi, family, place, wanted, folder / "sizing")
    machine = Machine(psi, hidden)
    for i in range(size.logs):
        write_log(folder / "logs" / f"run_{i:02d}.csv", kit.log(machine, size.seconds, int(rng.integers(2**31))))
    _write_mapping(folder, kit, psi, size.only)
    report = close_loop(folder / "mapping.yaml", folder / "report", seed=seed % 2**31, jobs=jobs)
    row = Row(robot, family, hidden.text, seed, ratio, verdict=report["verdict"], seconds=report["seconds"])
    row.claims = [" = ".join([e["id"], *e["equivalents"]]) for e in report["effects"]]
    row.outcome = judge(report, hidden.family, hidden.where)
    alone = [judge(report | {"effects": [e]}, hidden.family, hidden.where) for e in report["effects"]]
    row.false_claims = sum(a != "right" for a in alone)
    _compare(row, folder, report, machine)
    return row


def _write_mapping(folder: Path, kit: Robot, psi: dict[str, float], only: Sequence[str] = ()) -> None:
    mapping = yaml.safe_load(kit.mapping(psi["base_mass"]))
    if only:
        mapping["effects"] = {"only": list(only)}
    (folder / "mapping.yaml").write_text(yaml.safe_dump(mapping, sort_keys=False))


def sized(
    kit: Robot, psi: dict[str, float], family: str, place: int, wanted: float, folder: Path
) -> tuple[Hidden, float]:
    """The effect at a size that makes X / X_null about `wanted`, and the ratio reached (sizes have a range)."""
    kind = kit.kinds[family]
    floor = _chi2(kit, psi, Hidden(), folder)
    size = float(np.sqrt(kind.low * kind.high))
    best: tuple[float, Hidden, float] | None = None
    for _ in range(8):
        hidden = kind.make(np.random.default_rng(place), size)
        ratio = _chi2(kit, psi, hidden, folder) / floor
        miss = abs(np.log(max(ratio, 1.0) / wanted))
        if best is None or miss < best[0]:
            best = (miss, hidden, ratio)
        if miss < 0.1:
            break
        # The excess grows about as the square of the size; where not, a step goes at most to a tenth or tenfold.
        step = np.sqrt((wanted - 1) / max(ratio - 1, 1e-2))
        size = float(np.clip(size * np.clip(step, 0.1, 10.0), kind.low, kind.high))
    assert best is not None
    return best[1], best[2]


def _chi2(kit: Robot, psi: dict[str, float], hidden: Hidden, folder: Path) -> float:
    """X of the model without effects at the true psi, on four short logs of always the same commands."""
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    for i in range(4):
        write_log(folder / "logs" / f"{i}.csv", kit.log(Machine(psi, hidden), 2.1, i))
    _write_mapping(folder, kit, psi)
    bench = make_bench(load(folder / "mapping.yaml"), 1)
    problem = bench.problem(list(bench.dataset.logs))
    x = bench.plant.space.vector(psi)
    return mean_square(problem, _white(problem, bench.plant, x, problem.covariance(bench.plant, x)))


def _white(problem: Problem, plant: Plant, x: Array, sigma: Array) -> Array:
    return metric(problem, sigma).whiten(problem.residual(plant, x[None]))[0]


def _compare(row: Row, folder: Path, report: dict, machine: Machine) -> None:
    """Errors on the verification logs of all models over the oracle's: true effect, true psi, the package's model."""
    bench = make_bench(load(folder / "mapping.yaml"), 1)
    logs = {log.name: log for log in bench.dataset.logs}
    fitting = [logs[n] for n in report["logs"]["fit"]]
    problem = bench.problem([logs[n] for n in report["logs"]["verify"]])
    oracle = _oracle(bench, fitting, machine)
    sigma = problem.covariance(*oracle)
    row.oracle_x = mean_square(problem, _white(problem, *oracle, sigma)) / report["chi2"]["null"]
    fits = json.loads((folder / "report" / "fit.json").read_text())
    models = {"nominal": (bench.plant, bench.plant.null), "psi only": unpack(fits["calibrated"], bench.plant)}
    models["after"] = unpack(fits["extended"], bench.plant)
    try:
        models["sysid"] = (bench.plant, identify(bench, fitting))
    except Exception as error:  # the baseline's own limits are a result, and no reason to lose the trial
        row.note = f"mujoco.sysid: {type(error).__name__}: {error}"
    best = group_errors(problem, *oracle)
    for name, (plant, x) in models.items():
        row.errors[name] = float(np.exp(np.mean(np.log(group_errors(problem, plant, x) / best))))


def _oracle(bench: Bench, logs: Sequence[Log], machine: Machine) -> tuple[Plant, Array]:
    psi = bench.plant.space.vector(dict(machine.psi))
    hidden = machine.hidden
    if hidden.family == "none":
        return bench.plant, psi
    of = [e for e in candidates(bench, logs) if e.family == hidden.family and set(e.where) == set(hidden.where)]
    theta = np.array([hidden.parameters[p.name] for p in of[0].params])
    return bench.plant.with_effects([of[0]]), np.concatenate([psi, theta])


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
