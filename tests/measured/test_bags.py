"""Bags that `rosbags` writes come back field by field and stamp by stamp; damaged ones are refused by name."""

import sys
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from writers import NS, START, Messages, typestore, write_bag

from nfc_gym.core import InputError
from nfc_gym.measured.align import Use, align
from nfc_gym.measured.columns import LogColumns
from nfc_gym.measured.entries import TimeColumn
from nfc_gym.measured.log_time import time_of
from nfc_gym.measured.readers import Streams, read_table

pytest.importorskip("rosbags", reason="needs rosbags: pip install 'nfc_gym[ros]'")
STORE = typestore()
make = Messages(STORE)
KINDS = ("mcap", "sqlite3", "ros1")


def low(i: int, ns: int, spare: int = 0) -> Any:
    motors = [
        make("machine_msgs/msg/Motor", q=0.5 * i, torque=float(-i)),
        make("machine_msgs/msg/Motor", q=1.0, torque=0.1),
    ]
    return make(
        "machine_msgs/msg/Low", header=make.header(ns), motor=motors, gyro=np.array([i, 2.0 * i, 0.3]),
        spare=np.arange(float(spare)), on=i % 2 == 0, text="moving",
    )  # fmt: skip


def low_bag(path: Path, kind: str = "mcap", only: bool = False, count: int = 50) -> Path:
    messages = [(START + i * 10**7 + 5_000_000, low(i, START + i * 10**7)) for i in range(count)]
    return write_bag(path, STORE, {"/low": ("machine_msgs/msg/Low", messages)}, kind, only)


@pytest.mark.parametrize(("kind", "only"), [*((k, False) for k in KINDS), ("mcap", True), ("sqlite3", True)])
def test_a_message_type_that_only_the_bag_knows(tmp_path: Path, kind: str, only: bool) -> None:
    table = read_table(low_bag(tmp_path / "run", kind, only))
    assert isinstance(table, Streams)
    i = np.arange(50.0)
    np.testing.assert_array_equal(table["/low.motor[0].q"], 0.5 * i)
    np.testing.assert_array_equal(table["/low.motor[0].torque"], -i)
    np.testing.assert_array_equal(table["/low.motor[1].torque"], np.full(50, 0.1))
    np.testing.assert_array_equal(table["/low.gyro"], np.stack([i, 2 * i, np.full(50, 0.3)], 1))
    np.testing.assert_array_equal(table["/low.on"], i % 2 == 0)
    np.testing.assert_array_equal(table["/low.time"], np.arange(50) * 10**7 * 1e-9)
    np.testing.assert_array_equal(table.streams[0].stamps, START + np.arange(50) * 10**7)
    np.testing.assert_array_equal(table.streams[0].received - table.streams[0].stamps, 5_000_000)
    assert table.streams[0].clock == "header.stamp"
    assert not [name for name in table if "text" in name or "spare" in name or "frame_id" in name]


def test_arrays_that_cannot_be_columns_are_left_out_by_name(tmp_path: Path) -> None:
    messages = [(START + i, low(i, START + i, spare=i % 3 + 1)) for i in range(9)]
    blobs = [(START + i, make("std_msgs/msg/String", data="x" * 70_000)) for i in range(2)]
    topics = {"/low": ("machine_msgs/msg/Low", messages), "/blob": ("std_msgs/msg/String", blobs)}
    table = read_table(write_bag(tmp_path / "run", STORE, topics))
    assert table.left_out["/low.spare"] == "its length changes, from 1 to 3"
    assert table.left_out["/blob"] == "its messages are larger than 64 KiB"
    with pytest.raises(InputError, match=r"'/low.spare\[0\]' cannot be used: /low.spare: its length changes"):
        align(table, "/low.time", [Use(("/low.spare[0]",), "linear", True)])
    with pytest.raises(InputError, match=r"'/blob.data' cannot be used: /blob: its messages are larger"):
        align(table, "/low.time", [Use(("/blob.data",), "linear", True)])


def test_joints_are_addressed_by_name_whatever_their_order(tmp_path: Path) -> None:
    def state(i: int) -> Any:
        names = ["hip", "knee"] if i % 2 else ["knee", "hip"]
        value = {"hip": i, "knee": 100 + i}
        return START + i, make.joints(START + i, names, [value[n] for n in names])

    path = write_bag(tmp_path / "a", STORE, {"/js": ("sensor_msgs/msg/JointState", [state(i) for i in range(8)])})
    table = read_table(path)
    np.testing.assert_array_equal(table["/js.position[hip]"], np.arange(8.0))
    np.testing.assert_array_equal(table["/js.position[knee]"], 100 + np.arange(8.0))
    assert "/js.position" not in table
    with pytest.raises(InputError, match=r"address it by name"):
        align(table, "/js.time", [Use(("/js.position[0]",), "linear", True)])
    steady = [(START + i, make.joints(START + i, ["hip", "knee"], [i, -i])) for i in range(8)]
    table = read_table(write_bag(tmp_path / "b", STORE, {"/js": ("sensor_msgs/msg/JointState", steady)}))
    np.testing.assert_array_equal(table["/js.position"][:, 1], table["/js.position[knee]"])
    assert "/js.velocity" not in table  # empty in every message


