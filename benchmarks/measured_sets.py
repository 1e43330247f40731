"""The six recorded machines: prepare the logs, close the loop on each, predict, score, print a table with the goals.

    python benchmarks/measured_sets.py --data ../shared [--sets emps ...] [--work DIR] [--jobs N] [--at-once N]
                                       [--json FILE] [--figures docs/machines] [--quick]

The recordings, their splits and their scores are those of `score/recordings.py` in the data folder; everything that is
particular to a machine is in its folder under `benchmarks/measured/`: the model to start from, and a mapping file.
A run that was killed goes on in the same work folder; a set that is finished there is measured anew.
Without the data the benchmark says so and ends. `--quick` runs one set, with one family of effects, to show that
the way through works.
"""

import argparse
import io
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
from options import count, ended, json_file, made, write_json

from nfc_gym.cli import app
from nfc_gym.measured.dataset import load

HERE = Path(__file__).resolve().parent
# set -> (what `nfc-gym predict --mode` is asked for, figure of the start, figure of the reference, goal), by the scorer
SETS = {
    "skidsteer_husky": ("rollout", (0.448, 1.383), (0.244, 0.128), (0.235, 0.115)),
    "bam_xl330": ("rollout", (0.088,), (0.076,), (0.072,)),
    "emps": ("inverse", (0.704,), (0.0269,), (0.026,)),
    "dfki_double_pendulum": ("inverse", (0.281,), (0.217,), (0.205,)),
    "nanobench_crazyflie": ("forward", (0.254,), (0.217,), (0.205,)),
    "quadruped_go2": ("rollout", (0.0373,), (0.0098,), (0.0085,)),
}
TITLES = {
    "skidsteer_husky": "Clearpath Husky",
    "bam_xl330": "Dynamixel XL330",
    "emps": "EMPS ball screw",
    "dfki_double_pendulum": "double pendulum",
    "nanobench_crazyflie": "Crazyflie 2.1",
    "quadruped_go2": "Unitree Go2 legs",
}
QUICK = ("coulomb",)  # what a quick run looks for
# The scorer prints the figures of single groups first; the goals are about the last ones.
STAGES = ("nominal", "calibrated", "extended")


def nfc_gym(*words: object, here: bool = False) -> None:
    """`nfc-gym ...` with this interpreter; `here` in this process, which has loaded the libraries already."""
    line = [str(word) for word in words]
    if not here:
        subprocess.run([sys.executable, "-c", "from nfc_gym.cli import main; main()", *line], check=True)
    elif code := app(line, standalone_mode=False):
        sys.exit(code)


