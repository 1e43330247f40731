"""Progress says names as they are."""

import io
import time

import pytest
from rich.console import Console

from nfc_gym.measured.telling import teller


@pytest.mark.parametrize("name", ["joint:x:pos", "body:sled:pos", "imu[a]", "[/bold]", "a\\[b]"])
def test_names_are_no_emoji_and_no_markup(name: str) -> None:
    told = io.StringIO()
    teller(Console(file=told, width=200), time.monotonic())(f" at {name}", lead=name)
    assert told.getvalue().rstrip().endswith(f"  {name} at {name}")


def test_without_a_console_it_is_silent() -> None:
    teller(None, 0.0)("nothing")
