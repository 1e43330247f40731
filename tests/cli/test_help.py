"""What `--help` shows: paragraphs that flow, commands in groups, the whole package in view."""

import re
from collections.abc import Callable
from itertools import pairwise

import pytest
from typer.testing import CliRunner

import nfc_gym
from nfc_gym.cli import COMMANDS, app, flowing


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """The help of a command on a terminal of some width."""

    def show(*args: str, width: int) -> str:
        monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", width)
        done = CliRunner().invoke(app, [*args, "--help"])
        assert done.exit_code == 0
        return re.sub(r"\x1b\[[0-9;]*m", "", done.output)

    return show


def test_lines_of_a_paragraph_flow_and_examples_stay() -> None:
    text = "First\nline.\n\nSecond\nparagraph.\n\n    code: 1\n    more: 2\n\n- an item\n  of two lines"
    assert flowing(text) == (
        "First line.\n\nSecond paragraph.\n\n    code: 1\n    more: 2\n\n- an item\n  of two lines"
    )  # fmt: skip


@pytest.mark.parametrize("name", [name for group in COMMANDS.values() for name in group])
@pytest.mark.parametrize("width", [80, 110])
def test_no_line_is_a_stump(shown: Callable[..., str], name: str, width: int) -> None:
    """A line ends where the next word would not have fitted, or with its paragraph."""
    lines = [line.strip() for line in shown(name, width=width).split("╭")[0].splitlines()]
    for line, after in pairwise(lines):
        if line and after and not line.startswith("Usage"):
            assert len(line) + 1 + len(after.split()[0]) > width - 4, line


def test_the_overview_is_of_the_whole_package(shown: Callable[..., str]) -> None:
    text = " ".join(shown(width=100).split())
    for word in ("gymnasium.make", "nfc_gym.wrappers", "nfc_gym.measured", "nfc_gym.inference", "nfc_gym.adaptation"):
        assert word in text
        assert word in (nfc_gym.__doc__ or "")
    places = [text.index(f"─ {group} ─") for group in COMMANDS]
    assert places == sorted(places)
    assert "excite.csv beside the mapping" in " ".join(shown("excite", width=200).split())
