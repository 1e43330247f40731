"""Windows per second and core that `nfc-gym simulate` makes, beside the bare physics of the same windows.

    python benchmarks/simulate.py [--quick] [--only JackalFlat ...] [--windows N] [--json FILE]

One process, one thread, processor time: on a machine that does nothing else, n cores make n times as many. The baseline
is `mujoco.batch` alone under random commands for as many physics steps as a window and its warm-up have on average,
with psi and ground per simulation, and without effects, the residual's second simulation, or redrawn windows.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import asdict

os.environ.setdefault("OMP_NUM_THREADS", "1")

import mujoco
import numpy as np
import safetensors
from options import count, ended, json_file, write_json
from timing import SEED, Table

from nfc_gym.simulate import ground
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.run import manifest_of
from nfc_gym.simulate.shard import Plan, make_shard, workshop

MILLION, MACHINE = 1_000_000, 16  # windows, and the cores that they are to be made on


def bare(machine: Machine, windows: int) -> float:
    """Seconds of processor time for the physics alone of so many windows."""
    rng, habit = np.random.default_rng(SEED), machine.habit
    soil = ground.Ground.of(machine, SEED, 0)
    sims = machine.simulations(windows, 1, soil.maps)
    which = rng.integers(max(len(soil.maps), 1), size=windows)
    u = rng.random((windows, ground.count(machine)))
    ground.begin(machine, sims, machine.space.sample(rng, windows), which, u)
    began = time.process_time()
    for _ in range(round(np.mean(habit.warm)) + habit.horizon):
        action = rng.uniform(-1, 1, (windows, machine.kind.action_size))
        sims.view.ctrl[...] = sims.robot.actuate(action, sims.view)
        sims.batch.step(nstep=machine.kind.frame_skip)
    return time.process_time() - began


def speed(table: Table, name: str, windows: int) -> None:
    """Rows of one environment."""
    machine = Machine(f"nfc_gym/{name}-v0")
    workshop(machine.environment)  # made once a process: the library's sizes for this robot
    plan = Plan(manifest_of(machine.environment, windows, SEED, windows, {}))
    began = time.process_time()
    data = make_shard(plan, 0)
    took = time.process_time() - began
    raw = bare(machine, windows)
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    counts = json.loads(header["__metadata__"]["counts"])
    table.add(f"{name}: windows", windows / took, "1/s a core", baseline=windows / raw)
    minutes = MILLION / MACHINE * took / windows / 60
    goal = 30.0 if name.startswith("Jackal") else None
    table.add(f"{name}: 1e6 windows on 16 cores", minutes, "min", at_most=goal)
    redrawn = (counts["unstable"] + counts["ended"]) / windows
    table.add(f"{name}: redrawn windows over those kept", redrawn, "1")
    table.add(f"{name}: size", len(data) / windows / 1e3, "kB a window")


def main() -> None:
    """Command line."""
    robots = ("Jackal", "Ant", "Quadruped", "Humanoid", "Quadcopter")
    names = [f"{robot}{soil}" for robot in robots for soil in ("Flat", "Rough")]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=names)
    parser.add_argument("--windows", type=count(1), default=2048, help="of a shard")
    parser.add_argument("--quick", action="store_true", help="Jackal alone, 64 windows: seconds")
    parser.add_argument("--json", type=json_file, help="write the rows here")
    args = parser.parse_args()
    print(f"mujoco {mujoco.__version__}, numpy {np.__version__}, safetensors {safetensors.__version__}; one thread")
    table = Table()
    for name in args.only or (names[:2] if args.quick else names):
        speed(table, name, 64 if args.quick else args.windows)
    if args.json:
        write_json(args.json, [asdict(r) for r in table.rows])


if __name__ == "__main__":
    sys.exit(ended(main))
