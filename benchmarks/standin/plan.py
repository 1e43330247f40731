"""Which trials there are, and running them: in turns, several at a time, each kept as soon as it is finished."""

import json
import math
import shutil
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from .robots import ROBOTS
from .row import Row, Size, Task, from_json, to_json
from .trial import trial

QUICK = {
    "quadcopter": ("wind", Size(3, 0.6, ("wind", "drag_linear"), 1)),
    "jackal": ("coulomb", Size(4, 1.7, ("coulomb", "slope"), 2)),
    "quadruped": ("offset", Size(3, 0.9, ("offset",), 2)),
    "ant": ("damping_poly", Size(3, 0.9, ("damping_poly",), 2)),
}
# Two effects of one kind partly stand in for each other (a payload for a shifted centre of mass): a pair takes two.
_KIND = {
    **dict.fromkeys(("delay", "lag"), "timing"),
    **dict.fromkeys(("wind", "drag_linear", "drag_quadratic", "rotor_drag", "external_force", "slope"), "push"),
    **dict.fromkeys(("payload", "com_shift", "gain"), "mass"),
    **dict.fromkeys(("coulomb", "stribeck", "damping_poly", "armature", "spring_offset"), "joint"),
    **dict.fromkeys(("loss", "offset", "supply_sag", "dead_zone", "saturation"), "drive"),
    **dict.fromkeys(("sensor_bias",), "sensor"),
    **dict.fromkeys(("slip",), "ground"),
}


def seed_of(master: int, *names: object) -> int:
    """A trial's own seed: the same whichever other trials are asked for."""
    return int(np.random.SeedSequence([master, zlib.crc32(" ".join(map(str, names)).encode())]).generate_state(1)[0])


def singles(robot: str, families: Sequence[str], trials: int, master: int, wider: bool = False) -> Iterator[Task]:
    """`trials` of every usual family of the robot, or of every further one (`wider`), or of those given."""
    kit = ROBOTS[robot]
    chosen = kit.named if families else kit.wider if wider else kit.kinds
    for i in range(trials):
        for family in chosen:
            if not families or family in families:
                yield Task(robot, "single", (family,), seed_of(master, robot, family, i))


def pairs(robot: str, count: int, master: int) -> Iterator[Task]:
    """`count` pairs of effects of different kind, in an order drawn from the master seed."""
    able = [p for p in combinations(ROBOTS[robot].kinds, 2) if _KIND[p[0]] != _KIND[p[1]]]
    order = np.random.default_rng(seed_of(master, robot, "pairs")).permutation(len(able))
    for i in range(count):
        yield Task(robot, "pair", able[order[i % len(able)]], seed_of(master, robot, "pair", i))


def others(robot: str, trials: int, nulls: int, master: int) -> tuple[list[Task], list[Task]]:
    """`trials` of every effect outside the library; and trials without any."""
    outside = [
        Task(robot, "outside", (family,), seed_of(master, robot, "outside", family, i))
        for i in range(trials)
        for family in ROBOTS[robot].outside
    ]
    return outside, [Task(robot, "null", (), seed_of(master, robot, "null", i)) for i in range(nulls)]


def woven(lanes: Sequence[Sequence[Task]]) -> list[Task]:
    """All tasks of all lanes, each lane spread evenly over the whole: any beginning has its share of each."""
    spread = [((i + 0.5) / len(lane), task) for lane in lanes for i, task in enumerate(lane)]
    return [task for _, task in sorted(spread, key=lambda pair: pair[0])]


def quick(robots: Sequence[str], master: int) -> list[Task]:
    """One tiny trial a robot; the Quadcopter's with the baselines."""
    tasks = []
    for robot in robots:
        family, size = QUICK[robot]
        seed = seed_of(master, robot, family, 0)
        tasks.append(Task(robot, "single", (family,), seed, size, robot == "quadcopter"))
    return tasks


def with_baselines(tasks: Sequence[Task], share: float) -> list[Task]:
    """The same, that share of each robot's single effects with the baselines, spread evenly."""
    out, seen = [], dict.fromkeys(ROBOTS, 0.0)
    for t in tasks:
        if t.group == "single":
            seen[t.robot] += share
            if seen[t.robot] >= 1 - 1e-9:
                seen[t.robot] -= 1
                t = Task(t.robot, t.group, t.families, t.seed, t.size, True)
        out.append(t)
    return out


