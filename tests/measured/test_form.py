"""A law that stands in for another one at its joint is known by what a smooth function there mends beside it."""

import mujoco
import pytest
from hinge import DRY, FRICTION, LAGGING, MODEL, SCALES, SPRING, arena, given

from nfc_gym.measured.form import _joints, misshapen
from nfc_gym.measured.screen import Screen
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


def test_a_spring_that_yields_is_not_refuted_by_a_function_of_the_past(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside dry friction that function is asked; beside the law that is one of its terms it is not."""
    asked: list[str] = []
    try_one = Screen.try_one
    monkeypatch.setattr(Screen, "try_one", lambda self, e, *a: asked.append(e.id) or try_one(self, e, *a))
    yields = build("hysteresis", "hinge", {"level": 0.2, "transition": 0.05})
    for law, expected in ((yields, False), (build(*DRY), True)):
        asked.clear()
        misshapen(arena(FRICTION, [law]), generics(), WORTH)
        assert ("generic_memory:hinge" in asked) is expected
        assert "generic_velocity:hinge" in asked


@pytest.mark.parametrize("named", [("motor",), ("hinge",), ("motor", "hinge")])
def test_a_drive_acts_at_its_joint(named: tuple[str, ...]) -> None:
    assert _joints(given(), named) == {"hinge"}


def test_what_acts_on_a_body_or_a_sensor_is_at_no_joint() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL.format(physics=""))
    assert _joints(model, ("arm", "joint:hinge:pos")) == set()
