"""Stopwatches stand still while nobody reads them, and go on afterwards."""

import mujoco

from nfc_gym.physics.untimed import untimed


def test_steps_are_timed_before_and_after_but_not_within() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    data = mujoco.MjData(model)
    spent = []

    def step() -> None:
        mujoco.mj_step(model, data)
        spent.append(data.timer[int(mujoco.mjtTimer.mjTIMER_STEP)].duration)

    step()
    with untimed():
        step()
    step()
    assert 0 < spent[0] == spent[1] < spent[2]
