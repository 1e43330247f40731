"""Air, wind, rotors and outside forces against closed forms."""

import mujoco
import numpy as np
import pytest
from machines import make, plant_of, run

from nfc_gym.core.errors import InputError
from nfc_gym.measured.export import corrected
from nfc_gym.physics.effects import propose
from nfc_gym.physics.effects.air import hull
from nfc_gym.physics.effects.base import Scales
from nfc_gym.physics.effects.load import Wind
from nfc_gym.physics.effects.places import base_bodies, joint_places
from nfc_gym.physics.effects.rotor import RotorDrag
from nfc_gym.physics.segments import Segments

DT, MASS = 0.001, 2.0
FLYER = f"""
<mujoco><option timestep="{DT}" gravity="0 0 %s"/><worldbody><body name="b" simple="false"><freejoint align="false"/>
<inertial pos=".05 0 0" mass="{MASS}" diaginertia=".02 .02 .02"/><site name="up"/></body></worldbody>
<actuator><motor name="lift" site="up" gear="0 0 1 0 0 0"/></actuator></mujoco>"""
SLED = f"""
<mujoco><option timestep="{DT}" gravity="0 0 0"/><worldbody><body name="cart">
<joint name="y" type="slide" axis="0 1 0"/><joint name="x" type="slide" axis="1 0 0"/>
<body name="b"><joint name="yaw" axis="0 0 1"/><inertial pos=".1 0 0" mass="{MASS}" diaginertia=".02 .02 .02"/></body>
<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>"""
XYZ = dict.fromkeys("xyz", 0.0)


def test_linear_drag_decays_exponentially_along_each_axis() -> None:
    effect, theta = make("drag_linear", "b", {"x": 1.0, "y": 2.0, "z": 4.0})
    v = run(FLYER % 0, effect, theta, 500, qvel=[1, 1, 1, 0, 0, 0]).qvel[0, 0]
    time = np.arange(501) * DT
    # the centre of mass lies off the frame's origin but on the x axis of the pull: y and z also turn the body, x not
    alone = run(FLYER % 0, effect, theta, 500, qvel=[1, 0, 0, 0, 0, 0]).qvel[0, 0]
    np.testing.assert_allclose(alone[:, 0], np.exp(-1.0 / MASS * time), atol=1e-3)
    for axis, k in enumerate((1.0, 2.0, 4.0)):
        np.testing.assert_allclose(v[:, axis], np.exp(-k / MASS * time), atol=2e-3)
    # force at the centre of mass: no torque
    np.testing.assert_allclose(v[:, 3:], 0, atol=1e-9)


def test_quadratic_drag_decays_as_one_over_time() -> None:
    effect, theta = make("drag_quadratic", "b", {"x": 3.0, "y": 3.0, "z": 3.0})
    start = np.array([3.0, 4.0, 0.0])
    v = run(FLYER % 0, effect, theta, 500, qvel=[*start, 0, 0, 0]).qvel[0, 0, :, :3]
    time = np.arange(501) * DT
    np.testing.assert_allclose(v, start / (1 + 3.0 / MASS * 5.0 * time)[:, None], rtol=5e-3, atol=1e-9)


@pytest.mark.parametrize(("family", "power"), [("drag_linear", 1), ("drag_quadratic", 2)])
def test_fall_ends_at_terminal_velocity(family: str, power: int) -> None:
    effect, theta = make(family, "b", {"x": 0.0, "y": 0.0, "z": 4.0})
    v = run(FLYER % -10, effect, theta, 5000).qvel[0, 0, -1, 2]
    assert v == pytest.approx(-((10 * MASS / 4.0) ** (1 / power)), rel=1e-3)


