"""The benchmark of undeclared effects: two separate codes must mean the same by an effect, and the sums must add up."""

import importlib.util
import json
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    """`undeclared_effects` with its own folder on the path, as when it is run as a script."""
    pytest.importorskip("mujoco.sysid._src.parameter", reason="needs mujoco[sysid]")
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location("undeclared_effects", FOLDER / "undeclared_effects.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


@pytest.mark.parametrize(
    ("robot", "family"),
    [
        ("quadcopter", "loss"),
        ("quadcopter", "payload"),
        ("quadcopter", "wind"),
        ("quadcopter", "drag_quadratic"),
        ("quadcopter", "delay"),
        ("quadcopter", "supply_sag"),
        ("jackal", "loss"),
        ("jackal", "payload"),
        ("jackal", "delay"),
        ("jackal", "lag"),
        ("jackal", "coulomb"),
        ("jackal", "slope"),
    ],
)
def test_the_package_explains_the_stand_in_to_its_noise_floor(
    benchmark: ModuleType, tmp_path: Path, robot: str, family: str
) -> None:
    """True effect and true psi in the package's model: X is about 1, while without the effect it is far from it."""
    trial = sys.modules["standin.trial"]
    kit = benchmark.ROBOTS[robot]
    rng = np.random.default_rng(7)
    psi = trial.draw_psi(kit.psi, rng)
    kind = kit.kinds[family]
    hidden = kind.make(rng, kind.low ** (1 / 3) * kind.high ** (2 / 3))
    machine = trial.Machine(psi, hidden)
    (tmp_path / "logs").mkdir()
    for i in range(4):
        trial.write_log(tmp_path / "logs" / f"{i}.csv", kit.log(machine, 2.5, i))
    trial._write_mapping(tmp_path, kit, psi)
    bench = trial.make_bench(trial.load(tmp_path / "mapping.yaml"), 1)
    logs = list(bench.dataset.logs)
    problem = bench.problem(logs)
    plant, x = trial._oracle(bench, logs, machine)
    sigma = problem.covariance(plant, x)
    with_effect = trial.mean_square(problem, trial._white(problem, plant, x, sigma))
    bare = bench.plant.space.vector(psi)
    without = trial.mean_square(problem, trial._white(problem, bench.plant, bare, sigma))
    assert with_effect < 1.4
    assert without > 1.5 * with_effect


def row(benchmark: ModuleType, robot: str, family: str, outcome: str, ratio: float = 5.0, after: float = 1.0) -> object:
    errors = {"after": after, "psi only": 2.0, "nominal": 3.0, "sysid": 2.5}
    false = int(family == "none" and outcome == "wrong")
    return benchmark.Row(robot, family, family, 1, ratio, outcome, false, errors=errors)


def test_summary_counts_and_compares_with_the_goals(benchmark: ModuleType) -> None:
    rows = [row(benchmark, "jackal", "lag", "right", 2.0) for _ in range(9)]
    rows += [row(benchmark, "jackal", "lag", "missed", 20.0) for _ in range(3)]
    rows += [row(benchmark, "quadcopter", "wind", "right", after=1.2)]
    rows += [row(benchmark, "jackal", "none", "right", math.nan), row(benchmark, "jackal", "none", "wrong", math.nan)]
    by_name = {r["name"]: r for r in benchmark.summary(rows, 11)}
    assert by_name["jackal: named right"]["value"] == 0.75
    assert by_name["jackal: named right"]["holds"] is True
    assert by_name["jackal: named right, X/X_null 10 to inf (3 trials)"]["value"] == 0.0
    assert by_name["quadcopter: error after / oracle's, worst right case"]["holds"] is False
    assert by_name["false claims in 2 nulls"] | {"seeds": 0} == {
        "name": "false claims in 2 nulls",
        "value": 1,
        "unit": "trials",
        "baseline": None,
        "goal": "<= 1",
        "holds": True,
        "seeds": 0,
    }
    json.dumps(benchmark.summary(rows, 11), allow_nan=False)


def test_the_plan_takes_turns_and_repeats_with_its_seed(benchmark: ModuleType) -> None:
    args = benchmark.parse(["--trials", "12", "--nulls", "3", "--robots", "jackal"])
    plans = [benchmark.planned(args, np.random.default_rng(5)) for _ in range(2)]
    assert plans[0] == plans[1]
    families = [p[1] for p in plans[0]]
    assert sorted(families.count(f) for f in benchmark.ROBOTS["jackal"].kinds) == [2] * 6
    assert families.count("none") == 3


def test_sysid_finds_the_true_psi_of_a_machine_without_effect(benchmark: ModuleType, tmp_path: Path) -> None:
    """A baseline that were badly set up would be no baseline."""
    trial = sys.modules["standin.trial"]
    kit = benchmark.ROBOTS["quadcopter"]
    psi = {"base_mass": 0.63, "arm_mass": 0.09, "mount_stiffness": 4.5}
    (tmp_path / "logs").mkdir()
    for i in range(4):
        trial.write_log(tmp_path / "logs" / f"{i}.csv", kit.log(trial.Machine(psi), 2.0, i))
    trial._write_mapping(tmp_path, kit, psi)
    bench = trial.make_bench(trial.load(tmp_path / "mapping.yaml"), 1)
    found = trial.identify(bench, list(bench.dataset.logs))
    np.testing.assert_allclose(found, [psi[p] for p in bench.plant.space.names], rtol=0.03)
