"""Each way to spoil a data set is found, named, and comes with advice; an unspoilt one passes without a word."""

import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.measured.checks import check, require
from nfc_gym.measured.findings import parted
from tests.measured import arm

Build = Any
DEGREES = 180 / np.pi


def scale(name: str, factor: float) -> Any:
    return lambda table: table.update({name: table[name] * factor})


def change(name: str, rows: slice, value: float) -> Any:
    def spoil(table: dict[str, np.ndarray]) -> None:
        table[name] = table[name].copy()
        table[name][rows] = value

    return spoil


def drop(name: str) -> Any:
    return lambda table: table.pop(name)


def swap(a: str, b: str) -> Any:
    return lambda table: table.update({a: table[b], b: table[a]})


def rotate_quaternion(table: dict[str, np.ndarray]) -> None:
    """The file holds x, y, z, w where the mapping says w, x, y, z."""
    w, x, y, z = (table[k] for k in ("qw", "qx", "qy", "qz"))
    table.update(qw=x, qx=y, qy=z, qz=w)


def gap(table: dict[str, np.ndarray]) -> None:
    table["t"] = np.where(np.arange(len(table["t"])) >= 200, table["t"] + 0.5, table["t"])


def jitter(table: dict[str, np.ndarray]) -> None:
    table["t"] = table["t"] + np.random.default_rng(0).uniform(0, 0.009, len(table["t"]))


def errors(path: Path) -> list[str]:
    return [str(f) for f in check(path) if f.severity == "error"]


def test_a_sound_data_set_has_no_findings(build: Build) -> None:
    assert check(build()) == []


def test_what_mujoco_remarks_on_a_model_is_told_once(tmp_path: Path) -> None:
    """And not as a warning of Python's at each of the times that it is compiled."""
    path = arm.machine(tmp_path)
    model = tmp_path / "arm.xml"
    model.write_text(model.read_text().replace("<compiler ", '<compiler settotalmass="0.5" '))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (remark,) = (f for f in check(path) if f.where == "model")
    assert remark.severity == "note"
    assert "'settotalmass' is deprecated" in remark.message


