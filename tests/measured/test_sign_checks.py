"""What `check` says of encoders, commands and frames that are the wrong way round."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.checks import check
from nfc_gym.measured.findings import Finding

ARM = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping=".1"/>
    <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/>
    <body name="fore" pos="0 0 -.3"><joint name="elbow" axis="0 1 0" damping=".05"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.25" mass=".3"/></body></body>
</worldbody><actuator>
  <position name="lift" joint="shoulder" kp="8" kv=".5"/><motor name="bend" joint="elbow"/></actuator></mujoco>"""
# A thruster that leans with its body: where it drifts to tells which way z is.
FLIER = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="hull"><freejoint/><geom type="box" size=".1 .1 .03" mass="1"/><site name="fan"/></body>
</worldbody><actuator><motor name="thrust" site="fan" gear="0 0 1 0 0 0"/></actuator>
<sensor><accelerometer name="imu" site="fan"/></sensor></mujoco>"""
NED = {"p": np.array([1.0, -1, -1]), "q": np.array([1.0, 1, -1, -1])}


def moved(model: mujoco.MjModel, k: int) -> dict[str, np.ndarray]:
    """Columns of 4 s of a machine, sampled at 100 Hz with a little noise: t, u0.., qpos as `joint` or `p`, `q`."""
    data, rng = mujoco.MjData(model), np.random.default_rng(k)
    free = model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    if free:
        data.qpos[3:7] = [1, 0.3 * np.sin(k), 0.3 * np.cos(k), 0]
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    rows, felt = [], []
    for n in range(400):
        wave = 0.6 * np.sin(np.array([2.3, 3.1]) * (0.01 * n) + k + np.arange(2))
        ctrl = (9.81 + 2 * wave if free else wave * [1, 0.5])[: model.nu]
        rows.append(np.concatenate([[0.01 * n], ctrl, data.qpos]))
        data.ctrl[:] = ctrl
        mujoco.mj_forward(model, data)
        felt.append(data.sensordata.copy())
        mujoco.mj_step(model, data, 2)
    table = np.array(rows).T
    table[1 + model.nu :] += 1e-4 * rng.standard_normal((model.nq, 400))
    columns = {"t": table[0], **{f"u{i}": table[1 + i] for i in range(model.nu)}}
    state = table[1 + model.nu :]
    columns["a"] = np.array(felt) + 1e-3 * rng.standard_normal((400, model.nsensordata))
    return columns | ({"p": state[:3].T, "q": state[3:].T} if free else {"shoulder": state[0], "elbow": state[1]})


def found(folder: Path, xml: str, signs: dict[str, float | np.ndarray], wrong: str = "") -> list[Finding]:
    """Findings of three logs of `xml` whose columns are multiplied by signs, checked against `xml` or `wrong`."""
    (folder / "machine.xml").write_text(wrong or xml)
    model = mujoco.MjModel.from_xml_string(xml)
    for k in range(3):
        np.savez(folder / f"log{k}.npz", **{c: v * signs.get(c, 1.0) for c, v in moved(model, k).items()})
    names = [model.actuator(i).name for i in range(model.nu)]
    unit = {"lift": "rad", "bend": "N m", "thrust": "N"}
    controls = "\n".join(f"  ctrl:{n}: {{column: u{i}, unit: {unit[n]}}}" for i, n in enumerate(names))
    channels = (
        "  body:hull:pos: {column: p, unit: m, noise: 0.0001}\n"
        "  body:hull:quat: {column: q, order: wxyz, noise: 0.0001}\n"
        "  sensor:imu: {column: a, unit: m/s^2, noise: 0.001}"
        if xml is FLIER
        else "\n".join(f"  joint:{j}:pos: {{column: {j}, unit: rad, noise: 0.0001}}" for j in ("shoulder", "elbow"))
    )
    body = model.body(1).name
    (folder / "mapping.yaml").write_text(
        "version: 1\nmodel: machine.xml\nparameters:\n"
        f"  - {{name: mass, field: body_mass, of: {body}, unit: kg, low: 0.1, high: 5}}\nlogs:\n  - {{path: '*.npz'}}\n"
        f"time: {{column: t, unit: s}}\ncontrols:\n{controls}\nchannels:\n{channels}\n"
    )
    return check(folder / "mapping.yaml")


def turned(findings: list[Finding]) -> list[Finding]:
    return [f for f in findings if "turned round" in f.message]


def test_turns_that_are_rolled_out_at_once_are_told_as_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an encoder, a command and a frame: each with its own signs and measurements, whatever is beside it."""
    for name, xml, signs in (("arm", ARM, {"shoulder": -1.0, "u1": -1.0}), ("flier", FLIER, NED)):
        (tmp_path / name).mkdir()
        told = []
        for at_once in (8, 1):
            monkeypatch.setattr("nfc_gym.measured.sign_checks.TURNS", at_once)
            told.append(turned(found(tmp_path / name, xml, signs)))
        assert told[0] == told[1] != []


