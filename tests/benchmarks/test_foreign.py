"""The benchmark of foreign machines: each can be drawn and read as a user's, and the scorer tells right from wrong."""

import ast
import json
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
NAMES = [
    "ankle_spring", "arm2_bias", "arm2_none", "arm2_pair", "arm3_loom", "arm6_none", "arm6_payload", "biped_delay",
    "cable_loss", "cartpole_dead_zone", "crane_grease", "crane_none", "crane_pair", "diffbot_slope", "drone_lag",
    "drone_none", "drone_pair", "finger_none", "finger_sheath", "geared_load", "gimbal_cogging", "gripper_coulomb",
    "gripper_none", "hoist_sag", "leg_joint", "leg_none", "pan_tilt_delay", "rov_drag", "rov_tether", "rover_loss",
    "rover_none", "urdf_coulomb", "urdf_none", "wheel_torque_speed",
]  # fmt: skip
# One of each sort: to check all of a folder takes longer than to read it.
CHECKED = {
    "arm2_none", "cartpole_dead_zone", "finger_none", "pan_tilt_delay", "drone_none", "crane_none", "leg_none",
    "rover_none", "rov_drag", "hoist_sag",
}  # fmt: skip


def modules() -> SimpleNamespace:
    names = ("drawing", "folder", "machines", "running", "score", "simulation", "summary")
    return SimpleNamespace(**{n: import_module(f"foreign.{n}") for n in names}, main=import_module("foreign_machines"))


def short(name: str) -> Any:
    """The case with logs that are just long enough for a mapping to be read, and a size that is not sought."""
    case = modules().machines.CASES[name]
    size = float(np.sqrt(case.sizes[0] * case.sizes[1]))
    machine = replace(case.machine, logs=3, seconds=0.7, settle=min(case.machine.settle, 0.1))
    return replace(case, machine=machine, sizes=(size, size))


# ---- machines -------------------------------------------------------------------------------------------------------


def test_the_cases_are_enough_of_each_kind() -> None:
    cases = modules().machines.CASES
    assert sorted(cases) == NAMES
    groups = [c.group for c in cases.values()]
    assert {g: groups.count(g) for g in set(groups)} == {"null": 9, "single": 18, "pair": 3, "outside": 4}
    assert len({c.machine.model for c in cases.values()}) >= 16
    assert all((c.hide is None) == (c.group == "null") for c in cases.values())


@pytest.mark.parametrize("name", NAMES)
def test_a_case_is_drawn_told_as_the_library_tells_it_and_written_as_a_user_has_it(name: str, tmp_path: Path) -> None:
    m, effects = modules(), import_module("nfc_gym.physics.effects")
    drawn = m.drawing.draw(short(name), 11)
    assert all(np.isfinite(r.qpos).all() for r in drawn.runs)
    m.folder.write(drawn, tmp_path / "user", tmp_path / "truths" / "truth.json")
    truth = json.loads((tmp_path / "truths" / "truth.json").read_text())
    assert len(truth["effects"]) == {"null": 0, "pair": 2}.get(drawn.case.group, 1)
    for effect in truth["effects"]:
        assert effect["forms"] or drawn.case.group == "outside"
        for form in effect["forms"]:
            family = effects.FAMILIES[form["family"]](tuple(form["where"]))
            assert set(form["parameters"]) <= {p.name for p in family.params}
    suffix = Path(drawn.case.machine.model).suffix
    assert {p.name for p in (tmp_path / "user").iterdir()} == {f"machine{suffix}", "mapping.yaml", "runs"}
    dataset = import_module("nfc_gym.measured.dataset").load(tmp_path / "user" / "mapping.yaml")
    assert len(dataset.logs) == 3
    if name in CHECKED:
        findings = import_module("nfc_gym.measured.checks").check(tmp_path / "user" / "mapping.yaml")
        assert [f.message for f in findings if f.severity == "error"] == []