def test_what_comes_apart_is_not_told_by_mujoco(
    build: Build, machine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its warnings, one for each roll-out, would bury the findings, and go into a file in the working folder."""
    monkeypatch.chdir(tmp_path)
    mujoco.set_mju_user_warning(None)
    check(build(model=machine.replace('kp="10"', 'kp="1e7"')))
    assert "WARNING" not in "".join(capfd.readouterr())
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (drop("v"), ["joint:hinge:vel", "no column 'v'", "valid: t, goal"]),
        (change("q", slice(None), 0.3), ["joint:hinge:pos", "constant", "right column"]),
        (lambda t: t.update(v=t["q"]), ["same numbers as joint:hinge:pos"]),
        (change("t", slice(100, 101), 0.5), ["time", "goes back", "row 100", "cut the file"]),
        (change("t", slice(100, 101), 0.99), ["time", "stands still", "row 100"]),
        (change("t", slice(100, 101), np.nan), ["time", "not a number", "row 100"]),
        (gap, ["time", "gap of 0.51 s", "row 199", "`gaps: cut`"]),
        (change("q", slice(50, 60), np.nan), ["10 of 400 rows are NaN", "row 50", "mask"]),
        (change("goal", slice(5, 6), np.inf), ["controls.ctrl:servo", "1 of 400 rows"]),
        (scale("q", DEGREES), ["joint:hinge:pos", "in degrees", "unit"]),
        (scale("v", DEGREES), ["joint:hinge:pos", "degrees/s", "unit"]),
        (scale("v", 30 / np.pi), ["joint:hinge:pos", "rpm"]),
        (scale("v", -1), ["joint:hinge:pos", "opposite signs"]),
        (scale("qw", 2.0), ["body:base:quat", "norm", "unit quaternions"]),
        (rotate_quaternion, ["body:base:quat", "scalar order", "xyzw scalar last"]),
        (lambda t: t.update(q=np.array(["left"] * 400)), ["not numeric", "row 0", "'left'"]),
        (lambda t: t.update(q=np.array(["0,25"] * 400)), ["row 0 holds '0,25'", "save it with decimal points"]),
        (lambda t: t.update(q=t["q"][:-1]), ["shape (399,)", "400 rows"]),
        (lambda t: t.update(q=np.stack([t["q"]] * 2, 1)), ["2 columns where 1 is wanted"]),
    ],
)
def test_a_spoilt_log_is_an_error_that_says_what_to_do(build: Build, spoil: Any, words: list[str]) -> None:
    found = "\n".join(errors(build(spoil)))
    for word in words:
        assert word in found


def test_degrees_are_found_without_a_speed(build: Build) -> None:
    no_speed = ('  "joint:hinge:vel": {column: v, unit: rad/s, noise: 0.01}\n', "")
    assert "in degrees" in "\n".join(errors(build(scale("q", DEGREES), no_speed)))
    no_command = ("unit: rad}", "unit: deg}")  # the goal too is in degrees and said to be so: the joint's range decides
    both = lambda t: (scale("q", DEGREES)(t), scale("goal", DEGREES)(t))  # noqa: E731
    passive = (
        (Path(build(both, no_speed, no_command)).parent / "machine.xml").read_text().replace("<position", "<motor")
    )
    found = "\n".join(errors(build(both, no_speed, no_command, model=passive.replace(' kp="10"', ""))))
    assert "joint range" in found


def test_scalar_order_is_found_without_rates(build: Build) -> None:
    no_rates = ('  "sensor:gyro": {columns: [gx, gy, gz], unit: rad/s, noise: 0.01}\n', "")
    assert check(build(None, no_rates)) == []
    assert "scalar order" in "\n".join(errors(build(rotate_quaternion, no_rates)))
    said_so = ("[qw, qx, qy, qz], order: wxyz", "[qw, qx, qy, qz], order: xyzw")
    assert check(build(rotate_quaternion, no_rates, said_so)) == []
    assert "scalar order" in "\n".join(errors(build(None, no_rates, said_so)))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (jitter, ["time", "jitter"]),
        (change("goal", slice(None), 0.1), ["ctrl:servo", "constant"]),
        (scale("goal", 3.0), ["ctrl:servo", "beyond the actuator's ctrlrange [-2.5, 2.5]"]),
        (lambda t: t.update(goal=np.clip(10 * t["goal"], -2.5, 2.5)), ["ctrl:servo", "saturated"]),
        (lambda t: t.update(gz=np.clip(t["gz"], -1.2, 1.2)), ["sensor:gyro", "clipped"]),
        (lambda t: t.update(v=np.clip(t["v"], -0.7 * t["v"].max(), 0.7 * t["v"].max())),
         ["joint:hinge:vel", "its extreme", "mask"]),
        (lambda t: [t.update({k: t[k][::2]}) for k in t] and t.update(t=np.delete(np.arange(203), [20, 21, 22]) * 0.02),
         ["time", "pause"]),
    ],
)  # fmt: skip
def test_a_doubtful_log_is_a_warning(build: Build, spoil: Any, words: list[str]) -> None:
    found = check(build(spoil))
    assert not [f for f in found if f.severity == "error"]
    text = "\n".join(str(f) for f in found if f.severity == "warning")
    for word in words:
        assert word in text


def test_speeds_are_not_compared_where_they_are_masked(build: Build) -> None:
    """As `check` advises of a tachometer that is cut off: what is left agrees with the angle's slope."""
    masked = ("column: v, unit: rad/s, noise: 0.01", "column: v, unit: rad/s, noise: 0.01, mask: ok")

    def cut(t: dict[str, Any]) -> None:
        top = 0.4 * np.abs(t["v"]).max()
        t["v"] = np.clip(t["v"], -top, top)
        t["ok"] = np.abs(t["v"]) < top

    assert "times the measured speed" in "\n".join(str(f) for f in check(build(cut)))
    assert check(build(cut, masked)) == []
    assert "opposite signs" in "\n".join(errors(build(lambda t: (cut(t), scale("v", -1)(t)), masked)))


def test_a_speed_in_steps_is_not_clipped(build: Build) -> None:
    """An encoder counts them: many samples share the largest, as many as share the one below."""

    def count(t: dict[str, Any]) -> None:
        step = 2 * np.abs(t["v"]).max() / 35
        t["v"] = np.round(t["v"] / step) * step
        assert (t["v"] == t["v"].max()).mean() > 0.02 or (t["v"] == t["v"].min()).mean() > 0.02

    assert "clipped" not in "\n".join(str(f) for f in check(build(count)))


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (('"ctrl:servo"', '"ctrl:sevro"'), ["no actuator 'sevro'", "did you mean 'servo'"]),
        (("joint:hinge:pos", "joint:hing:pos"), ["no joint 'hing'", "did you mean 'hinge'"]),
        (("body:base:quat", "body:bas:quat"), ["no body 'bas'", "did you mean 'base'"]),
        (("sensor:gyro", "sensor:gyroscope"), ["no sensor 'gyroscope'", "valid: gyro, acc"]),
        (("of: [bob]", "of: [bot]"), ["parameters.0 (mass)", "no body named 'bot'", "bob"]),
        (("field: body_mass", "field: body_mas"), ["body_mas", "did you mean 'body_mass'"]),
        (("high: 0.2", "high: 0.06"), ["nominal 0.1 kg lies outside"]),
        (("machine.xml", "machin.xml"), ["machin.xml", "machine.xml"]),
        (("column: q, unit: rad,", "column: q, unit: m,"), ["joint 'hinge' turns, but the unit is 'm'"]),
        (("length: 0.4", "length: 5"), ["as long as the longest horizon, 5 s", "shorten", "no log that verifies is"]),
        (("unit: rad,", "unit: degrees,"), ["unknown unit; did you mean 'deg'?"]),
        (('"*.npz"', '"*.csv"'), ["no file matches '*.csv'", "run_0.npz"]),
        (('"*.npz"', "."), ["no file matches '.'", "run_0.npz"]),
        (('"*.npz"', "./"), ["no file matches './'", "run_0.npz"]),
    ],
)
def test_a_mapping_that_does_not_fit_model_or_logs(build: Build, edit: tuple[str, str], words: list[str]) -> None:
    found = "\n".join(errors(build(None, edit)))
    for word in words:
        assert word in found


