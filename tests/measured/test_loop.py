"""The loop end to end, on the one-joint machine of `arm`, which is simulated with plain `mj_step`."""

import hashlib
import io
import json
import os
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from arm import DAMPING, GIVEN, LOSS, MODEL, NOISE, Closed, machine, same
from rich.console import Console

from nfc_gym.adaptation.extended import read_found
from nfc_gym.core import InputError
from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.predict import predict


def test_the_hidden_friction_is_found_and_sized(closed: Closed) -> None:
    report = closed.report
    assert [e["id"] for e in report["effects"]] == ["coulomb:hinge"]
    assert report["verdict"] == "explained"
    (level,) = report["effects"][0]["parameters"].values()
    assert level["value"] == pytest.approx(LOSS, rel=0.03)
    assert level["low"] < level["value"] < level["high"]
    (damping,) = report["parameters"]
    assert damping["estimate"] == pytest.approx(DAMPING, rel=0.15)
    assert (damping["field"], damping["of"]) == ("dof_damping", ["hinge"])
    assert damping["identifiable"]
    assert not damping["left_prior"]
    chi2 = report["chi2"]
    assert chi2["nominal"] > chi2["calibrated"] > 5 * chi2["extended"]
    assert chi2["extended"] == pytest.approx(1, abs=0.3)
    assert chi2["null"] == pytest.approx(1, abs=0.3)
    assert report["effects"][0]["share_of_excess"] > 0.9


def test_what_check_warns_of_is_printed_first_and_stands_in_the_report(tmp_path: Path) -> None:
    """Here the motor's wires are swapped."""
    mapping = machine(tmp_path, loss=0.0)
    (tmp_path / "arm.xml").write_text(GIVEN.replace('name="motor"', 'name="motor" gear="-1"'))
    told = io.StringIO()
    report = close_loop(mapping, tmp_path / "out", seed=3, jobs=1, console=Console(file=told, width=400))
    warning = next(line for line in told.getvalue().splitlines() if "turned round" in line)
    assert told.getvalue().index(warning) < told.getvalue().index("segments")
    assert any(f["kind"] == "check" and "turned round" in f["text"] for f in report["findings"])
    assert "turned round" in (tmp_path / "out" / "report.html").read_text()