def recordings(data: Path) -> ModuleType:
    """The scorer: its `SETS` read the recordings, its `main` prepares them, its `score` judges."""
    spec = spec_from_file_location("recordings", data / "score" / "recordings.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def prepare(scorer: ModuleType, sets: Sequence[str], work: Path) -> None:
    """Write the prepared logs of sets, and each set's mapping and model beside them; loops that were run stay."""
    scorer.SETS = {name: scorer.SETS[name] for name in sets}
    with redirect_stdout(io.StringIO()):
        scorer.main(["prepare", str(work / "prepared")])
    for name in sets:
        folder = work / name
        shutil.rmtree(folder / "logs", ignore_errors=True)
        shutil.copytree(HERE / "measured" / name, folder, dirs_exist_ok=True)
        shutil.move(work / "prepared" / name, folder / "logs")


def run_set(scorer: ModuleType, name: str, args: argparse.Namespace) -> dict[str, list[float]]:
    """Close the loop on a set and score each stage's predictions: stage -> the figures that the goals are about."""
    work = args.work
    mapping, out = work / name / "mapping.yaml", work / name / "loop"
    close = ("close-loop", mapping, "--out", out, "--jobs", args.jobs, "--seed", args.seed)
    if (out / "report.json").exists():
        shutil.rmtree(out)
    folds = [f.name for f in load(mapping).folds]
    if args.at_once > 1 and len(folds) > 1:  # the whole run finds them done
        folds = [name for name in folds if not (out / name / "report.json").exists()]
        with ThreadPoolExecutor(args.at_once) as pool:
            list(pool.map(lambda fold: nfc_gym(*close, "--fold", fold), folds))
    nfc_gym(*close, here=args.quick)
    figures = {}
    for stage in STAGES:
        file = work / name / f"{stage}.npz"
        told = ("--fit", out, "--mode", SETS[name][0], "--stage", stage, "--out", file)
        nfc_gym("predict", mapping, *told, here=args.quick)
        with np.load(file) as predicted:
            values = list(scorer.score(name, dict(predicted)).values())
        figures[stage] = [round(float(v), 4) for v in values[-len(SETS[name][3]) :]]
    return figures


def claims(out: Path) -> str:
    """What the loop claimed."""
    report = json.loads((out / "report.json").read_text())
    if "folds" in report:
        return "; ".join(f"{k} ({v})" for k, v in report["effects_found_in"].items()) or "nothing"
    return "; ".join(e["id"] for e in report["effects"]) or "nothing"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=HERE.parents[1] / "shared", help="folder with data/ and score/")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument("--work", type=Path, default=Path("results/measured_sets"))
    parser.add_argument("--jobs", type=count(0), default=0, help="threads of a loop; 0 takes all cores")
    parser.add_argument(
        "--at-once", type=count(1), default=1, help="folds of a set at a time, each with --jobs threads"
    )
    parser.add_argument("--seed", type=count(0), default=0)
    parser.add_argument("--json", type=json_file)
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help="draw one picture a set there")
    parser.add_argument(
        "--quick", action="store_true", help="one set and one family of effects, as an end-to-end check"
    )
    args = parser.parse_args()
    if not (args.data / "score" / "recordings.py").exists():
        print(f"measured_sets: skipped, the recordings are not at {args.data} (say --data FOLDER)")
        return
    args.work.mkdir(parents=True, exist_ok=True)
    scorer, rows = recordings(args.data), []
    if args.quick:
        args.sets, args.jobs = ["emps"], 1
    prepare(scorer, args.sets, args.work)
    if args.quick:
        with open(args.work / "emps" / "mapping.yaml", "a", encoding="utf-8") as mapping:
            mapping.write(f"effects: {{only: [{', '.join(QUICK)}]}}\n")
    for name in args.sets:
        began = time.monotonic()
        figures = run_set(scorer, name, args)
        seconds = time.monotonic() - began
        if args.figures:
            from measured.figure import draw  # matplotlib, of which nothing else here knows

            files = {stage: args.work / name / f"{stage}.npz" for stage in STAGES}
            draw(args.work / name / "mapping.yaml", SETS[name][0], files, TITLES[name], args.figures / f"{name}.png")
        _, start, reference, goals = SETS[name]
        for i, goal in enumerate(goals):
            rows.append(
                {
                    "name": name, "value": figures["extended"][i], "unit": "scorer's",
                    "baseline": figures["calibrated"][i],
                    "start": start[i], "reference": reference[i], "goal": goal, "holds": figures["extended"][i] <= goal,
                    "seeds": [args.seed], "seconds": round(seconds, 1), "claims": claims(args.work / name / "loop"),
                }
            )  # fmt: skip
    print(f"{'set':22} {'start':>8} {'reference':>9} {'psi alone':>9} {'extended':>9} {'goal':>8}  holds  minutes")
    for r in rows:
        print(
            f"{r['name']:22} {r['start']:8.4g} {r['reference']:9.4g} {r['baseline']:9.4g} {r['value']:9.4g} "
            f"{r['goal']:8.4g}  {'yes' if r['holds'] else 'NO':5}  {r['seconds'] / 60:.1f}"
        )
        print(f"    {r['claims']}")
    if args.json:
        write_json(args.json, {**made(args), "rows": rows})


if __name__ == "__main__":
    sys.exit(ended(main))
