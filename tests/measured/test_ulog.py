"""ULog files, written byte by byte from the published format, come back field by field; damaged ones are refused."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from writers import ULOG_MAGIC, write_ulog

from nfc_gym.core import InputError
from nfc_gym.measured.align import Use, align
from nfc_gym.measured.readers import Streams, read_table

pytest.importorskip("pyulog", reason="needs pyulog: pip install 'nfc_gym[px4]'")
US = 1_000_000
SENSOR = np.arange(0, 2, 0.004)
COMMAND = np.arange(0.1, 2, 0.01)


def flight(path: Path) -> Path:
    taken, sent = np.round(SENSOR * US) + US, np.round(COMMAND * US) + US
    quat = np.stack([np.cos(SENSOR / 2), 0 * SENSOR, 0 * SENSOR, np.sin(SENSOR / 2)], 1)
    motors = np.stack([np.sin(COMMAND), COMMAND], 1)
    return write_ulog(
        path,
        {
            "vehicle_attitude": {"timestamp": taken + 800, "timestamp_sample": taken, "q": quat},
            "sensor_gyro": {"timestamp": taken, "x": 2 * SENSOR},
            "sensor_gyro[1]": {"timestamp": taken, "x": 3 * SENSOR},
            "actuator_motors": {"timestamp": sent, "timestamp_sample": sent - 3000, "control": motors},
        },
        {"MPC_XY_P": 0.95},
    )


def test_topics_instances_arrays_parameters_and_stamps(tmp_path: Path) -> None:
    table = read_table(flight(tmp_path / "log.ulg"))
    assert isinstance(table, Streams)
    np.testing.assert_array_equal(table["sensor_gyro.x"], (2 * SENSOR).astype(np.float32))
    np.testing.assert_array_equal(table["sensor_gyro[1].x"], (3 * SENSOR).astype(np.float32))
    assert table["vehicle_attitude.q"].shape == (len(SENSOR), 4)
    assert table["parameters.MPC_XY_P"] == np.float32(0.95)
    assert {s.name: s.clock for s in table.streams} == {
        "vehicle_attitude": "timestamp_sample",
        "sensor_gyro": "timestamp",
        "sensor_gyro[1]": "timestamp",
        "actuator_motors": "timestamp",  # a command counts from when it was sent
    }
    attitude = next(s for s in table.streams if s.name == "vehicle_attitude")
    np.testing.assert_array_equal(attitude.received - attitude.stamps, 800_000)
    np.testing.assert_allclose(table["vehicle_attitude.time"], SENSOR, atol=1e-6)


def test_streams_are_brought_to_one_time(tmp_path: Path) -> None:
    table = read_table(flight(tmp_path / "log.ulg"))
    quat = tuple(f"vehicle_attitude.q[{i}]" for i in range(4))
    uses = [
        Use(quat, "slerp", True),
        Use(("actuator_motors.control[1]",), "hold"),
        Use(("sensor_gyro[1].x",), "linear", True),
    ]
    found = align(table, "sensor_gyro.time", uses)
    t = found.table["sensor_gyro.time"]
    np.testing.assert_allclose(found.table[quat[3]], np.sin(t / 2), atol=1e-6)
    np.testing.assert_allclose(found.table["sensor_gyro[1].x"], 3 * t, atol=1e-6)
    last = COMMAND[np.searchsorted(np.round(COMMAND * US), np.round(t * US), side="right") - 1]
    np.testing.assert_allclose(found.table["actuator_motors.control[1]"], last, rtol=1e-6)


@pytest.mark.parametrize("part", [0.001, 0.3, 0.5, 0.999])
def test_a_log_that_was_cut_off_is_refused(tmp_path: Path, part: float) -> None:
    path = flight(tmp_path / "log.ulg")
    whole = path.read_bytes()
    path.write_bytes(whole[: max(int(part * len(whole)), 1)])
    with pytest.raises(InputError, match=r"log\.ulg: truncated or not a ulg file .*write_ulog"):
        read_table(path)


def test_what_pyulog_saves_of_a_log_that_was_cut_off_is_read(tmp_path: Path) -> None:
    """The advice of the error works."""
    from pyulog import ULog

    path = flight(tmp_path / "log.ulg")
    whole = read_table(path)
    path.write_bytes(path.read_bytes()[:-5])
    ULog(str(path)).write_ulog(str(tmp_path / "new.ulg"))
    saved = read_table(tmp_path / "new.ulg")
    assert set(saved) == set(whole)
    lengths = [len(whole[n]) - len(saved[n]) for n in whole if whole[n].ndim]
    assert set(lengths) == {0, 1}


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(min_size=1, max_size=300), honest=st.booleans())
def test_garbage_never_raises_anything_else(tmp_path: Path, content: bytes, honest: bool) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes((ULOG_MAGIC + bytes(8)) * honest + content)
    with pytest.raises(InputError):
        read_table(path)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_refused_or_harmless(tmp_path: Path, at: float, bit: int) -> None:
    path = tmp_path / "log.ulg"
    times = 1000 * np.arange(1, 20)
    content = bytearray(write_ulog(path, {"sensor_gyro": {"timestamp": times, "x": np.arange(19.0)}}).read_bytes())
    content[int(at * len(content))] ^= 1 << bit
    path.write_bytes(content)
    try:
        table = read_table(path)
    except InputError:
        return
    assert isinstance(table, Streams)


def test_a_log_without_data_and_an_absent_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no topic was logged"):
        read_table(write_ulog(tmp_path / "empty.ulg", {}))
    path = flight(tmp_path / "log.ulg")
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(InputError, match=r"needs pyulog, which is not installed; pip install 'nfc_gym\[px4\]'"):
        read_table(path)
