"""A mapping of a bag: what `nfc-gym check` says of its streams and clocks, and the log that is loaded."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from writers import NS, START, Messages, typestore, write_bag

from nfc_gym.measured.checks import check
from nfc_gym.measured.dataset import load

pytest.importorskip("rosbags", reason="needs rosbags: pip install 'nfc_gym[ros]'")
STORE = typestore()
make = Messages(STORE)
SECONDS = 5.0

MAPPING = """
version: 1
model: machine.xml
parameters:
  - {name: mass, field: body_mass, of: [bob], unit: kg, low: 0.05, high: 0.2}
logs: [{path: "run_*"}]
time: {column: /js.time}
controls:
  "ctrl:servo": {column: /goal.data, unit: rad}
channels:
  "joint:hinge:pos": {column: "/js.position[hinge]", unit: rad, noise: 0.001}
  "joint:hinge:vel": {column: "/js.velocity[hinge]", unit: rad/s, noise: 0.01}
  "body:base:quat": {columns: [/pose.pose.orientation.x, /pose.pose.orientation.y, /pose.pose.orientation.z,
    /pose.pose.orientation.w], order: xyzw, noise: 0.001}
  "sensor:gyro": {columns: [/imu.angular_velocity.x, /imu.angular_velocity.y, /imu.angular_velocity.z],
    unit: rad/s, noise: 0.01}
