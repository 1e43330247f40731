"""Tasks spread over processes, with a pipe for each.

A `ProcessPoolExecutor` has one pipe for all answers: where a worker dies in the middle of writing one, the rest of it
is waited for without end, since the others hold that pipe open. A worker's own pipe ends when the worker does.
"""

import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from typing import Any

from nfc_gym.core.errors import NfcError

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def unordered(function: Callable, tasks: Iterable[tuple], jobs: int) -> Generator[tuple[int, Any], None, None]:
    """Results as they are finished, each with its task's number; the processes end with the generator.

    Args:
      function: of a module's top level, what is called.
      tasks: its arguments, drawn as workers fall idle.
      jobs: processes of one thread each, at least 1.

    Raises:
      NfcError: a process died.
      Exception: what `function` raised, with the worker's traceback as a note.
    """
    waiting = enumerate(tasks)
    workers: list[_Worker] = []
    busy: dict[Connection, _Worker] = {}
    try:
        for _, task in zip(range(jobs), waiting, strict=False):
            with _single_threaded():
                workers.append(_Worker(function))
            busy[workers[-1].pipe] = workers[-1].given(*task)
        while busy:
            for pipe in wait(list(busy)):
                worker = busy.pop(pipe)  # pyright: ignore[reportArgumentType]  # connections were waited for
                yield worker.number, worker.result()
                if task := next(waiting, None):
                    busy[worker.pipe] = worker.given(*task)
    finally:
        for worker in workers:
            worker.end()


class _Worker:
    """A process and this side of its pipe."""

    def __init__(self, function: Callable) -> None:
        context = get_context("spawn")  # a fork would take this process's threads for its own
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, function), daemon=True)
        self.process.start()
        theirs.close()  # so that the pipe ends where the process does
        self.number = -1

    def given(self, number: int, args: tuple) -> "_Worker":
        self.number = number
        try:
            self.pipe.send(args)
        except OSError:
            raise _died() from None
        return self

    def result(self) -> Any:
        try:
            fine, found = self.pipe.recv()
        except (EOFError, OSError):
            raise _died() from None
        if not fine:
            raise found
        return found

    def end(self) -> None:
        self.process.terminate()
        self.pipe.close()


def _died() -> NfcError:
    return NfcError(
        "a worker process died, perhaps for want of memory; finished shards stay: the same command goes on, "
        "and --jobs with a smaller number needs less"
    )


def _serve(pipe: Connection, function: Callable) -> None:
    """A worker's loop. Ctrl-C is the caller's to answer, and nobody works on for a caller that was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        caller = parent_process()
        if caller is not None:
            caller.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    while True:
        args = pipe.recv()
        try:
            answer = True, function(*args)
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = False, error
        pipe.send(answer)


@contextmanager
def _single_threaded() -> Generator[None, None, None]:
    """Processes started meanwhile compute with one thread each."""
    before = {k: os.environ.get(k) for k in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for k, v in before.items():
            if v is None:
                del os.environ[k]
            else:
                os.environ[k] = v
