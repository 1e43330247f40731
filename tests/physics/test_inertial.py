"""Mass and its place, against models compiled with the mass welded on and against mechanics."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import make, run

from nfc_gym.physics.effects.inertial import Payload, principal
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.state import rotate

BODY = """
<mujoco><option timestep=".001" gravity="0 0 0"/><worldbody><body name="b" simple="false"><freejoint align="false"/>
<inertial pos=".02 -.01 .03" quat=".8 .2 -.4 .1" mass="2" diaginertia=".03 .02 .04"/>%s</body></worldbody></mujoco>"""
BARE = BODY % ""


def _tensor(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Inertia of a body about its own centre of mass in the body's frame, (3, 3)."""
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[body])
    frame = frame.reshape(3, 3)
    return frame @ np.diag(model.body_inertia[body]) @ frame.T


def _edited(family: str, parameters: dict[str, float], text: str = BARE) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(text)
    effect, theta = make(family, "b", parameters)
    effect.bind(model)
    fields = ModelFields(model)
    effect.model(fields, theta)
    fields.commit()
    return model


@settings(max_examples=30)
@given(st.floats(0, 5), st.tuples(*[st.floats(-0.4, 0.4)] * 3))
def test_payload_is_a_welded_point_mass(mass: float, place: tuple[float, float, float]) -> None:
    """Mass matrix, centre and inertia equal those of MuJoCo's own compilation of a point mass in a child body."""
    model = _edited("payload", {"mass": mass, **dict(zip("xyz", place, strict=True))})
    point = f'<inertial pos="0 0 0" mass="{max(mass, 1e-12)}" diaginertia="1e-14 1e-14 1e-14"/>'
    child = f'<body pos="{place[0]} {place[1]} {place[2]}">{point}</body>'
    welded = mujoco.MjModel.from_xml_string(BODY % child)
    matrices = []
    for m in (model, welded):
        data = mujoco.MjData(m)
        data.qpos[3:7] = np.array([0.9, 0.1, -0.3, 0.2]) / np.linalg.norm([0.9, 0.1, -0.3, 0.2])
        mujoco.mj_forward(m, data)
        full = np.zeros((6, 6))
        mujoco.mj_fullM(m, data, full)
        matrices.append(full)
    np.testing.assert_allclose(matrices[0], matrices[1], atol=1e-10)
    assert model.body_subtreemass[1] == pytest.approx(2 + mass)


FRAME = """
<mujoco><worldbody><body name="frame" simple="false"><joint name="rail" type="slide" axis="1 0 0"/>
<body pos="0 0 .2"><geom size=".1" mass="2"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("mass", [0.0, 0.5])
def test_a_body_without_mass_carries_a_payload_or_none(mass: float) -> None:
    """A bare frame, whose mass is in what is welded to it: a load of nothing leaves it as it is."""
    payload, theta = make("payload", "frame", {"mass": mass, "x": 0.1, "y": 0.0, "z": 0.0})
    found = run(FRAME, payload, theta, 20, qvel=[1.0])
    assert found.stable.all()
    if mass == 0:
        np.testing.assert_array_equal(found.qpos, run(FRAME, None, [], 20, qvel=[1.0]).qpos)
    model = mujoco.MjModel.from_xml_string(FRAME)
    payload.bind(model)
    fields = ModelFields(model)
    payload.model(fields, theta)
    fields.commit()
    assert model.body_mass[1] == mass
    assert model.dof_M0[0] == pytest.approx(2 + mass)
    np.testing.assert_allclose(model.body_ipos[1], [0.1 * (mass > 0), 0, 0])


def test_payload_moves_as_the_welded_body_does() -> None:
    place = (0.2, -0.1, 0.15)
    effect, theta = make("payload", "b", {"mass": 0.7, **dict(zip("xyz", place, strict=True))})
    start = [0.3, 0.1, -0.2, 2.0, -3.0, 1.0]
    mine = run(BARE, effect, theta, 300, qvel=start)
    child = '<body pos="0.2 -0.1 0.15"><inertial pos="0 0 0" mass=".7" diaginertia="1e-12 1e-12 1e-12"/></body>'
    theirs = run(BODY % child, None, [], 300, qvel=start)
    np.testing.assert_allclose(mine.qpos, theirs.qpos, atol=1e-7)


def test_a_load_on_a_body_that_floats_has_weight() -> None:
    """MuJoCo's compensation is a share of the mass, which the load adds to."""
    floats = BARE.replace('name="b"', 'name="b" gravcomp="1"').replace('gravity="0 0 0"', 'gravity="0 0 -9.81"')
    effect, theta = make("payload", "b", {"mass": 0.5, "x": 0.02, "y": -0.01, "z": 0.03})
    after = run(floats, effect, theta, 1000, qvel=[0.0] * 6).qvel[0, 0, -1, 2]
    assert after == pytest.approx(-9.81 * 0.5 / 2.5, rel=1e-6)