segments: {length: 0.4}
"""


def yaw(t: np.ndarray) -> np.ndarray:
    return 0.8 * np.sin(2 * t) + 0.3 * np.sin(5.3 * t)


def yaw_rate(t: np.ndarray) -> np.ndarray:
    return 1.6 * np.cos(2 * t) + 1.59 * np.cos(5.3 * t)


def record(
    folder: Path,
    seed: int,
    late: float = 0.0,
    gap: tuple[float, float] = (0, 0),
    header: bool = True,
    shift: float = 0.01,
) -> None:
    """Joints at 100 Hz, a command `shift` before each, poses at 40 Hz, an IMU at 200 Hz stamped `late` seconds late."""
    rng = np.random.default_rng(seed)

    def times(rate: float, begin: float) -> list[tuple[float, int]]:
        seconds = begin + np.arange(int(SECONDS * rate)) / rate
        return [(t, START + round(t * NS)) for t in seconds if not gap[0] < t < gap[1]]

    def noisy(value: float, sd: float) -> float:
        return value + sd * float(rng.standard_normal())

    def joint(t: float, ns: int) -> Any:
        return make.joints(ns, ["hinge"], [noisy(np.sin(3 * t + seed), 1e-3)], [noisy(3 * np.cos(3 * t + seed), 1e-2)])

    joints = [(ns + 2_000_000, joint(t, ns)) for t, ns in times(100, 0.2)]
    goals = [(ns, make.command(ns if header else 0, np.sin(3 * t + seed + 0.1))) for t, ns in times(100, 0.2 - shift)]
    poses = [(ns, make.pose(ns, (np.cos(yaw(t) / 2), 0, 0, np.sin(yaw(t) / 2)))) for t, ns in times(40, 0.0)]
    imu = [
        (ns, make.imu(ns + round(late * NS), [noisy(w, 1e-2) for w in (0, 0, yaw_rate(t))]))
        for t, ns in times(200, 0.0)
    ]
    topics = {
        "/js": ("sensor_msgs/msg/JointState", joints),
        "/goal": ("machine_msgs/msg/Stamped", goals),
        "/pose": ("geometry_msgs/msg/PoseStamped", poses),
        "/imu": ("sensor_msgs/msg/Imu", imu),
    }
    write_bag(folder / f"run_{seed}", STORE, topics)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, machine: str) -> Any:
    """A mapping, edited, of three bags recorded in a certain way; each way is recorded once."""
    made: dict[Any, Path] = {}

    def write(folder: Path, *edits: tuple[str, str], **how: Any) -> Path:
        key = tuple(sorted(how.items()))
        if key not in made:
            made[key] = tmp_path_factory.mktemp("bags")
            for seed in range(3):
                record(made[key], seed, **how)
        text = MAPPING
        for old, new in edits:
            assert old in text
            text = text.replace(old, new)
        shutil.copytree(made[key], folder, dirs_exist_ok=True)
        (folder / "machine.xml").write_text(machine)
        (folder / "mapping.yaml").write_text(text)
        return folder / "mapping.yaml"

    return write


def told(path: Path, *severities: str) -> str:
    return "\n".join(f"{f.severity} {f}" for f in check(path) if not severities or f.severity in severities)


def test_what_was_resampled_is_said_and_nothing_is_wrong(tmp_path: Path, dataset: Any) -> None:
    path = dataset(tmp_path)
    said = told(path)
    assert "error" not in said
    assert "warning" not in said
    assert "streams./imu: in 3 of 3 logs" in said
    assert "interpolated linearly from 200 Hz (header.stamp) to the 100 Hz of /js (header.stamp)" in said
    assert "0.00% of its rows in gaps over 20 ms" in said
    assert "name /imu.time as the time column" in said
    assert "interpolated by slerp from 40 Hz" in said
    assert "kept in the 0.4 of its rows" in said
    assert "held from 100 Hz" in said
    assert "at the end, which /pose does not reach" in said


def test_the_log_is_what_was_written(tmp_path: Path, dataset: Any) -> None:
    log = load(dataset(tmp_path)).logs[0]
    t = log.time + 0.2
    np.testing.assert_allclose(log.controls["ctrl:servo"], np.sin(3 * t + 0.1), atol=1e-9)
    np.testing.assert_allclose(log.channels["joint:hinge:pos"].values, np.sin(3 * t), atol=5e-3)
    gyro, quat = log.channels["sensor:gyro"], log.channels["body:base:quat"]
    assert gyro.mask is None
    np.testing.assert_allclose(gyro.values[:, 2], yaw_rate(t), atol=5e-2)
    assert quat.rate == pytest.approx(40)
    assert quat.mask is not None
    assert quat.mask.mean() == pytest.approx(0.4, abs=0.01)
    seen = quat.values[quat.mask]
    np.testing.assert_allclose(2 * np.arctan2(seen[:, 3], seen[:, 0]), yaw(t[quat.mask]), atol=2e-3)


def test_a_clock_offset_is_found_with_its_number_and_nothing_is_shifted(tmp_path: Path, dataset: Any) -> None:
    path = dataset(tmp_path, late=0.0123)
    warnings = told(path, "warning", "error")
    finding = next(f for f in check(path) if f.where == "channels.sensor:gyro")
    size, deviation = (float(x) for x in finding.message.split(" ms")[0].removeprefix("comes ").split(" ± "))
    assert abs(size - 12.3) < max(4 * deviation, 0.3)
    assert deviation < 0.5
    assert "after body:base:quat" in finding.message
    assert "nothing was shifted" in finding.message
    assert "sensor_delay:sensor:gyro" in finding.advice
    assert "streams./imu: in 3 of 3 logs, first run_0: stamped 12.3 ms after it was received" in warnings
    assert "error" not in warnings
    log = load(path).logs[0]
    np.testing.assert_allclose(log.channels["sensor:gyro"].values[:, 2], yaw_rate(log.time + 0.2 - 0.0123), atol=6e-2)


def test_the_offset_that_is_advised_is_taken_out(tmp_path: Path, dataset: Any) -> None:
    path = dataset(tmp_path, late=0.0123)
    advice = next(f.advice for f in check(path) if f.where == "channels.sensor:gyro" and f.severity == "warning")
    advised = re.search(r"write `(shift: (\S+))` under channels\.sensor:gyro", advice)
    assert advised
    assert float(advised[2]) == pytest.approx(0.0123, abs=0.0005)
    path.write_text(path.read_text().replace("unit: rad/s, noise: 0.01}\nseg", f"unit: rad/s, {advised[1]}}}\nseg"))
    assert advised[1] in path.read_text()
    said = told(path)
    assert "error" not in said
    assert "nothing was shifted" not in said
    assert "note channels.sensor:gyro: its stamps are taken to be 12." in said
    assert "its stamps shifted by -12." in said
    for log in load(path).logs:  # time zero is the first row that both clocks reach
        np.testing.assert_allclose(log.channels["sensor:gyro"].values[:, 2], yaw_rate(log.time + 0.2), atol=6e-2)


def test_what_a_shift_leaves_is_advised_on_top(tmp_path: Path, dataset: Any) -> None:
    edit = ("unit: rad/s, noise: 0.01}\nseg", "unit: rad/s, noise: 0.01, shift: 0.004}\nseg")
    finding = next(
        f for f in check(dataset(tmp_path, edit, late=0.0123)) if "sensor:gyro" in f.where and f.severity == "warning"
    )
    assert "nothing was shifted beyond its `shift` of 0.004 s" in finding.message
    advised = re.search(r"`shift: (\S+)`", finding.advice)
    assert advised
    assert float(advised[1]) == pytest.approx(0.0123, abs=0.0005)


def test_a_shift_longer_than_the_log_and_an_interval_are_refused(tmp_path: Path, dataset: Any) -> None:
    edit = ("unit: rad/s, noise: 0.01}\nseg", "unit: rad/s, noise: 0.01, shift: -6}\nseg")
    said = told(dataset(tmp_path / "long", edit), "error")
    assert "channels.sensor:gyro.shift: in 3 of 3 logs, first run_0: -6 s is no shorter than the log" in said
    said = told(dataset(tmp_path / "rows", ("time: {column: /js.time}", "time: {interval: 0.01}")), "error")
    assert "`interval` is for logs without a clock" in said
    assert "/js.time" in said


def test_a_gap_is_a_mask_for_a_sensor_and_an_error_in_the_base(tmp_path: Path, dataset: Any) -> None:
    path = dataset(tmp_path, ("time: {column: /js.time}", "time: {column: /imu.time}"), gap=(3.0, 3.04))
    log = load(path).logs[0]
    mask = log.channels["body:base:quat"].mask
    assert mask is not None
    assert "pause" in told(path, "warning")
    assert "a gap of 0.6" in told(dataset(tmp_path / "wide", gap=(3.0, 3.6)), "error")


def test_late_commands_unset_headers_and_no_common_time_are_said(tmp_path: Path, dataset: Any) -> None:
    said = told(dataset(tmp_path, shift=0.004, header=False), "warning", "note")
    assert "its commands wait 4 ms on average for the next row of /js" in said
    assert "held from 100 Hz (receive time, as header.stamp is not always set)" in said
    apart = tmp_path / "apart"
    assert "no time in common" in told(dataset(apart, late=100.0), "error")
    assert "/js.received' as the time column" in told(apart / "mapping.yaml", "error")
    by_receipt = (apart / "mapping.yaml").read_text().replace("/js.time", "/js.received")
    (apart / "mapping.yaml").write_text(by_receipt)
    assert "error" not in told(apart / "mapping.yaml")
    assert "to the 100 Hz of /js (receive time)" in told(apart / "mapping.yaml")


def test_a_column_that_is_not_there_is_suggested(tmp_path: Path, dataset: Any) -> None:
    said = told(dataset(tmp_path, ("/js.position[hinge]", "/js.positon[hinge]")), "error")
    assert "no column '/js.positon[hinge]'" in said
    assert "did you mean '/js.position[hinge]'" in said


def test_a_bag_that_lost_all_topics_for_a_while_is_cut_there(tmp_path: Path, dataset: Any) -> None:
    path = dataset(tmp_path, ("time: {column: /js.time}", "time: {column: /js.time, gaps: cut}"), gap=(2.0, 3.0))
    logs = load(path).logs
    assert [log.name for log in logs] == [f"run_{k}/{n}" for k in range(3) for n in (1, 2)]
    for log in logs[:2]:
        t = log.exogenous["exo:time"] + 0.2
        np.testing.assert_allclose(log.channels["joint:hinge:pos"].values, np.sin(3 * t), atol=5e-3)
    assert "cut at its gaps: 2 stretches" in told(path, "note")
    assert told(path, "error") == ""