@pytest.mark.parametrize("name", ["cartpole_dead_zone", "hoist_sag"])
def test_a_seed_repeats_a_machine_and_another_draws_another(name: str) -> None:
    m, case = modules(), short(name)

    def drawn(seed: int) -> tuple:
        d = m.drawing.draw(case, seed)
        return m.folder.told(d), [m.drawing.columns(d, i) for i in range(len(d.runs))]

    (truth, logs), (again, relogged), (other, _) = drawn(3), drawn(3), drawn(4)
    assert truth == again
    for a, b in zip(logs, relogged, strict=True):
        assert all(np.array_equal(a[c], b[c], equal_nan=True) for c in a)
    assert truth["psi"] != other["psi"]


def test_psi_is_within_its_bounds_and_off_the_models() -> None:
    truth = modules().folder.told(modules().drawing.draw(short("crane_none"), 5))
    for name, true in truth["psi"].items():
        assert 0.7 < true / truth["nominal"][name] < 1.3
        assert true != truth["nominal"][name]


@pytest.mark.parametrize("name", ["arm2_bias", "gimbal_cogging", "crane_grease"])
def test_an_effect_is_seen_where_it_is_hidden_and_nothing_is_where_nothing_is(name: str) -> None:
    m, case = modules(), short(name)
    drawn = m.drawing.draw(case, 8)
    clean = case.machine.true_model(drawn.psi)
    assert max(drawn.shown.values()) > 1
    runs = m.drawing._runs(case.machine, clean, [], [1, 2], drawn.signals[:2])
    assert max(m.simulation.visible(case.machine, clean, runs).values()) < 1e-6


@pytest.mark.parametrize("wanted", [10.0, 90.0])
def test_a_size_is_sought_until_it_shows_as_wanted(wanted: float) -> None:
    m, case = modules(), short("ankle_spring")
    sizes = m.machines.CASES[case.name].sizes
    drawn = m.drawing.draw(replace(case, sizes=sizes, shown=(wanted, wanted)), 2)
    assert wanted / 1.6 < max(drawn.shown.values()) < wanted * 1.6
    assert sizes[0] <= drawn.effects[0].forms[0].parameters["stiffness"] <= sizes[1]


def test_truths_know_nothing_of_the_package() -> None:
    readers = {"running.py", "score.py", "summary.py"}
    for path in sorted((FOLDER / "foreign").rglob("*.py")):
        if path.name in readers:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            assert not {n.split(".")[0] for n in names} & {"nfc_gym", "standin", "options"}, path


def test_a_lump_is_two_bodies_in_one() -> None:
    """Mass, moment of mass and inertia about the frame's origin are those of both parts added."""
    mujoco, bodies = import_module("mujoco"), import_module("foreign.bodies")
    model = modules().machines.CASES["arm6_payload"].machine.user_model()
    b, at = model.body("link6").id, np.array([0.08, 0.01, -0.02])

    def sums() -> tuple:
        turn = bodies._matrix(model.body_iquat[b])
        inertia = turn @ np.diag(model.body_inertia[b]) @ turn.T
        mass, centre = float(model.body_mass[b]), model.body_ipos[b].copy()
        return mass, mass * centre, inertia + mass * bodies._about(centre)

    before = sums()
    bodies.Payload("link6", 0.4, at, []).build(model)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for new, old, part in zip(sums(), before, (0.4, 0.4 * at, 0.4 * bodies._about(at)), strict=True):
        np.testing.assert_allclose(new, old + part, rtol=1e-9, atol=1e-12)


# ---- scores ---------------------------------------------------------------------------------------------------------


def truth(group: str, *effects: dict, psi: dict | None = None) -> dict:
    return {"name": "m", "group": group, "seed": 1, "effects": list(effects), "psi": psi or {}, "shown": {}}


def effect(*forms: tuple[str, tuple[str, ...], dict], places: tuple[str, ...] = ("elbow",)) -> dict:
    rows = [{"family": f, "where": list(w), "parameters": p} for f, w, p in forms]
    return {"forms": rows, "places": list(places), "text": "hidden"}


def claim(family: str, where: Any, equivalents: tuple[str, ...] = (), **parameters: tuple[float, float, float]) -> dict:
    values = {n: {"value": v, "low": a, "high": b, "unit": "1"} for n, (v, a, b) in parameters.items()}
    place = where if isinstance(where, str) else "+".join(where)
    return {"id": f"{family}:{place}", "family": family, "where": where, "equivalents": list(equivalents)} | {
        "parameters": values
    }


