"""docs/environments.md runs as written, and knows every argument and option that there is."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from nfc_gym.envs.contract import OPTIONS
from nfc_gym.envs.settings import Settings

TEXT = (Path(__file__).parents[1] / "docs" / "environments.md").read_text(encoding="utf-8")


def test_the_program_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (program,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    names: dict = {}
    exec(compile(program, "docs/environments.md", "exec"), names)
    assert "base_mass 12..35 kg" in capsys.readouterr().out
    assert names["envs"].unwrapped.terrain_id.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(names["envs"].unwrapped.psi[:, 0], [14, 16, 18, 20])


def test_every_argument_and_option_has_a_row() -> None:
    rows = " ".join(line.partition(" means")[0] for line in TEXT.splitlines() if line.startswith("| `"))
    wanted = {f.name for f in fields(Settings)} - {"kind"} | {*OPTIONS, "reset_mask", "nthread", "max_episode_steps"}
    assert wanted <= set(re.findall(r"`(\w+)`", rows))
