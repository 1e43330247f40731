"""Drawing and closing the loop, as commands in processes of their own; what has ended is not run again."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

TIMED_OUT, STOPPED = 124, 130
PATIENCE = 30.0  # s from the request to stop to the end by force


@dataclass(frozen=True)
class Folders:
    """Where a run keeps what: the loop is given `machine(name)`, and `truth(name)` lies elsewhere."""

    out: Path

    def machine(self, name: str) -> Path:
        """What the user would have."""
        return self.out / "machines" / name

    def truth(self, name: str) -> Path:
        """What is hidden."""
        return self.out / "truths" / f"{name}.json"

    def loop(self, name: str) -> Path:
        """The loop's words, its report, and how it ended."""
        return self.out / "loops" / name

    def report(self, name: str) -> Path:
        """The report of a loop that has ended well."""
        return self.loop(name) / "result" / "report.json"

    def ending(self, name: str) -> dict[str, Any] | None:
        """{code, seconds} of the loop so far; None where it never began."""
        path = self.loop(name) / "ended.json"
        return json.loads(path.read_text()) if path.exists() else None

    def ended(self, name: str) -> bool:
        """Whether a loop has ended by itself or by its limit: one that was stopped is to go on."""
        ending = self.ending(name)
        return ending is not None and ending["code"] != STOPPED

    def done(self, name: str, limit: float) -> bool:
        """Whether there is nothing to run: a report, or a loop that had as much time as it may have."""
        ended = self.ending(name)
        if ended is None:
            return False
        return ended["code"] == 0 or (ended["code"] == TIMED_OUT and ended["seconds"] >= limit)


@dataclass
class Runner:
    """Runs commands with one thread each and a time limit; `stop` ends those that are running."""

    live: set[subprocess.Popen] = field(default_factory=set)
    stopping: threading.Event = field(default_factory=threading.Event)

    def call(self, command: Sequence[str], log: Path, limit: float) -> tuple[int, float]:
        """(exit code, seconds); words are added to the log. 124 where the limit ended it, 130 where `stop` did."""
        if self.stopping.is_set():
            return STOPPED, 0.0
        threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
        began = time.monotonic()
        with log.open("a", encoding="utf-8") as file:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, env=os.environ | threads,
                start_new_session=True,
            )  # fmt: skip
            self.live.add(process)
            if self.stopping.is_set():  # between the question above and now
                _signal(process, signal.SIGTERM)
            try:
                code = process.wait(limit)
            except subprocess.TimeoutExpired:
                _end(process)
                code = TIMED_OUT
            finally:
                self.live.discard(process)
        return STOPPED if self.stopping.is_set() and code else code, time.monotonic() - began

    def stop(self) -> None:
        """End what is running, and begin nothing more."""
        self.stopping.set()
        for process in tuple(self.live):
            _signal(process, signal.SIGTERM)


def _end(process: subprocess.Popen) -> None:
    """Ask, then end by force; a loop keeps its finished stages either way.

    Not by SIGINT: what is begun in a shell's background is deaf to it, and so is all that it begins.
    """
    for how in (signal.SIGTERM, signal.SIGKILL):
        _signal(process, how)
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            continue
        return


def _signal(process: subprocess.Popen, how: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, how)  # a session of its own: the group is this process and its children


def run(
    names: Sequence[str], drawing: dict[str, list[str]], folders: Folders, jobs: int, limit: float
) -> Iterator[str]:
    """Names as their loops end, those that had ended first; `drawing` has the command that draws each machine."""
    left = [n for n in names if not folders.done(n, limit)]
    yield from (n for n in names if n not in left)
    runner = Runner()
    with ThreadPoolExecutor(jobs) as pool:
        running = {pool.submit(_one, runner, n, drawing[n], folders, limit): n for n in left}
        try:
            for done in as_completed(running):
                done.result()
                yield running[done]
        except BaseException:
            runner.stop()
            pool.shutdown(cancel_futures=True)
            raise


def _one(runner: Runner, name: str, drawing: Sequence[str], folders: Folders, limit: float) -> None:
    """Draw a machine unless it is there, and close the loop on it, going on where an earlier run was stopped."""
    loop, mapping = folders.loop(name), folders.machine(name) / "mapping.yaml"
    loop.mkdir(parents=True, exist_ok=True)
    before = folders.ending(name) or {"code": STOPPED, "seconds": 0.0}
    spent = before["seconds"] if before["code"] in (STOPPED, TIMED_OUT) else 0.0
    log = loop / "log.txt"
    code = 0
    if not folders.truth(name).exists():
        code, _ = runner.call(drawing, log, limit)
    if code == 0:
        command = [sys.executable, "-m", "nfc_gym.cli", "close-loop", str(mapping), "--out", str(loop / "result")]
        code, seconds = runner.call([*command, "--jobs", "1"], log, max(limit - spent, 1.0))
        spent += seconds
    if code == 0 and not folders.report(name).exists():
        code = 1
    part = loop / "ended.part"
    part.write_text(json.dumps({"code": code, "seconds": round(spent, 1)}))
    part.replace(loop / "ended.json")
