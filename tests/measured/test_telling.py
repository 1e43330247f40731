"""Progress says names as they are."""

import io
import time

import pytest
from rich.console import Console

from nfc_gym.measured.telling import paced, teller


@pytest.mark.parametrize("name", ["joint:x:pos", "body:sled:pos", "imu[a]", "[/bold]", "a\\[b]"])
def test_names_are_no_emoji_and_no_markup(name: str) -> None:
    told = io.StringIO()
    teller(Console(file=told, width=200), time.monotonic())(f" at {name}", lead=name)
    assert told.getvalue().rstrip().endswith(f"  {name} at {name}")


def test_long_looks_say_how_far_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 1000, 7))
    monkeypatch.setattr("nfc_gym.measured.telling.time.monotonic", lambda: float(next(clock)))
    said: list[str] = []
    assert list(paced(said.append, "abcdefg")) == list("abcdefg")
    assert said == ["2 of 7 so far", "5 of 7 so far"]


def test_without_a_console_it_is_silent() -> None:
    teller(None, 0.0)("nothing")