def report(*claims: dict, verdict: str = "explained", at: str | None = None, psi: tuple = ()) -> dict:
    chi2 = {"nominal": 30.0, "calibrated": 12.0, "extended": 1.1, "null": 1.0}
    rest = None if at is None else {"coordinate": at}
    return {"effects": list(claims), "verdict": verdict, "unexplained": rest, "parameters": list(psi), "chi2": chi2}


def outcome(true: dict, said: dict | None, code: int = 0) -> str:
    return modules().score.score(true, said, {"code": code, "seconds": 9.0}).outcome


LOSS = effect(("loss", ("m1",), {"fraction": 0.2}), ("gain", ("m1",), {"gain": 0.8}))
DRY = effect(("coulomb", ("elbow",), {"level": 0.1}))


def test_a_null_is_right_only_where_nothing_is_said() -> None:
    assert outcome(truth("null"), report(verdict="nothing missing")) == "right"
    assert outcome(truth("null"), report(verdict="unexplained", at="joint:a:pos")) == "unclear"
    assert outcome(truth("null"), report(claim("coulomb", "elbow"))) == "claimed"


def test_one_effect_is_right_by_family_and_place_or_by_an_equivalent() -> None:
    one = truth("single", LOSS)
    assert outcome(one, report(claim("loss", "m1"))) == "right"
    assert outcome(one, report(claim("gain", ["m1"]))) == "right"
    assert outcome(one, report(claim("dead_zone", "m1", ("loss:m1",)))) == "right"
    assert outcome(one, report(claim("dead_zone", "m1", ("offset:m1", "loss:m1")))) == "wide"
    assert outcome(one, report(claim("loss", "m2"))) == "wrong"
    assert outcome(one, report(claim("loss", ["m1", "m2"]))) == "wrong"
    assert outcome(one, report(claim("loss", "m1"), claim("coulomb", "elbow"))) == "wrong"
    assert outcome(one, report(verdict="unexplained", at="joint:elbow:pos")) == "missed"


def test_two_effects_are_both_to_be_named() -> None:
    two = truth("pair", LOSS, DRY)
    assert outcome(two, report(claim("coulomb", "elbow"), claim("gain", "m1", ("loss:m1",)))) == "right"
    assert outcome(two, report(claim("coulomb", "elbow"))) == "half"
    assert outcome(two, report(claim("coulomb", "elbow"), claim("lag", "m1"))) == "wrong"
    assert outcome(two, report(claim("coulomb", "elbow", ("loss:m1",)))) == "half"  # one claim is one effect


def test_what_is_outside_is_right_where_it_is_left_at_its_place() -> None:
    rail = truth("outside", effect(places=("rail", "r_knee")))
    assert outcome(rail, report(verdict="unexplained", at="joint:rail:vel")) == "right"
    assert outcome(rail, report(verdict="partly explained", at="joint:r_knee (joint speed)")) == "right"
    assert outcome(rail, report(verdict="unexplained", at="joint:railing:vel")) == "elsewhere"
    assert outcome(rail, report(verdict="nothing missing")) == "silent"
    assert outcome(rail, report(claim("coulomb", "rail"), verdict="partly explained", at="joint:rail:vel")) == "wrong"
    near = truth("outside", effect(("load_friction", ("rail",), {}), places=("rail",)))
    told = report(claim("load_friction", "rail"), verdict="partly explained", at="joint:rail:vel")
    assert outcome(near, told) == "right"


def test_a_loop_that_failed_or_ran_out_of_time_is_a_row_that_counts_as_wrong() -> None:
    m = modules()
    assert outcome(truth("null"), None, 124) == "timed out"
    assert outcome(truth("null"), None, 1) == "failed"
    assert outcome(truth("null"), report(verdict="nothing missing"), 1) == "failed"
    rows = [
        m.score.score(truth("null"), said, {"code": code, "seconds": 9.0})
        for said, code in ((report(verdict="nothing missing"), 0), (None, 124))
    ]
    figures = {r["name"]: r["value"] for r in m.summary.summarise(rows, 5)}
    assert figures["nothing hidden: right (1 of 2)"] == 0.5
    table = m.summary.by_group(rows).splitlines()
    assert table[-1] == "| all | 2 | 1 | 0 | 1 |  |  | 9 |"


