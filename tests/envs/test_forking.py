"""Pictures in workers that were forked from a process that had drawn some, which would wait for ever."""

import multiprocessing
import os
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import gymnasium
import pytest

from nfc_gym.core import InputError
from nfc_gym.envs import forking

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")


def made() -> gymnasium.Env:
    env = gymnasium.make("nfc_gym/JackalFlat-v0", context=[], render_mode="rgb_array", width=48, height=32)
    env.reset(seed=0)
    return env


@pytest.fixture
def drawn() -> gymnasium.Env:
    """An environment of which there is a picture."""
    env = made()
    try:
        env.render()
    except Exception as error:  # no graphics library at all
        pytest.skip(f"cannot render here: {error}")
    return env


def said_by_a_worker(act: Callable[[], Any]) -> str:
    """What `act` raises in a forked process, or that it was done."""
    context = multiprocessing.get_context("fork")
    said = context.Queue()

    def work() -> None:
        try:
            act()
            said.put("done")
        except InputError as error:
            said.put(str(error))

    worker = context.Process(target=work)
    worker.start()
    try:
        return said.get(timeout=30)
    finally:
        worker.kill()
        worker.join()


@pytest.mark.parametrize("closed", [False, True])
def test_a_forked_worker_is_told_that_it_cannot_draw(drawn: gymnasium.Env, closed: bool) -> None:
    if closed:
        drawn.close()
    assert 'vector_kwargs={"context": "spawn"}' in said_by_a_worker(lambda: made().render())
    if not closed:
        assert "forked from one that had drawn" in said_by_a_worker(drawn.render)
        assert drawn.render().shape == (32, 48, 3)
    assert made().render().shape == (32, 48, 3), "the parent goes on"


def test_a_forked_worker_may_step_and_close_what_has_drawn(drawn: gymnasium.Env) -> None:
    assert said_by_a_worker(lambda: (drawn.step([0, 0]), drawn.close())) == "done"


def test_what_others_have_drawn_by_counts_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forking, "_drew", False)
    monkeypatch.setitem(sys.modules, "mujoco.egl", SimpleNamespace(EGL_DISPLAY=None))
    assert said_by_a_worker(forking.require_graphics) == "done"
    monkeypatch.setitem(sys.modules, "mujoco.egl", SimpleNamespace(EGL_DISPLAY=object()))
    assert "can draw none" in said_by_a_worker(forking.require_graphics)
