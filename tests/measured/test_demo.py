"""The demo around the loop, and the formulas of its hidden effects; the loop itself is replaced here."""

import hashlib
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from rich.console import Console

from nfc_gym.core import InputError
from nfc_gym.measured import demo as module
from nfc_gym.measured import hidden, standin
from nfc_gym.measured.dataset import load
from nfc_gym.measured.demo import demo, judge


def claim(effect_id: str, *equivalents: str) -> dict[str, Any]:
    return {"id": effect_id, "sentence": effect_id, "equivalents": list(equivalents), "parameters": {}}


@pytest.mark.parametrize(
    ("claims", "family", "where", "outcome"),
    [
        ([], "none", [], "right"),
        ([], "lag", ["a"], "missed"),
        ([claim("lag:a")], "none", [], "wrong"),
        ([claim("lag:a")], "lag", ["a"], "right"),
        ([claim("lag:b")], "lag", ["a"], "wrong"),
        ([claim("delay:a")], "lag", ["a"], "wrong"),
        ([claim("delay:a", "lag:a")], "lag", ["a"], "right"),
        ([claim("delay:a", "lag:a", "gain:a")], "lag", ["a"], "wrong"),  # a class of three is no answer
        ([claim("lag:b+a")], "lag", ["a", "b"], "right"),
        ([claim("lag:a+b")], "lag", ["a"], "wrong"),
        ([claim("lag:a"), claim("coulomb:j")], "lag", ["a"], "wrong"),
    ],
)
def test_judge(claims: list[dict[str, Any]], family: str, where: list[str], outcome: str) -> None:
    assert judge({"effects": claims}, family, where) == outcome


