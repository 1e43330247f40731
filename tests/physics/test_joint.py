"""Damping, rotor inertia, springs and cogging against closed forms."""

import mujoco
import numpy as np
import pytest
from machines import make, plant_of, run

from nfc_gym.core.errors import InputError
from nfc_gym.measured.export import corrected
from nfc_gym.physics.effects import FAMILIES, Scales, build, propose
from nfc_gym.physics.effects.joint import Cogging

DT, MASS = 0.001, 2.0
RAIL = f"""
<mujoco><option timestep="{DT}" gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="rail" type="slide" axis="1 0 0"/><geom type="sphere" size=".1" mass="{MASS}"/></body></worldbody>
</mujoco>"""
ROTOR = f"""
<mujoco><option timestep="{DT}" gravity="0 0 0" integrator="RK4"/><worldbody><body><joint name="turn" axis="0 0 1"/>
<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/></body></worldbody></mujoco>"""
INERTIA = 0.01


def _decay(**parameters: float) -> np.ndarray:
    effect, theta = make("damping_poly", "rail", {"linear": 0.0, "quadratic": 0.0, "cubic": 0.0} | parameters)
    return run(RAIL, effect, theta, 1000, qvel=[1.0]).qvel[0, 0, :, 0]


def test_linear_damping_decays_exponentially() -> None:
    time = np.arange(1001) * DT
    np.testing.assert_allclose(_decay(linear=3.0), np.exp(-3.0 / MASS * time), atol=1e-3)


def test_quadratic_damping_decays_as_one_over_time() -> None:
    time = np.arange(1001) * DT
    np.testing.assert_allclose(_decay(quadratic=3.0), 1 / (1 + 3.0 / MASS * time), atol=1e-3)


def test_cubic_damping_decays_as_one_over_root_time() -> None:
    time = np.arange(1001) * DT
    np.testing.assert_allclose(_decay(cubic=3.0), 1 / np.sqrt(1 + 2 * 3.0 / MASS * time), atol=1e-3)


def _period(family: str, parameters: dict[str, float], text: str, joint: str, start: float) -> float:
    """Period of an oscillation about zero from its upward zero crossings, interpolated."""
    effect, theta = make(family, joint, parameters)
    t = run(text, effect, theta, 6000, qpos=np.array([start]))
    q = t.qpos[0, 0, :, 0]
    up = np.flatnonzero((q[:-1] < 0) & (q[1:] >= 0))
    return float(np.diff(up + q[up] / (q[up] - q[up + 1])).mean() * DT)


def test_spring_sets_the_period() -> None:
    period = _period("spring_offset", {"stiffness": 0.5, "rest": 0.0}, ROTOR, "turn", 0.3)
    assert period == pytest.approx(2 * np.pi * np.sqrt(INERTIA / 0.5), rel=1e-4)


def test_armature_adds_to_the_inertia() -> None:
    sprung = ROTOR.replace('axis="0 0 1"', 'axis="0 0 1" stiffness=".5"')
    period = _period("armature", {"inertia": 0.02}, sprung, "turn", 0.3)
    assert period == pytest.approx(2 * np.pi * np.sqrt((INERTIA + 0.02) / 0.5), rel=1e-4)


def test_two_springs_balance_at_their_weighted_mean() -> None:
    """A spring of 3 at rest 0.2 beside the model's 1 at rest -0.2: force as the sum of both."""
    text = ROTOR.replace('axis="0 0 1"', 'axis="0 0 1" stiffness="1" springref="-.2"').replace("RK4", "Euler")
    text = text.replace('springref="-.2"', f'springref="{np.degrees(-0.2)}"')
    effect, theta = make("spring_offset", "turn", {"stiffness": 3.0, "rest": 0.2})
    for q in (-0.3, 0.1, 0.5):
        v = run(text, effect, theta, 1, qpos=np.array([q])).qvel[0, 0, 1, 0]
        assert v / DT * INERTIA == pytest.approx(-(q + 0.2) - 3 * (q - 0.2), rel=1e-6, abs=1e-9)


