"""Something that moves in a body: a force that follows the body's speed late."""

import mujoco
import numpy as np
import pytest
from machines import make

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import Context, Forces, Scales
from nfc_gym.physics.effects.generic_inner import GenericInner

MODEL = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body name="hull"><freejoint name="root"/>
<inertial pos="0 0 0" mass="2" diaginertia=".02 .08 .08"/></body><body><joint name="rail" type="slide"/>
<geom size=".1"/></body></worldbody></mujoco>""")
DT, YAW, SPEED = 0.01, 0.5, 2.0
NAMES = [p.name for p in GenericInner.PARAMS]


def test_it_pushes_along_the_body_by_what_its_speed_was_of_late() -> None:
    """A body that is struck to 2 m/s along its own x: the force fades as exp(-t / 0.1 s), or 0.4 s."""
    given = {"force_x_fast": 3.0, "torque_x_slow": -5.0}
    effect, theta = make("generic_inner", "root", dict.fromkeys(NAMES, 0.0) | given)
    effect.bind(MODEL)
    q, v = MODEL.qpos0.copy(), np.zeros(MODEL.nv)
    q[3:7] = [np.cos(YAW / 2), 0, 0, np.sin(YAW / 2)]
    ctx = Context(MODEL, DT, q, v, np.zeros(0), {}, None, None)  # type: ignore[arg-type]
    memory = effect.rest(ctx, theta)
    v[:2] = SPEED * np.array([np.cos(YAW), np.sin(YAW)])
    for k in range(1, 40):
        ctx.memory = memory = effect.follow(ctx, theta, memory)
        out = Forces(np.zeros(MODEL.nv), np.zeros((MODEL.nbody, 6)))
        effect.force(ctx, theta, out)
        push, turn = (size * SPEED * np.exp(-k * DT / tau) for size, tau in ((3.0, 0.1), (-5.0, 0.4)))
        np.testing.assert_allclose(out.qfrc, [push * np.cos(YAW), push * np.sin(YAW), 0, 0, turn, 0, 0], atol=1e-12)
    sideways, theta = make("generic_inner", "root", dict.fromkeys(NAMES, 0.0) | {"torque_y_fast": 1.0})
    sideways.bind(MODEL)
    ctx.memory = np.array([[0.0, 0.0], [-1.0, -1.0]])
    v[:] = 0
    out = Forces(np.zeros(MODEL.nv), np.zeros((MODEL.nbody, 6)))
    sideways.force(ctx, theta, out)
    np.testing.assert_allclose(out.qfrc, [0, 0, 0, -1, 0, 0, 0], atol=1e-12)


def test_it_is_proposed_for_what_moves_freely() -> None:
    one = np.ones(MODEL.nv)
    (effect,) = GenericInner.propose(MODEL, Scales(one, one, np.ones(0), np.ones(0), 0.01))
    assert effect.id == "generic_inner:root"
    typical = {p.name: p.probes[0] for p in effect.params}
    assert typical["force_y_slow"] == pytest.approx(0.05 * 2 / 0.4)
    assert typical["torque_x_fast"] == pytest.approx(0.05 * 2 * 0.2 / 0.1)
    with pytest.raises(InputError, match=r"'rail' is no free joint; there are: root"):
        make("generic_inner", "rail", dict.fromkeys(NAMES, 0.0))[0].bind(MODEL)
