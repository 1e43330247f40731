"""MATLAB files are looked through before SciPy's compiled reader trusts their tags: a damaged one ends no process."""

import io
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from scipy.sparse import eye_array

from nfc_gym.core import InputError
from nfc_gym.measured.mat_tags import require_sound
from nfc_gym.measured.readers import read_table


def _mat(**variables: object) -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables)
    return buffer.getvalue()


@pytest.mark.parametrize("packed", [False, True])
def test_matlab_files_of_every_kind_are_sound(packed: bool) -> None:
    fields = np.zeros(3, [("a", float), ("b", int)])
    cells = np.array([1, "x", np.zeros(3)], object)
    deep = {"t": np.arange(5), "n": {"z": 1.0}}
    content = {"m": np.eye(3), "c": np.array([1j]), "b": np.array([True]), "e": np.zeros((0, 3)), "s": "text"}
    content |= {"f": fields, "k": cells, "d": deep, "sparse": eye_array(3)}
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, content, do_compression=packed)
    require_sound(buffer.getvalue())


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        # SciPy's reader takes the next element, of type 0, for the numbers, and the process dies.
        (lambda b: b.replace(b"\1\0\1\0q\0\0\0\x09\0\0\0", b"\1" + bytes(11)), "unknown type 0"),
        (lambda b: b[:132] + b"\xff\xff\xff\x7f" + b[136:], "beyond the end"),
        (lambda b: b[:-3], "beyond the end"),
        (lambda b: b[:130], "tag cut short"),
        (lambda b: b[:128] + b"\x09" + b[129:], "element of type 9"),
        (lambda b: b.replace(struct.pack("<ii", 1, 4), struct.pack("<ii", 1, -4)), r"shape \(1, -4\)"),
    ],
)
def test_a_matlab_file_not_built_as_its_tags_say(tmp_path: Path, damage: Callable[[bytes], bytes], words: str) -> None:
    whole = _mat(q=np.arange(4.0))
    assert damage(whole) != whole
    file = tmp_path / "run.mat"
    file.write_bytes(damage(whole))
    with pytest.raises(InputError, match=rf"run\.mat: truncated or not a mat file \(.*{words}"):
        read_table(file)


def test_a_matlab_variable_twice(tmp_path: Path) -> None:
    (tmp_path / "run.mat").write_bytes(_mat(q=np.arange(4.0)) + _mat(q=np.arange(4.0))[128:])
    with pytest.raises(InputError, match=r"run\.mat: .*Duplicate variable name"):
        read_table(tmp_path / "run.mat")