@pytest.mark.parametrize(
    ("field", "of", "words"),
    [
        ("dof_invweight0", "hinge", ["model.xml can say", "derives it from other fields"]),
        ("jnt_axis[0]", "hinge", ["jnt_axis[0] is nothing that model.xml can say"]),
        ("jnt_qposadr", "hinge", ["whole numbers"]),
        ("body_mass", "bob", ["'mass' and 'other' write the same number, of body_mass"]),
    ],
)
def test_a_parameter_that_no_corrected_model_could_have(build: Build, field: str, of: str, words: list[str]) -> None:
    other = f"\n  - {{name: other, field: '{field}', of: [{of}], unit: '1', low: 0.001, high: 2, nominal: 0.1}}\nlogs:"
    found = "\n".join(errors(build(None, ("\nlogs:", other))))
    for word in words:
        assert word in found


@pytest.mark.parametrize(
    ("actuator", "unit", "wanted"),
    [
        ('position name="servo" joint="hinge" kp="1"', "N m", "want rad"),
        ('velocity name="servo" joint="hinge" kv="1"', "rad", "want rad/s"),
        ('motor name="servo" joint="hinge"', "rad/s", "want a force, a torque"),
        ('motor name="servo" joint="hinge"', "N m", ""),
        ('motor name="servo" joint="hinge"', "1", ""),
    ],
)
def test_a_command_in_a_unit_that_its_actuator_does_not_take(
    build: Build, machine: str, actuator: str, unit: str, wanted: str
) -> None:
    model = re.sub(r'<position name="servo"[^>]*/>', f'<{actuator} ctrlrange="-2.5 2.5"/>', machine)
    assert actuator in model
    found = check(build(None, ("{column: goal, unit: rad}", f"{{column: goal, unit: {unit}}}"), model=model))
    told = "\n".join(str(f) for f in found if f.where == "controls.ctrl:servo" and "unit" in f.message)
    assert wanted in told
    assert bool(told) == bool(wanted)


