"""The benchmark of undeclared effects: what is planned, how reports are scored, and whether the sums add up."""

import json
import math
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest


def modules() -> SimpleNamespace:
    names = ("outside", "plan", "row", "score", "summary", "kinds", "robots", "faults", "pushes")
    return SimpleNamespace(
        **{n: import_module(f"standin.{n}") for n in names}, main=import_module("undeclared_effects")
    )


def claim(family: str, where: Any, equivalents: tuple[str, ...] = (), **parameters: tuple[float, float, float]) -> dict:
    place = where if isinstance(where, str) else "+".join(where)
    values = {n: {"value": v, "low": a, "high": b, "unit": "1"} for n, (v, a, b) in parameters.items()}
    return {"id": f"{family}:{place}", "family": family, "where": where, "equivalents": list(equivalents)} | {
        "parameters": values
    }


def report(*claims: dict, verdict: str = "explained", coordinate: str | None = None) -> dict:
    rest = None if coordinate is None else {"coordinate": coordinate}
    return {"effects": list(claims), "verdict": verdict, "unexplained": rest, "identifiability": []}


def outcome(said: dict, hidden: Any, outside: Any = None) -> Any:
    m = modules()
    row = m.row.Row("jackal", "single", [], 1)
    m.score.score(row, said, hidden, outside)
    return row


# ---- plans ----------------------------------------------------------------------------------------------------------


def tasks(*argv: str) -> list:
    main = modules().main
    return main.planned(main.parse(["--robots", "jackal", "ant", *argv]), 5)


def test_a_trial_has_the_same_seed_whatever_else_is_asked_for() -> None:
    few, many = tasks("--trials", "1", "--nulls", "2"), tasks("--trials", "2", "--nulls", "3", "--pairs", "4")
    assert {t.name for t in few} <= {t.name for t in many}
    assert len({t.seed for t in many}) == len(many)


def test_every_robot_has_at_least_twelve_effects_and_each_is_tried_as_often() -> None:
    robots = modules().robots.ROBOTS
    assert all(len(r.kinds) >= 12 for r in robots.values())
    families = [t.families for t in tasks("--trials", "3") if t.robot == "ant"]
    assert sorted(families) == sorted([(f,) for f in robots["ant"].kinds] * 3)


def test_wider_effects_are_tried_where_they_are_asked_for_alone() -> None:
    robots = modules().robots.ROBOTS
    assert not any(set(r.kinds) & set(r.wider) for r in robots.values())
    wider = [(t.robot, t.group, *t.families) for t in tasks("--wider", "--trials", "2")]
    assert sorted(wider) == sorted([(r, "single", f) for r in ("jackal", "ant") for f in robots[r].wider] * 2)
    assert {(t.robot, *t.families) for t in tasks("--effects", "thermal", "lag")} == {
        ("jackal", "lag"), ("ant", "lag"), ("ant", "thermal")
    }  # fmt: skip
    both = [*tasks("--trials", "2"), *tasks("--wider", "--trials", "2")]
    assert len({t.seed for t in both}) == len(both)


def test_a_motion_that_shows_the_effect_is_that_of_its_floor_too() -> None:
    kit = modules().robots.ROBOTS["quadcopter"]
    assert kit.showing(["thermal"]) is kit
    standin = import_module("nfc_gym.measured.standin")
    usual, low = (k.log(standin.Machine(k.psi), 0.3, 1)["z"] for k in (kit, kit.showing(["ground_effect"])))
    assert usual.min() > 2.0
    assert 0.2 < low.min() < low.max() < 1.0


def test_a_fade_is_judged_at_the_reference_of_the_claim() -> None:
    m = modules()
    hot = import_module("standin.drives").Thermal("a", 0.1, 2.0, 2.0)
    found = m.score.estimates(report(claim("thermal", "a", fade=(0.4, 0.3, 0.5), reference=(4.0, 3.0, 5.0))), hot)
    assert [(e.name, pytest.approx(e.true)) for e in found] == [("thermal.fade", 0.4), ("thermal.reference", 2.0)]


def test_pairs_are_of_two_kinds_and_repeat_with_the_seed() -> None:
    plan = modules().plan
    drawn = [t.families for t in plan.pairs("jackal", 30, 3)]
    assert drawn == [t.families for t in plan.pairs("jackal", 30, 3)]
    assert all(plan._KIND[a] != plan._KIND[b] for a, b in drawn)
    assert len(set(drawn)) == 30


