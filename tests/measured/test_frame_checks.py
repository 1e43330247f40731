"""A body that turns and flies by formula: each reading of its attitude and velocities but the right one is told."""

import re
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nfc_gym.core import Channel, Log
from nfc_gym.measured.frame_checks import exchanged
from nfc_gym.measured.rotation_checks import gravity

TIME = np.arange(0, 6, 0.01)
Signals = dict[str, np.ndarray]


def flight() -> Signals:
    """Attitude (scalar first), rates along the body's and the world's axes, place and velocity; some noise."""
    rng = np.random.default_rng(0)
    fine = np.arange(0, 6, 0.001)
    rate = np.stack([1.2 * np.sin(2.1 * fine), 0.9 * np.cos(1.7 * fine), 0.8 * np.sin(1.3 * fine + 1)], 1)
    turned, quats = Rotation.identity(), []
    for w in rate:
        quats.append(turned.as_quat(scalar_first=True))
        turned *= Rotation.from_rotvec(w * 0.001)
    body, quat = rate[::10], np.array(quats[::10])
    attitude = Rotation.from_quat(quat, scalar_first=True)
    place = np.stack([np.sin(1.1 * TIME), np.cos(0.7 * TIME), 0.3 * np.sin(2 * TIME)], 1)
    speed = np.stack([1.1 * np.cos(1.1 * TIME), -0.7 * np.sin(0.7 * TIME), 0.6 * np.cos(2 * TIME)], 1)
    exact = {"quat": quat, "body": body, "world": attitude.apply(body), "place": place, "speed": speed,
             "own": attitude.inv().apply(speed)}  # fmt: skip
    return {name: v + 1e-3 * rng.normal(size=v.shape) for name, v in exact.items()}


def told(model: mujoco.MjModel | None = None, **channels: tuple[np.ndarray, str]) -> list[str]:
    """What is said of a log whose channels are called so, `__` for a colon and `_at_` for an @."""
    named = {k.replace("__", ":").replace("_at_", "@"): Channel(v, unit) for k, (v, unit) in channels.items()}
    found = exchanged(model, Log(name="a", time=TIME, controls={}, channels=named))
    return [f"{s.severity} {s.where} {s.message}; {s.advice}" for s in found]


def test_what_is_declared_rightly_passes() -> None:
    s = flight()
    rest = {"body__b__quat": (s["quat"], "1"), "body__b__pos": (s["place"], "m")}
    assert told(body__b__angvel_at_body=(s["body"], "rad/s"), body__b__linvel=(s["speed"], "m/s"), **rest) == []
    assert told(body__b__angvel=(s["world"], "rad/s"), body__b__linvel_at_body=(s["own"], "m/s"), **rest) == []


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda s: s.update(quat=s["quat"] * [1, -1, -1, -1]), "error channels.body:b:quat .*from the world to"),
        (lambda s: s.update(body=np.rad2deg(s["body"])), "error channels.body:b:angvel@body .*say `unit: deg/s`"),
        (lambda s: s.update(body=s["world"]), "warning channels.body:b:angvel@body .*the channel body:b:angvel,"),
        (lambda s: s.update(speed=s["own"]), "warning channels.body:b:linvel .*the channel body:b:linvel@body,"),
    ],
)  # fmt: skip
def test_each_other_reading_is_named(spoil: Callable[[Signals], None], words: str) -> None:
    s = flight()
    spoil(s)
    (line,) = told(
        body__b__quat=(s["quat"], "1"), body__b__angvel_at_body=(s["body"], "rad/s"), body__b__pos=(s["place"], "m"),
        body__b__linvel=(s["speed"], "m/s"),
    )  # fmt: skip
    assert re.search(words, line)


MODEL = """
<mujoco>
  <worldbody>
    <body name="b"><freejoint/><geom size="0.1"/><site name="s" quat="0.6 0.8 0 0"/></body>
  </worldbody>
  <sensor><gyro name="gyro" site="s"/><accelerometer name="acc" site="s"/></sensor>
</mujoco>
"""


def test_a_gyroscope_counts_in_its_sites_frame() -> None:
    s, model = flight(), mujoco.MjModel.from_xml_string(MODEL)
    seen = Rotation.from_quat([0.6, 0.8, 0, 0], scalar_first=True).inv().apply(s["body"])
    assert told(model, body__b__quat=(s["quat"], "1"), sensor__gyro=(seen, "rad/s")) == []
    (line,) = told(model, body__b__quat=(s["quat"], "1"), sensor__gyro=(np.rad2deg(seen), "rad/s"))
    assert line.startswith("error channels.sensor:gyro")


@pytest.mark.parametrize(("up", "said"), [(0.0, True), (9.81, False)])
def test_an_accelerometer_without_gravity_is_told(up: float, said: bool) -> None:
    values = np.array([0, 0, up]) + np.random.default_rng(0).normal(0, 0.2, (600, 3))
    found = list(gravity("sensor:acc", "acc", Channel(values, "m/s^2"), mujoco.MjModel.from_xml_string(MODEL)))
    assert [s.severity for s in found] == ["warning"] * said
    assert all("where gravity is 9.81: taken out" in s.message for s in found)
