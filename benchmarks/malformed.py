"""Malformed inputs, thousands of them: no traceback, no hang, no half of a report, a message that says what is wrong.

    python benchmarks/malformed.py [--quick] [--cases N] [--seed S] [--json FILE]

A small machine's mapping, model, logs and results are damaged in every way that `benchmarks/damage/` knows, drawn anew
in each run from a seed that is printed. Commands run in this process through the entry point of `nfc-gym`, each under
an alarm; some run as programs. A command may succeed or exit with 2 and a message; anything else fails, as does a
Python warning on the user's screen, a report of a run that did not finish, or a loss in an earlier run's report.
"""

import argparse
import collections
import contextlib
import faulthandler
import io
import json
import os
import random
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

import gymnasium
from damage import FITS, INPUTS, OPTIONS, healthy
from damage.case import FORMATS
from options import count, ended, json_file, made, write_json
from timing import Table

from nfc_gym.cli import main as nfc_gym
from nfc_gym.core import InputError
from nfc_gym.wrappers import ApplyEffects

LIMIT = 20.0  # s of the processor that a command on logs of one second may take; a whole loop takes three
LOOPS, PROGRAMS = 25, 200  # of so many cases one that passes the check is fitted, and one runs as a program


class Hung(BaseException):
    """The alarm went off."""


@dataclass
class Ending:
    """How a command ended."""

    code: int
    text: str
    seconds: float
    warned: str = ""

    def fault(self, words: tuple[str, ...] = ()) -> str:
        """What is wrong with that, or nothing; a refusal must hold one of `words`."""
        if self.code not in (0, 2):
            return f"exit code {self.code}"
        if "Traceback" in self.text:
            return "a traceback"
        if self.warned:
            return f"a warning: {self.warned}"
        if self.code == 2 and not any(w in self.text for w in words):
            return "a message that names nothing"
        return ""


@contextlib.contextmanager
def alarm(seconds: float):
    def ring(*_: object) -> None:
        raise Hung

    # Processor time, since cores may be shared; what sleeps or does not listen to alarms ends by the clock on the wall.
    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    faulthandler.dump_traceback_later(20 * seconds, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        faulthandler.cancel_dump_traceback_later()


def command(line: list[str], limit: float = LIMIT) -> Ending:
    """Run `nfc-gym LINE` here, as its entry point does."""
    out, began, code, before = io.StringIO(), time.process_time(), 0, sys.argv
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("default")
        try:
            sys.argv = ["nfc-gym", *line]
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out), alarm(limit):
                nfc_gym()
        except SystemExit as e:
            code = e.code if isinstance(e.code, int) else int(e.code is not None)
        except Hung:
            code, _ = -1, out.write(f"hung for {limit:g} s")
        except Exception as e:
            code, _ = -2, out.write(f"{type(e).__name__}: {e}")
        finally:
            sys.argv = before
    return Ending(code, out.getvalue(), time.process_time() - began, first(seen))


def first(seen: list[warnings.WarningMessage]) -> str:
    """The first warning that a user would see."""
    shown = [w for w in seen if not issubclass(w.category, DeprecationWarning | ResourceWarning)]
    return next((f"{w.category.__name__}: {w.message} ({Path(w.filename).name}:{w.lineno})" for w in shown), "")


def program(line: list[str]) -> Ending:
    """Run `nfc-gym LINE` as a program."""
    entry = [sys.executable, "-c", "from nfc_gym.cli import main; main()"]
    done = subprocess.run([*entry, *line], capture_output=True, text=True, check=False, timeout=20 * LIMIT)
    text = done.stdout + done.stderr
    warned = next((x for x in text.splitlines() if "Warning: " in x), "")
    return Ending(done.returncode, text, 0.0, warned)