def test_an_effect_that_comes_to_nothing_on_all_logs_is_dropped(
    closed: Closed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it gained when it was chosen; here the last test is made to say so."""
    monkeypatch.setattr("nfc_gym.measured.final.differs", lambda fitted, blocks, effect, level: False)
    report = close_loop(closed.mapping, tmp_path / "out", seed=3, jobs=1)
    assert report["effects"] == []
    assert report["proposals"] == []
    assert report["chi2"]["extended"] == report["chi2"]["calibrated"]
    assert any(r["reason"].startswith("dropped coulomb:hinge: on all segments") for r in report["rounds"])
    assert report["verdict"] == "unexplained"
    assert yaml.safe_load((tmp_path / "out" / "effects.yaml").read_text())["effects"] == []


def test_the_report_has_the_promised_keys(closed: Closed) -> None:
    report = closed.on_disk()
    assert same(report, closed.report)
    assert set(report) >= {
        "schema", "model", "logs", "independent_splits", "parameters", "effects", "verdict", "unexplained", "error",
        "chi2", "identifiability", "findings", "seconds", "seed", "versions",
    }  # fmt: skip
    assert report["schema"] == 1
    assert report["model"] == "arm.xml"
    assert report["seed"] == 3
    assert report["independent_splits"] is True
    assert report["unexplained"] is None
    assert report["logs"] == {"fit": ["fit_0", "fit_1", "fit_2"], "select": ["select"], "verify": ["verify"]}
    assert report["versions"]["mujoco"] == mujoco.__version__
    assert set(report["versions"]) == {"nfc_gym", "mujoco"}
    assert set(report["chi2"]) >= {"nominal", "calibrated", "extended", "null", "null_95"}
    for row in report["parameters"]:
        assert set(row) >= {
            "name", "unit", "nominal", "estimate", "low", "high", "anchored", "reason", "identifiable", "left_prior"
        }  # fmt: skip
    for row in report["effects"]:
        assert set(row) >= {"id", "family", "where", "sentence", "share_of_excess", "equivalents", "parameters"}
        assert row["id"] == f"{row['family']}:{row['where']}"
        assert all(set(p) >= {"value", "low", "high", "unit"} for p in row["parameters"].values())
    for row in report["identifiability"]:
        assert set(row) >= {"id", "smallest_detectable", "unit", "worst_mimic", "distinguishable"}
    assert report["error"]["horizons_s"] == [0.1, 0.2, 0.4]
    assert set(report["error"]["groups"]) == {"joint angle", "joint speed"}
    for group in report["error"]["groups"].values():
        assert set(group) == {"unit", "nominal", "calibrated", "extended", "noise_floor"}
        assert all(len(group[stage]) == 3 for stage in ("nominal", "calibrated", "extended", "noise_floor"))
        assert group["extended"][-1] < 0.5 * group["calibrated"][-1] <= group["nominal"][-1]


def test_the_corrected_model_runs_in_plain_mujoco(closed: Closed) -> None:
    """The written model, stepped by MuJoCo alone, moves as the machine does; the given one does not."""
    corrected = mujoco.MjModel.from_xml_path(str(closed.out / "model.xml"))
    (level,) = closed.report["effects"][0]["parameters"].values()
    assert corrected.dof_frictionloss[0] == pytest.approx(level["value"], rel=1e-5)
    assert corrected.dof_damping[0] == pytest.approx(closed.report["parameters"][0]["estimate"], rel=1e-5)

    def swing(model: mujoco.MjModel) -> np.ndarray:
        data, out = mujoco.MjData(model), []
        data.qpos[0] = 1.0
        for _ in range(300):
            mujoco.mj_step(model, data)
            out.append(data.qpos[0])
        return np.array(out)

    truth = swing(mujoco.MjModel.from_xml_string(MODEL.format(damping=DAMPING, loss=LOSS)))
    given = swing(mujoco.MjModel.from_xml_path(str(closed.mapping.with_name("arm.xml"))))
    assert np.abs(swing(corrected) - truth).max() < 0.02 < 0.2 * np.abs(given - truth).max()


def test_effects_and_fit_files_agree_with_the_report(closed: Closed) -> None:
    effects = yaml.safe_load((closed.out / "effects.yaml").read_text())
    assert effects["version"] == 1
    # A frictionloss is the model's own: nothing is left for a wrapper to add a second time.
    assert effects["carried_by_model"] == ["coulomb:hinge"]
    assert effects["effects"] == []
    assert effects["model_sha256"] == hashlib.sha256((closed.out / "model.xml").read_bytes()).hexdigest()
    fitted = json.loads((closed.out / "fit.json").read_text())
    assert fitted["nominal"] == {"psi": {}, "effects": []}
    assert fitted["calibrated"]["effects"] == []
    assert len(fitted["extended"]["effects"]) == 1
    assert fitted["extended"]["psi"]["damping"] == pytest.approx(closed.report["parameters"][0]["estimate"])
    found = read_found(closed.out)  # what a policy is adapted to
    assert [(n.id, n.effect.where) for n in found.effects] == [("coulomb:hinge", ("hinge",))]
    assert [(p.field, p.of, p.value) for p in found.parameters] == [
        ("dof_damping", ("hinge",), closed.report["parameters"][0]["estimate"])
    ]
    page = (closed.out / "report.html").read_text()
    assert page.rstrip().endswith("</html>")
    assert not list(closed.out.rglob("*.part"))


def test_the_same_seed_gives_the_same_report(closed: Closed, tmp_path: Path) -> None:
    """Also over what an earlier run left, where that may be replaced; what is nobody's output stays."""
    out = tmp_path / "again"
    out.mkdir()
    (out / "report.json").write_text("{}")
    (out / "thesis.tex").write_text("years of work")
    again = close_loop(closed.mapping, out, seed=3, jobs=1, overwrite=True)
    assert same(again, closed.report)
    assert same(json.loads((out / "report.json").read_text()), closed.report)
    assert (out / "model.xml").read_bytes() == (closed.out / "model.xml").read_bytes()
    assert (out / "thesis.tex").read_text() == "years of work"


def test_where_slopes_cannot_follow_the_same_is_found(
    closed: Closed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a robot that crawls: half as far, over drawn starts; errors are told at the mapping's own horizons."""
    monkeypatch.setattr("nfc_gym.measured.foresight.followed", lambda *_: 2)
    report = close_loop(closed.mapping, tmp_path / "out", seed=3, jobs=1)
    assert report["error"]["horizons_s"] == closed.report["error"]["horizons_s"]
    assert [e["id"] for e in report["effects"]] == ["coulomb:hinge"]
    (size,) = report["effects"][0]["parameters"].values()
    assert size["low"] < LOSS < size["high"]
    assert size["high"] - size["low"] < 0.1
    (damping,) = report["parameters"]
    assert damping["low"] < DAMPING < damping["high"]


def test_a_machine_that_is_its_model_lacks_nothing(tmp_path: Path) -> None:
    report = close_loop(machine(tmp_path, loss=0, damping=DAMPING), tmp_path / "out", jobs=1)
    assert report["effects"] == []
    assert report["verdict"] == "nothing missing"
    assert report["parameters"][0]["estimate"] == pytest.approx(DAMPING, rel=0.05)
    assert report["chi2"]["extended"] == pytest.approx(1, abs=0.3)
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml")).dof_frictionloss[0] == 0


def test_every_stage_predicts_every_log_and_the_error_falls(closed: Closed, tmp_path: Path) -> None:
    measured = {
        f.stem: np.genfromtxt(f, delimiter=",", names=True) for f in sorted(closed.mapping.parent.glob("*.csv"))
    }
    error = {}
    for stage in ("nominal", "calibrated", "extended"):
        said = predict(closed.mapping, closed.out, "rollout", stage, tmp_path / f"{stage}.npz", restart=0.5)
        written = np.load(tmp_path / f"{stage}.npz")
        assert set(said) == set(written.files) == set(measured)
        for name, table in measured.items():
            assert said[name].shape == (len(table), 2)
            np.testing.assert_array_equal(written[name], said[name])
        off = said["verify"] - np.stack([measured["verify"]["q"], measured["verify"]["v"]], 1)
        error[stage] = float(np.sqrt((off[:, 0] ** 2).mean()))
    assert error["nominal"] > error["calibrated"] > 2 * error["extended"]
    assert error["extended"] < 5 * NOISE["q"]


def test_nominal_prediction_needs_no_fit_and_is_mujocos_own(closed: Closed, tmp_path: Path) -> None:
    """From rest with the first samples' state, the nominal roll-out of a log is a plain `mj_step` loop."""
    said = predict(closed.mapping, None, "rollout", "nominal", tmp_path / "p.npz")["verify"]
    table = np.genfromtxt(closed.mapping.with_name("verify.csv"), delimiter=",", names=True)
    model = mujoco.MjModel.from_xml_path(str(closed.mapping.with_name("arm.xml")))
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = said[0]
    for k, torque in enumerate(table["torque"]):
        np.testing.assert_allclose(said[k], [data.qpos[0], data.qvel[0]], atol=1e-9)
        data.ctrl[0] = torque
        mujoco.mj_step(model, data, 2)


def test_a_fit_of_another_model_is_refused(closed: Closed, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    shutil.copytree(closed.out, folder)
    report = json.loads((folder / "report.json").read_text())
    (folder / "report.json").write_text(json.dumps(report | {"model": "leg.xml"}))
    with pytest.raises(InputError, match=r"other is of the model leg\.xml, the mapping of arm\.xml"):
        predict(closed.mapping, folder, "rollout", "extended", tmp_path / "p.npz")


def test_predict_without_a_run_says_what_to_do(closed: Closed, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"fit\.json does not exist: run close-loop"):
        predict(closed.mapping, tmp_path / "nowhere", "rollout", "extended", tmp_path / "p.npz")
    assert not (tmp_path / "p.npz").exists()


class _Killed(BaseException):
    """What no handler catches, as no handler catches SIGKILL."""


_KILLS = [
    ("calibrated.json", "before"),
    ("calibrated.json", "after"),
    ("search.json", "during"),
    ("search.json", "after"),
    ("found.json", "after"),
    ("final calibrated.json", "during"),
    ("final extended.json", "after"),
    ("model.xml", "during"),
    ("report.html", "after"),
    ("report.json", "before"),
]


def test_a_run_killed_again_and_again_ends_with_the_report_of_one_that_was_not(
    closed: Closed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed at the writes, where files could be left half; `tests/measured/test_resume.py` kills at any moment."""
    out, replace = tmp_path / "out", os.replace
    for write, when in _KILLS:

        def kill(part: Path, target: Path, write: str = write, when: str = when) -> None:
            if Path(target).name != write:
                replace(part, target)
                return
            if when == "during":
                part.write_text(part.read_text()[:20])
            if when == "after":
                replace(part, target)
            raise _Killed

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", kill)
            patch.setattr(Path, "unlink", lambda *_, **__: None)  # nothing tidies up after a kill
            with pytest.raises(_Killed):
                close_loop(closed.mapping, out, seed=3, jobs=1)
        assert not (out / "report.json").exists()
    assert same(close_loop(closed.mapping, out, seed=3, jobs=1), closed.report)
    assert same(json.loads((out / "report.json").read_text()), closed.report)
    for name in ("model.xml", "effects.yaml", "fit.json", "report.html"):
        assert (out / name).read_bytes() == (closed.out / name).read_bytes(), name
    assert {p.name for p in (out / ".stages").iterdir() if not p.name.startswith(".")} == {"key"}


def test_a_finished_run_is_not_replaced_unasked(closed: Closed, tmp_path: Path) -> None:
    before = (closed.out / "report.json").read_bytes()
    with pytest.raises(InputError, match=r"holds the report of a finished run.*--overwrite"):
        close_loop(closed.mapping, closed.out, seed=3, jobs=1)
    assert (closed.out / "report.json").read_bytes() == before
    strange = tmp_path / "strange"
    strange.mkdir()
    (strange / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"holds 'thesis\.tex', which is not a run's"):
        close_loop(closed.mapping, strange, jobs=1)


def test_logs_shorter_than_a_segment_are_refused(tmp_path: Path) -> None:
    mapping = machine(tmp_path, edits=(("length: 0.4", "length: 9.0"), ("[0.1, 0.2, 0.4]", "[1.0, 9.0]")))
    with pytest.raises(InputError, match=r"as long as the longest horizon, 9 s; the longest lasts 2\.99 s"):
        close_loop(mapping, tmp_path / "out", jobs=1)
    assert not (tmp_path / "out").exists()


def test_a_model_that_blows_up_is_named(closed: Closed, tmp_path: Path) -> None:
    """A servo far too stiff for an explicit step: MuJoCo diverges at once."""
    mapping = machine(tmp_path)
    wild = GIVEN.replace("implicitfast", "Euler")
    wild = wild.replace('<motor name="motor" joint="hinge"/>', '<position name="motor" joint="hinge" kp="1e9"/>')
    (tmp_path / "arm.xml").write_text(wild)
    mapping.write_text(mapping.read_text().replace("unit: Nm", "unit: rad"))
    with pytest.raises(InputError, match=r"log '.*': the simulation is unstable with the nominal model"):
        predict(mapping, None, "rollout", "nominal", tmp_path / "p.npz")
    with pytest.raises(InputError, match=r"arm\.xml: the simulation is unstable on every segment .* step of 0\.005 s"):
        close_loop(mapping, tmp_path / "out", jobs=1)
    assert not (tmp_path / "p.npz").exists()
    assert not (tmp_path / "out").exists()
