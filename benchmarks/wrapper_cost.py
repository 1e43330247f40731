"""What each wrapper adds to a control step of one environment, and what `ResidualTerrain` adds to a reset.

    python benchmarks/wrapper_cost.py [--quick] [--json FILE]

Every wrapper is at null, so that the wrapped environment makes the bare one's motion and contacts to the bit, and both
take turns in one run; seconds are those of the processor, since cores may be shared. A null costs what any other value
does: nothing is skipped where a parameter is zero.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from options import ended, json_file, write_json
from timing import Table

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.core import Fidelity
from nfc_gym.wrappers import (
    ApplyEffects,
    Hallucinate,
    MonitorAnomaly,
    PerceiveTerrain,
    PerturbSignals,
    RandomizePsi,
    RecordLog,
    ResidualDynamics,
    ResidualTerrain,
)

STEP, SUBSTEP = 15.0, 30.0  # us, the goals: of a wrapper, and of one whose force acts at each of the physics steps
Wrap = Callable[[Any], Any]


class Silent:
    """A detector that does nothing."""

    threshold = 1.0

    def reset(self, rows: Any = None) -> None: ...

    def update(self, obs: Any, action: Any, next_obs: Any) -> float:
        return 0.0


def effect(family: str, where: str, **parameters: float) -> Wrap:
    return lambda env: ApplyEffects(env, [{"family": family, "where": where, "parameters": parameters}])


def hallucinated(env: Any) -> Any:
    """With a posterior of no width around nominal."""
    nv = env.unwrapped.model.nv
    return Hallucinate(env, Fidelity(delta_s=np.zeros((2, nv))))


def cases(name: str, folder: Path) -> dict[str, tuple[Wrap, float | None]]:
    """Wrapper by label, with its goal in us."""
    env = gymnasium.make(name)
    nv, space = env.unwrapped.model.nv, env.observation_space
    body, joint, motor = ("torso", "hip_1", "hip_1") if "Ant" in name else ("base", "rear_left_wheel", "rear_left")
    if name.startswith("nfc_gym/Ant"):
        joint = motor = str(env.unwrapped.model.joint(1).name)
    key = "proprio" if isinstance(space, gymnasium.spaces.Dict) else "observation"
    mass = float(env.unwrapped.model.body(body).mass[0])
    still = (lambda e: RandomizePsi(e, {body: (mass, mass)})) if name == "Ant-v5" else (lambda e: RandomizePsi(e, {}))
    return {
        "RandomizePsi": (still, STEP),
        "ResidualDynamics": (lambda e: ResidualDynamics(e, np.zeros(nv)), STEP),
        "ResidualDynamics, with noise": (lambda e: ResidualDynamics(e, np.zeros(nv), covariance=np.zeros(nv)), STEP),
        "ResidualDynamics, mode state": (lambda e: ResidualDynamics(e, np.zeros(2 * nv), mode="state"), STEP),
        "Hallucinate, delta_s": (hallucinated, STEP),
        "PerturbSignals, noise and delay": (
            lambda e: PerturbSignals(e, {key: {"sd": 0.0, "delay": 0}, "action": {"bias": 0.0}}),
            STEP,
        ),
        "MonitorAnomaly": (lambda e: MonitorAnomaly(e, Silent()), STEP),
        "RecordLog": (lambda e: RecordLog(e, folder / name.replace("/", "_")), STEP),
        "ApplyEffects, a delay": (effect("delay", motor, delay=0.0), SUBSTEP),
        "ApplyEffects, dry friction (a model field)": (effect("coulomb", joint, level=0.0), SUBSTEP),
        "ApplyEffects, Stribeck friction": (effect("stribeck", joint, level=0.0, rise=0.0, speed=0.1), SUBSTEP),
        "ApplyEffects, a constant force": (effect("external_force", body, x=0.0, y=0.0, z=0.0), SUBSTEP),
        "ApplyEffects, linear drag": (effect("drag_linear", body, x=0.0, y=0.0, z=0.0), SUBSTEP),
    }


def seconds(env: Any, actions: np.ndarray) -> float:
    """Of one step on average; resets are not counted. Actions are padded with zeros to what the environment takes."""
    actions = np.pad(actions, ((0, 0), (0, env.action_space.shape[0] - actions.shape[1])))
    env.reset(seed=0)
    spent, began = 0.0, time.thread_time()
    for action in actions:
        _, _, ended, truncated, _ = env.step(action)
        if ended or truncated:
            spent += time.thread_time() - began
            env.reset(seed=0)
            began = time.thread_time()  # not between steps: a system call slows down what follows it
    return (spent + time.thread_time() - began) / len(actions)


def reset_seconds(env: Any) -> float:
    began = time.thread_time()
    env.reset(seed=0)
    return time.thread_time() - began


def added(bare: Any, wrapped: Any, time_of: Callable[[Any], float], turns: int) -> tuple[float, float]:
    """(us that the wrapper adds, us of the bare environment): medians over turns, the two one after the other."""
    pairs = []
    for turn in range(turns + 1):
        first, second = (bare, wrapped) if turn % 2 else (wrapped, bare)
        a, b = time_of(first), time_of(second)
        pairs.append((b, a) if first is bare else (a, b))
    return (
        1e6 * statistics.median(w - b for w, b in pairs[1:]),
        1e6 * statistics.median(b for _, b in pairs[1:]),
    )


def steps(table: Table, name: str, count: int, turns: int, folder: Path) -> None:
    kwargs = {"context": ["psi"]} if name.startswith("nfc_gym") else {}
    shape = gymnasium.make(name, **kwargs).action_space.shape
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (count, *shape))
    for label, (wrap, goal) in cases(name, folder).items():
        bare, wrapped = gymnasium.make(name, **kwargs), wrap(gymnasium.make(name, **kwargs))
        cost, alone = added(bare, wrapped, lambda env: seconds(env, actions), turns)
        table.add(f"{label}, on {name}", cost, "us/step", baseline=alone, at_most=goal)


def resets(table: Table, turns: int, count: int) -> None:
    name, kwargs = "nfc_gym/JackalRough-v0", {"terrain_pool": 1}
    bare = gymnasium.make(name, **kwargs)
    wrapped = ResidualTerrain(gymnasium.make(name, **kwargs), np.zeros((256, 256)))
    cost, alone = added(bare, wrapped, reset_seconds, 10 * turns)
    table.add(f"ResidualTerrain, a reset of {name}", cost, "us/reset", baseline=alone)
    actions = np.zeros((count, 2))
    cost, alone = added(bare, wrapped, lambda env: seconds(env, actions), turns)
    # Less than what two runs of the same environment differ by.
    table.add(f"ResidualTerrain, a step of {name}", cost, "us/step", baseline=alone, at_most=2.0)
    seen = PerceiveTerrain(gymnasium.make(name, **kwargs))
    cost, alone = added(bare, seen, lambda env: seconds(env, actions), turns)
    table.add(f"PerceiveTerrain (an image each 0.1 s), on {name}", cost, "us/step", baseline=alone)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two environments, fewer turns")
    rows = "rows {name, value, unit, baseline, goal, holds, seeds}"
    parser.add_argument("--json", type=json_file, metavar="FILE", help=rows)
    args = parser.parse_args()
    count, turns = (50, 2) if args.quick else (500, 15)
    names = ["Ant-v5", "nfc_gym/JackalFlat-v0"] + ([] if args.quick else ["nfc_gym/AntFlat-v0"])
    table = Table()
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            steps(table, name, count, turns, Path(folder))
        resets(table, turns, count)
    if args.json:
        write_json(args.json, [asdict(r) for r in table.rows])


if __name__ == "__main__":
    sys.exit(ended(main))
