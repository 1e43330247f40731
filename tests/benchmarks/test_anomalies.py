"""Faults that detectors are judged by: which a robot is asked for, and at what size an effect is strong."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from nfc_gym.physics.effects import build
from nfc_gym.simulate.machine import Machine

pytest.importorskip("torch", reason="windows are nfc_gym.inference's")

JACKAL = "nfc_gym/JackalFlat-v0"


@pytest.mark.parametrize(("robot", "asked"), [("Quadcopter", 0), ("Jackal", 4), ("Quadruped", 4)])
def test_only_what_stands_on_the_ground_is_asked_for_friction(robot: str, asked: int) -> None:
    from anomalies.faults import faults

    found = faults(Machine(f"nfc_gym/{robot}Flat-v0"), 0, np.random.default_rng(0))
    slippery = [f for f in found if "friction" in f.name]
    assert len(slippery) == asked
    assert [f.name for f in slippery if f.wanted] == ["friction x 0.3"] * (asked > 0)
    assert sum(f.wanted for f in found) == 2 + (asked > 0)  # a doubled mass and a lost actuator


def test_effects_grow_to_their_bounds_and_keep_their_shape() -> None:
    from anomalies.faults import grown, most_of

    effect, _ = build("stribeck", "front_left_wheel", {"level": 100.0, "rise": 500.0, "speed": 0.5})
    assert [(p.high, p.shape) for p in effect.params] == [(1000.0, False), (1000.0, False), (100.0, True)]
    size = np.array([100.0, 500.0, 0.5])
    assert most_of(effect, size) == pytest.approx(10.0)
    for by, parameters in {1: size, 3: [300, 1000, 0.5], 10: [1000, 1000, 0.5], 20: [1000, 1000, 0.5]}.items():
        np.testing.assert_allclose(grown(effect, size, by), parameters)


@pytest.mark.parametrize(
    ("ratio", "most", "size", "told"),
    [
        (lambda k: k, 100.0, 6.0, 6.0),  # 1, 2, 4, 8, and the middle of the last two
        (lambda k: k, 3.0, 3.0, 3.0),  # the bound comes first
        (lambda k: 100 * k, 100.0, 0.125, 12.5),  # strong as drawn: halved as often as it may be
        (lambda k: k if k < 7 else math.inf, 100.0, 6.0, 6.0),  # twice as much ends most windows
        (lambda k: k if k < 4.5 else math.inf, 100.0, 4.5, math.inf),  # so does every strong size
    ],
)
def test_a_strong_size_is_bracketed(ratio: Callable[[float], float], most: float, size: float, told: float) -> None:
    from anomalies.strength import reaching

    assert reaching(ratio, most) == (size, told)


def test_an_effect_is_sized_by_what_replays_say_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    """A servo's offset of nothing is X_null to the bit; grown it is strong; a touch of inertia never is."""
    from anomalies import strength

    monkeypatch.setattr(strength, "_WINDOWS", 4)
    monkeypatch.setattr(strength, "_DRAWS", 6)
    machine = Machine(JACKAL)
    offset, size = build("offset", "front_left", {"offset": 4.0})
    wheel, heavier = build("inertia", "front_left_wheel", {"x": 1.5, "y": 1.5, "z": 1.5})
    ruler = strength.Yardstick(machine, 0.02, 3)
    assert ruler(offset, offset.null) == 1.0
    monkeypatch.setattr(strength, "drawn", lambda *_: [(offset, size), (wheel, heavier)])
    (found,) = strength.strong(machine, 2, np.random.default_rng(0), 0.02, 3)
    assert found.wanted
    assert found.theta is not None
    ratio = ruler(offset, found.theta)
    assert ratio >= strength.STRONG > ruler(offset, size)
    assert found.name.startswith("offset:front_left offset ")
    assert found.name.endswith(f", X / X_null {ratio:.1f}")
    assert "inertia:front_left_wheel" in capsys.readouterr().out
