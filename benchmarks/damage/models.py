"""Damage to models: MJCF and URDF text."""

import re
from collections.abc import Callable
from random import Random

from damage.case import Case
from damage.values import BYTES

Kind = Callable[[Case, Random], None]

URDF = """<robot name="r"><link name="base"/><link name="bob"><inertial><mass value="0.1"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="bob"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""


def contents(case: Case, rng: Random) -> None:
    damage = BYTES[rng.choice(list(BYTES))]
    case.edits["machine.xml"] = lambda content: damage(content, rng)


def attribute(case: Case, rng: Random) -> None:
    """An attribute has another value."""
    for _ in range(rng.randint(1, 3)):
        spots = list(re.finditer(r'(\w+)="([^"]*)"', case.model))
        spot = rng.choice(spots)
        new = rng.choice(("", "nan", "inf", "-1", "0", "1e308", "1e-308", "0 0 0", "1 2 3 4 5 6 7 8 9", "abc",
        "hinge", "bob", "true",
                          "1e999", "ü", "&#0;", "&lt;", "99999999999", "0.5", "-0", "1e-9", "1e9",
                          "x" * 3000))  # fmt: skip
        case.model = case.model[: spot.start(2)] + new + case.model[spot.end(2) :]


def element(case: Case, rng: Random) -> None:
    """An element is gone, doubled, renamed, or stands elsewhere."""
    spots = list(re.finditer(r"<[^/!][^>]*>", case.model))
    spot, other = rng.choice(spots), rng.choice(spots)
    how = rng.randrange(4)
    if how == 0:
        case.model = case.model[: spot.start()] + case.model[spot.end() :]
    elif how == 1:
        case.model = case.model[: other.start()] + spot[0] + case.model[other.start() :]
    elif how == 2:
        case.model = case.model.replace(
            spot[0], re.sub(r"^<\w+", f"<{rng.choice(('bodi', 'geom', 'mujoco', 'x', 'include'))}", spot[0])
        )
    else:
        case.model = case.model.replace(spot[0], "").replace(other[0], other[0] + spot[0])


def inserted(case: Case, rng: Random) -> None:
    """Something that does not belong there, or reaches outside."""
    new = rng.choice((
        '<include file="/etc/passwd"/>', '<include file="../../nothing.xml"/>', '<include file="machine.xml"/>',
        '<include file=""/>',
        '<asset><mesh name="m" file="/etc/hostname"/></asset>', '<asset><mesh name="m" file="no.stl"/></asset>',
        "<worldbody/>",
        '<asset><hfield name="h" nrow="3" ncol="3" size="1 1 0 0"/></asset>', '<option timestep="0"/>',
        '<option timestep="-1"/>',
        '<option timestep="1e-9"/>', '<option timestep="10"/>', '<option timestep="nan"/>',
        '<option gravity="nan 0 0"/>', '<option gravity="0 0 1e9"/>',
        '<size memory="1"/>', '<size nstack="5"/>', '<keyframe><key qpos="1"/></keyframe>',
        '<equality><weld body1="bob" body2="x"/></equality>',
        '<worldbody><body name="bob"/></worldbody>', '<worldbody><body><joint/></body></worldbody>',
        '<worldbody><body><freejoint/></body></worldbody>',
        '<default class="main"><geom mass="0"/></default>', '<compiler angle="degree"/>',
        '<compiler inertiafromgeom="false"/>',
        '<compiler autolimits="false"/>', '<option integrator="RK4"/>', '<actuator><motor joint="root"/></actuator>',
        '<actuator><motor name="servo" joint="hinge"/></actuator>',
        '<actuator><general joint="hinge" dyntype="user" actdim="3"/></actuator>',
        '<sensor><gyro name="gyro" site="imu"/></sensor>', '<sensor><user dim="3" name="u"/></sensor>',
        '<extension><plugin plugin="mujoco.pid"/></extension>',
        '<extension><plugin plugin="no.such"/></extension>', '<contact><exclude body1="bob" body2="bob"/></contact>',
        '<tendon><fixed name="t"/></tendon>',
        "<!-- <mujoco> -->", "<![CDATA[ x ]]>", "<?xml version='9'?>", '<!DOCTYPE m [<!ENTITY a "b">]>', "&a;",
    ))  # fmt: skip
    at = rng.choice([m.end() for m in re.finditer(r">", case.model)])
    case.model = case.model[:at] + new + case.model[at:]


URDF_EDITS = (
    ("bob", "bob"), ("revolute", "fixed"), ("revolute", "planar"), ('value="0.1"', 'value="-1"'), ("0 1 0", "0 0 0"),
    ('<link name="base"/>', ""), ('parent link="base"', 'parent link="bob"'), ("robot", "mujoco"), ("1e-3", "0"),
    ("<inertial>", '<visual><geometry><mesh filename="package://x"/></geometry></visual><inertial>'),
)  # fmt: skip
NAMES = (
    "", ".", "..", "no.xml", "run_0.npz", "mapping.yaml", "/dev/null", "/etc/passwd", "jackal", "Jackal", "ant",
    "JackalFlat",
    "nfc_gym/JackalFlat-v0", "nfc_gym/Jackal-v9", "machine", "./machine.xml", "machine.xml/", "x" * 400, "a\0b",
)  # fmt: skip


def urdf(case: Case, rng: Random) -> None:
    """A URDF under the same name, sound or not."""
    case.model = URDF.replace(*rng.choice(URDF_EDITS))


def named(case: Case, rng: Random) -> None:
    """The mapping names another model."""
    case.mapping["model"] = rng.choice(NAMES)


MODELS: dict[str, Kind] = {
    f"model: {f.__name__.replace('_', ' ')}": f for f in (contents, attribute, element, inserted, urdf, named)
}
