"""What one window tells of psi when the simulator itself is asked, as `nfc-gym infer ID window.npz --refine` does.

    python benchmarks/one_window.py --out DIR [--robots Jackal Ant ...] [--windows N] [--simulations N] [--axle N]
                                    [--posteriors DIR] [--seed S] [--jobs J] [--stop SECONDS] [--json FILE]
    python benchmarks/one_window.py --quick

Windows on flat ground under psi from the prior, drawn at run time, without a trained posterior: gain over the prior of
the true psi, its share of what the window can tell at most (`simulate.ceiling`), how many truths the 90 % intervals
hold, and the time on one core. With `--axle` also Jackals whose front-left servo has no gain. Each window is kept as it
is done, so that the command goes on where it was stopped; `--stop` begins nothing new after so many seconds.
With `--posteriors` rounds begin where `DIR/<Robot>Flat.safetensors`, a trained posterior, believes psi to be, and its
own gain is told beside.
"""

import argparse
import os
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from options import count, ended, json_file, made, number, write_json
from posteriors import metrics
from posteriors.cases import AXLE, GROUND, SAMPLES
from posteriors.keep import Kept, begun

from nfc_gym.core import Fidelity
from nfc_gym.inference.normal import NormalPosterior
from nfc_gym.inference.posterior import Window, load
from nfc_gym.inference.progress import Quiet
from nfc_gym.simulate import Simulator, starts
from nfc_gym.simulate.ceiling import ceiling
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.pool import unordered
from nfc_gym.simulate.refined import refined

Array = NDArray[np.float64]
ROBOTS = ("Jackal", "Ant", "Quadruped", "Humanoid", "Quadcopter")
LEVEL = 0.9
NARROW = 0.25  # of the prior, that an interval of the lost axle is to be within
_SPREAD = 2048  # windows that say how fast a robot may be moving when one begins
_ROUND = "round "


class Rounds(Quiet):
    """Counts them."""

    count = 0

    def message(self, text: str) -> None:
        """See `Report`."""
        self.count += text.startswith(_ROUND)


@cache
def before(environment: str, seed: int) -> Array:
    """See `starts.spread`."""
    simulator = Simulator(environment, effects=0.0, jobs=1, names=("start",))
    drawn = simulator.draw(_SPREAD, np.random.default_rng([seed, 3]))
    return starts.spread(Machine(environment), {"start": drawn["start"].numpy()})


def judged(task: tuple[str, int, int, bool, int, Path | None]) -> dict[str, Any]:
    """One window: see `one`; it is asked for by (robot, number, seed, axle, simulations, folder of posteriors)."""
    robot, number, seed, axle, simulations, folder = task
    environment = f"nfc_gym/{robot}Flat-v0"
    machine = Machine(environment)
    rng = np.random.default_rng([seed, ROBOTS.index(robot), number, int(axle)])
    u = rng.uniform(size=(1, len(machine.space)))
    at = machine.space.names.index(AXLE) if axle else None
    if at is not None:
        u[:, at] = (0 - machine.space.low[at]) / (machine.space.high[at] - machine.space.low[at])
    psi = machine.space.low + u * (machine.space.high - machine.space.low)
    seen = Simulator(environment, effects=0.0, jobs=1, names=("states", "actions", "start", *GROUND))(psi, rng)
    window, heard, clock = Window(seen["states"][0].numpy(), seen["actions"][0].numpy()), Rounds(), time.monotonic()
    trained = None if folder is None else load(folder / f"{robot}Flat.safetensors")
    found = refined(
        trained, window, environment=environment, simulations=simulations, seed=number, jobs=1, report=heard
    )
    out: dict[str, Any] = {"seconds": time.monotonic() - clock, "rounds": heard.count}
    draws = found.prior.u_of(found.sample(SAMPLES, rng).psi)[None]
    low, high = (end[0] for end in metrics.intervals(draws, LEVEL))
    if at is not None:
        return out | {"held": float(low[at] <= u[0, at] <= high[at]), "width": float(high[at] - low[at])}
    if trained is not None:
        known = trained.of("psi").given(window).log_prob(Fidelity(psi))
        out["trained"] = float(known[0] + found.prior.log_volume) / found.prior.size
    asked = {name: t.numpy() for name, t in seen.items()} | {"psi": u}
    most = ceiling(environment, asked, before=before(environment, seed))
    return out | one(found, psi, u, low, high) | {"ceiling": float(most.joint[0]) / found.prior.size}


def one(found: NormalPosterior, psi: Array, u: Array, low: Array, high: Array) -> dict[str, float]:
    """Gain of the truth [nats a parameter]; its squared distance a parameter, 1 on average; intervals."""
    off = found.prior.to_z(psi)[0] - found.normal.mean
    return {
        "gain": float(found.log_prob(Fidelity(psi))[0] + found.prior.log_volume) / found.prior.size,
        "squares": float(off @ np.linalg.solve(found.normal.covariance, off)) / len(off),
        "held": float(((low <= u[0]) & (u[0] <= high)).mean()),
        "width": float((high - low).mean()),
    }


