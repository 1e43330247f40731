"""Wheel slip: stopping distances of a sliding rover, across and along its wheels."""

import mujoco
import numpy as np
import pytest
from machines import make, run

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Context, Forces
from nfc_gym.physics.effects.slip import wheels

MU, G = 0.6, 9.81
# Four wheels whose hinges hardly turn (huge rotor inertia): the rover slides in any direction.
WHEEL = """<body name="w{0}" pos="{1} {2} 0"><joint name="w{0}" axis="0 1 0" armature="{3}"/>
<geom name="w{0}" type="ellipsoid" size=".1 .04 .1" mass=".5" friction="{4}"/></body>"""


def _rover(armature: float = 1e4, mu: float = MU) -> mujoco.MjModel:
    corners = enumerate([(0.4, 0.4), (0.4, -0.4), (-0.4, 0.4), (-0.4, -0.4)])
    inside = "".join(WHEEL.format(i, x, y, armature, mu) for i, (x, y) in corners)
    return mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep=".002" cone="elliptic"/><worldbody>
    <geom type="plane" size="50 50 1" friction=".1"/><body name="rover" pos="0 0 .099"><freejoint/>
    <inertial pos="0 0 -.08" mass="20" diaginertia="1 1 1"/>{inside}</body></worldbody></mujoco>""")


def _stop(model: mujoco.MjModel, direction: list[float], where: str = "ground", **parameters: float) -> float:
    """Distance until a start at 2 m/s has come to rest."""
    effect, theta = make("slip", where, {"lateral": 0.0, "longitudinal": 0.0} | parameters)
    speed = np.zeros(model.nv)
    speed[:2] = 2 * np.array(direction)
    t = run(model, effect, theta, 1200, qvel=speed)
    assert t.stable.all()
    assert np.abs(t.qvel[0, 0, -1, :2]).max() < 0.05
    return float(np.linalg.norm(t.qpos[0, 0, -1, :2]))


def test_wheels_are_found_and_other_hinges_are_not() -> None:
    assert len(wheels(_rover())) == 4
    arm = """<mujoco><worldbody><body><joint axis='0 1 0'/><geom type='capsule' fromto='0 0 0 0 0 -1' size='.1'/></body>
    </worldbody></mujoco>"""
    assert wheels(mujoco.MjModel.from_xml_string(arm)) == []
    with pytest.raises(InputError, match="wheels"):
        make("slip", "ground", {"lateral": 0.1, "longitudinal": 0.0})[0].bind(mujoco.MjModel.from_xml_string(arm))


@pytest.mark.parametrize(
    ("direction", "name", "other"), [([0, 1], "lateral", "longitudinal"), ([1, 0], "longitudinal", "lateral")]
)
def test_lost_grip_lengthens_the_slide_in_its_own_direction(direction: list[float], name: str, other: str) -> None:
    """v^2 / (2 mu g (1 - share)) across (along) the wheels; the other direction's share changes nothing."""
    model = _rover()
    full = 2.0**2 / (2 * MU * G)
    assert _stop(model, direction) == pytest.approx(full, rel=0.03)
    assert _stop(model, direction, **{name: 0.4}) == pytest.approx(full / 0.6, rel=0.04)
    assert _stop(model, direction, **{other: 0.4}) == pytest.approx(full, rel=0.03)


def test_the_higher_friction_or_priority_counts() -> None:
    """With priority on the wheels the law uses their low friction, not the larger one of the ground."""
    model = _rover(mu=0.3)
    model.geom_friction[0, 0] = 0.9
    model.geom_priority[1:] = 1
    full = 2.0**2 / (2 * 0.3 * G)
    assert _stop(model, [0, 1], lateral=0.3) == pytest.approx(full / 0.7, rel=0.05)


def test_rolling_wheels_are_left_alone() -> None:
    """Free wheels that roll without sliding: the share of grip along them does not matter."""
    model = _rover(armature=0.0)
    speed = np.zeros(model.nv)
    speed[0], speed[6:] = 1.0, 1.0 / 0.1
    ends = []
    for share in (0.0, 0.5):
        effect, theta = make("slip", "ground", {"lateral": share, "longitudinal": share})
        ends.append(run(model, effect, theta, 300, qvel=speed).qpos[0, 0, -1, 0])
    assert ends[1] == pytest.approx(ends[0], rel=0.01)
    assert ends[0] == pytest.approx(0.6, rel=0.05)


