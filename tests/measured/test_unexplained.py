"""A force with memory is said as such, where no law was believed."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.laws import Proposal, Scanned
from nfc_gym.measured.observe import observer
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.remainder import Remainder
from nfc_gym.measured.unexplained import unexplained
from nfc_gym.measured.verdict import Verified
from nfc_gym.physics.effects.law_motion import LawPower
from nfc_gym.physics.effects.law_place import LawHeight
from nfc_gym.physics.effects.law_waves import LawHarmonic
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant

MODEL = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 1"><joint name="knee"/><geom size="0.1" contype="0" conaffinity="0"/></body>
<body name="car" pos="0 0 0.1"><freejoint name="root"/><geom size="0.1"/></body></worldbody></mujoco>"""
RANKED = {"id": "coulomb:knee", "generic": False, "share": 0.3}


def said(
    generic: str | None,
    weak: tuple[str, ...] = (),
    alike: tuple[str, ...] = (),
    ranked: dict[str, Any] | None = None,
    evidence: dict[str, float] | None = None,
    nearest: Proposal | None = None,
    text: str = MODEL,
    bare: Proposal | None = None,
    sure: bool = False,
    hinted: str | None = None,
    **more: str,
) -> dict[str, Any]:
    model = mujoco.MjModel.from_xml_string(text)
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    rows = [RANKED] if ranked is None else [RANKED, ranked]
    believable = [nearest] if sure and nearest else []
    rest = Remainder(fitted=None, scanned=Scanned(believable, nearest, {}, evidence or {}))  # type: ignore[arg-type]
    rest.bare = None if bare is None else Scanned([], bare, {}, {})
    found: Any = SimpleNamespace(generic=generic, hinted=hinted, rest=rest, rounds=[Round([], 0.0, rows)], nearest=None)
    place, channel = ("joint:knee",) * 2, ("joint:knee:pos", "joint:knee:vel")
    columns = SimpleNamespace(place=place, group=("joint angle", "joint speed"), channel=channel)
    problem = SimpleNamespace(columns=columns, mask=np.ones((1, 2), bool))
    white, none = {"extended": np.array([[1.0, 3.0]])}, np.zeros((0, 0))
    v = Verified(problem, {}, white, none, none, none, floor=np.ones(2))  # type: ignore[arg-type]
    return unexplained(v, found, plant, [], [{"id": i, "alike": list(alike)} | more for i in weak], 0.06)


def test_memory_in_a_joint_is_said_as_such() -> None:
    found = said("generic_memory:knee")
    assert (found["coordinate"], found["where"]) == ("joint:knee:pos", "joint:knee")
    assert found["description"].startswith("looks like a force with memory in knee, of no law of the library")
    assert (found["nearest"], found["nearest_share"]) == ("coulomb:knee", pytest.approx(0.3))


def test_ground_that_grips_otherwise_in_places_is_said_as_such() -> None:
    told = "Friction of the ground that depends on the place: beside the middle, 0.8 times about (1.0, 0.0) m."
    found = said("generic_grip:ground", ranked={"id": "generic_grip:ground", "generic": True, "sentence": told})
    assert (found["coordinate"], found["where"]) == ("body:car:pos", "ground")
    assert "friction of the ground that depends on the place: beside the middle, 0.8 times" in found["description"]


def test_a_force_that_repeats_with_a_wheels_turn_is_at_the_wheel() -> None:
    told = "A force under a wheel that repeats with its turn, knee: 3 N ahead, 6 N across, 5 N up."
    found = said("generic_tread:knee", ranked={"id": "generic_tread:knee", "generic": True, "sentence": told})
    assert (found["coordinate"], found["where"]) == ("joint:knee:pos", "joint:knee")
    assert found["description"].startswith("looks like a force under a wheel that repeats with its turn, knee: 3 N")


def test_what_moves_in_a_body_is_at_the_body() -> None:
    told = "Something that moves in a body, root: it follows the body's speed late, and leans on it elsewhere then."
    found = said("generic_inner:root", ranked={"id": "generic_inner:root", "generic": True, "sentence": told})
    assert (found["coordinate"], found["where"]) == ("body:car:pos", "joint:root")
    assert found["description"].startswith("looks like something that moves in a body, root: it follows")


@pytest.mark.parametrize(
    ("generic", "coordinate", "where"),
    [
        ("generic_position:root[2]", "body:car:pos[2]", "joint:root[2]"),
        ("generic_velocity:root[4]", "body:car:angvel@body[1]", "joint:root[4]"),
        ("generic_velocity:knee", "joint:knee:vel", "joint:knee"),
    ],
)
def test_a_smooth_force_that_is_believed_goes_before_a_law_that_is_not(
    generic: str, coordinate: str, where: str
) -> None:
    near = Proposal(LawHeight(("root[2]",)), np.ones(2), 0.2)
    found = said(generic, nearest=near, evidence={"root": 300.0, "knee": 0.0})
    assert (found["coordinate"], found["where"]) == (coordinate, where)
    assert found["description"].startswith("looks like a smooth force by ")