def test_joints_with_accents_are_addressed_however_they_were_written(tmp_path: Path) -> None:
    name = unicodedata.normalize("NFD", "hüfte")
    messages = [(START + i * NS, make.joints(START + i * NS, [name], [0.1 * i])) for i in range(5)]
    table = read_table(write_bag(tmp_path / "bag", STORE, {"/js": ("sensor_msgs/msg/JointState", messages)}))
    assert isinstance(table, Streams)
    column = unicodedata.normalize("NFC", "/js.position[hüfte]")
    np.testing.assert_allclose(table[column], 0.1 * np.arange(5))
    assert table.owner(column) is table.streams[0]


def test_two_publishers_of_one_topic_are_two_sampled_sets_of_joints(tmp_path: Path) -> None:
    both = [(START + i * NS, make.joints(START + i * NS, ["arm"] if i % 2 else ["leg"], [i])) for i in range(10)]
    grid = [(START + i * NS, make.command(START + i * NS, i)) for i in range(10)]
    topics = {"/js": ("sensor_msgs/msg/JointState", both), "/cmd": ("machine_msgs/msg/Stamped", grid)}
    table = read_table(write_bag(tmp_path / "run", STORE, topics))
    found = align(table, "/cmd.time", [Use(("/js.position[arm]",), "linear", True)])
    row = found.table["/js.position[arm]"]
    np.testing.assert_array_equal(row[1::2], [1, 3, 5, 7, 9])  # kept at its own samples, as it is slower than /cmd
    assert np.isnan(row[::2]).all()
    assert found.rates == {"/js.position[arm]": pytest.approx(0.5)}


def test_frames_of_tf_are_topics(tmp_path: Path) -> None:
    def frames(i: int) -> Any:
        def transform(child: str, x: float) -> Any:
            pose = make("geometry_msgs/msg/Transform", translation=make.vector(x),
                        rotation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0))  # fmt: skip
            return make(
                "geometry_msgs/msg/TransformStamped",
                header=make.header(START + i),
                child_frame_id=child,
                transform=pose,
            )

        both = [transform("base", i), transform("tool", -i)]
        return START + 7 + i, make("tf2_msgs/msg/TFMessage", transforms=both if i % 2 else both[:1])

    path = write_bag(tmp_path / "run", STORE, {"/tf": ("tf2_msgs/msg/TFMessage", [frames(i) for i in range(6)])})
    table = read_table(path)
    np.testing.assert_array_equal(table["/tf[base].transform.translation.x"], np.arange(6.0))
    np.testing.assert_array_equal(table["/tf[tool].transform.translation.x"], [-1.0, -3.0, -5.0])
    assert {s.clock for s in table.streams} == {"header.stamp"}


def test_topics_that_nobody_asks_for_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rosbags.highlevel import AnyReader

    decoded: list[str] = []
    plain = AnyReader.deserialize
    monkeypatch.setattr(
        AnyReader, "deserialize", lambda self, raw, kind: decoded.append(kind) or plain(self, raw, kind)
    )
    messages = [(START + i, low(i, START + i)) for i in range(9)]
    commands = [(START + i, make.command(START + i, i)) for i in range(9)]
    topics = {"/low": ("machine_msgs/msg/Low", messages), "/low_cmd": ("machine_msgs/msg/Stamped", commands)}
    table = read_table(write_bag(tmp_path / "run", STORE, topics), names={"/low_cmd.data", "/low_cmd.time"})
    np.testing.assert_array_equal(table["/low_cmd.data"], np.arange(9.0))
    assert "/low.motor[0].q" in table  # it can still be suggested
    assert sorted(decoded) == ["machine_msgs/msg/Low"] + ["machine_msgs/msg/Stamped"] * 9


def test_stamps_that_were_never_set_are_not_believed(tmp_path: Path) -> None:
    unset = [(START + i * 10**8, make.command(0, i)) for i in range(5)]
    plain = [(START + i * 10**8, make("std_msgs/msg/Float64", data=float(i))) for i in range(5)]
    topics = {"/unset": ("machine_msgs/msg/Stamped", unset), "/plain": ("std_msgs/msg/Float64", plain)}
    table = read_table(write_bag(tmp_path / "run", STORE, topics))
    assert {s.name: s.clock for s in table.streams} == {
        "/unset": "receive time, as header.stamp is not always set",
        "/plain": "receive time, as its messages have no stamp",
    }
    np.testing.assert_allclose(table["/unset.time"], np.arange(5) * 0.1)