LIFT = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="cage"><joint name="mast" type="slide" axis="0 0 1"/><geom size=".05" mass="1"/></body>
</worldbody><actuator><motor name="winch" joint="mast"/></actuator>
<sensor><actuatorfrc name="pull" actuator="winch"/></sensor></mujoco>"""
LIFTED = """
version: 1
model: lift.xml
logs: [{path: '*.npz'}]
time: {column: t, unit: s}
channels:
  joint:mast:pos: {column: x, unit: m, noise: 0.0001}
  force:winch: {column: f, unit: N, noise: 0.01}
segments: {mode: inverse}
"""


def test_nothing_is_said_of_a_machine_whose_commands_are_not_logged(tmp_path: Path) -> None:
    """Hoisted with twice its weight: without the winch's force it would fall as fast as it rises."""
    (tmp_path / "lift.xml").write_text(LIFT)
    (tmp_path / "mapping.yaml").write_text(LIFTED)
    t = 0.01 * np.arange(200)
    for k in range(3):
        force = 2 * 9.81 + np.sin(5 * t + k)
        x = 9.81 * t**2 / 2 + (t * np.cos(k) - (np.sin(5 * t + k) - np.sin(k)) / 5) / 5
        np.savez(tmp_path / f"{k}.npz", t=t, x=x, f=force)
    assert turned(check(tmp_path / "mapping.yaml")) == []


@pytest.mark.parametrize("xml", [ARM, FLIER])
def test_nothing_is_said_where_all_is_the_right_way_round(tmp_path: Path, xml: str) -> None:
    assert not turned(found(tmp_path, xml, {}))


def test_nor_where_the_model_is_far_off_in_another_way(tmp_path: Path) -> None:
    wrong = ARM.replace('kp="8"', 'kp="2"').replace('mass=".3"', 'mass=".9"').replace('damping=".1"', 'damping="1"')
    assert not turned(found(tmp_path, ARM, {}, wrong))


@pytest.mark.parametrize(
    ("column", "joint", "command"),
    [
        ("shoulder", "shoulder", "lift"),
        ("u0", "shoulder", "lift"),
        ("elbow", "elbow", "bend"),
        ("u1", "elbow", "bend"),
    ],
)
def test_a_joint_or_its_command_with_the_other_sign_is_told(
    tmp_path: Path, column: str, joint: str, command: str
) -> None:
    (finding,) = turned(found(tmp_path, ARM, {column: -1.0}))
    assert finding.severity == "warning"
    want = f"joint '{joint}'" if column == joint else f"the command 'ctrl:{command}'"
    assert want in finding.message


@pytest.mark.parametrize("sensors", [False, True])
def test_a_frame_with_z_downwards_is_told(tmp_path: Path, sensors: bool) -> None:
    """Whether the body's sensors are read along axes of that kind too or not."""
    (finding,) = turned(found(tmp_path, FLIER, NED | ({"a": NED["p"]} if sensors else {})))
    assert ("and its sensors" in finding.message) == sensors
    assert "north-east-down" in finding.message
    assert "(w, x, -y, -z)" in finding.advice
