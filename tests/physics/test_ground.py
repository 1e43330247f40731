"""Ground: sliding over patches, resting on what gives way, ploughing through soil; and a gust from above."""

import copy

import mujoco
import numpy as np
import pytest
from machines import make, plant_of, run, zoo
from test_slip import WHEEL

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import Context, Forces, Scales, propose
from nfc_gym.physics.effects.generic_ground import GenericGrip
from nfc_gym.physics.effects.ground import FrictionPatch
from nfc_gym.physics.fields import ModelFields

G = 9.81
# Three feet under a box that slides on a floor; the floor's friction, the feet's, and the feet's priority vary.
SLED = """<mujoco><option timestep=".002" cone="elliptic" integrator="implicitfast"/><worldbody>
<geom name="floor" type="plane" size="50 50 1" friction="{0}"/><body name="sled" pos="0 0 .049"><freejoint/>
<inertial pos="0 0 -.04" mass="3" diaginertia=".1 .1 .1"/>
<geom name="a" type="sphere" size=".05" pos=".2 0 0" friction="{1}" priority="{2}"/>
<geom name="b" type="sphere" size=".05" pos="-.2 .15 0" friction="{1}" priority="{2}"/>
<geom name="c" type="sphere" size=".05" pos="-.2 -.15 0" friction="{1}" priority="{2}"/></body></worldbody></mujoco>"""
HERE = {"x": 0.0, "y": 0.0, "radius_x": 20.0, "radius_y": 20.0}


def _slide(text: str, lost: float, steps: int = 900, **place: float) -> np.ndarray:
    """x of a sled that starts at 2 m/s."""
    model = mujoco.MjModel.from_xml_string(text)
    effect, theta = make("friction_patch", "ground", {"lost": lost} | HERE | place)
    return run(model, effect, theta, steps, qvel=[2, 0, 0, 0, 0, 0]).qpos[0, 0, :, 0]


@pytest.mark.parametrize(("floor", "feet", "priority"), [(0.6, 0.2, 0), (0.2, 0.6, 0), (0.9, 0.6, 1)])
def test_a_patch_stops_a_sled_by_its_own_friction(floor: float, feet: float, priority: int) -> None:
    """v^2 / (2 mu g) inside, whichever geom's friction rules the contact, and the nominal bits outside."""
    text = SLED.format(floor, feet, priority)
    assert _slide(text, 0.4)[-1] == pytest.approx(2.0**2 / (2 * 0.6 * 0.6 * G), rel=0.02)
    assert _slide(text, -0.5)[-1] == pytest.approx(2.0**2 / (2 * 0.6 * 1.5 * G), rel=0.02)
    np.testing.assert_array_equal(_slide(text, 0.4, y=30.0, radius_y=5.0), _slide(text, 0.0))


def test_a_sled_brakes_harder_once_it_is_in_the_patch() -> None:
    """A strip of doubled friction across its way: each foot's friction times its way adds up to m v^2 / 2."""
    x = _slide(SLED.format(0.3, 0.1, 0), -1.0, x=1.5, radius_x=1.0, radius_y=1e4)
    way = np.linspace(0, 1, 10001)
    braking = np.zeros_like(way)
    for foot, load in ((0.2, 0.5), (-0.2, 0.5)):  # the one in front, and both behind
        s = np.clip((1.1 - np.abs(way + foot - 1.5)) / 0.2, 0, 1)
        braking += load * 0.3 * G * (1 + s * s * (3 - 2 * s))
    spent = np.concatenate([[0], np.cumsum((braking[1:] + braking[:-1]) / 2 * way[1])])
    stop = float(np.interp(2.0**2 / 2, spent, way))
    assert stop < 0.8 * 2.0**2 / (2 * 0.3 * G) + 0.1
    assert x[-1] == pytest.approx(stop, rel=0.02)


