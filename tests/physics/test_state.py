"""Differences and sums of states against MuJoCo's own."""

import mujoco
import numpy as np
import pytest

from nfc_gym.physics.state import (
    cross,
    difference,
    integrate,
    quat_conjugate,
    quat_multiply,
    quat_to_vector,
    rotate,
    rotate_back,
    vector_to_quat,
)

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody>
  <body><joint type="slide"/><geom size=".1"/><body><joint type="hinge"/><geom size=".1"/></body></body>
  <body><freejoint/><geom size=".1"/><body><joint type="ball"/><geom size=".1"/></body></body>
  <body><joint type="ball"/><geom size=".1"/></body>
</worldbody></mujoco>""")
RNG = np.random.default_rng(11)


def _configurations(*shape: int) -> np.ndarray:
    q = RNG.normal(size=(*shape, MODEL.nq))
    flat = q.reshape(-1, MODEL.nq)
    for row in flat:
        mujoco.mj_normalizeQuat(MODEL, row)
    return q


@pytest.mark.parametrize("size", [1e-9, 0.1, 2.0])
def test_difference_and_integrate_are_mujocos(size: float) -> None:
    start = _configurations(20)
    step = RNG.normal(size=(20, MODEL.nv)) * size
    end = integrate(MODEL, start, step)
    for a, s, b in zip(start, step, end, strict=True):
        there = a.copy()
        mujoco.mj_integratePos(MODEL, there, s, 1.0)
        np.testing.assert_allclose(b, there, atol=1e-14)
    other = _configurations(20)
    for a, b, d in zip(start, other, difference(MODEL, start, other), strict=True):
        expected = np.zeros(MODEL.nv)
        mujoco.mj_differentiatePos(MODEL, expected, 1.0, a, b)
        np.testing.assert_allclose(d, expected, atol=1e-12)


def test_difference_inverts_integrate_and_is_exactly_zero_on_itself() -> None:
    start = _configurations(3, 4)
    step = RNG.uniform(-1.5, 1.5, size=(3, 4, MODEL.nv))  # turns of less than half a circle
    np.testing.assert_allclose(difference(MODEL, start, integrate(MODEL, start, step)), step, atol=1e-12)
    np.testing.assert_allclose(difference(MODEL, start, start), 0, atol=1e-15)
    np.testing.assert_array_equal(integrate(MODEL, start, 0 * step), start)


def test_opposite_quaternions_are_one_orientation() -> None:
    q = vector_to_quat(RNG.normal(size=(10, 3)))
    np.testing.assert_allclose(quat_to_vector(quat_multiply(quat_conjugate(q), -q)), 0, atol=1e-12)


def test_batch_shapes_broadcast() -> None:
    start, end = _configurations(1, 4), _configurations(3, 1)
    assert difference(MODEL, start, end).shape == (3, 4, MODEL.nv)
    np.testing.assert_array_equal(difference(MODEL, start, end)[2, 1], difference(MODEL, start[0, 1], end[2, 0]))


def test_rotation_is_mujocos_and_inverts() -> None:
    q, v = vector_to_quat(RNG.normal(size=(10, 3))), RNG.normal(size=(10, 3))
    for quat, vector, turned in zip(q, v, rotate(q, v), strict=True):
        expected = np.zeros(3)
        mujoco.mju_rotVecQuat(expected, vector, quat)
        np.testing.assert_allclose(turned, expected, atol=1e-14)
    np.testing.assert_allclose(rotate_back(q, rotate(q, v)), v, atol=1e-14)
    np.testing.assert_array_equal(rotate(np.array([1.0, 0, 0, 0]), v), v)


def test_one_vector_is_a_row_of_many_to_the_bit() -> None:
    q, v, w = (RNG.normal(size=(4, 5, k)) for k in (4, 3, 3))
    np.testing.assert_array_equal(cross(v, w), np.cross(v, w))
    for law, a, b in ((cross, v, w), (rotate, q, v), (rotate_back, q, v)):
        stacked = law(a, b)
        for i in np.ndindex(4, 5):
            np.testing.assert_array_equal(stacked[i], law(a[i], b[i]))
            np.testing.assert_array_equal(stacked[i], law(a[i][None], b[i][None])[0])
        np.testing.assert_array_equal(law(a[0, 0], b), law(np.broadcast_to(a[0, 0], a.shape), b))
