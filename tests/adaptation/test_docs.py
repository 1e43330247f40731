"""The programs of docs/adaptation.md run as they stand, with less of everything."""

import re
from pathlib import Path

import pytest
from rounds import fewer

DOCS = (Path(__file__).resolve().parents[2] / "docs" / "adaptation.md").read_text(encoding="utf-8")
PROGRAMS = re.findall(r"^```python\n(.*?)^```", DOCS, re.DOTALL | re.MULTILINE)
LESS = {
    "max_episode_steps=400": "max_episode_steps=60",
    "range(60)": "range(4)",
    "rate=0.05": "rate=0.9",
    "missions=10, worlds=64, steps=500_000": "missions=1, worlds=4, steps=256",
    "threshold=limit": "threshold=0.9 * limit",
}


def test_the_adaptation_runs(jackal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    fewer(monkeypatch, 0.4)
    monkeypatch.setattr("nfc_gym.adaptation.ppo._LONGEST", 32)  # iterations of a quarter of the control steps
    (program,) = (p for p in PROGRAMS if "adapt(" in p)
    for long, short in LESS.items():
        assert long in program
        program = program.replace(long, short)
    found: dict = {}
    exec(program.replace("load_policy(ID)", f"load_policy({str(jackal)!r})"), found)
    assert len(found["done"].dataset) == 1
    assert (tmp_path / "runs" / "axle" / "trajectory_00000.npz").is_file()
    assert (tmp_path / "adapted.safetensors").is_file()
