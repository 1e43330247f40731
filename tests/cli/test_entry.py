"""What `python -m` starts."""

import runpy
import sys

import pytest


@pytest.mark.parametrize("module", ["nfc_gym", "nfc_gym.cli"])
def test_python_m_is_the_command(module: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setattr(sys, "argv", ["nfc-gym", "check", "--help"])
    monkeypatch.delitem(sys.modules, f"{module}.__main__", raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(module, run_name="__main__")
    assert not ended.value.code
    assert "MAPPING" in capsys.readouterr().out
