"""Every task is done once, and a worker that dies is noticed whatever it was doing."""

import os
import signal
import threading
import time
from collections.abc import Generator
from multiprocessing import active_children
from pathlib import Path

import pytest

from nfc_gym.core import InputError, NfcError
from nfc_gym.simulate.pool import unordered


def square(x: int) -> int:
    return x * x


def picky(x: int) -> int:
    if x == 2:
        raise InputError("x is 2")
    return x


def large_then_dead(go: Path | None) -> bytes:
    """More than a pipe holds, begun when `go` exists; the writer is killed while it waits for a reader."""
    if go is None:
        return b""
    while not go.exists():
        time.sleep(0.01)
    threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return bytes(50_000_000)


def threads_of_a_worker() -> str:
    return os.environ["OMP_NUM_THREADS"]


@pytest.mark.parametrize(("jobs", "tasks"), [(1, 3), (2, 5), (3, 2), (2, 0)])
def test_each_task_is_done_once(jobs: int, tasks: int) -> None:
    assert sorted(unordered(square, ((x,) for x in range(tasks)), jobs)) == [(x, x * x) for x in range(tasks)]


def test_tasks_are_drawn_as_workers_fall_idle() -> None:
    drawn = []

    def tasks() -> Generator[tuple[int]]:
        for x in range(10):
            drawn.append(x)
            yield (x,)

    found = unordered(square, tasks(), 2)
    next(found)
    assert drawn == [0, 1]
    found.close()


def test_an_error_is_the_callers_with_the_workers_traceback() -> None:
    with pytest.raises(InputError, match="x is 2") as error:
        list(unordered(picky, ((x,) for x in range(4)), 2))
    assert "in picky" in error.value.__notes__[0]


def test_a_worker_killed_in_the_middle_of_its_answer_is_said_so(tmp_path: Path) -> None:
    go = tmp_path / "go"
    found = unordered(large_then_dead, ((task,) for task in (None, go)), 2)
    assert next(found) == (0, b"")
    alive = len(active_children())
    go.touch()
    while len(active_children()) == alive:  # nobody reads meanwhile
        time.sleep(0.01)
    with pytest.raises(NfcError, match="a worker process died"):
        next(found)


def test_workers_compute_with_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    assert list(unordered(threads_of_a_worker, [()], 1)) == [(0, "1")]
    assert os.environ["OMP_NUM_THREADS"] == "7"