SUMMING = 'intvelocity name="servo" joint="hinge" kp="10" actrange="-9 9"'


@pytest.mark.parametrize(
    ("actuator", "mode", "severity", "words"),
    [
        (SUMMING, "rollout", "note", "holds the joint"),
        (
            SUMMING,
            "forward",
            "warning",
            "0 where a log begins",
        ),
        ('general name="servo" joint="hinge" dyntype="integrator"', "rollout", "warning", "s before each start"),
        ('motor name="servo" joint="hinge"', "rollout", "", ""),
    ],
)
def test_what_an_integrator_is_taken_to_have_gathered_is_told(
    build: Build, machine: str, actuator: str, mode: str, severity: str, words: str
) -> None:
    model = re.sub(r'<position name="servo"[^>]*/>', f"<{actuator}/>", machine)
    assert actuator in model
    edits = () if mode == "rollout" else (("segments: {length: 0.4}", "segments: {mode: forward}"),)
    found = [f for f in check(build(None, *edits, model=model)) if "integrates" in f.message]
    assert [f.severity for f in found] == [severity] * bool(severity)
    assert all(words in str(f) and f.where == "controls.ctrl:servo" for f in found)


def test_bounds_beyond_nature_and_values_made_alike_are_told_of(build: Build, machine: str) -> None:
    rows = "\n  - {name: damping, field: dof_damping, of: [hinge], unit: N m s/rad, low: -1, high: 1}"
    rows += (
        "\n  - {name: size, field: 'geom_size[0]', of: [weight, hull], tied: true, unit: m, low: 0.01, high: 1}\nlogs:"
    )
    said = "\n".join(map(str, check(build(None, ("\nlogs:", rows)))))
    assert "reach beyond what nature allows, 0 or more" in said
    assert "one value for what differs in the model (0.02, 0.1)" in said


def test_the_same_log_twice_is_told_of(build: Build, tmp_path: Path) -> None:
    path = build()
    shutil.copy(tmp_path / "run_0.npz", tmp_path / "run_9.npz")
    assert "log 'run_9' holds the same as 'run_0'" in "\n".join(map(str, check(path)))


@pytest.mark.parametrize(
    ("mode", "channel", "servo", "said"),
    [
        ("inverse", "", "", "segments: mode inverse compares force: channels, and there is none"),
        ("forward", "", "", "segments: mode forward compares sensor: channels, and there is none"),
        ("inverse", '"force:servo": {column: goal, unit: N m}', "", ""),
        ("inverse", '"force:push": {column: goal, unit: N}', "", "channels.force:push: cannot be compared with"),
        (
            "inverse", '"force:servo": {column: goal, unit: N m}', '<motor name="twin" joint="hinge"/>',
            "twin can move the same joint",
        ),
    ],
)  # fmt: skip
def test_what_a_mode_compares_must_be_there(
    build: Build, machine: str, mode: str, channel: str, servo: str, said: str
) -> None:
    """The other commands stop there, and so `check` tells."""
    more = f'<general name="push" site="imu" gear="1 0 0 0 0 0"/>{servo}</actuator>'
    gyro = '  "sensor:gyro": {columns: [gx, gy, gz], unit: rad/s, noise: 0.01}\n'
    edits = [(gyro, f"  {channel}\n" if channel else ""), ("{length: 0.4}", f"{{mode: {mode}, length: 0.4}}")]
    found = errors(build(None, *edits, model=machine.replace("</actuator>", more)))
    assert [said in f for f in found] == ([True] if said else []), found