def test_numbers_are_scored_where_the_effect_is_claimed_by_a_name_of_its_own() -> None:
    score = modules().score
    psi = tuple(
        {"name": n, "unit": "kg", "estimate": 2.2, "low": 2.1, "high": 2.3, "identifiable": shown}
        for n, shown in (("mass", True), ("hidden_mass", False))
    )
    true = truth("single", LOSS, psi={"mass": 2.0, "hidden_mass": 1.0})
    row = score.score(true, report(claim("gain", "m1", gain=(0.81, 0.79, 0.83)), psi=psi), {"code": 0, "seconds": 9.0})
    assert [(n.name, n.true, n.covered, round(n.off, 4)) for n in row.effect] == [("gain.gain", 0.8, True, 0.0125)]
    assert [(n.name, n.covered, round(n.off, 3)) for n in row.psi] == [("mass", False, 0.1)]
    assert score.score(true, report(claim("lag", "m1", ("loss:m1",))), {"code": 0, "seconds": 9.0}).effect == []


def test_a_component_is_off_by_a_share_of_its_vector() -> None:
    push = effect(("drag_linear", ("hull",), {"x": 3.0, "y": 4.0, "z": 0.0}))
    said = report(claim("drag_linear", "hull", x=(3.0, 2, 4), y=(4.0, 3, 5), z=(0.5, 0, 1)))
    row = modules().score.score(truth("single", push), said, {"code": 0, "seconds": 9.0})
    assert [n.off for n in row.effect] == pytest.approx([0.0, 0.0, 0.1])


# ---- running --------------------------------------------------------------------------------------------------------


@pytest.fixture
def in_the_background() -> Iterator[None]:
    """As of a shell's `&`: deaf to SIGINT, with all that is begun."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("in_the_background")
def test_a_command_that_takes_too_long_is_ended_and_its_words_are_kept(tmp_path: Path) -> None:
    runner, log = modules().running.Runner(), tmp_path / "log.txt"
    slow = [sys.executable, "-c", "print('begun', flush=True); import time; time.sleep(60)"]
    code, seconds = runner.call(slow, log, 0.8)
    assert (code, seconds < 20) == (124, True)
    assert runner.call([sys.executable, "-c", "import sys; sys.exit(3)"], log, 20)[0] == 3
    assert "begun" in log.read_text()
    runner.stop()
    assert runner.call(slow, log, 20)[0] == 130


def test_what_has_ended_is_not_run_again_and_what_has_failed_is(tmp_path: Path) -> None:
    folders = modules().running.Folders(tmp_path)
    ends = {"fine": (0, 5.0), "slow": (124, 60.0), "broken": (1, 2.0), "stopped": (130, 9.0)}
    for name, (code, seconds) in ends.items():
        folders.loop(name).mkdir(parents=True)
        (folders.loop(name) / "ended.json").write_text(json.dumps({"code": code, "seconds": seconds}))
    assert [n for n in (*ends, "new") if folders.done(n, 60)] == ["fine", "slow"]
    assert [n for n in (*ends, "new") if folders.done(n, 600)] == ["fine"]  # more time than it had
    assert [n for n in (*ends, "new") if folders.ended(n)] == ["fine", "slow", "broken"]  # rows of a table


def test_a_run_that_cannot_begin_is_a_row(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A drawing that fails ends the case, and neither the others nor the count."""
    m = modules()
    drawing = {"urdf_none": [sys.executable, "-c", "import sys; sys.exit(1)"]}
    folders = m.running.Folders(tmp_path)
    assert list(m.running.run(["urdf_none"], drawing, folders, 1, 60)) == ["urdf_none"]
    assert (
        m.main.main(["--kept", "--out", str(tmp_path), "--only", "urdf_none", "--json", str(tmp_path / "a.json")]) == 0
    )
    assert "| urdf_none | nothing | failed |" in capsys.readouterr().out
    assert json.loads((tmp_path / "a.json").read_text())["trials"][0]["outcome"] == "failed"


def test_the_list_has_every_machine(capsys: pytest.CaptureFixture) -> None:
    assert modules().main.main(["--list"]) == 0
    assert sorted(line.split()[0] for line in capsys.readouterr().out.splitlines()) == NAMES