@pytest.fixture
def fake_loop(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """`close_loop` that reads what the real one reads and claims the effect it is told to."""
    told: dict[str, Any] = {"effects": [], "touch": None}

    def close_loop(mapping: Path, out: Path, **_: object) -> dict[str, Any]:
        told["logs"] = len(load(mapping).logs)
        if told["touch"]:
            told["touch"](mapping.parent)
        out.mkdir()
        (out / "report.json").write_text("{}")
        return {"effects": told["effects"], "verdict": "explained", "error": {"groups": {}, "horizons_s": [0.4]}}

    monkeypatch.setattr(module, "close_loop", close_loop)
    monkeypatch.setattr(module, "_SECONDS", 1.0)
    return told


def test_the_envelope_is_sealed_before_the_loop_and_judged_after(tmp_path: Path, fake_loop: dict[str, Any]) -> None:
    console = Console(record=True, width=200)
    result = demo(tmp_path / "d", console=console, draw=1)
    envelope = (tmp_path / "d" / "envelope.json").read_bytes()
    text = console.export_text()
    assert result["outcome"] == "missed"
    assert fake_loop["logs"] == module._LOGS
    assert hashlib.sha256(envelope).hexdigest() in text
    assert "simulated" in text.split("SHA-256")[0]
    assert text.index(hashlib.sha256(envelope).hexdigest()) < text.index(json.loads(envelope)["hidden"])


def test_a_right_claim_is_told_from_a_wrong_one(tmp_path: Path, fake_loop: dict[str, Any]) -> None:
    first = demo(tmp_path / "a", draw=1)
    fake_loop["effects"] = [claim(f"{first['family']}:{'+'.join(first['where'])}")]
    assert demo(tmp_path / "b", draw=1)["outcome"] == "right"
    fake_loop["effects"] = [claim("backlash:somewhere")]
    assert demo(tmp_path / "c", draw=1)["outcome"] == "wrong"
    console, hidden = Console(record=True, width=200), f"{first['family']}:{'+'.join(first['where'])}"
    fake_loop["effects"] = [claim(hidden, "wind:base", "gust:base")]
    assert demo(tmp_path / "e", console=console, draw=1)["outcome"] == "wrong"
    assert "what was hidden is among 3 effects that these logs cannot tell apart" in console.export_text()


def test_a_changed_envelope_voids_the_demo(tmp_path: Path, fake_loop: dict[str, Any]) -> None:
    fake_loop["touch"] = lambda folder: (folder / "envelope.json").write_text("{}")
    with pytest.raises(InputError, match="was changed"):
        demo(tmp_path / "d", draw=1)


def test_effects_differ_from_run_to_run(tmp_path: Path, fake_loop: dict[str, Any]) -> None:
    drawn = {demo(tmp_path / str(i))["draw"] for i in range(3)}
    assert len(drawn) == 3


def test_folders(tmp_path: Path, fake_loop: dict[str, Any]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(InputError, match=r"thesis\.tex"):
        demo(tmp_path / "mine", draw=1)
    demo(tmp_path / "d", draw=1)
    with pytest.raises(InputError, match="finished demo"):
        demo(tmp_path / "d", draw=1)
    (tmp_path / "d" / "report" / "report.json").unlink()  # an interrupted one starts over
    demo(tmp_path / "d", draw=2)
    assert json.loads((tmp_path / "d" / "envelope.json").read_text())["draw"] == 2


def test_the_mapping_names_true_values_only_where_they_were_weighed(tmp_path: Path, fake_loop: dict[str, Any]) -> None:
    psi = demo(tmp_path / "d", draw=3)["psi"]
    for p in load(tmp_path / "d" / "mapping.yaml").mapping.declared:
        near = p.nominal is not None and abs(p.nominal / psi[p.name] - 1) < 1e-3
        assert near == p.anchored


def test_lag_is_an_exponential_approach() -> None:
    lag = hidden.Lag(("a",), 0.05)
    lag.begin(mujoco.MjModel.from_xml_string("<mujoco/>"))
    lag.command(np.zeros(1))
    steps = 25
    for _ in range(steps):
        reached = lag.command(np.ones(1))
    assert reached == pytest.approx(1 - np.exp(-steps * hidden.STEP / 0.05), rel=1e-12)


def test_delay_shifts_a_ramp_by_itself() -> None:
    delay = hidden.Delay(("a",), 7.4 * hidden.STEP)
    delay.begin(mujoco.MjModel.from_xml_string("<mujoco/>"))
    out = [float(delay.command(np.array([k * hidden.STEP]))[0]) for k in range(40)]
    np.testing.assert_allclose(out[10:], np.arange(10, 40) * hidden.STEP - 7.4 * hidden.STEP, atol=1e-12)


def test_payload_adds_its_mass_at_its_place() -> None:
    bare = standin.build_jackal(standin.Machine(standin.JACKAL_PSI))
    at = np.array([0.1, -0.05, 0.2])
    laden = standin.build_jackal(standin.Machine(standin.JACKAL_PSI, hidden.Payload("base", 2.0, at)))
    bare_data, data = mujoco.MjData(bare), mujoco.MjData(laden)
    mujoco.mj_kinematics(bare, bare_data), mujoco.mj_comPos(bare, bare_data)
    mujoco.mj_kinematics(laden, data), mujoco.mj_comPos(laden, data)
    base = bare.body("base").id
    total = bare.body_subtreemass[base]
    assert laden.body_subtreemass[base] == pytest.approx(total + 2.0)
    want = (total * bare_data.subtree_com[base] + 2.0 * (bare_data.xpos[base] + at)) / (total + 2.0)
    np.testing.assert_allclose(data.subtree_com[base], want, atol=1e-12)


def test_slope_keeps_the_strength_of_gravity_and_leans_it() -> None:
    model = standin.build_jackal(standin.Machine(standin.JACKAL_PSI, hidden.Slope(0.03, 0.04)))
    gravity = model.opt.gravity
    assert np.linalg.norm(gravity) == pytest.approx(9.81)
    assert np.arccos(-gravity[2] / 9.81) == pytest.approx(0.05)
    assert gravity[0] < 0 < gravity[1]


def test_loss_takes_its_share_of_the_torque() -> None:
    def torque(effect: hidden.Hidden) -> float:
        model = standin.build_jackal(standin.Machine(standin.JACKAL_PSI, effect))
        data = mujoco.MjData(model)
        data.ctrl[0] = 0.5
        mujoco.mj_forward(model, data)
        return float(data.actuator_force[0])

    assert torque(hidden.Loss("front_left", 0.3)) == pytest.approx(0.7 * torque(hidden.Hidden()))


@pytest.mark.parametrize("module_file", [standin.__file__, hidden.__file__])
def test_the_stand_in_shares_no_physics_with_the_package(module_file: str) -> None:
    assert "nfc_gym.physics" not in "".join(
        line for line in Path(module_file).read_text().splitlines(True) if "import" in line
    )
