"""Commands that write a file say where it is and what is in it."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from typer.testing import CliRunner

from nfc_gym.cli import app


def test_predict(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def predict(*_: Any, **__: Any) -> dict[str, Any]:
        return {"run_0": None, "run_1": None}

    module = ModuleType("nfc_gym.measured.predict")
    module.predict = predict  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "nfc_gym.measured.predict", module)
    out = tmp_path / "p.npz"
    done = CliRunner().invoke(app, ["predict", "m.yaml", "--stage", "nominal", "--out", str(out)])
    assert done.exit_code == 0
    assert done.stdout == f"{out}: rollout of 2 logs by the nominal model, an array each\n"
