"""MuJoCo's warnings, kept to itself for a while."""

import threading
from collections.abc import Iterator

import mujoco
import pytest

from nfc_gym.physics.quiet import no_warnings


@pytest.fixture
def told() -> Iterator[list[str]]:
    """What the handler that somebody had set before has been told."""
    messages: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    yield messages
    mujoco.set_mju_user_warning(before)


def come_apart() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j' type='slide'/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qvel[0] = 1e20
    mujoco.mj_step(model, data)


def test_what_comes_apart_is_told_to_who_listened_before_and_not_inside(told: list[str]) -> None:
    come_apart()
    assert len(told) == 1
    with no_warnings():
        with no_warnings():
            come_apart()
        come_apart()  # the outer one lasts
    assert len(told) == 1
    come_apart()
    assert len(told) == 2


def test_it_is_given_back_where_something_fails(told: list[str]) -> None:
    with pytest.raises(RuntimeError), no_warnings():
        raise RuntimeError
    come_apart()
    assert len(told) == 1


def test_contexts_of_two_threads_may_end_in_any_order(told: list[str]) -> None:
    begun, leave = threading.Event(), threading.Event()

    def other() -> None:
        with no_warnings():
            begun.set()
            leave.wait()

    with no_warnings():
        thread = threading.Thread(target=other)
        thread.start()
        begun.wait()
    come_apart()  # the other one lasts
    assert not told
    leave.set()
    thread.join()
    come_apart()
    assert len(told) == 1