def test_only_the_geoms_inside_feel_the_patch() -> None:
    """Slippery under the left foot alone: the sled turns towards the other."""
    model = mujoco.MjModel.from_xml_string(SLED.format(0.6, 0.2, 0))
    effect, theta = make("friction_patch", "b", {"lost": 0.9} | HERE)
    turned = run(model, effect, theta, 200, qvel=[2, 0, 0, 0, 0, 0]).qvel[0, 0, -1, 5]
    straight = run(model, effect, effect.null, 200, qvel=[2, 0, 0, 0, 0, 0]).qvel[0, 0, -1, 5]
    assert turned < -0.1
    assert abs(straight) < 0.01
    with pytest.raises(InputError, match=r"no geom 'floor' touches the ground; there are: a, b, c"):
        make("friction_patch", "floor", {"lost": 0.9} | HERE)[0].bind(model)


@pytest.mark.parametrize(("floor", "feet", "priority"), [(0.6, 0.2, 0), (0.2, 0.6, 0), (0.9, 0.6, 1)])
def test_grip_by_place_brakes_a_sled_by_the_friction_at_each_place(floor: float, feet: float, priority: int) -> None:
    """mu(x) = mu exp(c u) with u = x / 2 m: each foot's friction times its way adds up to m v^2 / 2."""
    model = mujoco.MjModel.from_xml_string(SLED.format(floor, feet, priority))
    effect = GenericGrip(("ground",))
    effect.reach = np.full(2, 2.0)
    theta = np.array([-0.8, 0.0, 0.0, 0.0, 0.0])
    x = run(model, effect, theta, 900, qvel=[2, 0, 0, 0, 0, 0]).qpos[0, 0, :, 0]
    way = np.linspace(0, 1, 10001)
    braking = 0.6 * G * sum(0.5 * np.exp(-0.8 * (way + foot) / 2) for foot in (0.2, -0.2))
    spent = np.concatenate([[0], np.cumsum((braking[1:] + braking[:-1]) / 2 * way[1])])
    assert x[-1] == pytest.approx(float(np.interp(2.0**2 / 2, spent, way)), rel=0.02)
    assert "33.0% less about (1.0, 0.0) m" in effect.say(theta)


def test_grip_by_place_is_looked_for_where_the_machine_was() -> None:
    model = mujoco.MjModel.from_xml_string(SLED.format(0.6, 0.2, 0))
    one, low, high = np.ones(model.nv), model.qpos0.copy(), model.qpos0.copy()
    low[:2], high[:2] = [-1.0, 0.5], [4.0, 1.5]
    scales = Scales(one, one, np.ones(0), np.ones(0), 0.01, low=low, high=high)
    (effect,) = GenericGrip.propose(model, scales)
    np.testing.assert_allclose(effect.basis(np.array([4.0, 0.5])), [1, -1, 1, -1, 1])
    assert GenericGrip.propose(model, Scales(one, one, np.ones(0), np.ones(0), 0.01)) == []


def test_patches_are_looked_for_where_the_machine_was() -> None:
    """A free base, and one on slides along x and y that begins elsewhere; not one that cannot move in both."""
    slides = SLED.replace(
        "<freejoint/>", '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
    ).replace('pos="0 0 .049"', 'pos="3 -2 .049"')
    for text, start in ((SLED, [0.0, 0.0]), (slides, [3.0, -2.0])):
        model = mujoco.MjModel.from_xml_string(text.format(0.6, 0.2, 0))
        one = np.ones(model.nv)
        low, high = model.qpos0.copy(), model.qpos0.copy()
        low[:2], high[:2] = [-1.0, 0.5], [4.0, 1.5]
        (effect,) = FrictionPatch.propose(model, Scales(one, one, np.ones(0), np.ones(0), 0.01, low=low, high=high))
        x, y = (next(p for p in effect.params if p.name == n) for n in "xy")
        assert x.probes[0] == pytest.approx(start[0] + 1.5)
        assert y.probes[0] == pytest.approx(start[1] + 1.0)
        assert FrictionPatch.propose(model, Scales(one, one, np.ones(0), np.ones(0), 0.01)) == []
    fixed = mujoco.MjModel.from_xml_string(BALL.format("", "", 1.0))
    here = fixed.qpos0
    assert FrictionPatch.propose(fixed, Scales(np.ones(1), np.ones(1), here, here, 0.01, low=here, high=here)) == []