def test_two_payloads_compose() -> None:
    """Half the mass twice at one place is the whole mass once."""
    model = mujoco.MjModel.from_xml_string(BARE)
    effect, theta = make("payload", "b", {"mass": 0.4, "x": 0.1, "y": 0.2, "z": -0.1})
    effect.bind(model)
    fields = ModelFields(model)
    effect.model(fields, theta)
    effect.model(fields, theta)
    once = _edited("payload", {"mass": 0.8, "x": 0.1, "y": 0.2, "z": -0.1})
    np.testing.assert_allclose(_tensor(model, 1), _tensor(once, 1), atol=1e-12)
    np.testing.assert_allclose(model.body_ipos[1], once.body_ipos[1], atol=1e-14)


def test_com_shift_keeps_mass_and_inertia_and_moves_the_centre() -> None:
    model, bare = _edited("com_shift", {"x": 0.01, "y": -0.02, "z": 0.03}), mujoco.MjModel.from_xml_string(BARE)
    np.testing.assert_allclose(model.body_ipos[1] - bare.body_ipos[1], [0.01, -0.02, 0.03])
    np.testing.assert_array_equal(_tensor(model, 1), _tensor(bare, 1))
    assert model.body_mass[1] == bare.body_mass[1]


def test_com_shift_tips_a_hanging_body() -> None:
    """A pendulum's centre moved sideways by s at depth d balances turned by atan(s / d)."""
    text = """<mujoco><option timestep=".005"/><worldbody><body name="b" simple="false">
    <joint axis="0 1 0" damping=".5"/>
    <inertial pos="0 0 -.4" mass="1" diaginertia=".01 .01 .01"/></body></worldbody></mujoco>"""
    effect, theta = make("com_shift", "b", {"x": 0.05, "y": 0.0, "z": 0.0})
    q = run(text, effect, theta, 2000).qpos[0, 0, -1, 0]
    assert abs(q) == pytest.approx(np.arctan2(0.05, 0.4), rel=1e-4)


def test_inertia_scales_each_principal_moment() -> None:
    model, bare = _edited("inertia", {"x": 1.2, "y": 0.9, "z": 1.1}), mujoco.MjModel.from_xml_string(BARE)
    np.testing.assert_allclose(model.body_inertia[1] / bare.body_inertia[1], [1.2, 0.9, 1.1])
    assert model.body_mass[1] == bare.body_mass[1]


def test_principal_of_a_diagonal_matrix_is_itself_bit_for_bit() -> None:
    for diagonal in ([1.0, 2.0, 3.0], [3.0, 1.0, 2.0], [1.0, 1.0, 1.0], [2.0, 2.0, 1.0]):
        moments, quat = principal(np.diag(diagonal))
        np.testing.assert_array_equal(moments, diagonal)
        np.testing.assert_array_equal(quat, [1, 0, 0, 0])


@settings(max_examples=50)
@given(st.lists(st.floats(-1, 1), min_size=9, max_size=9))
def test_principal_rebuilds_the_matrix(values: list[float]) -> None:
    root = np.array(values).reshape(3, 3)
    matrix = root @ root.T
    moments, quat = principal(matrix)
    axes = np.stack([rotate(quat, e) for e in np.eye(3)], -1)
    np.testing.assert_allclose(axes @ np.diag(moments) @ axes.T, matrix, atol=1e-12)


def test_principal_is_continuous() -> None:
    """Nearly equal moments: a small change of the matrix turns the axes by a small angle, without swapping them."""
    quats = [principal(np.diag([1.0, 1.2, 2.0]) + e * np.ones((3, 3)))[1] for e in (0.0, 1e-6, 1e-3)]
    assert 1 - quats[1][0] < 1e-9
    assert 1 - quats[2][0] < 1e-3


def test_a_lump_starts_with_the_same_moments_or_multiples_within_its_bounds() -> None:
    """About the middle of its body: a body that gives up mass for the lump keeps its own centre."""
    place = {axis: {"low": c - 0.5, "high": c + 0.5} for axis, c in zip("xyz", (0.1, 0.0, -0.2), strict=True)}
    lump = Payload(("b",), sized(Payload.PARAMS, mass={"high": 2.0}, **place))
    theta = np.array([0.03, 0.5, 0.1, -0.3])
    found = lump.starts(theta)
    middle = np.array([0.1, 0.0, -0.2])
    growth = found[:, :1] * (found[:, 1:] - middle) / (theta[0] * (theta[1:] - middle))
    np.testing.assert_allclose(growth, growth[:, :1] @ np.ones((1, 3)))
    assert set(growth[:, 0].round(6)) == {1.0, 2.0, 4.0}
    assert (found >= lump.low).all()
    assert (found <= lump.high).all()
    assert found[:, 0].max() > 10 * theta[0]
    assert not len(lump.starts(lump.null)), "no mass has no moments"
    assert lump.outlying(np.array([1.0, *middle])) == pytest.approx(0.0)
    assert lump.outlying(theta) == pytest.approx(np.hypot(np.hypot(0.8, 0.2), 0.2))