class Bench:
    """Runs cases, counts their endings, and keeps what went wrong."""

    def __init__(self, seed: int, folder: Path, show: int) -> None:
        self.seed, self.folder, self.show = seed, folder, show
        self.count: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
        self.faults: list[str] = []
        self.slowest = (0.0, "")
        self.env = gymnasium.make("nfc_gym:nfc_gym/JackalFlat-v0", context=())

    def ended(self, kind: str, case: int, line: list[str], ending: Ending, words: tuple[str, ...] = ()) -> None:
        fault = ending.fault(words)
        self.count[kind]["faulty" if fault else "refused" if ending.code else "accepted"] += 1
        self.slowest = max(self.slowest, (ending.seconds, f"case {case} ({kind}): {line[0]}"))
        if fault:
            self.faults.append(f"case {case} ({kind}): {' '.join(line)}: {fault}")
            if len(self.faults) <= self.show:
                print(f"{self.faults[-1]}\n    {' '.join(ending.text.split())[-600:]}", flush=True)

    def inputs(self, number: int, kind: str, rng: random.Random) -> None:
        """Damaged inputs go through `check`; of what passes some is fitted, what does not must be refused there too."""
        case = healthy(rng.choice(FORMATS))
        INPUTS[kind](case, rng)
        path, out = case.write(self.folder), self.folder / "out"
        words = ("mapping.yaml", "machine.xml", "model", "run_", *INPUTS_WORDS)
        line = ["check", str(path)]
        checked = command(line)
        self.ended(kind, number, line, checked, words)
        if number % PROGRAMS == 0:
            self.ended(kind, number, line, program(line), words)
        if checked.code == 2 and number % 3 and checked.text:
            return
        if checked.code == 0 and number % LOOPS:
            line = ["predict", str(path), "--stage", "nominal", "--out", str(self.folder / "p.npz")]
            self.ended(kind, number, line, command(line), words)
            return
        earlier = number % 2 == 0
        if earlier:
            out.mkdir()
            (out / "report.json").write_text("earlier")
        line = ["close-loop", str(path), "--out", str(out), *(["--overwrite"] if earlier else []), "--jobs", "1"]
        ending = command(line)
        if ending.code == 2 and checked.code == 0 and "unstable" not in ending.text:
            print(f"case {number}: passed the check, but: {' '.join(ending.text.split())[-200:]}", flush=True)
        self.ended(kind, number, line, ending, words)
        report = out / "report.json"
        if ending.code and (report.read_text() != "earlier" if earlier else report.exists()):
            self.faults.append(f"case {number} ({kind}): a report of a run that did not finish")
        if not ending.code:
            json.loads(report.read_text())

    def options(self, number: int, kind: str, rng: random.Random) -> None:
        healthy(rng.choice(FORMATS)).write(self.folder)
        line = OPTIONS[kind](self.folder, rng)
        before = {p: p.read_bytes() for p in self.folder.rglob("*") if p.is_file()}
        ending = command(line)
        self.ended(kind, number, line, ending, ("",))
        if ending.code and any(not p.exists() or p.read_bytes() != content for p, content in before.items()):
            self.faults.append(f"case {number} ({kind}): {line} was refused, but files changed")

    def results(self, number: int, kind: str, rng: random.Random) -> None:
        path, content = healthy().write(self.folder), FITS[kind](rng)
        if kind.startswith("fit.json"):
            (self.folder / "fit.json").write_bytes(content)
            line = ["predict", str(path), "--fit", str(self.folder), "--out", str(self.folder / "p.npz")]
            ending = command(line)
            self.ended(kind, number, line, ending, ("fit.json",))
            if ending.code and (self.folder / "p.npz").exists():
                self.faults.append(f"case {number} ({kind}): a prediction of a command that failed")
            return
        file = self.folder / "effects.yaml"
        file.write_bytes(content.replace(b"hinge", b"fl_wheel").replace(b"servo", b"fl"))
        code, text, began = 0, "", time.process_time()
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("default")
            try:
                with alarm(LIMIT):
                    ApplyEffects.from_file(self.env, file, any_model=True).reset(seed=0)
            except InputError as e:
                code, text = 2, str(e)
            except BaseException as e:
                code, text = 1, f"{type(e).__name__}: {e}"
        ending = Ending(code, text, time.process_time() - began, first(seen))
        self.ended(kind, number, ["from_file", str(file)], ending, ("effects.yaml",))

    def run(self, cases: int, only: str, one: int | None) -> None:
        turns = {k: self.inputs for k in INPUTS} | {k: self.options for k in OPTIONS} | {k: self.results for k in FITS}
        kinds = [k for k in turns if only in k]
        for number in range(cases) if one is None else [one]:
            rng = random.Random(f"{self.seed} {number}")
            kind = rng.choice(kinds)
            shutil.rmtree(self.folder, ignore_errors=True)
            self.folder.mkdir(parents=True)
            turns[kind](number, kind, rng)
            if number % 500 == 499:
                print(f"{number + 1} cases, {len(self.faults)} faults", flush=True)


INPUTS_WORDS = (
    "version",
    "parameters",
    "logs",
    "split",
    "time",
    "controls",
    "channels",
    "exogenous",
    "known",
    "segments",
    "effects",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="sixty cases, some ten seconds")
    parser.add_argument("--cases", type=count(1), help="how many (10 000)")
    parser.add_argument("--seed", type=count(0), help="repeat the run of that seed")
    parser.add_argument("--only", default="", help="kinds of damage whose name holds this")
    parser.add_argument("--case", type=count(0), help="only the case of that number, whose files stay")
    parser.add_argument("--json", type=json_file, help="write the rows there")
    args = parser.parse_args()
    if not any(args.only in kind for kind in (*INPUTS, *OPTIONS, *FITS)):
        kinds = ", ".join(sorted({kind.partition(":")[0] for kind in (*INPUTS, *OPTIONS, *FITS)}))
        parser.error(f"--only {args.only!r}: no kind of damage holds that; they begin with {kinds}")
    if args.case is not None and args.seed is None:
        parser.error(f"--case {args.case} is one of a run: give that run's --seed, which it printed")
    seed = secrets.randbits(32) if args.seed is None else args.seed
    cases = args.cases or (60 if args.quick else 10_000)
    print(f"seed {seed}, {cases} cases", flush=True)
    began, folder = time.monotonic(), Path(tempfile.mkdtemp(prefix="malformed"))
    bench = Bench(seed, folder / "case", show=40)
    bench.run(cases, args.only, args.case)
    for kind, counts in sorted(bench.count.items()):
        print(f"{kind:36} {counts['accepted']:6} accepted {counts['refused']:6} refused {counts['faulty']:6} faulty")
    if args.case is None:
        shutil.rmtree(folder)
    else:
        print(f"files in {folder}")
    print(f"slowest: {bench.slowest[0]:.2f} s, {bench.slowest[1]}; {time.monotonic() - began:.0f} s in all")
    table = Table()
    table.add("commands", sum(sum(c.values()) for c in bench.count.values()), "1")
    table.add("faults: tracebacks, hangs, warnings, losses, mute refusals", len(bench.faults), "1", at_most=0)
    table.add("slowest command", bench.slowest[0], "s", at_most=LIMIT)
    if args.json:
        rows = [asdict(r) | {"seeds": [seed]} for r in table.rows]
        write_json(args.json, {**made(args), "seed": seed, "rows": rows})
    sys.exit(bool(bench.faults))


if __name__ == "__main__":
    faulthandler.enable()
    os.environ.setdefault("NO_COLOR", "1")
    sys.exit(ended(main))
