"""Delays that are longer than what was seen: they keep what there was, and no more."""

import mujoco
import numpy as np
import pytest
from machines import make, run

from nfc_gym.physics.acting import _merged
from nfc_gym.physics.effects import build

DT = 0.002
RAIL = f"""
<mujoco><option timestep="{DT}" gravity="0 0 0"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
<geom type="sphere" size=".1" mass="2"/></body></worldbody>
<actuator><motor name="push" joint="rail"/></actuator>
<sensor><actuatorfrc name="made" actuator="push"/></sensor></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(RAIL)


@pytest.mark.parametrize("delay", [1e6, 1e308])
def test_a_delay_longer_than_the_run_holds_the_first_command(delay: float) -> None:
    effect, theta = make("delay", "push", {"delay": delay})
    ctrl = np.linspace(1.0, 2.0, 30)[:, None]
    t = run(RAIL, effect, theta, 30, ctrl=ctrl)
    assert t.sensordata is not None
    np.testing.assert_array_equal(t.sensordata[0, 0, :-1, 0], 1.0)
    memory = effect.state0((), ctrl[0], theta, DT)
    for u in ctrl:
        _, memory = effect.action(u, theta, memory, {}, DT)
    assert len(memory[1]) <= len(ctrl) + 1
    np.testing.assert_array_equal(effect.course(ctrl, theta, {}, DT), np.ones((30, 1)))
    assert not effect.spec(mujoco.MjSpec.from_string(RAIL), theta)  # MuJoCo would make room for all of its steps


def test_rows_that_start_anew_forget_what_the_others_remember() -> None:
    """Two simulations of delays of their own, one of which begins again: each is as it would be alone."""
    effect, _ = build("delay", "push", {"delay": 0.01})
    effect.bind(MODEL)
    delays, anew = np.array([[0.0113], [0.0056]]), 7
    ctrl = np.random.default_rng(3).normal(size=(20, 2, 1))
    memory = effect.state0((2,), ctrl[0], delays, DT)
    seen = []
    for k, u in enumerate(ctrl):
        if k == anew:
            memory = _merged(effect.state0((2,), u, delays, DT), memory, np.array([False, True]))
        made, memory = effect.action(u, delays, memory, {}, DT)
        seen.append(made)
    lone = [effect.course(ctrl[first:, i], delays[i], {}, DT) for i, first in ((0, 0), (1, 0), (1, anew))]
    np.testing.assert_array_equal(np.array(seen)[:, 0], lone[0])
    np.testing.assert_array_equal(np.array(seen)[:anew, 1], lone[1][:anew])
    np.testing.assert_array_equal(np.array(seen)[anew:, 1], lone[2])