def test_a_topic_whose_own_stamps_go_back_may_be_timed_by_its_receipt(tmp_path: Path) -> None:
    stamps = START + np.array([1, 2, 3, 2, 3, 4]) * NS // 100
    messages = [(START + i * NS // 100, make.command(int(ns), 0.1 * i)) for i, ns in enumerate(stamps)]
    table = read_table(write_bag(tmp_path / "bag", STORE, {"/u": ("machine_msgs/msg/Stamped", messages)}))
    with pytest.raises(InputError, match=r"goes back at row 3.*; or name '/u\.received', or the time of another topic"):
        time_of(TimeColumn(columns=("/u.time",)), LogColumns(table), ["/u.data"])
    np.testing.assert_allclose(
        time_of(TimeColumn(columns=("/u.received",)), LogColumns(table), []), 0.01 * np.arange(6)
    )


def test_a_bag_of_several_files_is_one_log(tmp_path: Path) -> None:
    folder = low_bag(tmp_path / "run", "sqlite3")
    file = next(folder.glob("*.db3"))
    (folder / "more.db3").write_bytes(file.read_bytes())
    text = (folder / "metadata.yaml").read_text()
    assert "message_count: 50" in text
    twice = text.replace(f"- {file.name}", f"- {file.name}\n  - more.db3").replace(
        "message_count: 50", "message_count: 100"
    )
    (folder / "metadata.yaml").write_text(twice)
    assert len(read_table(folder)["/low.time"]) == 100


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("part", [0.02, 0.5, 0.97])
def test_a_recording_that_was_cut_off_is_refused(tmp_path: Path, kind: str, part: float) -> None:
    path = low_bag(tmp_path / "run", kind, kind != "ros1", count=400)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    for broken in (path, path.parent) if kind != "ros1" else (path,):
        with pytest.raises(InputError, match=rf"{broken.name}: truncated or not a .*mcap recover"):
            read_table(broken)


def test_a_folder_whose_files_hold_less_than_it_says(tmp_path: Path) -> None:
    folder = low_bag(tmp_path / "run", "sqlite3")
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("message_count: 50", "message_count: 51"))
    with pytest.raises(InputError, match="51 messages are announced, 50 are there"):
        read_table(folder)
    (folder / "metadata.yaml").unlink()
    with pytest.raises(InputError, match=r"without metadata\.yaml.*ros2 bag reindex"):
        read_table(folder)


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(min_size=1, max_size=300), honest=st.booleans())
def test_garbage_never_raises_anything_else(tmp_path: Path, suffix: str, content: bytes, honest: bool) -> None:
    magic = {".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\x00", ".bag": b"#ROSBAG V2.0\n"}[suffix]
    path = tmp_path / f"log{suffix}"
    path.write_bytes(magic * honest + content)
    with pytest.raises(InputError, match=r"truncated or not a"):
        read_table(path)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_refused_or_harmless(tmp_path: Path, at: float, bit: int) -> None:
    path = tmp_path / "run" / "run.mcap"
    if not path.exists():
        low_bag(tmp_path / "run")
        (tmp_path / "whole").write_bytes(path.read_bytes())
    content = bytearray((tmp_path / "whole").read_bytes())
    content[int(at * len(content))] ^= 1 << bit
    path.write_bytes(content)
    try:
        table = read_table(path)
    except InputError:
        return
    assert isinstance(table, Streams)


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_a_compressed_recording_is_read_by_its_folder(tmp_path: Path, mode: str) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer as bag:
        connection = bag.add_connection("/u", "machine_msgs/msg/Stamped", typestore=STORE)
        for i in range(20):
            ns = START + i * NS
            bag.write(connection, ns, STORE.serialize_cdr(make.command(ns, float(i)), "machine_msgs/msg/Stamped"))
    np.testing.assert_array_equal(read_table(tmp_path / "bag")["/u.data"], np.arange(20))
    file = next(p for p in (tmp_path / "bag").iterdir() if p.name != "metadata.yaml")
    with pytest.raises(InputError, match=r"compressed.* name the .*folder"):
        read_table(file)


def test_an_mcap_file_of_other_messages_says_so(tmp_path: Path) -> None:
    path = write_bag(
        tmp_path / "bag",
        STORE,
        {"/u": ("std_msgs/msg/Float64", [(START, make("std_msgs/msg/Float64", data=1.0))])},
        only=True,
    )
    content = path.read_bytes()
    header = b"\x89MCAP0\r\n\x01"
    assert content.startswith(header)
    size = int.from_bytes(content[9:17], "little")
    foreign = (9).to_bytes(4, "little") + b"protobufs"
    path.write_bytes(header + (size + 5).to_bytes(8, "little") + foreign + content[17 + 8 :])
    with pytest.raises(InputError, match="its profile is 'protobufs', and messages of ros2 alone are read"):
        read_table(path)


def test_an_empty_bag_and_an_absent_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    empty = write_bag(tmp_path / "empty", STORE, {"/low": ("machine_msgs/msg/Low", [])})
    with pytest.raises(InputError, match=r"no topic that can be read \(/low: no message was recorded\)"):
        read_table(empty)
    path = low_bag(tmp_path / "run")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r"needs rosbags, which is not installed; pip install 'nfc_gym\[ros\]'"):
        read_table(path)
