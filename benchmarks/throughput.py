"""Steps per second of the environments and of their peers: the same work side by side, in turns, in one run.

    python benchmarks/throughput.py [--quick] [--only vector elevation async ant single torchrl memory] [--json FILE]
                                    [--clock wall|cpu]

Contestants of one row take turns; what is reported are medians over the turns. `--quick` ends within a minute on two
cores and has fewer robots, sizes and turns. `--clock cpu` counts processor time, that of worker processes included, in
place of the time that passes: for machines that are busy with other things, where every contestant waits at random
(steps/s are then those of one core). Ant-v5 is Gymnasium's own task, driven by this package's engine
(`peers/ant_v5.py`; its equality with Gymnasium's is checked before it is timed).
"""

import argparse
import importlib.util
import multiprocessing
import os
import sys
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the policies' libraries: the cores are the simulations'

import gymnasium
import mujoco
import numpy as np
from mujoco.batch import Batch
from options import ended, json_file, write_json
from peers.ant_v5 import AntV5, AntV5ContactVectorEnv
from timing import SEED, Table, race, use_clock

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.envs.vector import RobotVectorEnv
from nfc_gym.physics.fields import ModelFields

CORES = os.cpu_count() or 1


def randomised(space, n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, d) psi in the middle half of the prior."""
    return 0.5 * space.sample(rng, n) + 0.25 * (space.low + space.high)


def raw_batch(env: RobotVectorEnv, psi: np.ndarray) -> Batch:
    """A batch of the environment's model, psi and terrain, and nothing else."""
    batch = Batch(env.model, env.num_envs)
    fields = ModelFields(batch)
    env.psi_space.write(fields, psi)
    fields.commit()
    if env.rough:
        batch.expand("geom_dataid")[...] = env.batch.expand("geom_dataid")
    return batch


