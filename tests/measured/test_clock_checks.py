"""Two sensors of one motion, one of which shows it later: a clock, and what only looks like one."""

import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured.clock_checks import clock_offsets

DT, EACH, ROWS = 0.002, 10, 400  # s between physics steps, of which a control step has so many


def driven(answers_in: float, late: float = 0.0) -> Log:
    """A joint whose speed goes over to each 50 Hz command in `answers_in` s; the speed is stamped `late` s late."""
    commands = np.cumsum(np.random.default_rng(0).normal(size=ROWS))
    commands -= np.convolve(commands, np.ones(25) / 25, "same")
    speed, now = np.empty(ROWS * EACH), 0.0
    for k, wish in enumerate(np.repeat(commands, EACH)):
        now += (wish - now) * min(1.0, DT / answers_in)
        speed[k] = now
    position = np.cumsum(speed) * DT
    time = DT * EACH * np.arange(1, ROWS)
    at = DT * np.arange(1, ROWS * EACH + 1)
    channels = {
        "joint:j:pos": Channel(np.interp(time, at, position), "rad"),
        "joint:j:vel": Channel(np.interp(time - late, at, speed), "rad/s"),
    }
    return Log("run", time, {"ctrl:j": commands[1:]}, channels)


@pytest.mark.parametrize("answers_in", [0.004, 0.01])
def test_a_drive_that_follows_commands_within_a_sample_has_one_clock(answers_in: float) -> None:
    """Its speed when it is sampled is that of the command before, its position's slope there the mean of two."""
    assert not list(clock_offsets(None, [driven(answers_in)], {}))


def test_a_late_clock_is_told_under_commands_too() -> None:
    (finding,) = clock_offsets(None, [driven(0.01, late=0.015)], {})
    assert finding.where == "channels.joint:j:vel"
    assert "after joint:j:pos" in finding.message
