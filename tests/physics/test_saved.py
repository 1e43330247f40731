"""Effects as rows: what is read again is what was written, of every family."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml
from machines import candidates, plant_of, probe, zoo, zoo_scales, zoo_segments

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import FAMILIES, Effect
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
