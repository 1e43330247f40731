"""The README's programs run as they stand, the long one for a shorter time."""

import re
from pathlib import Path
from typing import Any

import pytest

README = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")
PROGRAMS = re.findall(r"^```python\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
LONG, SHORT = "model.learn(500_000)", "model.learn(1_000)"


def test_there_are_programs() -> None:
    assert len(PROGRAMS) == 3
    assert sum(LONG in program for program in PROGRAMS) == 1


@pytest.mark.parametrize("program", PROGRAMS, ids=range(len(PROGRAMS)))
def test_it_runs(program: str) -> None:
    if "stable_baselines3" in program:
        pytest.importorskip("stable_baselines3", reason="needs Stable-Baselines3: pip install 'nfc_gym[sb3]'")
    names: dict[str, Any] = {}
    exec(program.replace(LONG, SHORT).replace("range(100)", "range(5)"), names)
    for env in ("env", "envs"):
        if env in names:
            names[env].close()