class Kept:
    """Trials in a folder: the finished ones, one file each, their reports, and those under way; None keeps nothing."""

    def __init__(self, folder: Path | None) -> None:
        self.folder, self.reports = (folder / "trials", folder / "reports") if folder else (None, None)
        self.begun = folder / "begun" if folder else None
        if self.folder:
            self.folder.mkdir(parents=True, exist_ok=True)

    def get(self, task: Task) -> Row | None:
        """The row of a finished trial; one that ran without the baselines is not finished for a task with them."""
        path = self.folder / f"{task.name}.json" if self.folder else None
        if path is None or not path.exists():
            return None
        saved = json.loads(path.read_text())
        return None if task.baselines and not saved["baselines"] else from_json(saved["row"])

    def put(self, task: Task, row: Row) -> None:
        """Keep a row, whole or not at all."""
        if self.folder:
            path = self.folder / f"{task.name}.json"
            part = path.with_suffix(".part")
            part.write_text(json.dumps({"baselines": task.baselines, "row": to_json(row)}, allow_nan=False))
            part.replace(path)


def run(tasks: Sequence[Task], jobs: int, threads: int, kept: Kept) -> Iterator[tuple[Row, str]]:
    """Rows as they finish, with a note on progress; a trial that fails is reported and left for the next run."""
    left = [t for t in tasks if kept.get(t) is None]
    for t in tasks:
        if (row := kept.get(t)) is not None:
            yield row, "kept"
    clock = _Clock(left, jobs)
    for task, row in _each(left, jobs, threads, kept):
        if row is not None:
            kept.put(task, row)
        note = clock.tick(task)
        if row is not None:
            yield row, note


def _each(tasks: Sequence[Task], jobs: int, threads: int, kept: Kept) -> Iterator[tuple[Task, Row | None]]:
    if jobs == 1:
        for task in tasks:
            try:
                yield task, one(task, threads, kept)
            except Exception as error:
                _failed(task, error)
                yield task, None
        return
    # A process a trial: what one leaves behind (threads, memory, MuJoCo's warning hook) is gone before the next.
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), max_tasks_per_child=1)
    running = {pool.submit(one, task, threads, kept): task for task in tasks}
    try:
        for done in as_completed(running):
            task, error = running[done], done.exception()
            if error is not None:
                _failed(task, error)
            yield task, None if error is not None else done.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _failed(task: Task, error: BaseException) -> None:
    print(f"{task.name} failed: {type(error).__name__}: {error}", file=sys.stderr, flush=True)


def one(task: Task, threads: int, kept: Kept) -> Row:
    """A trial in a folder of its own, which is removed when it is over; its report is kept.

    A trial that was killed goes on from its last finished stage, where trials are kept.
    """
    folder = Path(tempfile.mkdtemp(prefix="standin_")) if kept.begun is None else kept.begun / task.name
    folder.mkdir(parents=True, exist_ok=True)
    try:
        row = trial(task, folder, threads)
        if kept.reports is not None:
            own = kept.reports / task.name
            own.mkdir(parents=True, exist_ok=True)
            for name in ("report.html", "report.json"):
                shutil.copy(folder / "report" / name, own)
    except BaseException as error:
        if kept.begun is None or isinstance(error, Exception):
            shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)
    return row


class _Clock:
    """Time left, from how long the finished trials of each robot took."""

    def __init__(self, tasks: Sequence[Task], jobs: int) -> None:
        self.left, self.jobs, self.began, self.total = list(tasks), jobs, time.monotonic(), len(tasks)
        self.done: list[Task] = []

    def tick(self, task: Task) -> str:
        """Note a finished trial; says how many there are and how long the rest will take."""
        self.left.remove(task)
        self.done.append(task)
        spent = time.monotonic() - self.began
        cost = {"quadcopter": 1.0, "jackal": 3.0, "quadruped": 15.0, "ant": 10.0}  # of a trial, relative
        rate = spent / sum(cost[t.robot] for t in self.done)
        rest = rate * sum(cost[t.robot] for t in self.left)
        return f"{len(self.done)}/{self.total}, {_time(spent)} gone, about {_time(rest)} left"


def _time(seconds: float) -> str:
    minutes = math.ceil(seconds / 60)
    return f"{seconds:.0f} s" if seconds < 100 else f"{minutes} min" if minutes < 120 else f"{minutes / 60:.1f} h"