def test_drag_turns_with_the_body() -> None:
    """Drag along the body's x only; turned by 90 degrees about z it brakes motion along the world's y."""
    effect, theta = make("drag_linear", "b", {"x": 2.0, "y": 0.0, "z": 0.0})
    turned = np.array([0, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    v = run(FLYER % 0, effect, theta, 400, qpos=turned, qvel=[1, 1, 0, 0, 0, 0]).qvel[0, 0, -1]
    assert v[0] == pytest.approx(1.0, abs=1e-9)
    assert v[1] == pytest.approx(np.exp(-2.0 / MASS * 0.4), rel=1e-3)


def test_a_body_that_spins_about_its_centre_of_mass_feels_no_drag() -> None:
    """The frame's origin circles the centre of mass, which stays where it is."""
    effect, theta = make("drag_linear", "b", {"x": 5.0, "y": 5.0, "z": 5.0})
    start = [0, -0.05 * 4.0, 0, 0, 0, 4.0]
    t = run(FLYER % 0, effect, theta, 300, qvel=start)
    turn = 4.0 * 0.3
    np.testing.assert_allclose(
        t.qpos[0, 0, -1, :2] + 0.05 * np.array([np.cos(turn), np.sin(turn)]), [0.05, 0], atol=5e-4
    )


def test_joints_of_a_floating_base_are_no_bearings() -> None:
    assert joint_places(mujoco.MjModel.from_xml_string(SLED)) == []


def test_planar_base_feels_drag_at_its_centre_of_mass() -> None:
    """The slides' body carries a turning one; drag of a body that turns on the spot about its centre is no force."""
    assert "b" in base_bodies(mujoco.MjModel.from_xml_string(SLED))
    effect, theta = make("drag_linear", "b", {"x": 2.0, "y": 2.0, "z": 0.0})
    spin = 1.5
    v = run(SLED, effect, theta, 300, qvel=[-0.1 * spin, 0.0, spin]).qvel[0, 0]
    assert v[-1, 2] == pytest.approx(spin, rel=1e-4)
    turned = np.array([-np.sin(0.3 * spin), np.cos(0.3 * spin)])
    np.testing.assert_allclose(v[-1, 1::-1] + 0.1 * spin * turned, 0, atol=2e-3)
    straight = run(SLED, effect, theta, 300, qvel=[0.0, 1.0, 0.0]).qvel[0, 0]
    assert straight[-1, 1] == pytest.approx(np.exp(-2.0 / MASS * 0.3), rel=2e-3)


RAIL = """
<mujoco><worldbody><body name="trolley"><joint name="rail" type="slide" axis="1 0 0"/>{turn}<geom size=".1"/>
  <body name="gimbal"><joint name="sway" axis="0 1 0"/><geom size=".01"/>
    <body name="load" pos="0 0 -1"><joint name="hoist" type="slide" axis="0 0 1"/><geom size=".1"/></body></body></body>
</worldbody></mujoco>"""


def _where(model: mujoco.MjModel, family: str) -> set[str]:
    """Bodies at which a family is proposed."""
    one = np.ones(model.nv)
    scales = Scales(one, one, one[:0], one[:0], 0.01, exogenous={"exo:time": 5.0})
    proposed = propose(model, scales, only=(family,), generic=False)
    return {n for e in proposed for n in e.where} - {model.joint(j).name for j in range(model.njnt)}


@pytest.mark.parametrize("family", ["drag_linear", "drag_quadratic", "wind", "gust", "external_force"])
def test_air_acts_on_what_swings_from_rails_and_on_no_limb_of_a_base_that_turns(family: str) -> None:
    """A push on a crane's load is nothing that one on the trolley and a torque on its joints could be."""
    for turn, found in (("", {"trolley", "load"}), ('<joint name="yaw" axis="0 0 1"/>', {"trolley"})):
        assert _where(mujoco.MjModel.from_xml_string(RAIL.format(turn=turn)), family) == found


def test_an_arm_beside_a_base_may_be_pushed_at_its_end() -> None:
    arm = """<body name="upper"><joint name="shoulder"/><geom size=".1"/>
    <body name="fore" pos="1 0 0"><joint name="elbow"/><geom size=".1"/></body></body></worldbody>"""
    model = mujoco.MjModel.from_xml_string(RAIL.format(turn="").replace("</worldbody>", arm))
    assert _where(model, "external_force") == {"trolley", "load", "fore"}
    assert _where(model, "wind") == {"trolley", "load"}


def test_a_body_that_moves_with_the_wind_feels_nothing() -> None:
    parameters = {"push_x": 3.0, "push_y": -1.5, "push_z": 0.0, "drag": 1.5}
    effect, theta = make("wind", "b", parameters)
    wind = np.array([2.0, -1.0, 0.0])
    still = run(FLYER % 0, effect, theta, 400, qvel=[*wind, 0, 0, 0]).qvel[0, 0, -1]
    np.testing.assert_allclose(still, [*wind, 0, 0, 0], atol=1e-12)
    # from rest it is carried along
    v = run(FLYER % 0, effect, theta, 400).qvel[0, 0, -1, :3]
    np.testing.assert_allclose(v, wind * (1 - np.exp(-1.5 / MASS * 0.4)), rtol=2e-3, atol=1e-9)


def test_wind_is_told_in_metres_per_second() -> None:
    assert "2.24 m/s" in Wind(("b",)).say(np.array([3.0, -1.5, 0.0, 1.5]))


def test_a_push_on_next_to_no_drag_has_no_speed() -> None:
    """The ratio of two numbers, one of which may be none, is no speed of the air."""
    said = Wind(("b",)).say(np.array([0.0, 0.0, 0.19, 5e-16]), np.array([0.01, 0.01, 0.01, 3e-3]))
    assert "m/s along" not in said
    assert "push z 0.19" in said
    assert "m/s along" not in Wind(("b",)).say(np.array([0.0, 0.0, 0.19, 5e-16]))
    assert "m/s along" in Wind(("b",)).say(np.array([3.0, 0.0, 0.0, 1.5]), np.full(4, 0.1))


def test_external_force_on_a_body_and_along_a_joint() -> None:
    effect, theta = make("external_force", "b", {"x": 1.0, "y": 2.0, "z": -3.0})
    v = run(FLYER % 0, effect, theta, 100).qvel[0, 0, -1]
    np.testing.assert_allclose(v, [*np.array([1.0, 2.0, -3.0]) / MASS * 0.1, 0, 0, 0], atol=1e-12)
    hinge = """<mujoco><worldbody><body><joint name="j" axis="0 0 1"/>
    <inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>
    </body></worldbody></mujoco>"""
    effect, theta = make("external_force", "j", {"force": 0.5})
    assert run(hinge, effect, theta, 100).qvel[0, 0, -1, 0] == pytest.approx(0.5 / 0.1 * 100 * 0.002)


def test_slope_lets_a_frictionless_body_slide_down() -> None:
    effect, theta = make("slope", "world", {"roll": 0.0, "pitch": 0.1})
    v = run(FLYER % -10, effect, theta, 100).qvel[0, 0, -1, :3]
    np.testing.assert_allclose(v, 10 * 0.1 * np.array([-np.sin(0.1), 0, -np.cos(0.1)]), rtol=1e-9)
    effect, theta = make("slope", "world", {"roll": 0.1, "pitch": 0.0})
    v = run(FLYER % -10, effect, theta, 100).qvel[0, 0, -1, :3]
    np.testing.assert_allclose(v, 10 * 0.1 * np.array([0, np.sin(0.1), -np.cos(0.1)]), rtol=1e-9)


def test_rotor_drag_grows_with_thrust_and_speed() -> None:
    """Without thrust nothing; with thrust T the plane velocity decays at k T / m, and a climb loses inflow * T * v."""
    effect, theta = make("rotor_drag", "b", {"drag": 0.05, "inflow": 0.02})
    free = run(FLYER % 0, effect, theta, 50, qvel=[1, 0, 0, 0, 0, 0]).qvel[0, 0, -1]
    np.testing.assert_allclose(free, [1, 0, 0, 0, 0, 0], atol=1e-12)
    lifted = FLYER.replace('pos=".05 0 0"', 'pos="0 0 0"') % 0
    v = run(lifted, effect, theta, 50, qvel=[1, 0, 2, 0, 0, 0], ctrl=[20.0]).qvel[0, 0]
    assert v[-1, 0] == pytest.approx(np.exp(-0.05 * 20 / MASS * 0.05), rel=1e-4)
    rate = 0.02 * 20 / MASS
    assert v[-1, 2] == pytest.approx(2 * np.exp(-rate * 0.05) + 20 / MASS / rate * (1 - np.exp(-rate * 0.05)), rel=1e-4)


def test_ground_effect_carries_more_near_the_ground() -> None:
    effect, theta = make("ground_effect", "b", {"strength": 0.04})
    lifted = FLYER.replace('pos=".05 0 0"', 'pos="0 0 0"') % -10
    for height in (0.1, 0.5, 3.0):
        start = np.array([0, 0, height, 1, 0, 0, 0.0])
        v = run(lifted, effect, theta, 1, qpos=start, ctrl=[10 * MASS]).qvel[0, 0, -1, 2]
        assert v == pytest.approx(10 * min(0.04 / (16 * height**2), 0.5) * DT, rel=1e-6)


def test_rotor_effects_want_rotors() -> None:
    model = mujoco.MjModel.from_xml_string(SLED)
    assert RotorDrag.propose(model, Scales(np.ones(3), np.ones(3), np.ones(0), np.ones(0), 0.01)) == []
    with pytest.raises(InputError, match="site"):
        make("rotor_drag", "b", {"drag": 0.1, "inflow": 0.1})[0].bind(model)


def test_rotors_lift_more_in_forward_flight() -> None:
    effect, theta = make("rotor_drag", "b", {"lift": 0.01})
    lifted = FLYER.replace('pos=".05 0 0"', 'pos="0 0 0"') % 0
    v = run(lifted, effect, theta, 50, qvel=[3, 0, 0, 0, 0, 0], ctrl=[20.0]).qvel[0, 0, -1]
    assert v[2] == pytest.approx(20 * (1 + 0.01 * 9) / MASS * 0.05, rel=1e-6)


def test_a_carried_body_has_the_velocity_of_its_own_centre_of_mass() -> None:
    """Not of the vehicle's common one: a link whose centre rests for an instant feels no drag then."""
    text = SLED.replace('mass="1e-6" diaginertia="1e-9 1e-9 1e-9"', 'mass="3" diaginertia=".1 .1 .1"')
    effect, theta = make("drag_linear", "b", {"x": 9.0, "y": 9.0, "z": 0.0})
    for speed, same in (([-0.1 * 1.5, 0.0, 1.5], True), ([0.0, 0.0, 1.5], False)):
        dragged = run(text, effect, theta, 1, qvel=speed).qvel
        free = run(text, None, [], 1, qvel=speed).qvel
        assert np.allclose(dragged, free, atol=1e-12) == same


@pytest.mark.parametrize("family", ["external_force", "wind", "drag_linear"])
def test_a_lump_does_not_move_the_hull(family: str) -> None:
    """Against MuJoCo with the lump as a body of its own, the force acting on the one that carries it."""
    start, at, lump = np.array([1.0, 0.5, 0, 0, 0, 3.0]), (0.1, 0.3, 0.0), 0.5
    reference = mujoco.MjSpec.from_string(FLYER % 0)
    carried = reference.body("b").add_body(pos=at)
    carried.explicitinertial, carried.ipos, carried.mass, carried.inertia = True, [0, 0, 0], lump, np.full(3, 1e-9)
    model = reference.compile()
    data = mujoco.MjData(model)
    data.qvel[:] = start
    mujoco.mj_forward(model, data)
    push, drag = np.array([2.0, 0.0, 0.0]), 0.0 if family == "external_force" else 3.0
    push = push * (family != "drag_linear")
    for _ in range(200):
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, velocity, 0)
        data.xfrc_applied[1, :3] = push - drag * velocity[3:]
        mujoco.mj_step(model, data)
    values = {"external_force": {"x": 2.0, "y": 0.0, "z": 0.0}, "drag_linear": dict.fromkeys("xyz", 3.0)}
    values["wind"] = {"push_x": 2.0, "push_y": 0.0, "push_z": 0.0, "drag": 3.0}
    riding = make("payload", "b", {"mass": lump, **dict(zip("xyz", at, strict=True))})
    nominal, (effect, theta) = mujoco.MjModel.from_xml_string(FLYER % 0), make(family, "b", values[family])
    segments = Segments(DT, 0, np.array([nominal.qpos0]), start[None], np.zeros((1, 200, 1)), {})
    found = plant_of(nominal, effect, riding[0]).shoot(np.concatenate([theta, riding[1]])[None], segments)
    np.testing.assert_allclose(found.qvel[0, 0, -1], data.qvel, atol=2e-3)


def test_a_model_whose_centre_of_mass_was_moved_says_where_its_hull_is() -> None:
    spec = mujoco.MjSpec.from_string(FLYER % 0)
    nominal = spec.compile()
    effect, theta = make("com_shift", "b", XYZ | {"y": 0.1})
    plant = plant_of(nominal, effect)
    text, outside = corrected(spec, plant, theta)
    moved = mujoco.MjModel.from_xml_string(text)
    assert not outside
    assert moved.body("b").ipos == pytest.approx([0.05, 0.1, 0.0])
    assert hull(moved, 1) == pytest.approx([0.05, 0.0, 0.0])
    assert hull(nominal, 1) == pytest.approx([0.05, 0.0, 0.0])
    again, _ = corrected(mujoco.MjSpec.from_string(text), plant, theta)
    assert hull(mujoco.MjModel.from_xml_string(again), 1) == pytest.approx([0.05, 0.0, 0.0])


@pytest.mark.parametrize(
    ("family", "where", "theta", "said"),
    [
        ("slope", "b", {"roll": 0.1, "pitch": 0.0}, "slope: `where` is 'b', want 'world'"),
        (
            "wind",
            "world",
            {"push_x": 1.0, "push_y": 0.0, "push_z": 0.0, "drag": 1.0},
            "the world does not move; bodies: b",
        ),
        ("external_force", "world", {"x": 1.0, "y": 0.0, "z": 0.0}, "the world does not move; bodies: b"),
        ("drag_linear", "world", {"x": 1.0, "y": 0.0, "z": 0.0}, "the world does not move; bodies: b"),
        ("drag_linear", "c", {"x": 1.0, "y": 0.0, "z": 0.0}, "no body named 'c'; bodies: b"),
    ],
)
def test_places_where_nothing_could_happen_are_refused(
    family: str, where: str, theta: dict[str, float], said: str
) -> None:
    effect, _ = make(family, where, theta)
    with pytest.raises(InputError, match=said):
        effect.bind(mujoco.MjModel.from_xml_string(FLYER % 0))


STAGE = """
<mujoco><worldbody>
  <body name="led" mocap="true" pos="0 0 2"><geom size=".1"/></body>
  <body name="pedestal"><geom size=".1"/>
    <body name="arm"><joint name="turn" axis="0 1 0"/><geom pos="0 0 .3" size=".1"/>
      <body name="tool" pos="0 0 .5"><geom size=".05"/></body></body></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("where", ["led", "pedestal"])
@pytest.mark.parametrize("family", ["payload", "inertia", "drag_linear", "external_force"])
def test_what_no_force_moves_is_refused(family: str, where: str) -> None:
    model = mujoco.MjModel.from_xml_string(STAGE)
    effect, _ = make(family, where, dict.fromkeys("xyz", 1.0) | ({"mass": 1.0} if family == "payload" else {}))
    with pytest.raises(InputError, match=f"body '{where}' does not move; bodies: arm, tool"):
        effect.bind(model)
    scales = Scales(np.ones(model.nv), np.ones(model.nv), np.zeros(0), np.zeros(0), 0.01)
    found = propose(model, scales, only=("payload", "inertia", "external_force"), generic=False)
    assert not {where} & {place for e in found for place in e.where}
    make("drag_linear", "tool", dict.fromkeys("xyz", 1.0))[0].bind(model)  # it moves with the arm
