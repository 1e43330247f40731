"""Do two separate codes mean the same by an effect? The stand-ins' own formulas, and the library's laws.

    python benchmarks/both_codes.py [--quick] [--robots jackal ...] [--effects backlash ...] [--ratio R] [--json FILE]

Each effect of each robot is hidden at a size at which X / X_null without it is about R. The library's effect of the
same place and size, in the package's model with the true psi and at its own time step, should then leave X / X_null of
1: what is more is where the two differ. Figures are X on four logs over that of the machine with nothing hidden.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from options import count, ended, json_file, number, write_json
from standin.case import chi2, make_bench, oracle, sized, write_case
from standin.robots import ROBOTS, Robot

from nfc_gym.measured.dataset import load
from nfc_gym.measured.hidden import Hidden
from nfc_gym.measured.standin import Machine, draw_psi

SECONDS, SEEDS = 2.1, range(20, 24)  # of the logs


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    print("robot | hidden | without | with the library's law  (X / X_null)", flush=True)
    rows = []
    for robot in args.robots[:1] if args.quick else args.robots:
        kit = ROBOTS[robot]
        for family in [f for f in kit.named if not args.effects or f in args.effects]:
            text, without, known = compared(kit, family, args.ratio, args.seed)
            print(f"{robot} | {text} | {without:.2f} | {known:.3f}", flush=True)
            rows.append({"robot": robot, "family": family, "hidden": text, "without": without, "with": known})
            if args.quick:
                break
    if args.json:
        write_json(args.json, {"seed": args.seed, "rows": rows})
    return 0


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    families = sorted({f for r in ROBOTS.values() for f in r.named})
    add = parser.add_argument
    add("--quick", action="store_true", help="the first effect of the first robot")
    add("--robots", nargs="+", type=str.lower, choices=list(ROBOTS), default=list(ROBOTS), help="default all")
    add("--effects", nargs="+", choices=families, metavar="FAMILY", help="only these")
    add("--ratio", type=number(1.1, 100), default=8.0, metavar="R", help="X / X_null without the effect (default 8)")
    add("--seed", type=count(0), default=0, help="of psi, places and all else that is drawn")
    add("--json", type=json_file, metavar="FILE", help="the same figures")
    return parser.parse_args(argv)


def compared(kit: Robot, family: str, ratio: float, seed: int) -> tuple[str, float, float]:
    """What is hidden, in words, and X / X_null without the effect and with the library's law of the same size."""
    kit, rng = kit.showing([family]), np.random.default_rng(seed)
    psi = draw_psi(kit.psi, rng)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        hidden, _ = sized(kit, psi, kit.named[family], int(rng.integers(2**31)), ratio, folder / "sizing", 4)
        found = []
        for what in (Hidden(), hidden):
            machine = Machine(psi, what)
            bench = make_bench(load(write_case(folder / what.family, kit, machine, SECONDS, SEEDS)), 1)
            problem = bench.problem(list(bench.dataset.logs))
            found.append(chi2(problem, bench.plant, bench.plant.space.vector(psi)))
        best = oracle(bench, list(bench.dataset.logs), machine)
        if best is None:
            raise ValueError(f"{hidden.text}: the library proposes no such effect for this model")
        return hidden.text, found[1] / found[0], chi2(problem, *best) / found[0]


if __name__ == "__main__":
    sys.exit(ended(main))
