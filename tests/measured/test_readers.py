"""Readers: what is written comes back; what is damaged, foreign or empty is refused by name."""

import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nfc_gym.core import InputError
from nfc_gym.core.units import UNITS, si_unit, spread_to_si, to_si
from nfc_gym.measured.columns import LogColumns
from nfc_gym.measured.entries import Measured
from nfc_gym.measured.readers import csv_file, read_table, register_reader, suffixes

T = np.linspace(0, 1, 200)
Q = np.random.default_rng(0).standard_normal(200)

Writer = Callable[[Path], object]
WRITERS: dict[str, Writer] = {
    ".csv": lambda p: pd.DataFrame({"t": T, "q": Q}).to_csv(p, index=False),
    ".parquet": lambda p: pq.write_table(pa.table({"t": T, "q": Q}), p),
    ".npz": lambda p: np.savez_compressed(p, t=T, q=Q),
    ".mat": lambda p: scipy.io.savemat(p, {"t": T[:, None], "q": Q[None, :]}, do_compression=True),
}


@pytest.mark.parametrize("suffix", WRITERS)
def test_round_trip(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    WRITERS[suffix](path)
    table = read_table(path)
    assert set(table) == {"t", "q"}
    np.testing.assert_allclose(table["t"], T, rtol=1e-15)
    np.testing.assert_allclose(table["q"], Q, rtol=1e-14)


@pytest.mark.parametrize("suffix", [".parquet", ".npz", ".mat"])
@pytest.mark.parametrize("part", [0.02, 0.5, 0.97])
def test_a_truncated_file_is_refused_by_name(tmp_path: Path, suffix: str, part: float) -> None:
    path = tmp_path / f"log{suffix}"
    WRITERS[suffix](path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(InputError, match=rf"log\{suffix}.*truncated or not a {suffix[1:]} file.*copy it again"):
        read_table(path)


@pytest.mark.parametrize("suffix", WRITERS)
def test_an_empty_file_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(b"")
    with pytest.raises(InputError, match="the file is empty"):
        read_table(path)


@pytest.mark.parametrize("suffix", [".parquet", ".npz", ".mat"])
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(min_size=1, max_size=300))
def test_garbage_never_raises_anything_else(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_table(path)


def test_a_bit_flipped_inside_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    WRITERS[".npz"](path)
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(InputError, match="truncated or not a npz file"):
        read_table(path)


def test_missing_files_folders_and_unknown_suffixes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_table(tmp_path / "absent.csv")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        read_table(tmp_path / "folder.csv")
    with pytest.raises(InputError, match=r"no reader for \.xlsx; known: \.csv, \.parquet, \.npz, \.mat"):
        read_table(tmp_path / "log.xlsx")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,q,q\n0,1,2\n", "column 'q' appears 2 times"),
        ("t,q\n", "no rows under the header"),
        ("t,q\n0,1,2\n1,2,3\n", "more fields than the header names"),
        ("t,q\n0,1\n1,2,3\n", "truncated or not a csv file"),
        ("t,q,u\n0,1.25,2\n1,1.2", "last row is cut off, '1,1.2' where 3 fields are wanted; remove that row"),
        ("# made by a logger\n# on a Monday\nt,q\n0,1\n", "begins with a comment; the first line must be the columns'"),
    ],
)
def test_faulty_csv(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_table(path)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_separators_quotes_and_marks(tmp_path: Path, separator: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "\ufeff" + separator.join(['"joint:hinge:pos"', " on"]) + "\r\n" + separator.join(["0.5", "True"]) + "\r\n"
    )
    table = read_table(path)
    assert table["joint:hinge:pos"][0] == 0.5
    assert table["on"][0]


def test_csv_that_ends_without_a_line_end_and_names_that_hold_separators(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text('"t, s";"angle, rad, shaft"\n0;1.5\n0.1;2.5')
    assert read_table(path)["angle, rad, shaft"].tolist() == [1.5, 2.5]
    path.write_text("t,q,\n0,1.5\n0.1,2.5")  # every row lacks the last field
    assert read_table(path)["q"].tolist() == [1.5, 2.5]


@pytest.mark.parametrize(("encoding", "byte"), [("cp1252", "0xb0"), ("utf-16", "0xff")])
def test_csv_of_another_encoding_says_so(tmp_path: Path, encoding: str, byte: str) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes("t;Winkel (°)\n0;1.5\n0.1;2.5\n".encode(encoding))
    with pytest.raises(InputError, match=rf"is no UTF-8 text \(byte {byte}\); save it with that encoding"):
        read_table(path)


def test_long_csv_is_read_in_pieces_and_its_faults_are_found_in_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csv_file, "_ROWS", 64)
    path = tmp_path / "log.csv"
    pd.DataFrame({"t": T, "q": Q, "note": ["idle"] * 200, "count": range(200)}).to_csv(path, index=False)
    table = read_table(path, names={"t", "q", "count"})
    np.testing.assert_array_equal(table["q"], Q)
    np.testing.assert_array_equal(table["count"], np.arange(200))
    assert table["note"].size == 0
    assert read_table(path)["note"].tolist() == ["idle"] * 200
    path.write_text(path.read_text() + "1,2,idle,3,4\n")
    with pytest.raises(InputError, match="truncated or not a csv file"):
        read_table(path, names={"t", "q"})


@pytest.mark.parametrize("suffix", [".parquet", ".npz"])
def test_what_nobody_asks_for_is_not_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    columns = {"t": np.arange(4000.0), "q": np.ones((4000, 3)), "picture": np.zeros((4000, 500))}
    if suffix == ".npz":
        np.savez(path, **columns)
    else:
        lists = {
            k: v if v.ndim == 1 else pa.FixedSizeListArray.from_arrays(v.ravel(), v.shape[1])
            for k, v in columns.items()
        }
        pq.write_table(pa.table(lists), path)
    table = read_table(path, names={"t", "q[1]", "qq"})
    np.testing.assert_array_equal(table["t"], columns["t"])
    assert table["q"].shape == (4000, 3)
    assert list(table) == ["t", "q", "picture"]  # the name is there, to be suggested
    assert table["picture"].size == 0
    assert read_table(path)["picture"].shape == (4000, 500)


@pytest.mark.parametrize(("written", "asked"), [("NFD", "NFC"), ("NFC", "NFD")])
def test_accented_letters_are_one_name_however_they_are_written(tmp_path: Path, written: Any, asked: Any) -> None:
    path = tmp_path / "log.csv"
    path.write_text(unicodedata.normalize(written, "t,Größe,gültig\n0,1,1\n1,2,0\n"), encoding="utf-8")
    name, mask = (unicodedata.normalize(asked, n) for n in ("Größe", "gültig"))
    entry = Measured.model_validate({"column": name, "unit": "m", "mask": mask})
    columns = LogColumns(read_table(path, names={"t", *entry.columns, str(entry.mask)}))
    columns.time("t")
    assert columns.one(entry.columns[0]).tolist() == [1, 2]
    assert columns.mask(str(entry.mask)).tolist() == [True, False]


def test_pickled_objects_are_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    np.savez(path, t=np.array([{"a": 1}], object))
    with pytest.raises(InputError, match="Python objects, which are not opened"):
        read_table(path)


def test_matlab_structs_and_version_7_3(tmp_path: Path) -> None:
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, {"run": {"t": T, "gain": 35.15}})
    table = read_table(path)
    np.testing.assert_array_equal(table["run.t"], T)
    assert table["run.gain"].item() == 35.15
    for text in (b"MATLAB 7.3 MAT-file", b"MATLAB 7.0 MAT-file, HDF5 schema 0.05"):
        path.write_bytes(text.ljust(512, b"\0") + b"\x89HDF\r\n")
        with pytest.raises(InputError, match=r"v7\.3.*'-v7'"):
            read_table(path)


