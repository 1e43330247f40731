"""Positions that follow another motion's speed are found, or nobody's; noise, clocks and rest raise no alarm."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.speed_checks import strangers, too_fast

Array = NDArray[np.float64]
T = np.arange(1500) / 100


def swing(seed: int, t: Array = T) -> tuple[Array, Array]:
    """A motion of several frequencies at times t (T,): position in rad or m, speed in that a second."""
    rng = np.random.default_rng(seed)
    w, phase, size = rng.uniform(1, 9, 5), rng.uniform(0, 6, 5), rng.uniform(0.1, 0.3, 5)
    angle = np.outer(t, w) + phase
    return np.sin(angle) @ size, np.cos(angle) @ (size * w)


def noise(seed: int, sd: float) -> Array:
    return sd * np.random.default_rng(seed).standard_normal(len(T))


def machine(positions: list[Array], speeds: list[Array], unit: str = "rad", **options: Any) -> Log:
    """Joints a, b, ... of those positions and speeds, each (T,)."""
    channels = {}
    for name, x, v in zip("abc", positions, speeds, strict=False):
        channels[f"joint:{name}:pos"] = Channel(x, unit, **options)
        channels[f"joint:{name}:vel"] = Channel(v, f"{unit}/s")
    return Log("run", T, {}, channels)


def told(log: Log) -> list[tuple[str, str]]:
    assert all(s.severity == "warning" for s in strangers(log))
    return [(s.where, s.message) for s in strangers(log)]


(QA, VA), (QB, VB) = swing(0), swing(1)


@pytest.mark.parametrize("unit", ["rad", "m"])
@pytest.mark.parametrize("sd", [0.0, 0.02])
def test_swapped_positions_are_found_in_noise_too(unit: str, sd: float) -> None:
    log = machine([QB + noise(0, sd), QA + noise(1, sd)], [VA + noise(2, sd), VB + noise(3, sd)], unit)
    (a, of_a), (b, of_b) = told(log)
    assert (a, b) == ("channels.joint:a:pos", "channels.joint:b:pos")
    assert "does not follow its own measured speed (correlation 0." in of_a
    assert "it follows that of joint:b (1.00)" in of_a
    assert "it follows that of joint:a (1.00)" in of_b


def test_a_position_that_follows_nobody() -> None:
    (one,) = told(machine([QB], [VA]))
    assert one[0] == "channels.joint:a:pos"
    assert "does not follow its own measured speed" in one[1]
    assert "that of" not in one[1]


def test_swapped_axes_of_a_body() -> None:
    (qc, vc), still = swing(2), np.zeros((len(T), 3))
    place, speed = np.stack([QA, qc, QB], 1), np.stack([VA, VB, vc], 1)
    log = Log("run", T, {}, {"body:base:pos": Channel(place, "m"), "body:base:linvel": Channel(speed, "m/s")})
    messages = [message for _, message in told(log)]
    assert len(messages) == 2
    assert "y does not follow its own measured speed" in messages[0]
    assert "it follows that of z of body:base" in messages[0]
    # A speed in the body's own frame is no speed of these axes.
    own = {"body:base:pos": Channel(place, "m"), "body:base:linvel@body": Channel(speed + still, "m/s")}
    assert told(Log("run", T, {}, own)) == []


def held(values: Array, rows: int) -> Array:
    return values[np.arange(len(values)) // rows * rows]


def right() -> Iterator[tuple[str, list[Array], list[Array], dict[str, Any]]]:
    """Logs of two joints that are as they should be, and yet hard to read."""
    quiet = 1e-3
    yield "clean", [QA, QB], [VA, VB], {}
    yield "derivative is noise", [QA + noise(0, 0.3), QB + noise(1, 0.3)], [VA, VB], {}
    yield "speed is noise", [QA, QB], [VA + noise(0, 30), VB + noise(1, 30)], {}
    yield "both are", [QA + noise(0, 1), QB + noise(1, 1)], [VA + noise(2, 30), VB + noise(3, 30)], {}
    yield "at rest", [noise(0, quiet), noise(1, quiet)], [noise(2, quiet), noise(3, quiet)], {}
    yield "one at rest", [QA, noise(1, quiet)], [VA, noise(3, quiet)], {}
    yield "one at rest, of which the other's motion shows", [QA, 1e-4 * QA], [VA, noise(3, quiet)], {}
    yield "coarse encoder", [np.round(q / 0.02) * 0.02 for q in (QA, QB)], [np.round(v) for v in (VA, VB)], {}
    yield "no motion but the encoder's step", [np.round(1e-3 * q / 2e-3) * 2e-3 for q in (QA, QB)], [VA, VB], {}
    yield "late speeds", [QA, QB], [swing(k, T - 0.3)[1] for k in (0, 1)], {}
    yield "slow positions", [held(q, 10) for q in (QA, QB)], [VA, VB], {"rate": 10.0}
    yield "masked", [np.where(np.arange(len(T)) % 500 < 300, q, 0) for q in (QA, QB)], [VA, VB], {
        "mask": np.arange(len(T)) % 500 < 300
    }  # fmt: skip
    yield "the same motion twice", [QA, -QA], [VA, -VA], {}
    yield "a gear", [QA, QB], [50 * VA, -7 * VB], {}
    wrapped = (30 * T + np.pi) % (2 * np.pi) - np.pi
    yield "wrapped", [wrapped, QB], [30 + 0.1 * VA, VB], {}
    yield "short", [QA[:80], QB[:80]], [VB[:80], VA[:80]], {}


@pytest.mark.parametrize(
    ("why", "positions", "speeds", "options"), [pytest.param(*case, id=case[0]) for case in right()]
)
def test_what_is_right_or_cannot_be_told_raises_no_alarm(
    why: str, positions: list[Array], speeds: list[Array], options: dict[str, Any]
) -> None:
    log = machine(positions, speeds, **options) if len(positions[0]) == len(T) else short(positions, speeds)
    assert told(log) == []


def short(positions: list[Array], speeds: list[Array]) -> Log:
    return Log("run", T[:80], {}, {
        f"joint:{name}:{what}": Channel(values, "rad" if what == "pos" else "rad/s")
        for name, x, v in zip("ab", positions, speeds, strict=True) for what, values in (("pos", x), ("vel", v))
    })  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
def test_random_noisy_machines_raise_no_alarm(seed: int) -> None:
    """Noise of any size, white or slow, on position and speed."""
    rng = np.random.default_rng(seed)
    positions, speeds = [], []
    for k in range(3):
        q, v = swing(100 * seed + k)
        size, slow = 10 ** rng.uniform(-4, 1, 2), rng.integers(1, 30, 2)
        disturbed = [
            sd * np.convolve(rng.standard_normal(len(T)), np.ones(n) / np.sqrt(n), "same")
            for sd, n in zip(size, slow, strict=True)
        ]
        positions.append(q + 0.1 * disturbed[0])
        speeds.append(v + disturbed[1])
    assert not [m for _, m in told(machine(positions, speeds)) if "that of" in m]


def test_millimetres_as_metres_move_too_fast() -> None:
    slow, fast = machine([QA], [VA], "m"), machine([1000 * QA], [1000 * VA], "m")
    assert list(too_fast(slow)) == []
    assert [(s.where, s.advice) for s in too_fast(fast)] == [
        ("channels.joint:a:pos", "check its `unit` (is it in mm?), and that of time"),
        ("channels.joint:a:vel", "check its `unit` (is it in mm?), and that of time"),
    ]
    still = machine([noise(0, 0.01)], [noise(1, 0.01)], "m")  # a coarse sensor of what stands is no motion
    assert list(too_fast(still)) == []
    assert list(too_fast(machine([1000 * QA], [1000 * VA], "rad"))) == [], "a rotor may"
