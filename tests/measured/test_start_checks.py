"""What `check` says of joints that nobody measured, and of loops that the measured states leave open."""

from pathlib import Path

import numpy as np
import pytest

from nfc_gym.measured.checks import check
from nfc_gym.measured.findings import Finding

# A parallelogram: the coupler stays level, so that the elbow turns back by what crank and rocker turn.
LINKAGE = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="crank"><joint name="crank" axis="0 1 0"/><geom type="capsule" size=".01" fromto="0 0 0 0 0 .2"/>
    <body name="coupler" pos="0 0 .2"><joint name="elbow" axis="0 1 0" {elbow}/>
      <geom type="capsule" size=".01" fromto="0 0 0 .3 0 0"/></body></body>
  <body name="rocker" pos=".3 0 0"><joint name="rocker" axis="0 1 0"/>
    <geom type="capsule" size=".01" fromto="0 0 0 0 0 .2"/></body>
</worldbody>
<equality><connect name="pin" body1="coupler" body2="rocker" anchor=".3 0 0"/></equality>
<actuator><motor name="drive" joint="crank"/></actuator></mujoco>"""
WRIST = """
<mujoco><worldbody><body name="arm"><joint name="arm" axis="0 1 0"/><geom size=".05"/>
  <body name="hand" pos="0 0 .2"><joint name="wrist" type="ball"/><geom size=".05" pos="0 0 .1"/></body></body>
</worldbody>
<actuator><motor name="drive" joint="arm"/></actuator></mujoco>"""


def found(folder: Path, model: str, turns: dict[str, float], extra: str = "", every: int = 1) -> list[Finding]:
    """Findings of three logs in which each of the joints turns by so many times one angle; values renewed every k."""
    (folder / "machine.xml").write_text(model)
    rng, time = np.random.default_rng(0), np.arange(400) * 0.01
    for k in range(3):
        angle = 0.4 * np.sin(2 * time + k)
        columns = {j: (by * angle + 1e-4 * rng.standard_normal(400))[np.arange(400) // every * every]
                   for j, by in turns.items()}  # fmt: skip
        np.savez(folder / f"log{k}.npz", t=time, u=np.cos(time), **columns)
    channels = "\n".join(f"  joint:{j}:pos: {{column: {j}, unit: rad, noise: 0.0001}}" for j in turns)
    (folder / "mapping.yaml").write_text(
        "version: 1\nmodel: machine.xml\nparameters:\n"
        "  - {name: rod, field: body_mass, of: " + model.split('<body name="')[1].split('"')[0] + ", unit: kg, "
        "low: 0.001, high: 5}\nlogs:\n  - {path: '*.npz'}\ntime: {column: t, unit: s}\n"
        f"controls:\n  ctrl:drive: {{column: u, unit: N m}}\nchannels:\n{channels}\n{extra}"
    )
    return check(folder / "mapping.yaml")


def said(findings: list[Finding], words: str) -> list[str]:
    return [f.severity for f in findings if words in str(f)]


def test_a_loop_whose_joints_are_all_measured_is_sound(tmp_path: Path) -> None:
    assert not found(tmp_path, LINKAGE.format(elbow=""), {"crank": 1, "elbow": -1, "rocker": 1})


def test_a_loop_is_looked_at_in_sparse_models_too(tmp_path: Path) -> None:
    model = LINKAGE.format(elbow="").replace('timestep="0.005"', 'timestep="0.005" jacobian="sparse"')
    assert not found(tmp_path, model, {"crank": 1, "elbow": -1, "rocker": 1})
    findings = found(tmp_path, model, {"crank": 1, "elbow": -1, "rocker": 1.2})
    assert said(findings, "equality 'pin' is off by") == ["warning"]


@pytest.mark.parametrize(
    ("elbow", "extra", "severity", "words"),
    [
        ("", "", "warning", "no channel measures 'elbow': every roll-out starts with it at its reference, at rest"),
        ("", "segments: {start: settled}", "note", "with the speed that it settles at"),
        ('stiffness="5"', "", "note", "no channel measures 'elbow', which a spring holds"),
    ],
)
def test_a_joint_that_nobody_measures_is_told(
    tmp_path: Path, elbow: str, extra: str, severity: str, words: str
) -> None:
    findings = found(tmp_path, LINKAGE.format(elbow=elbow), {"crank": 1, "rocker": 1}, extra)
    assert said(findings, words) == [severity]
    assert said(findings, "equality 'pin' is off by") == ["warning"]


def test_a_zero_that_is_off_opens_the_loop(tmp_path: Path) -> None:
    findings = found(tmp_path, LINKAGE.format(elbow=""), {"crank": 1, "elbow": -1, "rocker": 1.2})
    assert said(findings, "equality 'pin' is off by") == ["warning"]


def test_a_ball_joint_is_an_error(tmp_path: Path) -> None:
    assert said(found(tmp_path, WRIST, {"arm": 1}), "'wrist' is a ball joint, which no channel measures") == ["error"]
    wrong = found(tmp_path, WRIST, {"arm": 1, "wrist": 1})
    assert said(wrong, "channels.joint:wrist:pos: joint 'wrist' is a ball joint, which no channel measures") == [
        "error"
    ]


@pytest.mark.parametrize(("every", "rate"), [(1, None), (2, "50"), (4, "25")])
def test_values_that_are_held_are_told_with_their_rate(tmp_path: Path, every: int, rate: str | None) -> None:
    findings = found(tmp_path, LINKAGE.format(elbow=""), {"crank": 1, "elbow": -1, "rocker": 1}, every=every)
    assert said(findings, f"say `rate: {rate}`") == (["warning"] * 3 if rate else [])


def test_an_encoders_steps_are_not_held_values(tmp_path: Path) -> None:
    folder = tmp_path
    found(folder, LINKAGE.format(elbow=""), {"crank": 1, "elbow": -1, "rocker": 1})
    for file in folder.glob("*.npz"):
        with np.load(file) as log:
            columns = dict(log)
        np.savez(file, **{k: v if k in "tu" else np.round(v / 0.02) * 0.02 for k, v in columns.items()})
    assert not said(check(folder / "mapping.yaml"), "say `rate")