BALL = """<mujoco><option timestep=".001"/><worldbody><geom name="floor" type="plane" size="5 5 1" {0}/>
<body pos="0 0 .1"><joint type="slide" axis="0 0 1"/><geom name="ball" size=".1" mass="{2}" {1}/></body></worldbody>
</mujoco>"""
FLAT = 'solimp="0.8 0.8 0.001"'  # an impedance that does not change with depth


@pytest.mark.parametrize("mass", [0.5, 4.0])
@pytest.mark.parametrize(
    ("floor", "ball"),
    [
        (f'{FLAT} solref="0.02 1"', f'{FLAT} solref="0.02 1"'),
        (f'{FLAT} solref="0.02 1"', f'{FLAT} solref="-2500 -100" priority="1"'),
        (f'{FLAT} solref="0.02 1"', f'{FLAT} solref="-2500 -100"'),
    ],
)
def test_soft_ground_sinks_by_weight_over_stiffness(mass: float, floor: str, ball: str) -> None:
    """m g / k with k = m w^2 / (1 - d) and w = (50 rad/s) / (1 + softness); damping leaves the depth as it is."""
    softness = 1.5
    effect, theta = make("compliance", "ground", {"softness": softness, "damping": 0.6})
    q = run(BALL.format(floor, ball, mass), effect, theta, 3000).qpos[0, 0, :, 0]
    stiffness = mass * (50 / (1 + softness)) ** 2 / (1 - 0.8)
    assert -q[-1] == pytest.approx(mass * G / stiffness, rel=0.02)
    assert np.ptp(q[-100:]) < 1e-9


def test_single_geoms_are_softer_where_their_own_values_rule() -> None:
    """Of a sled's three feet the one in front sinks (1 + softness)^2 times as deep, and the others as before."""
    softness, text = 2.0, SLED.replace("<geom", f"<geom {FLAT}")
    depth = []
    for of in ((None, []), make("compliance", "a", {"softness": softness, "damping": 0.0})):
        q = run(mujoco.MjModel.from_xml_string(text.format(0.6, 0.2, 1)), *of, 3000).qpos[0, 0, -1]
        pitch = 2 * np.arctan2(q[5], q[3])
        depth.append([0.05 - (q[2] - np.sin(pitch) * x) for x in (0.2, -0.2)])
    (front, back), (softer, same) = depth
    assert same == pytest.approx(back, rel=0.02)
    assert softer == pytest.approx((1 + softness) ** 2 * front, rel=0.02)
    for priority in (0, -1):
        ruled = mujoco.MjModel.from_xml_string(SLED.format(0.6, 0.2, priority))
        with pytest.raises(InputError, match="name `ground`, or give geoms a higher `priority`"):
            make("compliance", "a", {"softness": softness, "damping": 0.0})[0].bind(ruled)


def test_damping_of_the_ground_decides_whether_a_mass_rings() -> None:
    ring = {}
    for damping in (-0.8, 0.0):
        effect, theta = make("compliance", "ground", {"softness": 3.0, "damping": damping})
        text = BALL.format(f'{FLAT} solref="0.02 1"', f'{FLAT} solref="0.02 1"', 1.0)
        q = run(text, effect, theta, 3000).qpos[0, 0, :, 0]
        ring[damping] = float(q[-1] - q.min())  # how far it goes beyond where it comes to rest
    assert ring[0.0] < 1e-6
    assert ring[-0.8] > 0.002


def test_mjcf_carries_soft_and_deep_ground() -> None:
    """Fields go back into the spec; what plain MuJoCo then rolls out is what the hooks do."""
    text = SLED.format(0.6, 0.2, 0)
    for family, values in (("compliance", {"softness": 2.0, "damping": 0.5}), ("sinkage", {"depth": 0.01})):
        model, spec = mujoco.MjModel.from_xml_string(text), mujoco.MjSpec.from_string(text)
        effect, theta = make(family, "ground", values)
        mine = run(model, effect, theta, 300)
        if not effect.spec(spec, theta):
            edited = spec.compile()
            fields = ModelFields(edited, copy.copy(edited))
            effect.model(fields, theta)
            fields.commit()
            spec.copy_back(edited)
        theirs = run(mujoco.MjModel.from_xml_string(spec.to_xml()), None, [], 300)
        np.testing.assert_allclose(mine.qpos, theirs.qpos, atol=1e-9, err_msg=family)
        assert np.abs(mine.qpos - run(model, None, [], 300).qpos).max() > 1e-4


