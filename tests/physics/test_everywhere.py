"""`where: all` is every place that a family has in a model, as a list of them would be."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import yaml
from machines import make

import nfc_gym  # noqa: F401  (registers the ids)
from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import FAMILIES
from nfc_gym.physics.effects.saved import from_row
from nfc_gym.wrappers import ApplyEffects

BODIES = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="9 9 1"/>
  <body name="cart" pos="0 0 1"><joint name="rail" type="slide" axis="1 0 0"/><geom size=".1"/>
    <body name="pole"><joint name="pivot" axis="0 1 0"/><geom pos="0 0 .3" size=".1"/><site name="imu"/></body>
  </body></worldbody>
<actuator><motor name="push" joint="rail" ctrlrange="-1 1"/><motor name="{second}" joint="pivot"/></actuator>
<sensor><gyro name="gyro" site="imu"/></sensor></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(BODIES.format(second="turn"))


def places(family: str, parameters: dict[str, float], model: mujoco.MjModel = MODEL) -> tuple[str, ...]:
    effect, _ = make(family, "all", parameters)
    effect.bind(model)
    return effect.where


@pytest.mark.parametrize(
    ("family", "parameters", "found"),
    [
        ("coulomb", {"level": 0.2}, {"rail", "pivot"}),
        ("delay", {"delay": 0.03}, {"push", "turn"}),
        ("external_force", {"force": 1.0}, {"rail", "pivot"}),
        ("payload", {"mass": 0.1, "x": 0.0, "y": 0.0, "z": 0.0}, {"cart", "pole"}),
        ("sinkage", {"depth": 0.01}, {"ground"}),
        ("sensor_bias", {"bias": 0.1}, {f"joint:{j}:{q}" for j in ("rail", "pivot") for q in ("pos", "vel", "acc")}),
    ],
)
def test_every_place_of_a_family(family: str, parameters: dict[str, float], found: set[str]) -> None:
    assert set(places(family, parameters)) == found


def test_a_thing_of_that_name_comes_first() -> None:
    model = mujoco.MjModel.from_xml_string(BODIES.format(second="all"))
    assert places("delay", {"delay": 0.03}, model) == ("all",)
    assert places("delay", {"delay": 0.03}) == ("push", "turn")


def test_sensors_all_have_the_fault() -> None:
    effect, theta = make("sensor_gain", "all", {"gain": 2.0})
    effect.bind(MODEL)
    three = np.ones((5, 3))
    np.testing.assert_array_equal(effect.sense("sensor:gyro", three, theta, 0.01), 2 * three)
    q, v = effect.unsense(np.ones(2), np.ones(2), theta)
    np.testing.assert_array_equal((q, v), np.full((2, 2), 0.5))  # a speed that is measured too is divided once


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ({"family": "generic_velocity", "parameters": {f"c{k}": 0.1 for k in range(6)}}, "'all' says neither"),
        ({"family": "ground_effect", "parameters": {"strength": 0.1}}, "nothing with a name that it could sit on"),
    ],
)
def test_what_has_no_such_place_is_refused(row: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        from_row(row | {"where": "all"})[0].bind(MODEL)


def test_families_of_one_place_refuse_several() -> None:
    with pytest.raises(InputError, match="wind sits at one place alone, got: a, b"):
        make("wind", ["a", "b"], {"push_x": 1.0, "push_y": 0.0, "push_z": 0.0, "drag": 0.1})


def test_around_an_environment_and_from_a_file(tmp_path: Path) -> None:
    """The same motion as with all names in a list."""
    row = {"family": "delay", "where": "all", "parameters": {"delay": 0.04}}
    (tmp_path / "effects.yaml").write_text(yaml.safe_dump({"version": 1, "model_sha256": "", "effects": [row]}))
    bare = gymnasium.make("nfc_gym/JackalFlat-v0")
    names = [bare.unwrapped.model.actuator(i).name for i in range(bare.unwrapped.model.nu)]  # pyright: ignore
    given = ([row], tmp_path / "effects.yaml", [row | {"where": names}])
    seen = []
    for effects in given:
        env = ApplyEffects(gymnasium.make("nfc_gym/JackalFlat-v0"), effects)
        env.reset(seed=1)
        seen.append([env.step(np.array([0.5, 0.2], np.float32))[0]["proprio"] for _ in range(5)])
    np.testing.assert_array_equal(seen[0], seen[2])
    np.testing.assert_array_equal(seen[1], seen[2])


UNNAMED = """
<mujoco><worldbody>
  <body name="a"><joint name="left" type="slide" axis="1 0 0"/><geom size=".1"/></body>
  <body name="c" pos="2 0 0"><joint name="turn" axis="0 0 1"/><geom size=".1" pos=".2 0 0"/></body></worldbody>
<actuator><motor joint="left"/><motor joint="turn"/></actuator></mujoco>"""


def test_unnamed_actuators_go_by_their_joints_everywhere() -> None:
    """Of a model that nobody prepared, as environments of others have it."""
    model = mujoco.MjModel.from_xml_string(UNNAMED)
    for family, theta in (("delay", {"delay": 0.01}), ("backlash", {"gap": 0.01, "rotor": 0.01})):
        effect, _ = make(family, "all", theta)
        effect.bind(model)
        assert set(effect.where) == {"left", "turn"}
    assert FAMILIES["coulomb"]("turn").where == ("turn",)  # a name alone is one place