def test_cogging_does_its_work_and_returns_it() -> None:
    """Energy is conserved: 1/2 I v^2 + U(q), U the integral of the cogging torque."""
    cosine, sine, order = 0.02, 0.03, 3
    effect, theta = make("cogging", "turn", {"cosine": cosine, "sine": sine, "order": order})
    t = run(ROTOR.replace("RK4", "Euler"), effect, theta, 2000, qvel=[3.0])
    q, v = t.qpos[0, 0, :, 0], t.qvel[0, 0, :, 0]
    potential = -(cosine * np.sin(order * q) - sine * np.cos(order * q)) / order
    energy = INERTIA * v**2 / 2 + potential
    assert np.ptp(q) > 2 * np.pi / order
    assert np.ptp(v) > 0.3
    np.testing.assert_allclose(energy, energy[0], rtol=5e-3)


def test_groups_share_one_value() -> None:
    text = """<mujoco><worldbody><body><joint name="hip_l" axis="0 0 1"/><geom size=".1"/></body>
    <body><joint name="hip_r" axis="0 0 1"/><geom size=".1"/></body></worldbody></mujoco>"""
    effect, theta = make("damping_poly", ["hip_l", "hip_r"], {"linear": 0.3, "quadratic": 0.0, "cubic": 0.0})
    v = run(mujoco.MjModel.from_xml_string(text), effect, theta, 100, qvel=[1.0, 2.0]).qvel[0, 0]
    np.testing.assert_allclose(v[:, 1], 2 * v[:, 0])
    assert v[-1, 0] < 0.95


@pytest.mark.parametrize(("travel", "least"), [(7.0, 0.9), (1.0, 6.3), (0.3, 21.0), (0.1, None), (None, 0.5)])
def test_cogging_is_looked_for_where_a_joint_travels_as_far_as_it_repeats(
    travel: float | None, least: float | None
) -> None:
    one = np.ones(1)
    ends = {} if travel is None else {"low": np.array([0.2]), "high": np.array([0.2 + travel])}
    found = Cogging.propose(mujoco.MjModel.from_xml_string(ROTOR), Scales(one, one, one[:0], one[:0], 0.01, **ends))
    if least is None:
        assert found == []
        return
    order = found[0].params[2]
    assert order.low == pytest.approx(least, abs=0.1)
    assert all(order.low < p <= order.high for p in order.probes)
    assert order.probes[-1] == (12.0 if least < 12 else pytest.approx(1.5 * order.low))