def test_a_sensor_alone_is_no_motion(build: Build) -> None:
    """Roll-outs begin at measured states, and the other modes look at these."""
    shown = [
        '  "joint:hinge:pos": {column: q, unit: rad, noise: 0.001}\n',
        '  "joint:hinge:vel": {column: v, unit: rad/s, noise: 0.01}\n',
        '  "body:base:quat": {columns: [qw, qx, qy, qz], order: wxyz, noise: 0.01}\n',
    ]
    (only,) = errors(build(None, *((line, "") for line in shown)))
    assert "no channel measures a joint or a free body of the model" in only


def test_what_is_known_to_change_is_told_of_in_inverse_mode(build: Build) -> None:
    known = "known:\n  - {field: body_mass, of: [bob], column: m, unit: kg}\nsegments: {mode: inverse, length: 0.4}"
    force = '  "force:servo": {column: f, unit: N m, noise: 0.01}\n'

    def spoil(table: dict[str, np.ndarray]) -> None:
        table["m"], table["f"] = np.where(table["t"] > 2, 0.2, 0.1), np.sin(table["t"])

    edits = ("segments: {length: 0.4}", known), ('  "sensor:gyro"', force + '  "sensor:gyro"')
    said = "\n".join(map(str, check(build(spoil, *edits))))
    assert "changes from 0.1 to 0.2, and mode inverse takes its first value" in said


def test_a_free_body_without_an_attitude_is_told_of(build: Build) -> None:
    quat = '  "body:base:quat": {columns: [qw, qx, qy, qz], order: wxyz, noise: 0.01}\n'
    rates = '  "body:base:angvel@body": {columns: [gx, gy, gz], unit: rad/s, noise: 0.01}\n'
    said = "\n".join(map(str, check(build(None, (quat, rates)))))
    assert "no channel measures the attitude of 'base'" in said


def test_a_drive_whose_state_no_command_tells_is_told_of(build: Build, machine: str) -> None:
    model = re.sub(r'<position name="servo"[^>]*/>', '<muscle name="servo" joint="hinge"/>', machine)
    said = "\n".join(
        map(str, check(build(None, ("{column: goal, unit: rad}", "{column: goal, unit: 1}"), model=model)))
    )
    assert "dynamics 'muscle'" in said
    assert "the force of 'servo' is none of a motor or a servo" in said


@pytest.mark.parametrize("actuator", ["pid joint='hinge'", "orientation joint='free_ball'"])
def test_an_actuator_with_several_commands_is_refused(build: Build, machine: str, actuator: str) -> None:
    model = re.sub(r'<position name="servo"[^>]*/>', f"<{actuator} name='servo'/>", machine)
    model = model.replace(
        "</worldbody>", "<body pos='0 0 3'><joint name='free_ball' type='ball'/><geom size='.1'/></body></worldbody>"
    )
    assert any("'servo' has several commands" in e for e in errors(build(None, model=model)))


def test_a_models_step_longer_than_the_shortest_horizon(build: Build, machine: str) -> None:
    """As of one that is given in the mapping."""
    slow = re.sub(r"(<mujoco[^>]*>)", r'\1<option timestep="0.2"/>', machine, count=1)
    found = "\n".join(errors(build(model=slow)))
    assert "one step of 0.2 s is longer than the shortest horizon, 0.05 s" in found


