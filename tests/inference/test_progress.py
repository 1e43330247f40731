"""What is said while training goes on."""

import io

import pytest
from rich.console import Console

from nfc_gym.inference import progress
from nfc_gym.inference.progress import Spoken


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress, "monotonic", lambda: now[0])
    return now


def told(terminal: bool) -> tuple[Spoken, io.StringIO]:
    out = io.StringIO()
    return Spoken(Console(file=out, force_terminal=terminal, width=100)), out


def test_a_step_says_how_long_it_takes_at_most_once_a_minute_in_a_file(clock):
    spoken, out = told(terminal=False)
    for clock[0] in range(1, 150):
        spoken.step(clock[0], 7200, float(clock[0]))
    assert out.getvalue().splitlines() == ["step 60/7200  at most 1:59:00 left", "step 120/7200  at most 1:58:00 left"]


def test_on_a_terminal_lines_replace_each_other_whole(clock):
    spoken, out = told(terminal=True)
    spoken.epoch(1, 2, 0.5, 0.25)
    clock[0] = 1.0
    spoken.step(3, 4, 3.0)
    spoken.epoch(2, 2, 0.5, 0.25)
    epoch, step, last = out.getvalue().split("\r")
    assert len(epoch) <= len(step)
    assert "at most 0:00:01 left" in step
    assert last.endswith("\n")