def vector(table: Table, ids: list[str], sizes: list[int], turns: int) -> None:
    """Our vector environment over `mujoco.batch` alone; psi (and on rough ground the terrain) per simulation."""
    for name in ids:
        for n in sizes:
            envs = gymnasium.make_vec(f"nfc_gym/{name}-v0", num_envs=n, context=["psi"])
            env, rng = envs.unwrapped, np.random.default_rng(SEED)
            psi = randomised(env.psi_space, n, rng)
            envs.reset(seed=SEED, options={"psi": psi})
            raw, nominal = raw_batch(env, psi), Batch(env.model, n)
            chunk = max(2, 256 // n)
            actions = rng.uniform(-1, 1, (chunk, *envs.action_space.shape))

            def ours(envs=envs, actions=actions) -> None:
                for action in actions:
                    envs.step(action)

            def bare(batch: Batch, env=env, actions=actions) -> None:
                for action in actions:
                    batch.ctrl[...] = env.robot.actuate(action, env._view)
                    batch.step(nstep=env.frame_skip)

            def same_state(env=env, raw=raw, nominal=nominal) -> None:
                raw.state[...] = nominal.state[...] = env.batch.state

            contestants = {"ours": ours, "raw": partial(bare, raw), "nominal": partial(bare, nominal)}
            took = race(contestants, turns, same_state)
            work, goal = n * chunk, 0.90 if env.rough else 0.95
            table.add(f"{name} n={n}: vector environment", work / took["ours"], "steps/s", baseline=work / took["raw"])
            table.add(
                f"{name} n={n}: over raw Batch, psi{' and terrain' if env.rough else ''} per simulation in both",
                took["raw"] / took["ours"], "ratio", at_least=goal if n >= 1024 else None,
            )  # fmt: skip
            table.add(f"{name} n={n}: over raw Batch of one model for all", took["nominal"] / took["ours"], "ratio")
            envs.close()


def elevation(table: Table, batch: int, turns: int) -> None:
    """What the 128 x 128 map costs: a step with it minus a step without, the same states and terrain."""
    for n, limit in ((1, 80.0), (batch, 120.0)):
        single = n == 1
        made = {}
        for key, kwargs in {"without": {"context": ["psi"]}, "full": {}, "10 Hz": {"elevation_hz": 10}}.items():
            if single:
                made[key] = gymnasium.make("nfc_gym/JackalRough-v0", **kwargs)
            else:
                made[key] = gymnasium.make_vec("nfc_gym/JackalRough-v0", num_envs=n, **kwargs)
            made[key].reset(seed=SEED)
            # The map alone is timed: the physics, which varies by more than the map costs, is left out.
            made[key].unwrapped._run = made[key].unwrapped._advance = lambda *args: None
        action = np.zeros(made["full"].action_space.shape)
        steps = 200 if single else 5

        def play(env, action=action, steps=steps) -> None:
            for _ in range(steps):
                env.step(action)

        took = race({key: (lambda env=env: play(env)) for key, env in made.items()}, turns)
        where = "single environment" if single else f"vector environment n={n}, per environment"
        for key, most in (("full", limit), ("10 Hz", limit / 5)):
            cost = (took[key] - took["without"]) / steps / n * 1e6
            table.add(f"elevation map, {key}: {where}", cost, "us", at_most=most)


def asynchronous(table: Table, n: int, turns: int) -> None:
    """Our vector environment against Gymnasium's vectorisations of our single environment."""
    for name in ("JackalFlat",):
        make = {mode: {"vectorization_mode": mode} for mode in ("sync", "async")} | {"ours": {}}
        envs = {k: gymnasium.make_vec(f"nfc_gym/{name}-v0", num_envs=n, context=["psi"], **v) for k, v in make.items()}
        rng = np.random.default_rng(SEED)
        for env in envs.values():
            env.reset(seed=SEED)
        actions = rng.uniform(-1, 1, (10, *envs["ours"].action_space.shape)).astype(np.float32)

        def play(env, actions=actions) -> None:
            for action in actions:
                env.step(action)

        took = race({k: (lambda env=env: play(env)) for k, env in envs.items()}, turns)
        work = n * len(actions)
        for mode, least in (("async", 3.5), ("sync", None)):
            speed = work / took[mode]
            table.add(f"{name} n={n}: over vectorization_mode={mode!r}", took[mode] / took["ours"], "ratio",
                      baseline=speed, at_least=least)  # fmt: skip
        for env in envs.values():
            env.close()


def ant(table: Table, sizes: list[int], turns: int) -> None:
    """Ant-v5: our engine, EnvPool and Gymnasium on the same MJCF, frame skip, observation and reward."""
    if importlib.util.find_spec("imageio") is None:
        print("Ant-v5: Gymnasium's needs gymnasium[mujoco], its rows are left out")
        return
    table.add(
        "Ant-v5: largest difference to Gymnasium's, contact forces included", ant_difference(), "abs", at_most=1e-9
    )
    try:
        import envpool
    except ImportError:
        envpool = None
        print("Ant-v5: EnvPool is not installed, its rows are left out")
    for contact in (True, False):
        for n in sizes:
            options = {"max_episode_steps": 1000, "num_envs": n}
            ours = AntV5ContactVectorEnv(**options) if contact else RobotVectorEnv(AntV5, context=(), **options)
            envs = {"ours": ours}
            if envpool is not None:
                without = (
                    {}
                    if contact
                    else {"use_contact_force": False, "post_constraint": False, "contact_cost_weight": 0.0}
                )
                envs["EnvPool"] = envpool.make_gymnasium("Ant-v5", num_envs=n, num_threads=CORES, seed=SEED, **without)
            if n <= 16:
                kwargs = {} if contact else {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}
                envs["Gymnasium sync"] = gymnasium.make_vec("Ant-v5", num_envs=n, vectorization_mode="sync", **kwargs)
            rng = np.random.default_rng(SEED)
            chunk = max(2, 256 // n)
            actions = rng.uniform(-1, 1, (chunk, n, 8))
            for env in envs.values():
                env.reset()
                for action in actions[:2]:
                    env.step(action)

            def play(env, actions=actions) -> None:
                for action in actions:
                    env.step(action)

            took = race({k: (lambda env=env: play(env)) for k, env in envs.items()}, turns)
            work, forces = n * chunk, "with" if contact else "without"
            table.add(f"Ant-v5 {forces} contact forces, n={n}: ours", work / took["ours"], "steps/s")
            for peer in took.keys() - {"ours"}:
                least = None if peer != "EnvPool" else 1.05 if n >= 1024 else 1.3 if n == 16 else None
                name = f"Ant-v5 {forces} contact forces, n={n}: ours over {peer}"
                table.add(name, took[peer] / took["ours"], "ratio",
                          baseline=work / took[peer], at_least=least)  # fmt: skip
            for env in envs.values():
                env.close()


def ant_difference(n: int = 4, steps: int = 100) -> float:
    """Largest difference of observation or reward to Gymnasium's Ant-v5 from the same states under the same actions."""
    envs = AntV5ContactVectorEnv(num_envs=n, autoreset_mode="Disabled")
    peers = [gymnasium.make("Ant-v5").unwrapped for _ in range(n)]
    rng, worst = np.random.default_rng(SEED), 0.0
    ended = np.ones(n, bool)
    envs.reset(seed=SEED)
    for _ in range(steps):
        for i in np.flatnonzero(ended):
            peers[i].reset()
            mujoco.mj_resetData(peers[i].model, peers[i].data)
            peers[i].set_state(envs.batch.qpos[i], envs.batch.qvel[i])
        actions = rng.uniform(-1, 1, (n, 8))
        obs, reward, ended, _, _ = envs.step(actions)
        for i, peer in enumerate(peers):
            theirs = peer.step(actions[i])
            worst = max(
                worst, np.abs(theirs[0] - obs[i]).max(), abs(theirs[1] - reward[i]), float(theirs[2] != ended[i])
            )
        if ended.any():
            envs.reset(options={"reset_mask": ended})
    return worst


def single(table: Table, ids: list[str], turns: int) -> None:
    """A single environment's step over the bare physics of the same model, from the same states."""
    for name in ids:
        ours = not name.startswith("Ant-v5")
        if not ours and importlib.util.find_spec("imageio") is None:
            continue
        env = gymnasium.make(f"nfc_gym/{name}-v0", context=["psi"]) if ours else gymnasium.make(name)
        env.reset(seed=SEED)
        model, data = env.unwrapped.model, env.unwrapped.data
        skip = env.unwrapped.frame_skip
        actions = np.random.default_rng(SEED).uniform(-1, 1, (100, *env.action_space.shape)).astype(np.float32)
        spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
        start = np.empty(mujoco.mj_stateSize(model, spec))
        mujoco.mj_getState(model, data, start, spec)

        def play(env=env, actions=actions) -> None:
            for action in actions:
                env.step(action)

        controls = []
        for action in actions:
            env.step(action)
            controls.append(data.ctrl.copy())

        def bare(model=model, data=data, controls=controls, skip=skip) -> None:
            for ctrl in controls:
                data.ctrl[:] = ctrl
                mujoco.mj_step(model, data, nstep=skip)

        def back(model=model, data=data, start=start, spec=spec, env=env) -> None:
            env.reset(seed=SEED)
            mujoco.mj_setState(model, data, start, spec)
            mujoco.mj_forward(model, data)

        took = race({"step": play, "bare": bare}, 2 * turns, back)
        cost = (took["step"] - took["bare"]) / len(actions) * 1e6
        table.add(f"{name}: single environment's step over the bare physics", cost, "us",
                  baseline=took["bare"] / len(actions) * 1e6, at_most=25.0 if ours else None)  # fmt: skip
        env.close()


def torchrl(table: Table, n: int, turns: int) -> None:
    """TorchRL's GymEnv around the single environment, and its GymWrapper around the vector one."""
    try:
        import torch
        from torchrl.envs import GymEnv, GymWrapper
    except ImportError:
        print("TorchRL is not installed, its rows are left out")
        return
    torch.set_num_threads(1)
    name, steps = "nfc_gym/JackalFlat-v0", 20
    plain = gymnasium.make(name, context=["psi"])
    plain.reset(seed=SEED)
    envs = gymnasium.make_vec(name, num_envs=n, context=["psi"], autoreset_mode="Disabled")
    one, many = GymEnv(f"nfc_gym:{name}", context=["psi"]), GymWrapper(envs)

    def loop() -> None:
        plain.reset()
        for _ in range(steps):
            plain.step(plain.action_space.sample())

    took = race(
        {
            "plain": loop,
            "GymEnv": lambda: one.rollout(steps),
            "vector": lambda: many.rollout(steps, break_when_any_done=False),
        },
        turns,
    )
    table.add("TorchRL GymEnv, single", steps / took["GymEnv"], "steps/s", baseline=steps / took["plain"])
    table.add(f"TorchRL GymWrapper, vector n={n}", n * steps / took["vector"], "steps/s")


def _resident(kwargs: dict, out) -> None:
    """Resident memory that a vector environment adds, MiB, its worker processes included."""
    pages = os.sysconf("SC_PAGE_SIZE") / 2**20

    def held(pid: int) -> float:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * pages

    before = held(os.getpid())
    envs = gymnasium.make_vec(**kwargs)
    envs.reset(seed=SEED)
    envs.step(np.zeros(envs.action_space.shape, np.float32))
    workers = [p.pid for p in multiprocessing.active_children()]
    out.put(held(os.getpid()) - before + sum(map(held, workers)))
    envs.close()


def memory(table: Table, sizes: list[int], workers: int) -> None:
    """Resident memory per environment, with so many workers beside; each measured in a process of its own."""
    if not Path("/proc/self/statm").exists():
        print("memory: not measured, there is no /proc here")
        return
    context = multiprocessing.get_context("spawn")
    cases = [({"num_envs": n}, name) for name in ("JackalFlat", "JackalRough") for n in sizes]
    cases.append(({"num_envs": workers, "vectorization_mode": "async"}, "JackalFlat"))
    for kwargs, name in cases:
        out = context.Queue()
        call = {"id": f"nfc_gym:nfc_gym/{name}-v0", "context": ["psi"], **kwargs}
        process = context.Process(target=_resident, args=(call, out))
        process.start()
        total = out.get()
        process.join()
        mode = kwargs.get("vectorization_mode", "vector environment")
        table.add(
            f"{name} n={kwargs['num_envs']}: memory, {mode}", total / kwargs["num_envs"], "MiB/env", baseline=total
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sections = ("vector", "elevation", "async", "ant", "single", "torchrl", "memory")
    parser.add_argument("--only", nargs="+", choices=sections, default=sections)
    parser.add_argument("--quick", action="store_true", help="fewer robots, sizes and turns: a minute on two cores")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall")
    parser.add_argument("--json", type=json_file, help="write the rows here")
    args = parser.parse_args()
    quick = args.quick
    use_clock(args.clock)
    turns = 2 if quick else 25
    robots = ["Jackal"] if quick else ["Jackal", "Quadcopter", "Quadruped", "Ant", "Humanoid"]
    grounds = [f"{robot}{ground}" for robot in robots for ground in ("Flat", "Rough")]
    sizes = [16] if quick else [1, 16, 256, 1024]
    versions = ", ".join(f"{m.__name__} {m.__version__}" for m in (mujoco, gymnasium, np))
    print(f"{versions}; {CORES} cores, {args.clock} time")
    table = Table()
    runs: dict[str, Callable[[], None]] = {
        "vector": lambda: vector(table, grounds, sizes, turns),
        "elevation": lambda: elevation(table, 16 if quick else 1024, turns),
        "async": lambda: asynchronous(table, 2 if quick else 64, turns),
        "ant": lambda: ant(table, [16] if quick else [16, 256, 1024], turns),
        "single": lambda: single(table, [f"{robot}Flat" for robot in robots] + ["Ant-v5"], turns),
        "torchrl": lambda: torchrl(table, 32 if quick else 256, turns),
        "memory": lambda: memory(table, [256 if quick else 1024], 2 if quick else 16),
    }
    for section in args.only:
        runs[section]()
    short = [r for r in table.rows if r.holds is False]
    print(f"{len(table.rows)} figures; {len(short)} fall short of their goal" + "".join(f"\n  {r.name}" for r in short))
    if args.json:
        write_json(args.json, [asdict(r) for r in table.rows])


if __name__ == "__main__":
    sys.exit(ended(main))
