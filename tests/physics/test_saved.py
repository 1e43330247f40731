"""Effects as rows: what is read again is what was written, of every family."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml
from machines import candidates, plant_of, probe, zoo, zoo_scales, zoo_segments

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import FAMILIES, Effect, build
from nfc_gym.physics.effects.command import SupplySag
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.each import each
from nfc_gym.physics.effects.saved import from_row, to_row

MODEL = zoo()
CANDIDATES = candidates(MODEL)


def _told(effect: Effect) -> dict[str, Any]:
    """All that an effect was told before it is bound, but for what only a fit asks."""
    return {k: v for k, v in vars(effect).items() if k not in ("params", "singles")}


@pytest.mark.parametrize("family", FAMILIES)
def test_no_setting_is_lost(family: str) -> None:
    for effect in CANDIDATES[family]:
        theta = probe(effect)
        if effect.generic:
            continue  # never claimed by name, and so never saved
        again, values = from_row(to_row(effect, theta))
        np.testing.assert_array_equal(values, theta)
        assert type(again) is type(effect)
        assert [(p.name, p.unit) for p in again.params] == [(p.name, p.unit) for p in effect.params]
        assert _told(again) == _told(effect), effect.id


@pytest.mark.parametrize(
    ("family", "place", "entry", "value", "unit"),
    [
        ("delay", "m", {"value": 30, "unit": "ms"}, 0.03, "s"),
        ("slope", "world", {"value": 5, "unit": "deg"}, np.deg2rad(5), "rad"),
        ("backlash", "j", {"value": 2, "unit": "mm"}, 0.002, "m"),  # of a joint that slides
        ("stribeck", "j", {"value": 2, "unit": "m/s"}, 2, "m/s"),
        ("gain", "m", {"value": 12, "unit": "%"}, 0.12, "1"),
    ],
)
def test_other_scales_of_a_unit_are_converted(
    family: str, place: str, entry: dict[str, Any], value: float, unit: str
) -> None:
    names = [p.name for p in FAMILIES[family].PARAMS]
    at = {"stribeck": "speed"}.get(family, names[0])
    effect, theta = build(family, place, dict.fromkeys(names, 0.1) | {at: entry})
    assert theta[names.index(at)] == pytest.approx(value)
    assert effect.params[names.index(at)].unit == unit


@pytest.mark.parametrize("unit", ["mN m", "g", "deg", "parsec"])
def test_a_unit_of_something_else_is_refused(unit: str) -> None:
    with pytest.raises(InputError, match=f"coulomb: level is in '{unit}'; want N m"):
        build("coulomb", "j", {"level": {"value": 200, "unit": unit}})


@pytest.mark.parametrize("flag", [True, {"value": False}, {"value": True, "unit": "deg"}, np.True_])
def test_a_flag_is_no_value(flag: Any) -> None:
    with pytest.raises(InputError, match=r"slope: roll is (np\.)?(True|False)_?; want a number"):
        from_row({"family": "slope", "where": "world", "parameters": {"roll": flag, "pitch": 0.0}})


def test_numbers_that_yaml_takes_for_text_are_numbers() -> None:
    parameters = yaml.safe_load("{level: 1e-3}")
    assert parameters == {"level": "1e-3"}
    assert build("coulomb", "j", parameters)[1] == 1e-3


def test_a_place_that_is_named_twice_is_refused() -> None:
    with pytest.raises(InputError, match="gain: m is named more than once"):
        build("gain", ["m", "n", "m"], {"gain": 0.1})
    build("law_harmonic", "j+j", {"cosine": 0.1, "sine": 0.1, "order": 2.0})  # its second harmonic


def _sag(signal: str) -> Effect:
    """The candidate of logs whose supply voltage goes by this name."""
    (effect,) = SupplySag.propose(MODEL, replace(zoo_scales(MODEL), exogenous={signal: 11.0}))
    return effect


def test_a_supply_by_another_name_is_still_read() -> None:
    effect, theta = _sag("exo:vbat"), np.array([1.0, 11.0])
    row = yaml.safe_load(yaml.safe_dump(to_row(effect, theta)))
    again, _ = from_row(row)
    segments = zoo_segments(MODEL, 0)
    segments = replace(segments, exogenous={"exo:vbat": segments.exogenous["exo:supply"]})
    first, second = (plant_of(MODEL, e).shoot(theta[None], segments).qpos for e in (effect, again))
    np.testing.assert_array_equal(second, first)
    without = plant_of(MODEL).shoot(np.zeros((1, 0)), segments).qpos
    assert np.abs(first - without).max() > 1e-6


@pytest.mark.parametrize("settings", [{"volts": "exo:vbat"}, {"signal": 3}, ["exo:vbat"]])
def test_what_is_no_setting_is_refused(settings: object) -> None:
    row = to_row(_sag("exo:vbat"), np.array([1.0, 11.0])) | {"settings": settings}
    with pytest.raises(InputError, match=r"supply_sag.*signal"):
        from_row(row)


def test_members_and_conditions_hand_their_settings_on() -> None:
    effect = _sag("exo:vbat")
    members = each([effect, effect])
    ambient = SupplySag(effect.where, [replace(p, ambient=True) for p in effect.params])
    ambient.signal = "exo:vbat"
    for whole in (members, Conditioned(ambient, ("dry", "wet"))):
        assert whole.settings == {"signal": "exo:vbat"}
        assert whole.signals == ("exo:vbat",)


@pytest.mark.parametrize("places", [("knee@left", "knee@right"), ("left", "knee@left"), ("hip joint", "hüfte:1+x")])
def test_values_of_places_are_told_apart_by_any_name(places: tuple[str, ...]) -> None:
    members = each([build("coulomb", [p], {"level": 0.0})[0] for p in places])
    again, theta = from_row(yaml.safe_load(yaml.safe_dump(to_row(members, np.array([0.1, 0.2])))))
    assert again.where == places
    assert [p.name for p in again.params] == [f"level@{p}" for p in places]
    np.testing.assert_array_equal(theta, [0.1, 0.2])


def test_biases_of_velocities_in_the_bodies_own_axes_are_read_again() -> None:
    channels = ["body:craft:linvel@body", "body:craft:angvel@body"]
    members = each([build("sensor_bias", [c], dict.fromkeys("xyz", 0.0))[0] for c in channels])
    again, theta = from_row(to_row(members, np.arange(6.0)))
    again.bind(MODEL)
    assert list(again.where) == channels
    np.testing.assert_array_equal(theta, np.arange(6.0))


def test_conditions_may_hold_any_sign() -> None:
    wind = build("wind", "craft", {"push_x": 0.0, "push_y": 0.0, "push_z": 0.0, "drag": 0.0})[0]
    whole, labels = Conditioned(wind, ("a@dawn", "dawn")), ("a@dawn", "dawn")
    again, theta = from_row(to_row(whole, np.arange(7.0)))
    assert isinstance(again, Conditioned)
    assert again.conditions == labels
    for label in labels:
        np.testing.assert_array_equal(again.inside(theta, label), whole.inside(np.arange(7.0), label))