def test_goals_of_many_turns_are_in_degrees(build: Build) -> None:
    """Though a soft joint does not follow them by all of the way."""

    def soft(table: dict[str, np.ndarray]) -> None:
        table["goal"] = np.rad2deg(table["goal"])
        table["q"] = 0.6 * table["q"]

    found = "\n".join(
        str(f) for f in check(build(soft, ('  "joint:hinge:vel": {column: v, unit: rad/s, noise: 0.01}\n', "")))
    )
    assert "the command is in degrees" in found


def test_a_model_that_does_not_compile(build: Build) -> None:
    found = "\n".join(errors(build(model="<mujoco><worldbody><body name='a'><joint/></body></worldbody></mujoco>")))
    assert "does not compile" in found or "not a model" in found


def test_a_model_with_a_name_that_is_no_text(build: Build, tmp_path: Path) -> None:
    path = build()
    (tmp_path / "machine.xml").write_bytes((tmp_path / "machine.xml").read_bytes().replace(b'"bob"', b'"b\xa1b"'))
    found = "\n".join(errors(path))
    assert r"the name b'b\xa1b' is not UTF-8" in found


def test_what_a_model_does_not_name_goes_by_its_joint_or_its_number(build: Build, tmp_path: Path) -> None:
    path, file = build(None, ("ctrl:servo", "ctrl:hinge")), tmp_path / "machine.xml"
    path.write_text(path.read_text().replace("sensor:gyro", "sensor:sensor_0"))
    file.write_text(file.read_text().replace('name="servo" ', "").replace('name="gyro" ', ""))
    assert check(path) == []
    path.write_text(path.read_text().replace("ctrl:hinge", "ctrl:bob"))
    assert "the model has no actuator 'bob'; valid: hinge" in "\n".join(errors(path))


def test_a_model_with_a_number_that_is_not_finite(build: Build) -> None:
    body = "<body name='a'><joint/><geom size='0.1' mass='{}'/></body>"
    found = "\n".join(errors(build(model=f"<mujoco><worldbody>{body.format('inf')}</worldbody></mujoco>")))
    assert "body_inertia holds inf" in found


def test_too_few_logs_to_split(build: Build) -> None:
    found = "\n".join(errors(build(logs=2)))
    assert "2 logs cannot be split 3 ways" in found
    assert "by: time" in found


def test_cut_by_time_is_noted_as_not_independent(build: Build) -> None:
    found = check(build(None, ("time: {column: t}", "time: {column: t}\nsplit: {by: time}"), logs=1))
    assert [f.severity for f in found] == ["note"]
    assert "not independent" in found[0].message


def test_everything_wrong_is_said_at_once_and_once(build: Build) -> None:
    both = lambda t: (scale("q", DEGREES)(t), change("goal", slice(5, 6), np.nan)(t))  # noqa: E731
    path = build(both, ("of: [bob]", "of: [bot]"), ("sensor:gyro", "sensor:gyr"))
    found = errors(path)
    assert len(found) == 3  # the log is not judged further while a column of it cannot be read
    assert sum("in 3 of 3 logs" in line for line in found) == 1
    with pytest.raises(InputError, match=r"(?s)'bot'.*'gyr'|'gyr'.*'bot'"):
        require(path)


def test_a_wrong_time_does_not_hide_the_channels(build: Build) -> None:
    """One run tells both; of columns that can be read nothing is said."""
    spoil = lambda t: (gap(t), change("q", slice(50, 60), np.nan)(t))  # noqa: E731
    found = errors(build(spoil))
    assert len(found) == 2
    assert "gap of 0.51 s" in found[0]
    assert "10 of 400 rows are NaN" in found[1]
    found = errors(build(drop("v"), ("{column: t}", "{column: tt}"), ("column: q,", "column: q3,")))
    assert [line.partition(": in 3 of 3 logs")[0] for line in found] == [
        "time",
        "channels.joint:hinge:pos",
        "channels.joint:hinge:vel",
    ]
    # Where columns differ in length nobody knows the log's rows, and only the time is told.
    found = errors(build(lambda t: t.update(q=t["q"][:-1]), ("{column: t}", "{column: tt}")))
    assert len(found) == 1
    assert "no column 'tt'" in found[0]