def test_matlab_arrays_of_structs_as_simulink_writes_them(tmp_path: Path) -> None:
    path = tmp_path / "log.mat"
    signals = np.zeros((1, 2), [("values", "O"), ("label", "O")])
    for i in range(2):
        signals[0, i] = (i + 1) * Q[:, None], f"scope {i}"
    scipy.io.savemat(path, {"out": {"time": T[:, None], "signals": signals}})
    table = read_table(path)
    np.testing.assert_array_equal(table["out.signals[1].values"], 2 * Q)
    columns = LogColumns(table)
    columns.time("out.time")
    np.testing.assert_array_equal(columns.one("out.signals[0].values"), Q)


def test_parquet_lists_are_columns_and_dates_are_seconds(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    stamps = pd.to_datetime(["2024-01-01T00:00:00.25", "2024-01-01T00:00:01.75"])
    pq.write_table(pa.table({"t": stamps, "q": [[1.0, 2.0], [3.0, 4.0]]}), path)
    table = read_table(path)
    assert table["q"].shape == (2, 2)
    assert np.diff(table["t"]).item() == pytest.approx(1.5, abs=1e-6)


def test_parquet_rows_without_a_date_or_a_list_are_no_numbers(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    stamps = pd.to_datetime(["2024-01-01T00:00:00.25", None, "2024-01-01T00:00:01.75"])
    pq.write_table(pa.table({"t": stamps, "q": [[1.0, 2.0], [3.0, 4.0], None]}), path)
    table = read_table(path)
    assert np.isnan(table["t"]).tolist() == [False, True, False]
    np.testing.assert_array_equal(table["q"], [[1, 2], [3, 4], [np.nan, np.nan]])


def test_a_reader_can_be_added(tmp_path: Path) -> None:
    register_reader(".toy", lambda path: {"t": np.arange(3.0)})
    (tmp_path / "log.TOY").write_text("x")
    assert ".toy" in suffixes()
    assert len(read_table(tmp_path / "log.TOY")["t"]) == 3


@given(arrays(float, (7, 3), elements=st.floats(-1e6, 1e6)), st.integers(0, 2))
def test_columns_of_arrays_are_addressed_by_index(values: np.ndarray, k: int) -> None:
    columns = LogColumns({"t": np.arange(7.0), "q": values, "gain": np.array(2.5)})
    columns.time("t")
    np.testing.assert_array_equal(columns.one(f"q[{k}]"), values[:, k])
    np.testing.assert_array_equal(columns.many(("q",)), values)
    np.testing.assert_array_equal(columns.one("gain"), np.full(7, 2.5))
    np.testing.assert_array_equal(columns.product((f"q[{k}]", "gain"), 2.0), values[:, k] * 2.5 * 2.0)
    with pytest.raises(InputError, match="columns 0 to 2"):
        columns.one("q[3]")
    with pytest.raises(InputError, match=r"shape \(3, 7\) where time has 7 rows; turn it over"):
        LogColumns({"q": values.T}, 7).one("q")
    with pytest.raises(InputError, match=r"no column 'qq'; valid: t, q, gain|did you mean"):
        columns.one("qq")


def test_masks_are_truth_values() -> None:
    columns = LogColumns({"t": np.arange(3.0), "on": np.array([0, 1, 1]), "odd": np.array([0, 2, 1])})
    columns.time("t")
    assert columns.mask("on").tolist() == [False, True, True]
    with pytest.raises(InputError, match="holds 2 at row 1"):
        columns.mask("odd")


@given(st.sampled_from(UNITS), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_units_are_affine_and_idempotent(unit: str, a: float, b: float) -> None:
    assert si_unit(si_unit(unit)) == si_unit(unit)
    assert to_si(a, si_unit(unit)) == a
    assert to_si(a, unit) - to_si(b, unit) == pytest.approx(spread_to_si(a - b, unit), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (180, "deg", np.pi),
        (60, "rpm", 2 * np.pi),
        (1, "g", 9.80665),
        (20, "degC", 293.15),
        (50, "%", 0.5),
        (7, "ms", 0.007),
    ],
)
def test_units_by_hand(value: float, unit: str, expected: float) -> None:
    assert to_si(value, unit) == pytest.approx(expected)


def test_an_unknown_unit_lists_the_known() -> None:
    with pytest.raises(InputError, match=r"unknown unit 'degs'; did you mean 'deg.*known units: 1, %"):
        to_si(1.0, "degs")