@pytest.mark.parametrize(
    ("hinted", "coordinate", "where", "text"),
    [
        (
            "generic_tread:knee",
            "joint:knee:pos",
            "joint:knee",
            "a force under a wheel that repeats with its turn, knee",
        ),
        ("generic_grip:ground", "body:car:pos", "ground", "friction of the ground that depends on the place, ground"),
        ("generic_inner:root", "body:car:pos", "joint:root", "something that moves in a body, root"),
        ("generic_memory:knee", "joint:knee:pos", "joint:knee", "a force with memory in knee"),
    ],
)
def test_what_gains_beyond_chance_says_where_though_it_is_not_believed(
    hinted: str, coordinate: str, where: str, text: str
) -> None:
    near = Proposal(LawHeight(("root[2]",)), np.ones(2), 0.02)
    found = said(None, hinted=hinted, nearest=near)
    assert (found["coordinate"], found["where"]) == (coordinate, where)
    assert found["description"].startswith(f"most like {text}, but not surely on unseen logs")
    assert said("generic_velocity:knee", hinted=hinted)["coordinate"] == "joint:knee:vel", (
        "what is believed goes before"
    )


def test_what_repeats_with_another_parts_turn_comes_from_that_part() -> None:
    law = LawHarmonic(("root[5]", "knee"))
    near = Proposal(law, law.null, 0.2)
    assert said(None, nearest=near, sure=True)["coordinate"] == "joint:knee:pos"
    # by chance any push may seem to repeat with something
    assert said(None, nearest=near)["coordinate"] == "body:car:angvel@body[2]"


def test_what_is_no_cause_leaves_all_of_it_to_be_placed() -> None:
    lift, knock = LawHeight(("root[2]",)), LawHarmonic(("knee",))
    beside, alone = Proposal(lift, lift.null, 0.01), Proposal(knock, knock.null, 0.2)
    assert said(None, ("wind:base",), nearest=beside, bare=alone)["coordinate"] == "joint:knee:pos"
    assert said(None, (), nearest=beside, bare=alone)["coordinate"] == "body:car:pos[2]"


def test_what_takes_away_too_little_is_named_as_the_nearest_and_no_cause() -> None:
    found = said(None, ("wind:base", "gain:rotor"))
    assert (found["nearest"], found["nearest_share"]) == ("wind:base + gain:rotor", 0.06)
    assert found["proposed"] == ["wind:base", "gain:rotor"]
    assert found["description"].endswith(
        "the nearest named effect, wind:base + gain:rotor, explains 6%, too little to be the cause"
    )
    guesses = said(None, ("wind:base",), ("gain:rotor", "payload:base"))["description"]
    assert guesses.endswith("explains 6%, but gain:rotor, payload:base would explain nearly as much")


def test_what_may_have_no_size_is_told_as_that() -> None:
    text = said(None, ("spring_offset:knee",), may_be_none=True)["description"]
    assert text.count(", and by its intervals may have no size at all") == 1
    assert "too little to be the cause" not in text


def test_what_mends_a_claim_of_another_form_is_said() -> None:
    text = said(None, ("spring_offset:knee",), mended_by="generic_position:knee")["description"]
    assert "but a smooth force by position at knee mends much of what that leaves" in text


def test_a_force_without_a_law_is_placed_where_its_evidence_leads() -> None:
    found = said(None, evidence={"root": 300.0, "knee": 160.0})
    assert (found["coordinate"], found["where"]) == ("body:car:pos", "joint:root")
    assert found["description"].startswith(
        "a force of unknown course on root explains it best, and no law of it is sure"
    )
    assert "; furthest beyond the noise is joint:knee (joint speed), with 9 times its mean" in found["description"]
    found = said(None, evidence={"knee": 300.0, "root": 160.0})
    assert (found["coordinate"], found["where"]) == ("joint:knee:pos", "joint:knee")
    assert "furthest beyond" not in found["description"], "it is the same place"
    unnamed = said(None, evidence={"root": 300.0}, text=MODEL.replace('<body name="car"', "<body"))
    assert (unnamed["coordinate"], unnamed["where"]) == ("joint:root", "joint:root")
    # a law on the same joint says more than that it is the joint, one on another joint is not asked
    lift = LawHeight(("root[2]",))
    near = Proposal(lift, lift.null, 0.2)
    found = said(None, evidence={"root": 300.0, "knee": 160.0}, nearest=near)
    assert (found["coordinate"], found["where"]) == ("body:car:pos[2]", "joint:root[2]")
    unnamed = said(None, evidence={"root": 300.0}, nearest=near, text=MODEL.replace('<body name="car"', "<body"))
    assert (unnamed["coordinate"], unnamed["where"]) == ("joint:root[2]", "joint:root[2]")
    assert said(None, evidence={"knee": 300.0, "root": 160.0}, nearest=near)["coordinate"] == "joint:knee:pos"
    # a lead that is no lead: where the misfit is most times the noise
    assert said(None, evidence={"root": 300.0, "knee": 295.0})["coordinate"] == "joint:knee:vel"


@pytest.mark.parametrize(
    ("law", "coordinate"),
    [
        (LawPower(("root[0]",)), "body:car:linvel[0]"),
        (LawPower(("root[0]@body",)), "body:car:linvel@body[0]"),
        (LawPower(("root[3]",)), "body:car:angvel@body[0]"),
        (LawHeight(("root[2]",)), "body:car:pos[2]"),
    ],
)
def test_where_the_rest_is_has_the_name_of_a_channel_and_the_axis_of_a_component(law: Any, coordinate: str) -> None:
    found = said(None, nearest=Proposal(law, law.null, 0.2))
    assert found["coordinate"] == coordinate
    channel = parse_channel(coordinate.partition("[")[0])
    assert observer(mujoco.MjModel.from_xml_string(MODEL), coordinate.partition("[")[0]) is not None
    assert channel.own_frame == ("@body" in coordinate)
    turned = law.where[0].removesuffix("@body")
    assert found["where"] == f"joint:{turned}"
