"""Does the undamaged robot of the second engine move as ours does? The same commands in PyBullet and in MuJoCo.

    python benchmarks/second_engine.py [--quick] [--json FILE]

Jackal: mean forward speed and yaw rate after 1.2 s of constant commands, on flat ground, also with its front-left axle
broken. Quadcopter and Quadruped: how far apart the two bases are after 2 s of the same open-loop commands, beside how
far the robot has moved. Differences are reported, not tuned away: another engine has other contacts.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib.util import find_spec

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from options import ended, json_file, write_json
from timing import Table
from worlds.judge import state_of
from worlds.world import World

Array = NDArray[np.float64]
DRIVES = ((0.3, 0.0), (0.6, 0.0), (-0.5, 0.0), (0.3, 0.3), (0.3, -0.3), (0.0, 0.5), (0.0, -0.5), (0.6, 0.8))
STEPS, SETTLED = 120, 60
ENGINES = ("mujoco", "bullet")


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two drives and one flight")
    parser.add_argument("--json", type=json_file, metavar="FILE")
    args = parser.parse_args(argv)
    if find_spec("pybullet") is None:
        print("second_engine: skipped, PyBullet is not installed: pip install 'nfc_gym[bench]'")
        return 0
    table = Table()
    for scenario in ("nominal",) if args.quick else ("nominal", "axle"):
        for drive in DRIVES[::4] if args.quick else DRIVES:
            rover(table, scenario, drive)
    for name, place, commands in TRIALS[:1] if args.quick else TRIALS:
        open_loop(table, name, place, commands)
    if args.json:
        write_json(args.json, [asdict(r) for r in table.rows])
    return 0


def states(place: str, scenario: str, engine: str, command: Callable[[int], Array], steps: int) -> tuple[Array, Array]:
    """Poses (T + 1, 7) and velocities (T + 1, 6) of one robot in one engine."""
    env = World(place, scenario, 0, noisy=False, engine=engine).make(1, context=["psi"], max_episode_steps=-1)
    env.reset(seed=3)
    rows = [state_of(env)[:2]]
    for k in range(steps):
        _, _, ended, _, _ = env.step(command(k)[None])
        if ended.any():
            break
        rows.append(state_of(env)[:2])
    env.close()
    poses, speeds = zip(*rows, strict=True)
    return np.array(poses)[:, 0], np.array(speeds)[:, 0]


def forward(poses: Array, speeds: Array) -> Array:
    """(T,) speed along the heading [m/s]."""
    w, x, y, z = poses[:, 3:7].T
    cos, sin = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z)
    return (cos * speeds[:, 0] + sin * speeds[:, 1]) / np.hypot(cos, sin)


def rover(table: Table, scenario: str, drive: tuple[float, float]) -> None:
    """Forward speed and yaw rate in both engines."""
    found = {}
    for engine in ENGINES:
        poses, speeds = states("JackalFlat", scenario, engine, lambda k: np.array(drive), STEPS)
        found[engine] = forward(poses, speeds)[SETTLED:].mean(), speeds[SETTLED:, 5].mean()
    named = f"Jackal, {scenario}, action {drive}"
    for i, (what, unit) in enumerate((("forward speed", "m/s"), ("yaw rate", "rad/s"))):
        table.add(f"{named}: {what}, bullet", found["bullet"][i], unit, baseline=found["mujoco"][i])


def tilted(k: int) -> Array:
    """Thrust that leans a quadcopter over, and back."""
    return np.array([1.0, 0.0, 1.0, 0.0]) * (0.02 if k < 25 else -0.02 if k < 50 else 0.0)


def waving(k: int) -> Array:
    """Joint targets of a quadruped that go to and fro, each in its own phase."""
    return 0.5 * np.sin(2 * np.pi * 1.5 * 0.02 * k + 0.7 * np.pi * np.arange(12))


TRIALS: tuple[tuple[str, str, Callable[[int], Array]], ...] = (
    ("Quadcopter, leaning over and back", "QuadcopterFlat", tilted),
    ("Quadcopter, hovering", "QuadcopterFlat", lambda k: np.zeros(4)),
    ("Quadruped, standing", "QuadrupedFlat", lambda k: np.zeros(12)),
    ("Quadruped, waving its joints", "QuadrupedFlat", waving),
)


def open_loop(table: Table, name: str, place: str, commands: Callable[[int], Array]) -> None:
    """Distance between the two bases at the end, beside the way from the start."""
    ours, theirs = (states(place, "nominal", engine, commands, 90)[0] for engine in ENGINES)
    last = min(len(ours), len(theirs)) - 1
    apart, moved = np.linalg.norm(theirs[last, :3] - ours[last, :3]), np.linalg.norm(ours[last, :3] - ours[0, :3])
    table.add(f"{name}: bases apart after {0.02 * last:.1f} s (baseline: way moved)", apart, "m", baseline=float(moved))


if __name__ == "__main__":
    sys.exit(ended(main))