@pytest.mark.parametrize("value", [0.5, 0.99])
def test_the_message_about_time_is_whole(build: Build, tmp_path: Path, value: float) -> None:
    (found,) = check(build(change("t", slice(100, 101), value)))
    assert found.message.endswith(f"at row 100 (0.99 to {value:g} s, 1 such row)")
    assert found.advice.startswith(
        "remove repeated rows, cut the file there into two logs, or, if its stamps are rounded"
    )


@pytest.mark.parametrize(
    ("text", "message", "advice"),
    [
        ("wrong (a; b; c); do this; or that", "wrong (a; b; c)", "do this; or that"),
        ("wrong (a (b; c) d; e); do", "wrong (a (b; c) d; e)", "do"),
        ("column 'q(' is not there; do (so)", "column 'q(' is not there", "do (so)"),
        ("wrong", "wrong", ""),
    ],
)
def test_messages_are_parted_outside_of_brackets(text: str, message: str, advice: str) -> None:
    assert parted(text) == (message, advice)


@pytest.mark.parametrize(
    ("factor", "unit", "words"),
    [
        (1e3, "s", "0.001 times the measured speed, as if times in ms were declared as s"),
        (1e6, "ms", "0.001 times the measured speed, as if times in us were declared as ms"),
        (1e-3, "s", "1e+03 times the measured speed"),
        (1.0, "ms", "1e+03 times the measured speed, as if times in s were declared as ms"),
    ],
)
def test_a_wrong_unit_of_time_is_an_error_that_says_so(build: Build, factor: float, unit: str, words: str) -> None:
    found = errors(build(scale("t", factor), ("time: {column: t}", f"time: {{column: t, unit: {unit}}}")))
    assert any(f"check `time.unit`: the derivative of positions is {words}" in line for line in found)


def test_logs_too_slow_for_every_horizon_are_an_error(build: Build) -> None:
    no_speed = ('  "joint:hinge:vel": {column: v, unit: rad/s, noise: 0.01}\n', "")
    no_rates = ('  "sensor:gyro": {columns: [gx, gy, gz], unit: rad/s, noise: 0.01}\n', "")
    path = build(scale("t", 1e3), no_speed, no_rates)
    (found,) = errors(path)
    assert "every horizon, 0.05 to 0.4 s, lies below one sampling interval, 10 s" in found
    assert "check `time.unit`" in found
    with pytest.raises(InputError, match="below one sampling interval"):
        require(path)
    # A sample every 0.4 s: the last horizon is one.
    assert errors(build(scale("t", 40.0), no_speed, no_rates)) == []


def test_require_gives_the_data_set(build: Build) -> None:
    dataset, findings = require(build())
    assert sorted(dataset.splits.values()) == ["fit", "select", "verify"]
    assert findings == []


def wrap(table: dict[str, np.ndarray]) -> None:
    table["q"] = (np.linspace(0, 20, 400) + np.pi) % (2 * np.pi) - np.pi


def test_wrapped_angles_are_found(build: Build) -> None:
    found = "\n".join(errors(build(wrap)))
    assert "wrapped at a full turn" in found
    assert "unwrap" in found


@pytest.mark.parametrize(("unit", "wrong"), [("m/s^2", True), ("g", False)])
def test_gravity_of_one_is_in_g(build: Build, unit: str, wrong: bool) -> None:
    def rest(table: dict[str, np.ndarray]) -> None:
        table["az"] = 1 + 0.01 * np.random.default_rng(0).standard_normal(400)

    channel = f'"sensor:acc": {{column: az, unit: {unit}, axes: [z], noise: 0.1}}'
    found = errors(build(rest, ("segments:", f"  {channel}\nsegments:")))
    assert [("in g?" in line) for line in found] == [True] * wrong


