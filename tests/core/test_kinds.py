"""What lies at a path is told from its beginning, and nothing of another kind is written there."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from nfc_gym import assets
from nfc_gym.adaptation import policy, resume
from nfc_gym.core import InputError, kinds
from nfc_gym.inference import checkpoint, detector_file, state
from nfc_gym.simulate import witness


def tensors(path: Path, **metadata: str) -> Path:
    """A safetensors file without a tensor."""
    header = json.dumps({"__metadata__": metadata} if metadata else {"w": {}}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header)
    return path


def npz(path: Path, *names: str) -> Path:
    np.savez(path, **{name: np.zeros(3) for name in names})
    return path


def test_every_format_of_the_package_is_told(tmp_path: Path) -> None:
    formats = {
        checkpoint.FORMAT: kinds.POSTERIOR, detector_file.FORMAT: kinds.DETECTOR, policy.FORMAT: kinds.POLICY,
        state.FORMAT: kinds.TRAINING, resume.FORMAT: kinds.LEARNING,
    }  # fmt: skip
    for written, kind in formats.items():
        assert kinds.kind_of(tensors(tmp_path / "x", format=written)) == kind
    notes = json.dumps({"notes": {witness.MISFIT: True}})
    assert kinds.kind_of(tensors(tmp_path / "x", format=checkpoint.FORMAT, about=notes)) == kinds.STRUCTURE
    assert kinds.kind_of(assets.policy("JackalFlat-v0")) == kinds.POLICY


def test_what_is_not_ours_is_told(tmp_path: Path) -> None:
    assert kinds.kind_of(tensors(tmp_path / "x", format="pt")) == "weights of another program (format 'pt')"
    assert kinds.kind_of(tensors(tmp_path / "x")) == "weights of another program"
    (tmp_path / "x").write_bytes(b"some text that is longer than eight bytes")
    assert kinds.kind_of(tmp_path / "x") == "a file of another program"
    (tmp_path / "x").write_bytes(b"PK no archive")
    assert kinds.kind_of(tmp_path / "x") == "a damaged archive"
    assert kinds.kind_of(npz(tmp_path / "a.npz", "psi", "delta_s")) == kinds.DRAWS
    assert kinds.kind_of(npz(tmp_path / "a.npz", "states", "actions")) == kinds.WINDOW
    assert kinds.kind_of(npz(tmp_path / "a.npz", "run_0")) == kinds.ARRAYS
    assert kinds.kind_of(tmp_path / "gone") is None


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("manifest.json", {"psi_names": []}, kinds.WINDOWS),
        ("learned.json", {"of": {}}, kinds.LEARNED),
        ("envelope.json", {"family": "slip"}, kinds.DEMO),
        ("report.json", {"returns": {}, "verdict": None}, kinds.ADAPTED),
        ("report.json", {"verdict": "explained"}, kinds.REPORT),
        ("manifest.json", {"name": "of a web page"}, kinds.FOLDER),
    ],
)
def test_a_folder_is_told_by_its_own_file(tmp_path: Path, name: str, content: dict[str, object], kind: str) -> None:
    (tmp_path / name).write_text(json.dumps(content))
    assert kinds.kind_of(tmp_path) == kind


def test_ones_own_kind_and_nothing_are_free(tmp_path: Path) -> None:
    own = tensors(tmp_path / "own", format=policy.FORMAT)
    tensors(tmp_path / "own.training", format=resume.FORMAT)
    (tmp_path / "empty").touch()
    for path in (own, tmp_path / "empty", tmp_path / "gone"):
        kinds.require_kind(path, kinds.POLICY)
    (tmp_path / "posterior.training").mkdir()
    tensors(tmp_path / "posterior.training" / "training.safetensors", format=state.FORMAT)
    kinds.require_kind(tmp_path / "posterior", kinds.POSTERIOR)
    kinds.require_kind(tmp_path, kinds.WINDOWS)


def test_what_is_beside_a_file_is_told_too(tmp_path: Path) -> None:
    """A policy's state is a file where a posterior's is a folder."""
    tensors(tmp_path / "a.training", format=resume.FORMAT)
    with pytest.raises(InputError, match=r"a\.training is the state of training a policy, not a folder"):
        kinds.require_kind(tmp_path / "a", kinds.POSTERIOR)
    for folder in ("b", "c"):
        (tmp_path / f"{folder}.training").mkdir()
    tensors(tmp_path / "c.training" / "training.safetensors", format=state.FORMAT)
    for name, found in (("b", "a folder"), ("c", "a folder with the state of training a posterior")):
        with pytest.raises(InputError, match=f"{name}.training is {found}, not a file: choose another"):
            kinds.require_kind(tmp_path / name, kinds.POLICY)
    (tmp_path / "d").touch()
    with pytest.raises(InputError, match="exists and is not a folder: choose another"):
        kinds.require_kind(tmp_path / "d", kinds.WINDOWS)