def test_one_wheel_turns_the_rover() -> None:
    """A wheel at the front left that grips less makes a sideways slide turn the rover."""
    model = _rover()
    speed = np.zeros(model.nv)
    speed[1] = 2.0
    effect, theta = make("slip", "w0", {"lateral": 0.9, "longitudinal": 0.0})
    yaw_rate = run(model, effect, theta, 100, qvel=speed).qvel[0, 0, -1, 5]
    straight = run(model, effect, effect.null, 100, qvel=speed).qvel[0, 0, -1, 5]
    assert abs(straight) < 0.02
    assert yaw_rate > 0.1


def test_creep_slides_below_the_cone_in_proportion_to_the_force() -> None:
    """Pushed with a part of what friction could hold, the rover drifts steadily, twice as fast for twice the push."""
    model = _rover()
    drift = {}
    for creep in (0.0, 100.0):
        for push in (0.1, 0.2):
            model.opt.gravity[:] = (0, push * MU * G, -G)
            effect, theta = make("slip", "ground", {"creep": creep})
            t = run(model, effect, theta, 600)
            drift[creep, push] = float(t.qvel[0, 0, -200:, 1].mean())
    assert drift[100.0, 0.2] > 10 * drift[0.0, 0.2] > 0
    assert drift[100.0, 0.2] / drift[100.0, 0.1] == pytest.approx(2, rel=0.1)


FLOOR = '<geom name="floor" type="plane" size="50 50 1" friction=".8"/>'
WALL = '<geom name="wall" type="box" size=".1 1 1" pos="5 0 1" friction="2"/>'
SIDE = '<geom name="side" type="plane" size="9 9 1" pos="0 8 0" euler="90 0 0" friction="2"/>'
TABLE = '<geom name="table" type="box" size="2 2 .1" pos="0 0 3" friction="2"/>'
STAGE = '<geom name="stage" type="box" size="2 2 .1" pos="0 0 -.1" friction="1.2"/>'
PIT = '<geom name="floor" type="plane" size="50 50 1" pos="0 0 -1" friction=".8"/>'
FIELD = '<geom name="hills" type="hfield" hfield="hills" friction="1.2"/>'


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        (FLOOR + WALL, 0.8),
        (WALL + FLOOR, 0.8),
        (SIDE + FLOOR, 0.8),
        (TABLE + FLOOR, 0.8),
        (PIT + STAGE, 1.2),
        (STAGE + PIT, 1.2),
        (PIT + FIELD, 1.2),
        (WALL + FIELD, 1.2),
    ],
)
def test_the_friction_is_that_of_what_the_wheels_stand_on(scene: str, expected: float) -> None:
    """Lost grip is given back in proportion to it, whatever else stands about."""
    wheels_ = "".join(WHEEL.format(i, x, y, 1e4, 0.6) for i, (x, y) in enumerate([(0.4, 0.4), (-0.4, -0.4)]))
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep=".002" cone="elliptic"/>
    <asset><hfield name="hills" nrow="3" ncol="3" size="3 3 1 .1" elevation="0 0 0 0 0 0 0 0 1"/></asset>
    <worldbody>{scene}<body name="rover" pos="0 0 .099"><freejoint/>
    <inertial pos="0 0 -.08" mass="20" diaginertia="1 1 1"/>{wheels_}</body></worldbody></mujoco>""")
    effect, theta = make("slip", "ground", {"lateral": 0.5, "longitudinal": 0.0})
    effect.bind(model)
    data = mujoco.MjData(model)
    data.qvel[1] = 1.0
    mujoco.mj_forward(model, data)
    out = Forces(np.zeros(model.nv), np.zeros((model.nbody, 6)))
    read = lambda name: getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)  # noqa: E731
    effect.force(
        Context(model, 0.002, data.qpos, data.qvel, data.ctrl, {}, lambda n: getattr(data, n), read), theta, out
    )
    weight = model.body_mass.sum() * G
    assert out.xfrc[:, 1].sum() == pytest.approx(0.5 * expected * weight / np.sqrt(1 + 0.02**2), rel=1e-6)