@pytest.mark.parametrize(("keys", "wrong"), [("", True), ("axes: [x, z], ", False)])
def test_some_components_of_a_sensor_are_said_which(build: Build, keys: str, wrong: bool) -> None:
    channel = f'"sensor:acc": {{columns: [q, v], unit: m/s^2, {keys}noise: 0.1}}'
    found = errors(build(None, ("segments:", f"  {channel}\nsegments:")))
    assert any("2 columns where the sensor has 3 components" in line for line in found) == wrong


def test_a_constant_channel_in_one_log_of_many_is_a_doubt(build: Build, tmp_path: Path) -> None:
    path = build()
    table = dict(np.load(tmp_path / "run_1.npz"))
    table["q"] = np.full(400, 0.2)
    np.savez(tmp_path / "run_1.npz", **table)
    found = [f for f in check(path) if "constant" in f.message]
    assert [(f.severity, f.where) for f in found] == [("warning", "run_1: channels.joint:hinge:pos")]


RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "data"
CRAZYFLIE = """
version: 1
model: machine.xml
logs: [{path: "%s/nanobench_crazyflie/*circle*.npz"}]
time: {column: t}
channels:
  "body:base:quat": {columns: [qx, qy, qz, qw], order: %s, noise: 0.01}
  "sensor:gyro": {columns: [imu_gyro_x, imu_gyro_y, imu_gyro_z], unit: rad/s, noise: 0.05}
"""


@pytest.mark.recordings
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_scalar_order_of_recorded_flights(build: Build, order: str) -> None:
    path = build()
    path.write_text(CRAZYFLIE % (RECORDINGS, order))
    found = [line for line in errors(path) if "scalar order" in line]
    assert bool(found) == (order == "wxyz")


@pytest.mark.recordings
def test_a_recorded_matlab_file_reads_without_error(build: Build) -> None:
    path = build()
    model = '<mujoco><worldbody><body><joint name="x" type="slide"/><geom size="1"/></body></worldbody></mujoco>'
    (path.parent / "machine.xml").write_text(model)
    path.write_text(
        f'version: 1\nmodel: machine.xml\nlogs: [{{path: "{RECORDINGS}/emps/DATA_EMPS.mat"}}]\ntime: {{column: t}}\n'
        'split: {by: time}\nchannels: {"joint:x:pos": {column: qm, unit: m, noise: 1.0e-6}}\n'
    )
    assert errors(path) == []


def test_idle_commands_are_no_alarm(build: Build, tmp_path: Path) -> None:
    """A motor that is off part of the time is not saturated, and one log without commands is only worth a note."""
    from_zero = (Path(build()).parent / "machine.xml").read_text().replace('ctrlrange="-2.5 2.5"', 'ctrlrange="0 2.5"')
    assert check(build(lambda t: t.update(goal=np.clip(t["goal"], 0, 2)), model=from_zero)) == []
    table = dict(np.load(tmp_path / "run_1.npz"))
    np.savez(tmp_path / "run_1.npz", **(table | {"goal": np.zeros(400)}))
    assert [(f.severity, f.where) for f in check(tmp_path / "mapping.yaml")] == [("note", "run_1: controls.ctrl:servo")]


def test_what_has_no_effect_in_a_mode_is_told(build: Build) -> None:
    known = "known:\n  - {field: dof_damping, of: [hinge], column: goal}"
    servo = "{column: goal, unit: rad, servo: {joint: hinge, gain: 1.0, limit: 1.0}}"
    edits = (
        ("segments: {length: 0.4}", f"segments: {{mode: forward}}\n{known}"),
        ("{column: goal, unit: rad}", servo),
    )
    found = {f.where: f.message for f in check(build(None, *edits)) if f.severity == "warning"}
    assert found["known.dof_damping"] == "is not written to the model in mode forward"
    assert found["controls.ctrl:servo.servo"] == "a servo acts in roll-outs alone, not in mode forward"