def test_the_baselines_run_in_a_share_of_single_effects() -> None:
    singles = [t for t in tasks("--trials", "5", "--nulls", "9", "--baselines", "0.2") if t.robot == "ant"]
    assert sum(t.baselines for t in singles) == len([t for t in singles if t.group == "single"]) // 5
    assert not any(t.baselines for t in singles if t.group == "null")


def test_excluded_families_are_those_that_a_mapping_knows() -> None:
    known = set(import_module("nfc_gym.measured.entries").FAMILIES)
    for robot in modules().robots.ROBOTS.values():
        assert set(robot.named) <= known
        assert all(set(k.exclude) | set(k.near) <= known for k in robot.outside.values())


def test_any_beginning_has_its_share_of_every_kind_and_robot() -> None:
    first = tasks("--trials", "5", "--pairs", "10", "--outside", "5", "--nulls", "31")
    tenth = first[: len(first) // 10]
    for robot in ("jackal", "ant"):
        for group in ("single", "pair", "outside", "null"):
            share = sum(t.robot == robot and t.group == group for t in first) / 10
            assert abs(sum(t.robot == robot and t.group == group for t in tenth) - share) <= 1


def test_a_limit_that_does_nothing_down_to_some_value_is_enclosed() -> None:
    modules()
    case, kind = import_module("standin.case"), SimpleNamespace(low=0.05, high=0.6)
    tried = [(0.17, 40.0)]  # X / X_null 1 below 0.1, then steep
    for _ in range(7):
        size = case._next_size(tried, 3.0, kind)
        tried.append((size, 1 + max(size - 0.1, 0) * 600))
    assert min(abs(math.log(r / 3.0)) for _, r in tried) < 0.1


def test_a_trial_that_was_killed_goes_on_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    m = modules()
    task = tasks("--trials", "1")[0]
    kept, found = m.plan.Kept(tmp_path), m.row.Row(task.robot, task.group, list(task.families), task.seed)
    ways: list[BaseException | None] = [KeyboardInterrupt(), ValueError("a bug"), None]

    def trial(task: Any, folder: Path, threads: int) -> Any:
        there.append((folder / "half").exists())
        (folder / "half").write_text("")
        if (raised := ways.pop(0)) is not None:
            raise raised
        (folder / "report").mkdir()
        for name in ("report.html", "report.json"):
            (folder / "report" / name).write_text("{}")
        return found

    there: list[bool] = []
    monkeypatch.setattr(m.plan, "trial", trial)
    for error in (KeyboardInterrupt, ValueError):
        with pytest.raises(error):
            m.plan.one(task, 1, kept)
    assert m.plan.one(task, 1, kept) is found
    assert there == [False, True, False]  # one that failed begins anew
    assert not list(kept.begun.iterdir())
    assert (kept.reports / task.name / "report.json").is_file()


def test_a_machine_is_the_same_when_its_trial_goes_on(tmp_path: Path) -> None:
    trial = import_module("standin.trial")
    m = modules()
    task = m.row.Task("quadcopter", "single", ("wind",), 7, m.row.Size(3, 0.6, ("wind",), 1))
    first, resumed = trial.begun(task, tmp_path)
    assert not resumed
    log = (tmp_path / "logs" / "run_00.csv").read_bytes()
    again, resumed = trial.begun(task, tmp_path)
    assert resumed
    assert again.hidden.text == first.hidden.text
    assert (again.machine.psi, again.ratio, again.mapping) == (first.machine.psi, first.ratio, first.mapping)
    assert (tmp_path / "logs" / "run_00.csv").read_bytes() == log


# ---- resuming -------------------------------------------------------------------------------------------------------


def test_finished_trials_are_kept_and_failed_ones_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    m = modules()
    plan, ran = m.plan, []
    todo = [m.row.Task("jackal", "null", (), s) for s in range(4)]

    def fake(task: Any, folder: Path, threads: int) -> Any:
        ran.append(task.seed)
        if task.seed == 2 and len(ran) < 5:
            raise RuntimeError("once")
        (folder / "report").mkdir()
        for name in ("report.html", "report.json", "model.xml"):
            (folder / "report" / name).write_text(f"{task.seed}")
        return m.row.Row("jackal", "null", [], task.seed, oracle_x=math.nan, errors={"after": 1.0})

    monkeypatch.setattr(plan, "trial", fake)
    first = [r.seed for r, _ in plan.run(todo, 1, 1, plan.Kept(tmp_path))]
    assert first == [0, 1, 3]
    second = {r.seed: r for r, _ in plan.run(todo, 1, 1, plan.Kept(tmp_path))}
    assert sorted(second) == [0, 1, 2, 3]
    assert ran == [0, 1, 2, 3, 2]
    for task in todo:
        kept = {f.name: f.read_text() for f in (tmp_path / "reports" / task.name).iterdir()}
        assert kept == {"report.html": str(task.seed), "report.json": str(task.seed)}
    assert second[0].errors == {"after": 1.0}
    assert math.isnan(second[0].oracle_x)


def test_a_trial_without_baselines_is_not_finished_for_one_with(tmp_path: Path) -> None:
    m = modules()
    kept = m.plan.Kept(tmp_path)
    bare, full = (m.row.Task("ant", "single", ("lag",), 1, baselines=b) for b in (False, True))
    kept.put(bare, m.row.Row("ant", "single", ["lag"], 1))
    assert kept.get(bare) is not None
    assert kept.get(full) is None


def test_a_run_begins_with_the_trials_of_another(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    m = modules()
    task = m.main.planned(m.main.parse(["--robots", "ant", "--nulls", "1", "--trials", "0"]), 7)[0]
    row = m.row.Row("ant", "null", [], task.seed, outcome="right", seconds=2.0, cpu=3.0)
    m.plan.Kept(tmp_path / "a").put(task, row)
    words = ["--robots", "ant", "--nulls", "1", "--trials", "0", "--kept"]
    first = [*words, "--seed", "7", "--out", str(tmp_path / "a"), "--json", str(tmp_path / "a.json")]
    assert m.main.main(first) == 0
    told = json.loads((tmp_path / "a.json").read_text())
    assert told["settings"]["robots"] == ["ant"]
    older = tmp_path / "older.json"  # a file of before runs said how they were made
    older.write_text(json.dumps({k: told[k] for k in ("rows", "trials")}))
    for name in ("a", "older"):
        begun = ["--begin", str(tmp_path / f"{name}.json"), "--out", str(tmp_path / f"of_{name}")]
        assert m.main.main([*words, *begun]) == 0
        assert capsys.readouterr().out.splitlines()[-1].startswith("1 of 1 trials")


def test_a_folder_keeps_its_seed(tmp_path: Path) -> None:
    main = modules().main
    seed = main.master_seed(main.parse(["--out", str(tmp_path / "o")]))
    assert main.master_seed(main.parse(["--out", str(tmp_path / "o")])) == seed
    with pytest.raises(SystemExit, match="begun with seed"):
        main.master_seed(main.parse(["--out", str(tmp_path / "o"), "--seed", str(seed + 1)]))


# ---- scores ---------------------------------------------------------------------------------------------------------


def test_outcomes_of_one_and_two_effects() -> None:
    m = modules()
    loss, push = m.kinds.Loss("front_left", 0.3), m.pushes.Push("base", np.array([1.0, 0.0, 0.0]))
    both = m.outside.Both([loss, push])
    right, other = claim("loss", "front_left"), claim("external_force", "base")
    assert outcome(report(right), loss).outcome == "right"
    assert outcome(report(claim("gain", "front_left", ("loss:front_left",))), loss).class_size == 2
    assert outcome(report(claim("loss", "rear_left")), loss).outcome == "wrong"
    assert outcome(report(verdict="nothing missing"), loss).outcome == "missed"
    assert outcome(report(right, other), loss).false_claims == 1
    assert outcome(report(right, other), both).outcome == "right"
    assert outcome(report(right), both).outcome == "half"
    assert outcome(report(right, other, claim("lag", "front_left")), both).outcome == "wrong"
    assert outcome(report(right), m.kinds.Hidden()).false_claims == 1
    assert outcome(report(verdict="nothing missing"), m.kinds.Hidden()).outcome == "right"


def test_outcomes_outside_the_library() -> None:
    m = modules()
    cogs = m.outside.Cogging("front_left_wheel", 1.0, 3, 0.0)
    kind = m.robots.ROBOTS["jackal"].outside["cogging"]
    said = report(verdict="unexplained", coordinate="joint:front_left_wheel:vel")
    assert outcome(said, cogs, kind).outcome == "right"
    older = report(verdict="unexplained", coordinate="joint:front_left_wheel (joint speed)")  # of earlier reports
    assert outcome(older, cogs, kind).outcome == "right"
    assert outcome(report(verdict="unexplained", coordinate="body:base:linvel"), cogs, kind).outcome == "elsewhere"
    assert outcome(report(verdict="nothing missing"), cogs, kind).outcome == "silent"
    assert outcome(report(claim("coulomb", "front_left_wheel")), cogs, kind).outcome == "wrong"
    load, near = m.outside.LooseLoad("base", 1.0, 0.1, 0.0), m.robots.ROBOTS["jackal"].outside["loose_load"]
    partly = report(claim("payload", "base"), verdict="partly explained", coordinate="body:base:angvel@body[1]")
    assert outcome(partly, load, near).outcome == "right"
    assert outcome(report(claim("payload", "base")), load, near).outcome == "silent"


def test_parameters_are_compared_where_the_effect_is_claimed_by_its_own_name() -> None:
    m = modules()
    gain = m.faults.Gain(("a", "b"), 1.2)
    found = m.score.estimates(report(claim("gain", ["b", "a"], gain=(1.23, 1.15, 1.31))), gain)
    assert [(e.name, e.true, e.covered) for e in found] == [("gain.gain", 1.2, True)]
    assert found[0].off == pytest.approx(0.025)
    assert m.score.share_within(found, 0.05) == (1, 1)
    assert m.score.estimates(report(claim("gain", "a", gain=(1.2, 1.1, 1.3))), gain) == []


def test_a_miss_is_foretold_by_its_size_or_by_its_mimic() -> None:
    m = modules()
    slope = import_module("nfc_gym.physics.effects").FAMILIES["slope"](("world",))
    theta = np.array([0.03, 0.04])  # 0.05 rad

    def told(least: float, mimic: str, *claims: dict) -> bool:
        row = {"id": "slope:world", "smallest_detectable": least, "worst_mimic": mimic}
        return m.score.foretold(report(*claims) | {"identifiability": [row]}, slope, theta)

    assert told(0.06, "payload:base")
    assert not told(0.04, "payload:base")
    assert told(0.04, "payload:base", claim("payload", "base"))
    assert not m.score.foretold(report(), slope, theta)


def test_of_a_pair_each_effect_that_is_not_named_must_be_foretold() -> None:
    m = modules()
    families = import_module("nfc_gym.physics.effects").FAMILIES
    known = [(families[f]((at,)), np.array([size])) for f, at, size in (("coulomb", "j", 0.1), ("loss", "a", 0.2))]
    both = m.outside.Both([m.kinds.Coulomb("j", 0.1), m.kinds.Loss("a", 0.2)])
    sizes = {"coulomb:j": 0.3, "loss:a": 0.1}  # too small to be seen, and large enough
    table = [{"id": i, "smallest_detectable": least, "worst_mimic": None} for i, least in sizes.items()]

    def told(*claims: dict) -> bool | None:
        return m.score.misses_foretold(report(*claims) | {"identifiability": table}, both, known)

    friction, loss = claim("coulomb", "j"), claim("loss", "a")
    assert told(loss) is True
    assert told(friction) is False
    assert told() is False
    assert told(friction, loss, claim("lag", "a")) is None


def test_what_sparse_regression_names_is_read_generously_but_at_its_place() -> None:
    pytest.importorskip("pysindy")
    sparse, m = import_module("standin.sparse"), modules()
    found = sparse.Found("sign v", "joint:rear_left_wheel", sparse.ON_JOINT["sign v"], 0.4)
    assert found.judged(m.kinds.Coulomb("rear_left_wheel", 1.0))["right"]
    assert not found.judged(m.kinds.Coulomb("rear_right_wheel", 1.0))["right"]
    assert sparse.Found("u", "joint:rear_left_wheel", ("loss",), 0.4).judged(m.kinds.Loss("rear_left", 0.1))["right"]
    assert not found.judged(m.kinds.Hidden())["right"]


# ---- sums -----------------------------------------------------------------------------------------------------------


def row(robot: str, family: str, outcome: str, ratio: float = 5.0, after: float = 1.0, group: str = "single") -> Any:
    m = modules()
    errors = {"after": after, "psi only": 2.0, "nominal": 3.0, "sysid": 2.5}
    families = [] if group == "null" else [family]
    false = int(group == "null" and outcome == "wrong")
    verdict = "explained" if outcome == "wrong" else "nothing missing"
    return m.row.Row(
        robot, group, families, 1, family, ratio, outcome, false, class_size=1, errors=errors, verdict=verdict
    )  # fmt: skip


def test_wilson_is_the_interval_at_whose_ends_the_share_is_1_96_deviations_off() -> None:
    summary = modules().summary
    for hits, of in ((9, 12), (0, 31), (124, 124), (1, 2)):
        for end in summary.wilson(hits, of):
            sd = math.sqrt(end * (1 - end) / of)
            assert hits / of == pytest.approx(end, abs=1e-9) or abs(hits / of - end) == pytest.approx(1.959964 * sd)


def test_summary_counts_and_compares_with_the_goals() -> None:
    m = modules()
    rows = [row("jackal", "lag", "right", 2.0) for _ in range(9)]
    rows += [row("jackal", "lag", "missed", 20.0) for _ in range(3)]
    rows += [row("quadcopter", "wind", "right", after=1.2)]
    rows += [row("jackal", "", "right", math.nan, group="null"), row("jackal", "", "wrong", math.nan, group="null")]
    rows += [row("ant", "cogging", o, group="outside") for o in ("right", "right", "right", "silent")]
    rows[9].foretold = rows[10].foretold = True
    rows[11].foretold = False
    rows += [row("jackal", "lag", o, group="pair") for o in ("half", "missed")]
    rows[-2].foretold, rows[-1].foretold = True, False
    for r in rows:
        r.seconds, r.cpu = {"jackal": 200.0, "ant": 300.0}.get(r.robot, 50.0), 1.0
    estimate = m.row.Estimate("lag.time_constant", "s", 0.02, 0.0205, 0.019, 0.022)
    rows[0].effect = [estimate, m.row.Estimate("lag.time_constant", "s", 0.02, 0.03, 0.028, 0.032)]
    figures = m.summary.summarise(rows, 11)
    by_name = {r["name"]: r for r in figures}

    def of(start: str) -> dict:
        return next(v for k, v in by_name.items() if k.startswith(start))

    assert (of("jackal: named right (9 of 12)")["value"], of("jackal: named right (")["holds"]) == (0.75, False)
    assert of("jackal: named right, X/X_null 10 to inf (0 of 3)")["value"] == 0.0
    assert of("quadcopter: error after / oracle's at most 1.10")["holds"] is False
    assert (of("false claims in 2 nulls")["value"], of("false claims in 2 nulls")["holds"]) == (1, True)
    assert of("effects' parameters in their 95 % interval (1 of 2)")["holds"] is False
    assert of("effects' parameters within 5 % (1 of 2)")["value"] == 0.5
    assert of("effects' parameters within 5 % (1 of 2)")["holds"] is False
    assert of("effects' parameters, relative error, median")["value"] == pytest.approx(0.2625)
    assert of("misses that the identifiability table foretold (3 of 5)")["holds"] is False
    assert of("misses that the identifiability table foretold, of pairs (1 of 2)")["holds"] is None
    assert of("outside the library: coordinate right, X/X_null 3 to 10 (3 of 4)")["high"] < 1
    assert of("outside the library: silent (1 of 4)")["holds"] is False
    assert of("outside the library: said so, coordinate right (3 of 4)")["value"] == 0.75
    assert of("jackal: named right (")["seeds"] == [11] + [1] * 12
    times = {robot: of(f"{robot}: the loop, median") for robot in ("quadcopter", "jackal", "ant")}
    assert {robot: (r["goal"], r["holds"]) for robot, r in times.items()} == {
        "quadcopter": ("<= 60 s on two free cores", True),
        "jackal": ("<= 180 s on two free cores", None),  # cores were shared, so that above says nothing
        "ant": ("<= 360 s on two free cores", True),
    }
    printed = m.summary.table(figures)
    for r in figures:
        if " of " in r["name"]:
            assert f"{r['low']:.2f} to {r['high']:.2f}" in next(x for x in printed.split("\n") if r["name"] in x)
    json.dumps(figures, allow_nan=False)


def test_sysid_finds_the_true_psi_of_a_machine_without_effect(tmp_path: Path) -> None:
    """A baseline that were badly set up would be no baseline."""
    pytest.importorskip("mujoco.sysid._src.parameter", reason="needs mujoco[sysid]")
    case, sysid = import_module("standin.case"), import_module("standin.sysid")
    kit = modules().robots.ROBOTS["quadcopter"]
    psi = {"base_mass": 0.63, "arm_mass": 0.09, "mount_stiffness": 4.5}
    mapping = case.write_case(tmp_path, kit, case.Machine(psi), 1.6, range(3))
    bench = case.make_bench(case.load(mapping), 1)
    found = sysid.identify(bench, list(bench.dataset.logs), iterations=6)
    np.testing.assert_allclose(found, [psi[p] for p in bench.plant.space.names], rtol=0.03)