def rows(kept: Kept, robots: list[str]) -> list[dict[str, Any]]:
    """A row a robot, and one of lost axles."""
    out: list[dict[str, Any]] = []
    cells = kept.values()
    for name in [*robots, "axle"]:
        own = [c for k, c in cells.items() if k.rpartition("_")[0] == name]
        if not own:
            continue
        row: dict[str, Any] = {"name": name, "windows": len(own)}
        for key in [k for k in ("gain", "trained", "ceiling", "squares", "held", "width") if k in own[0]]:
            fine = [c[key] for c in own if np.isfinite(c[key])]
            row |= dict(zip((key, f"{key}_error"), metrics.mean(np.array(fine)), strict=True))
        told = [(c["gain"], c["ceiling"]) for c in own if np.isfinite(c.get("ceiling", np.nan))]
        if told:
            row["share"] = float(np.sum([g for g, _ in told]) / np.sum([m for _, m in told]))
            row["least"] = min(c["gain"] for c in own)
        if name == "axle":
            row["narrow"] = float(np.mean([c["width"] < NARROW for c in own]))
        row |= {k: float(np.median([c[k] for c in own])) for k in ("seconds", "rounds")}
        out.append(row)
    return out


def said(row: dict[str, Any]) -> str:
    """A row in words."""
    parts = [f"{row['name']:<11} {row['windows']:>4} windows"]
    if "gain" in row:
        parts.append(
            f"gain {row['gain']:.3f} +- {row['gain_error']:.3f} of {row['ceiling']:.3f} nats a parameter "
            f"({row.get('share', np.nan):.2f}; least {row['least']:.2f})"
        )
        parts.append(f"squares {row['squares']:.2f}")
    if "trained" in row:
        parts.append(f"the trained posterior alone {row['trained']:.3f} +- {row['trained_error']:.3f}")
    parts.append(f"90 % intervals hold {row['held']:.3f} +- {row['held_error']:.3f}")
    if "narrow" in row:
        parts.append(f"under a quarter of the prior {row['narrow']:.2f}")
    return ", ".join([*parts, f"{row['rounds']:.0f} rounds, {row['seconds']:.0f} s"])


def main(argv: list[str] | None = None) -> int:
    """Command line."""
    args = arguments(argv)
    seed = begun(args.out, args.seed)
    settings = {"simulations": args.simulations, "seed": seed}
    kept = Kept(args.out, settings | ({"trained": True} if args.posteriors else {}))
    how = args.simulations, args.posteriors
    wanted = [(name, (name, i, seed, False, *how)) for i in range(args.windows) for name in args.robots]
    wanted += [("axle", ("Jackal", i, seed, True, *how)) for i in range(args.axle)]
    tasks = [(f"{name}_{task[1]}", task) for name, task in wanted if not kept.has(f"{name}_{task[1]}")]
    print(f"seed {seed}; {len(wanted) - len(tasks)} of {len(wanted)} windows are there already", flush=True)
    until = time.monotonic() + args.stop
    asked = (task for _, task in tasks if time.monotonic() < until)
    cells = enumerate(map(judged, asked)) if args.jobs == 1 else unordered(judged, zip(asked), args.jobs)
    for done, (k, cell) in enumerate(cells, 1):
        kept.keep(tasks[k][0], cell)
        print(f"{done} of {len(tasks)}: {tasks[k][0]} {_short(cell)}", flush=True)
    table = rows(kept, args.robots)
    print("\n".join(map(said, table)))
    if args.json is not None:
        write_json(args.json, {**made(args), "seed": seed, "simulations": args.simulations, "rows": table})
    return 0


def _short(cell: dict[str, Any]) -> str:
    return ", ".join(f"{k} {v:.3g}" for k, v in cell.items())


def arguments(argv: list[str] | None) -> argparse.Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder of the results; with --quick a new one by default")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS), help="default all")
    parser.add_argument("--windows", type=count(0), default=40, help="a robot (default %(default)s)")
    parser.add_argument("--axle", type=count(0), default=0, help="Jackals with a lost axle (default %(default)s)")
    parser.add_argument("--simulations", type=count(1), default=10_000, help="a window at most (default %(default)s)")
    parser.add_argument("--posteriors", type=Path, metavar="DIR", help="trained ones to begin with")
    parser.add_argument("--seed", type=count(0), help="default the folder's, or a new one, which is printed")
    parser.add_argument("--jobs", type=count(1), default=os.cpu_count() or 1, help="processes (default all cores)")
    parser.add_argument("--stop", type=number(0), default=float("inf"), help="s, after which nothing new begins")
    parser.add_argument("--json", type=json_file, metavar="FILE", help="write the rows there too")
    parser.add_argument("--quick", action="store_true", help="one Quadcopter and few simulations: does it run?")
    args = parser.parse_args(argv)
    if args.quick:
        import tempfile

        args.out = args.out or Path(tempfile.mkdtemp())
        args.robots, args.windows, args.axle, args.simulations, args.jobs = ["Quadcopter"], 1, 0, 1800, 1
    if args.out is None:
        parser.error("--out DIR is wanted")
    return args


if __name__ == "__main__":
    sys.exit(ended(main))
