"""No command writes over a file or folder of another kind: it is refused before anything else is done."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from nfc_gym.cli import app


def refused(*args: object) -> str:
    """What a command says that ends with code 2."""
    done = CliRunner().invoke(app, [str(a) for a in args])
    assert done.exit_code == 2, done.output
    return " ".join(done.stderr.split())


@pytest.fixture
def target(tmp_path: Path) -> Path:
    """A policy at `x.safetensors`, a posterior at `y.safetensors`."""
    for name, kind in (("x", "policy"), ("y", "posterior")):
        header = json.dumps({"__metadata__": {"format": f"nfc_gym-{kind}-1"}}).encode()
        (tmp_path / f"{name}.safetensors").write_bytes(struct.pack("<Q", len(header)) + header)
    return tmp_path


def test_files(target: Path) -> None:
    policy, posterior = target / "x.safetensors", target / "y.safetensors"
    before = policy.read_bytes(), posterior.read_bytes()
    said = refused("train", target / "no_windows", "--out", policy)
    assert said == f"nfc-gym train: {policy} is a policy, and a posterior would be written there: choose another --out"
    assert "and a structure head would" in refused("train", target / "no_windows", "--structure", "--out", posterior)
    assert "is a posterior, and a policy would" in refused("pretrain", "Nobody", "--steps", 1, "--out", posterior)
    assert "is a policy, and a posterior would" in refused("infer", "no.safetensors", "no.npz", "--out", policy)
    assert (policy.read_bytes(), posterior.read_bytes()) == before


def test_archives(target: Path) -> None:
    window = target / "w.npz"
    np.savez(window, states=np.zeros((3, 2)), actions=np.zeros((2, 1)))
    assert "is a window of motion, and draws from a posterior would" in refused("infer", "a", window, "--out", window)
    said = refused("predict", "no.yaml", "--stage", "nominal", "--out", target / "x.npz", "--mode", "inverse")
    assert "no.yaml" in said  # nothing is there: the mapping is what is wrong
    np.savez(target / "psi.npz", psi=np.zeros((3, 2)))
    channel = "channels: {'joint:a:pos': {column: q, unit: rad}}"
    mapping = f"version: 1\nmodel: m.xml\nlogs: [{{path: w.npz}}]\ntime: {{column: t, unit: s}}\n{channel}\n"
    (target / "m.yaml").write_text(mapping)
    predict = ("predict", target / "m.yaml", "--stage", "nominal", "--out")
    assert "is draws from a posterior, and named arrays would" in refused(*predict, target / "psi.npz")
    np.savez(window, t=np.zeros(3), q=np.zeros(3))
    assert "w.npz is a log of" in refused(*predict, window)
    assert "w.npz is a log of" in refused("excite", target / "m.yaml", "--overwrite", "--out", window)


@pytest.mark.parametrize(
    ("args", "kind"),
    [
        (["adapt", "Nobody", "--effects", "no", "--out"], "what `nfc-gym adapt` wrote"),
        (["learn", "no", "--posterior", "no", "--out"], "what `nfc-gym learn` wrote"),
        (["close-loop", "no.yaml", "--overwrite", "--out"], "what `nfc-gym close-loop` wrote"),
    ],
)
def test_folders(tmp_path: Path, args: list[str], kind: str) -> None:
    (tmp_path / "manifest.json").write_text('{"psi_names": []}')
    assert f"{tmp_path} is a set of windows, and {kind} would" in refused(*args, tmp_path)
    (tmp_path / "manifest.json").unlink()
    (tmp_path / "report.json").write_text('{"verdict": "explained"}')
    if "close-loop" not in args:
        assert "is what `nfc-gym close-loop` wrote, and" in refused(*args, tmp_path)
    assert "is what `nfc-gym close-loop` wrote" in refused("simulate", "JackalFlat", "--windows", 1, "--out", tmp_path)
