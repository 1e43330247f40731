"""Does the loop tell the truth of machines that are none of the package's robots?

Arms, grippers, cranes, tendons, carts, rovers, legs, drones, an underwater vehicle, gimbals, a URDF leg: each is drawn
at run time by code that knows MuJoCo alone (`foreign/`), with psi off by up to 10 to 30 %, noisy sensors and logs in
formats that users have. It hides nothing, one effect, two, or one that the library has no law of. Each case states the
sizes that are realistic, and by how many deviations of a sample's noise the plainest channel is to go astray in 0.2 s.
`nfc-gym close-loop` then runs on the mapping file as a command of its own, on one core, and its report is scored
against the truth, which lies elsewhere. A loop that fails or exceeds its limit counts as wrong.

    python benchmarks/foreign_machines.py --jobs 31 --out foreign/ --json foreign.json
"""

import argparse
import json
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from foreign.drawing import draw
from foreign.folder import write
from foreign.machines import CASES
from foreign.running import Folders, run
from foreign.score import Score, score
from foreign.summary import GROUPS, by_group, by_machine, summarise
from options import count, ended, json_file, made, number, write_json
from standin.plan import seed_of
from undeclared_effects import master_seed

QUICK = "urdf_none"
BRIEF = (3, 1.5)  # logs, and s of each at most, of a quick run


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    if args.list:
        print(listed(args.only))
        return 0
    with folder(args.out) as args.out:
        seed, folders = begun(args), Folders(args.out)
        if args.draw:
            for name in args.only:
                drawn(name, seed, folders, args.quick)
            return 0
        return run_and_score(args, seed, folders)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--quick", action="store_true", help=f"only {QUICK}, with few and short logs")
    add("--only", nargs="+", choices=list(CASES), metavar="NAME", help="only these machines")
    add("--list", action="store_true", help="say which machines there are, and run nothing")
    add("--draw", action="store_true", help="write the machines' folders, and run nothing")
    add("--seed", type=count(0), help="repeats a run; default drawn, or the one that --out was begun with")
    add("--jobs", type=count(1), default=1, help="machines at a time, one core each")
    add("--limit", type=number(1), default=1800.0, metavar="S", help="seconds that a loop may take (default 1800)")
    add("--out", type=Path, metavar="DIR", help="keeps machines, truths and loops: a killed run goes on from here")
    add("--kept", action="store_true", help="no new loops: scores of those that --out holds")
    add("--json", type=json_file, metavar="FILE", help="figures {name, value, unit, ...} and each machine's score")
    args = parser.parse_args(argv)
    if args.kept and not args.out:
        parser.error("--kept wants --out DIR: where the loops are kept")
    if args.draw and not args.out:
        parser.error("--draw wants --out DIR: where the folders are to be written")
    args.only = args.only or ([QUICK] if args.quick else list(CASES))
    return args


def begun(args: argparse.Namespace) -> int:
    """The seed. A folder that has one is not written to: those who draw in it do so at the same time."""
    kept = args.out / "seed.json"
    return json.loads(kept.read_text())["seed"] if args.draw and kept.exists() else master_seed(args)


@contextmanager
def folder(out: Path | None) -> Iterator[Path]:
    """The given folder, or one that is removed."""
    if out is not None:
        yield out.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="foreign_") as made:
        yield Path(made)


def listed(names: Sequence[str]) -> str:
    """Each machine, its logs, what it hides of which size, and how plainly that is to show."""
    lines = []
    for name in names:
        case = CASES[name]
        m = case.machine
        logs = f"{m.logs} logs of {m.seconds:g} s at {m.rate:g} Hz, {m.format.suffix}"
        hidden = case.what
        if case.hide:
            hidden = f"{_range(case.sizes)} {case.what}; {_range(case.shown)} noise deviations after 0.2 s"
        lines.append(f"{name:20} {GROUPS[case.group]:20} {logs:36} {hidden}")
    return "\n".join(lines)


def _range(ends: tuple[float, float]) -> str:
    return " to ".join(f"{end:g}" for end in ends)


def drawn(name: str, seed: int, folders: Folders, brief: bool) -> None:
    """Draw a machine and write its folder and its truth."""
    case = CASES[name]
    if brief:
        logs, seconds = BRIEF
        case = replace(case, machine=replace(case.machine, logs=logs, seconds=min(seconds, case.machine.seconds)))
    write(draw(case, seed_of(seed, "foreign", name)), folders.machine(name), folders.truth(name))


def run_and_score(args: argparse.Namespace, seed: int, folders: Folders) -> int:
    """Run what has not ended, the longest first; print a line each and the tables."""
    names = sorted(args.only, key=lambda n: -CASES[n].cost)
    if args.kept:
        names = [n for n in names if folders.ended(n)]
    print(f"seed {seed} (drawn at run time unless given); {len(names)} machines, {args.jobs} at a time", flush=True)
    command = [sys.executable, str(Path(__file__).resolve()), "--draw", "--out", str(args.out)]
    command += [*(["--quick"] if args.quick else []), "--only"]
    drawing = {n: [*command, n] for n in names}
    began, rows = time.monotonic(), list[Score]()
    try:
        finished = names if args.kept else run(names, drawing, folders, args.jobs, args.limit)
        rows += shown((scored(n, folders) for n in finished), len(names))
    except KeyboardInterrupt:
        print("stopped" + ("; the same command goes on from here" if args.out else ""))
        rows = [scored(n, folders) for n in names if folders.ended(n)]
    rows.sort(key=lambda r: (list(GROUPS).index(r.group), r.name))
    figures = summarise(rows, seed)
    print("\n".join(("", by_machine(rows), "", by_group(rows), "")))
    for f in figures:
        print(
            f"{f['name']:75} {f['value']:8.3g} {f['unit']}"
            + (f"  (baseline {f['baseline']:.3g})" if f["baseline"] else "")
        )
    print(f"{len(rows)} of {len(args.only)} machines, {time.monotonic() - began:.0f} s; seed {seed}")
    for path in (args.json, args.out / "results.json"):
        if path:
            write_json(path, {**made(args), "seed": seed, "rows": figures, "trials": [r.plain() for r in rows]})
    return 0 if args.kept or len(rows) == len(args.only) else 1


def scored(name: str, folders: Folders) -> Score:
    """The score of a machine whose loop has ended in some way."""
    report, truth, ending = folders.report(name), folders.truth(name), folders.ending(name)
    content = json.loads(report.read_text()) if report.exists() else None
    case = CASES[name]
    known = {"name": name, "group": case.group, "seed": 0, "effects": [], "psi": {}, "shown": {}}  # drawing has failed
    return score(json.loads(truth.read_text()) if truth.exists() else known, content, ending or {})


def shown(rows: Iterable[Score], total: int) -> Iterator[Score]:
    """Print each row as it comes."""
    print("machine | hidden | outcome | X nominal > psi alone > after / null | s | claims")
    for i, r in enumerate(rows, 1):
        x = " > ".join(f"{r.x[k]:.3g}" for k in ("nominal", "calibrated", "extended")) if r.x else "-"
        x += f" / {r.x['null']:.3g}" if r.x else ""
        claims = "; ".join(r.claims) or r.verdict + (f" at {r.said}" if r.said else "")
        print(" | ".join((r.name, r.hidden, r.outcome, x, f"{r.seconds:.0f}", claims)), f"  {i}/{total}", flush=True)
        yield r


if __name__ == "__main__":
    for how in (signal.SIGINT, signal.SIGTERM):  # loops are processes of their own: whoever ends this ends them, too
        signal.signal(how, signal.default_int_handler)
    sys.exit(ended(main))