BOTH = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody><body><joint name="rail" type="slide"/><geom size=".1"/>
<body><joint name="pivot"/><geom size=".1" pos=".2 0 0"/></body></body></worldbody></mujoco>""")


@pytest.mark.parametrize(
    ("family", "parameters", "units"),
    [
        ("generic_memory", {f"c{k}": 0.1 for k in range(6)}, ["N"] * 6),
        ("coulomb", {"level": 0.2}, ["N"]),
        ("damping_poly", {"linear": 0.1, "quadratic": 0.0, "cubic": 0.0}, ["N s/m", "N s^2/m^2", "N s^3/m^3"]),
        ("armature", {"inertia": 0.1}, ["kg"]),
        ("external_force", {"force": 1.0}, ["N"]),
    ],
)
def test_units_are_those_of_the_joint(family: str, parameters: dict[str, float], units: list[str]) -> None:
    for joint, wanted in (("rail", units), ("pivot", [p.unit for p in build(family, "pivot", parameters)[0].params])):
        effect, _ = build(family, joint, parameters)
        effect.bind(BOTH)
        assert [p.unit for p in effect.params] == wanted


def test_generic_alternatives_are_proposed_with_the_units_of_the_joint() -> None:
    ones = np.ones(BOTH.nv)
    scales = Scales(force=ones, speed=ones, command=np.ones(0), actuation=np.ones(0), interval=0.01)
    found = {
        e.where[0]: e.params[0].unit for e in propose(BOTH, scales, only=("none",)) if e.family == "generic_memory"
    }
    assert found == {"rail": "N", "pivot": "N m"}


def test_less_damping_than_the_model_has_is_within_the_bounds() -> None:
    """A draw over an interval is kept within them (`nfc-gym adapt --vary`)."""
    effect, theta = build("damping_poly", "pivot", {"linear": -0.01, "quadratic": 0.0, "cubic": 0.0})
    effect.require_possible(theta)
    assert (effect.low <= theta).all()


@pytest.mark.parametrize("angle", ["degree", "radian"])
@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_a_spring_in_the_model_has_its_rest_in_the_models_own_unit(angle: str, kind: str) -> None:
    """1 N m/rad at 0.2 beside 3 at 0.6, whatever the unit of angles: a slide has none."""
    own = 0.2 if kind == "slide" or angle == "radian" else float(np.degrees(0.2))
    text = f"""<mujoco><compiler angle="{angle}"/><worldbody><body>
    <joint name="turn" type="{kind}" stiffness="1" springref="{own!r}"/><geom size=".1"/></body></worldbody></mujoco>"""
    spec = mujoco.MjSpec.from_string(text)
    effect, theta = build("spring_offset", "turn", {"stiffness": 3.0, "rest": 0.6})
    written, outside = corrected(spec, plant_of(spec.compile(), effect), theta)
    model = mujoco.MjModel.from_xml_string(written)
    assert not outside
    np.testing.assert_allclose(model.jnt_stiffness, 4.0)
    np.testing.assert_allclose(model.qpos_spring, 0.5, rtol=1e-5)


WRIST = mujoco.MjModel.from_xml_string("""
<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="wrist" type="ball"/><geom type="box" size=".1 .1 .1"/>
<body><joint name="thumb"/><geom size=".05" pos=".2 0 0"/></body></body>
<body pos="3 0 0"><freejoint name="flight"/><geom size=".1"/></body></worldbody></mujoco>""")
ROUND = {
    "coulomb": {"level": 0.05},
    "damping_poly": {"linear": 0.1, "quadratic": 0.0, "cubic": 0.0},
    "armature": {"inertia": 0.1},
}
# Families that take a joint's name and one number for its force, position or speed.
LINEAR = ("stribeck", "load_friction", "directional_friction", "spring_offset", "hysteresis", "backlash", "cogging")


@pytest.mark.parametrize("family", ROUND)
def test_what_is_alike_about_all_axes_of_a_ball_joint_acts_about_all(family: str) -> None:
    """Turning about any axis it slows, or is pushed less by the same torque, as about another."""
    torque = "" if family != "armature" else '<actuator><motor name="{0}" joint="wrist" gear="{1}"/></actuator>'
    own = []
    for axis in range(3):
        gear = " ".join(str(int(axis == k)) for k in range(3))
        ball = f"""<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="wrist" type="ball"/>
        <geom type="sphere" size=".1" mass="1"/></body></worldbody>{torque.format("push", gear)}</mujoco>"""
        effect, theta = build(family, "wrist", ROUND[family])
        speed = np.zeros(3) if torque else np.eye(3)[axis]
        after = [run(ball, e, t, 1, qvel=speed, ctrl=1.0).qvel[0, 0, 1] for e, t in ((effect, theta), (None, []))]
        own.append((after[0] - after[1])[axis])
        assert effect.params[0].unit in ("N m", "N m s/rad", "kg m^2")
    assert abs(own[0]) > 1e-4
    np.testing.assert_allclose(own, own[0], rtol=1e-6)


@pytest.mark.parametrize("joint", ["wrist", "flight"])
@pytest.mark.parametrize("family", LINEAR)
def test_a_law_along_one_axis_refuses_other_joints_and_names_those_it_takes(family: str, joint: str) -> None:
    effect, _ = make(family, joint, {p.name: p.probes[0] for p in FAMILIES[family].PARAMS})
    with pytest.raises(InputError, match=f"'{joint}' is a (ball|free) joint.*thumb"):
        effect.bind(WRIST)


def test_a_force_along_a_joint_refuses_a_ball_joint() -> None:
    with pytest.raises(InputError, match=r"'wrist' is a ball joint.*thumb"):
        build("external_force", "wrist", {"force": 1.0})[0].bind(WRIST)


@pytest.mark.parametrize("family", ROUND)
def test_nothing_is_alike_about_all_axes_of_a_free_joint(family: str) -> None:
    with pytest.raises(InputError, match=r"'flight' is a free joint.*wrist, thumb"):
        build(family, "flight", ROUND[family])[0].bind(WRIST)


def test_every_candidate_can_be_bound() -> None:
    ones = np.ones(WRIST.nv)
    scales = Scales(ones, ones, ones[:0], ones[:0], 0.01, low=WRIST.qpos0 - 9, high=WRIST.qpos0 + 9)
    found = propose(WRIST, scales)
    assert {"coulomb", "spring_offset"} <= {e.family for e in found}
    for effect in found:
        effect.bind(WRIST)
