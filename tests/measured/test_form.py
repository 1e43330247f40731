"""A law that stands in for another one at its joint is known by what a smooth function there mends beside it."""

import mujoco
import pytest
from hinge import DRY, FRICTION, LAGGING, MODEL, SCALES, SPRING, arena, given

from nfc_gym.measured.form import _joints, misshapen
from nfc_gym.physics.effects import build, propose
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.law import Law

WORTH = 0.02


def generics() -> list[Effect]:
    return [e for e in propose(given(), SCALES) if e.generic and not isinstance(e, Law)]


def test_dry_friction_that_stands_in_for_damping_has_not_its_form_and_the_spring_beside_it_has() -> None:
    contest = arena(LAGGING, [build(*DRY), build(*SPRING)])
    found = misshapen(contest, generics(), WORTH)
    assert set(found) == {"coulomb:hinge"}
    beside = found["coulomb:hinge"]
    assert contest.new(beside)[0].generic
    assert beside.lower > 0


def test_what_is_at_work_has_its_form() -> None:
    assert misshapen(arena(FRICTION, [build(*DRY), build(*SPRING)]), generics(), WORTH) == {}


@pytest.mark.parametrize("named", [("motor",), ("hinge",), ("motor", "hinge")])
def test_a_drive_acts_at_its_joint(named: tuple[str, ...]) -> None:
    assert _joints(given(), named) == {"hinge"}


def test_what_acts_on_a_body_or_a_sensor_is_at_no_joint() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL.format(physics=""))
    assert _joints(model, ("arm", "joint:hinge:pos")) == set()
