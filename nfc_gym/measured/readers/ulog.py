"""PX4 ULog files, by `pyulog`.

Columns are `<topic>.<field>`: `vehicle_attitude.q` (T, 4) with entries `vehicle_attitude.q[0]`; a topic's further
instances are `sensor_gyro[1].x`. Parameters are constants, `parameters.MPC_XY_P`, as they were at the start.

A sample's time is its `timestamp_sample`, when the sensor was read, where the topic has one. Commands (`actuator_*`,
`*_setpoint`) and topics without one are timed by `timestamp`, when they were sent: the `timestamp_sample` of a command
is that of the sample it answers to. `<topic>.received` is `timestamp`.
"""

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import broken, needed, parsing
from nfc_gym.measured.readers.streams import Stream, Streams

_HEADER, _PREFIX = 16, 3  # bytes before the first message, and of each message before its content
_COMMAND = re.compile(r"^actuator_|_setpoint")
_ENTRY = re.compile(r"^(.+)\[(\d+)\]$")
_ADVICE = (
    "copy it again or leave it out of `logs`; of a log that was cut off, `pyulog` writes what is whole: "
    "ULog('old.ulg').write_ulog('new.ulg')"
)


def read_ulog(path: Path) -> Streams:
    """All topics of a flight log.

    Raises:
      InputError: `pyulog` is not installed, or the file is cut off, damaged, or holds no data.
    """
    pyulog = needed(path, "pyulog", "px4")
    with parsing(path, _ADVICE), contextlib.redirect_stdout(io.StringIO()), path.open("rb") as file:
        log = pyulog.ULog(file)
    if log.file_corruption:
        raise broken(path, "it holds bytes that are no message", _ADVICE)
    if not log.has_data_appended:
        _require_whole(path)
    timed = [data for data in log.data_list if "timestamp" in data.data]
    left_out = {data.name: "it has no timestamp" for data in log.data_list if "timestamp" not in data.data}
    streams = [_stream(data) for data in timed]
    if not streams:
        raise InputError(f"{path}: no topic was logged; log some (SDLOG_MODE, SDLOG_PROFILE), or leave the file out")
    return Streams(streams, left_out, {f"parameters.{k}": v for k, v in log.initial_parameters.items()})


def _require_whole(path: Path) -> None:
    """The last message must end where the file does: `pyulog` reads on to wherever a file was cut off."""
    content = path.read_bytes()
    at = _HEADER
    while at + _PREFIX <= len(content):
        at += _PREFIX + int.from_bytes(content[at : at + 2], "little")
    if at != len(content):
        raise broken(path, f"its last message is cut off at byte {len(content)}", _ADVICE)


def _stream(data: Any) -> Stream:
    """One topic's samples."""
    name = data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
    sent = _nanoseconds(data.data["timestamp"])
    taken = data.data.get("timestamp_sample")
    stamps, clock = sent, "timestamp"
    if taken is not None and not _COMMAND.search(data.name) and len(taken) and taken.min() > 0:
        stamps, clock = _nanoseconds(taken), "timestamp_sample"
    return Stream(name, stamps, sent, clock, _columns(data.data))


def _nanoseconds(microseconds: NDArray[Any]) -> NDArray[np.int64]:
    return microseconds.astype(np.int64) * 1000


def _columns(fields: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Fields by name; `q[0]`, `q[1]`, ... become one array `q` (T, k)."""
    entries: dict[str, list[NDArray[Any]]] = {}
    for name, values in fields.items():
        match = _ENTRY.match(name)
        entries.setdefault(match[1] if match else name, []).append(values)
    single = {name for name in fields if not _ENTRY.match(name)}
    return {name: v[0] if name in single else np.stack(v, 1) for name, v in entries.items()}