def test_things_rest_deeper_by_the_depth() -> None:
    model = mujoco.MjModel.from_xml_string(SLED.format(0.6, 0.2, 0))
    rest = [run(model, *make("sinkage", "ground", {"depth": depth}), 1000).qpos[0, 0, -1, 2] for depth in (0.0, 0.013)]
    assert rest[0] - rest[1] == pytest.approx(0.013, rel=1e-6)


def _rover() -> mujoco.MjModel:
    corners = enumerate([(0.4, 0.4), (0.4, -0.4), (-0.4, 0.4), (-0.4, -0.4)])
    inside = "".join(WHEEL.format(i, x, y, 0, 0.8) for i, (x, y) in corners)
    return mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep=".002" cone="elliptic"/><worldbody>
    <geom name="floor" type="plane" size="50 50 1"/><body name="rover" pos="0 0 .099"><freejoint/>
    <inertial pos="0 0 -.08" mass="20" diaginertia="1 1 1"/>{inside}</body></worldbody></mujoco>""")


def test_soil_takes_work_in_proportion_to_load_and_way() -> None:
    """The kinetic energy that a rolling rover loses is c m g times the way it goes."""
    model, c = _rover(), 0.08
    speed = np.zeros(model.nv)
    speed[0], speed[6:] = 1.5, 15.0
    effect, theta = make("sinkage", "ground", {"depth": 0.0, "resistance": c})
    kinetic, way = {}, 0.0
    for name, values in (("soil", theta), ("none", effect.null)):
        t = run(model, effect, values, 500, qvel=speed)
        data = mujoco.MjData(model)
        energy = []
        for k in (20, 400):
            data.qpos[:], data.qvel[:] = t.qpos[0, 0, k], t.qvel[0, 0, k]
            mujoco.mj_forward(model, data)
            mujoco.mj_energyVel(model, data)
            energy.append(float(data.energy[1]))
        kinetic[name] = energy[0] - energy[1]
        way = t.qpos[0, 0, 400, 0] - t.qpos[0, 0, 20, 0] if name == "soil" else way
    weight = float(model.body_mass.sum()) * G
    assert kinetic["soil"] - kinetic["none"] == pytest.approx(c * weight * way, rel=0.03)


@pytest.mark.parametrize("resistance", [0.3, 0.6, 1.0])
def test_a_rover_that_soil_has_stopped_stands_still_at_any_step(resistance: float) -> None:
    """The way to rest, v^2 / (2 c g) of the mass that rolls, hardly depends on the step; nothing shakes afterwards."""
    way = {}
    for step in (0.005, 0.0005):
        model = _rover()
        model.opt.timestep = step
        speed = np.zeros(model.nv)
        speed[0], speed[6:] = 1.0, 10.0
        t = run(model, *make("sinkage", "ground", {"depth": 0.0, "resistance": resistance}), int(2 / step), qvel=speed)
        assert np.abs(t.qvel[0, 0, -int(0.3 / step) :, 0]).max() < 1e-6
        way[step] = float(t.qpos[0, 0, -1, 0])
    assert way[0.005] == pytest.approx(way[0.0005], abs=0.005)


def test_soil_under_one_wheel_and_without_wheels() -> None:
    model = _rover()
    speed = np.zeros(model.nv)
    speed[0], speed[6:] = 1.5, 15.0
    ends = {
        where: run(model, *make("sinkage", where, values), 200, qvel=speed).qvel[0, 0, -1]
        for where, values in (("w0", {"resistance": 0.2}), ("ground", {"depth": 0.0, "resistance": 0.2}))
    }
    none = run(model, None, [], 200, qvel=speed).qvel[0, 0, -1]
    assert (none - ends["w0"])[0] == pytest.approx((none - ends["ground"])[0] / 4, rel=0.05)
    assert ends["w0"][5] > 5 * abs(none[5])  # the front left wheel is held back
    sled = mujoco.MjModel.from_xml_string(SLED.format(0.6, 0.2, 0))
    with pytest.raises(InputError, match="wheels"):
        make("sinkage", "ground", {"depth": 0.01, "resistance": 0.1})[0].bind(sled)
    with pytest.raises(InputError, match="touch its ground"):
        make("compliance", "ground", {"softness": 1.0, "damping": 0.0})[0].bind(
            mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>")
        )


def test_a_gust_gives_its_impulse_within_its_time() -> None:
    """push * length / 2 in all, the nominal flight bit for bit before it, and no force after it."""
    model, dt = zoo(), 0.002
    effect, theta = make("gust", "craft", {"push_x": 3.0, "push_y": 0.0, "push_z": -1.0, "start": 0.1, "length": 0.3})
    time = np.arange(300) * dt
    t = run(model, effect, theta, 300, exogenous={"exo:time": time})
    nominal = run(model, None, [], 300)
    gained = (t.qvel - nominal.qvel)[0, 0]
    mass = model.body("craft").mass[0]
    np.testing.assert_array_equal(gained[:51], 0)
    assert mass * gained[-1, 0] == pytest.approx(3.0 * 0.3 / 2, rel=1e-3)
    assert mass * gained[-1, 2] == pytest.approx(-1.0 * 0.3 / 2, rel=1e-3)
    middle = 50 + 75  # half of the impulse is given at half of the time
    assert mass * gained[middle, 0] == pytest.approx(3.0 * 0.3 / 4, rel=2e-2)
    np.testing.assert_allclose(gained[205:, 0], gained[-1, 0], rtol=1e-6)
    with pytest.raises(InputError, match="exo:time"):
        run(model, effect, theta, 3)
    assert plant_of(model, effect).effects[0].signals == ("exo:time",)


def test_a_tread_pushes_with_the_wheels_turn_ahead_across_and_up() -> None:
    """A rover whose wheels hardly turn: the force on its base adds up, whichever way it heads."""
    corners = enumerate([(0.4, 0.4), (0.4, -0.4), (-0.4, 0.4), (-0.4, -0.4)])
    inside = "".join(WHEEL.format(i, x, y, 1e4, 0.6) for i, (x, y) in corners)
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep=".002"/><worldbody>
    <geom type="plane" size="50 50 1"/><body name="rover" pos="0 0 2"><freejoint/>
    <inertial pos="0 0 0" mass="20" diaginertia="1 1 1"/>{inside}</body></worldbody></mujoco>""")
    names = ("ahead_cosine", "ahead_sine", "across_cosine", "across_sine", "up_cosine", "up_sine")
    effect, theta = make("generic_tread", "w1", dict(zip(names, [1.0, 2.0, -3.0, 4.0, 5.0, -6.0], strict=True)))
    data, angle, yaw = mujoco.MjData(model), 0.7, 0.4
    data.qpos[3:7] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    data.qpos[model.joint("w1").qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    effect.bind(model)
    out = Forces(np.zeros(model.nv), np.zeros((model.nbody, 6)))
    read = {"opt.gravity": model.opt.gravity}
    effect.force(
        Context(model, 0.002, data.qpos, data.qvel, data.ctrl, {}, lambda n: getattr(data, n), read.__getitem__),
        theta,
        out,
    )
    ahead, across, up = (a * np.cos(angle) + b * np.sin(angle) for a, b in zip(theta[::2], theta[1::2], strict=True))
    want = [ahead * np.cos(yaw) - across * np.sin(yaw), ahead * np.sin(yaw) + across * np.cos(yaw), up]
    np.testing.assert_allclose(out.xfrc[model.body("w1").id], [*want, 0, 0, 0], atol=1e-12)
    assert np.count_nonzero(out.xfrc.any(1)) == 1
    with pytest.raises(InputError, match=r"'knee' is no wheel's joint; there are: w0, w1, w2, w3"):
        make("generic_tread", "knee", dict.fromkeys(names, 0.0))[0].bind(model)
    one, none = np.ones(model.nv), np.ones(0)
    proposed = {e.id: e for e in propose(model, Scales(one, one, none, none, 0.01))}
    assert [i for i in proposed if "tread" in i] == [f"generic_tread:w{i}" for i in range(4)]
    assert proposed["generic_tread:w0"].params[0].probes[0] == pytest.approx(0.1 * 22 * G / 4)
