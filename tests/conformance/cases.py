"""What the suite runs over: every registered id, every public wrapper, and what each wrapper is given.

Ids and wrappers are read from the package. A new wrapper is found by itself, and fails until it has a case here.
"""

import ctypes
import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import nfc_gym.wrappers
from nfc_gym.core import Fidelity, MissingExtra
from nfc_gym.core.posterior import register_loader

IDS = sorted(i for i in gym.registry if i.startswith("nfc_gym/"))
PUBLIC = {n: getattr(nfc_gym.wrappers, n) for n in nfc_gym.wrappers.__all__}
SINGLE = {n: c for n, c in PUBLIC.items() if issubclass(c, gym.Wrapper)}
VECTOR = {n: c for n, c in PUBLIC.items() if issubclass(c, gym.vector.VectorWrapper)}
SMALL: dict[str, Any] = {"terrain_pool": 2}

# The wrappers stand on the cheapest robot that has all they act on: psi, wheels, sensors, a map of rough ground.
BASE = "nfc_gym/JackalRough-v0"
ONE_MAP: dict[str, Any] = {"terrain_pool": 1}  # `VectorRecordLog` writes one model for all its logs
STATM = Path("/proc/self/statm")
NV, SHAPE = 10, (256, 256)


class Quiet:
    """A detector that scores how far the action is from 0, and never calls it an anomaly."""

    threshold = np.finfo(float).max

    def reset(self, rows: Any = None) -> None: ...

    def update(self, obs: Any, action: Any, next_obs: Any) -> Any:
        return np.abs(action).max(-1)


register_loader(".quiet", lambda path: Quiet())  # type: ignore[arg-type,return-value]


def write_sources(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    Fidelity(delta_s=np.zeros(NV)).save(folder / "still.npz")
    Fidelity(delta_s=0.05 * rng.standard_normal((20, NV))).save(folder / "moving.npz")
    Fidelity(delta_e=np.zeros(SHAPE)).save(folder / "level.npz")
    Fidelity(delta_e=np.stack([np.full(SHAPE, 0.1), np.full(SHAPE, 0.2)])).save(folder / "higher.npz")
    Fidelity(delta_s=np.zeros((2, NV))).save(folder / "certain.npz")
    (folder / "detector.quiet").touch()
    return folder


def _dry(level: float) -> list[dict[str, Any]]:
    return [
        {"family": "coulomb", "where": "rear_left_wheel", "parameters": {"level": level}},
        {"family": "delay", "where": "front_left", "parameters": {"delay": 0.01 * level}},
    ]


def _watching(sources: Path) -> dict[str, Any]:
    return {"detector": str(sources / "detector.quiet")}


def _recording(sources: Path) -> dict[str, Any]:
    return {"path": mkdtemp(dir=sources)}


Arguments = Callable[[Path], dict[str, Any]]
# Wrapper -> arguments under which nothing of the environment changes, and under which it acts.
CASES: dict[str, tuple[Arguments, Arguments]] = {
    "RandomizePsi": (lambda s: {"distribution": {}}, lambda s: {"distribution": 0.5}),
    "ResidualDynamics": (
        lambda s: {"source": str(s / "still.npz")},
        lambda s: {"source": str(s / "moving.npz"), "covariance": [1e-4] * NV},
    ),
    "ResidualTerrain": (lambda s: {"source": str(s / "level.npz")}, lambda s: {"source": str(s / "higher.npz")}),
    "Hallucinate": (lambda s: {"posterior": str(s / "certain.npz")}, lambda s: {"posterior": str(s / "moving.npz")}),
    "ApplyEffects": (lambda s: {"effects": _dry(0.0)}, lambda s: {"effects": _dry(2.0)}),
    "PerceiveTerrain": (lambda s: {}, lambda s: {}),
    "PerturbSignals": (
        lambda s: {"noise": {"proprio": {"sd": 0.0}, "action": {"bias": 0.0}}},
        lambda s: {"noise": {"proprio": {"sd": 0.01, "delay": 1}, "action": {"bias_sd": 0.1}}},
    ),
    "MonitorAnomaly": (_watching, _watching),
    "RecordLog": (_recording, _recording),
}
# What a wrapper makes itself: keys of the observation and of `info` that the bare environment lacks, or has otherwise.
MADE = {"PerceiveTerrain": {"elevation"}, "MonitorAnomaly": {"anomaly", "anomaly_score"}}


def kind(name: str) -> str:
    return name.removeprefix("Vector")


def wrapped(name: str, env: Any, sources: Path, null: bool = False) -> Any:
    """`env` in a wrapper, or a vector environment in its twin."""
    try:
        return PUBLIC[name](env, **CASES[kind(name)][0 if null else 1](sources))
    except MissingExtra as error:
        pytest.skip(str(error))


def made(name: str, **kwargs: Any) -> gym.Env:
    return gym.make(name, **(SMALL | kwargs))


def robot_of(name: str) -> str:
    return name.removeprefix("nfc_gym/").removesuffix("Flat-v0").removesuffix("Rough-v0")


def same(a: Any, b: Any, where: str = "") -> None:
    """Nested results, equal to the bit, with the same keys, shapes and types."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, list | tuple) or (isinstance(a, np.ndarray) and a.dtype == object):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{where}/{i}")
    elif a is None or b is None:
        assert a is b, where
    else:
        a, b = np.asarray(a), np.asarray(b)
        assert (a.shape, a.dtype) == (b.shape, b.dtype), where
        assert np.array_equal(a, b), where


def without(result: Any, keys: set[str]) -> Any:
    """A nested result less some keys, and less Gymnasium's masks of them."""
    if isinstance(result, dict):
        return {k: without(v, keys) for k, v in result.items() if k.removeprefix("_") not in keys}
    if isinstance(result, np.ndarray) and result.dtype == object:
        return [None if v is None else without(v, keys) for v in result]
    return type(result)(without(v, keys) for v in result) if isinstance(result, list | tuple) else result


def numbers(result: Any) -> Iterator[np.ndarray]:
    """Every array in a nested result."""
    if isinstance(result, dict):
        for value in result.values():
            yield from numbers(value)
    elif isinstance(result, list | tuple) or (isinstance(result, np.ndarray) and result.dtype == object):
        for value in result:
            yield from numbers(value)
    elif result is not None:
        yield np.asarray(result)


def actions(env: Any, seed: int, steps: int) -> np.ndarray:
    """(steps, *shape) random actions; what a wrapper has widened them by is drawn apart, and the rest is the same."""
    own, whole = env.unwrapped.action_space.shape, env.action_space.shape
    rng, more = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    wide = more.uniform(-1, 1, (steps, *whole))
    wide[..., : own[-1]] = rng.uniform(-1, 1, (steps, *own))
    return wide.astype(np.float32)


def play(env: gym.Env, seed: int, steps: int) -> list[Any]:
    """All that a reset and `steps` random steps return; an episode that ends is followed by another."""
    out: list[Any] = [env.reset(seed=seed)]
    for action in actions(env, seed, steps):
        out.append(env.step(action))
        if out[-1][2] or out[-1][3]:
            out.append(env.reset())
    return out


def play_many(envs: gym.vector.VectorEnv, seed: int, steps: int) -> list[Any]:
    """The same of a vector environment, in any mode of autoreset."""
    out: list[Any] = [envs.reset(seed=seed)]
    for action in actions(envs, seed, steps):
        out.append(envs.step(action))
        done = out[-1][2] | out[-1][3]
        if done.any() and envs.metadata["autoreset_mode"] is gym.vector.AutoresetMode.DISABLED:
            out.append(envs.reset(options={"reset_mask": done}))
    return out


def resident() -> int:
    """Bytes of memory that the process holds now; its peak would hide a leak beneath an earlier one."""
    if not STATM.exists():
        pytest.skip("the memory that a process holds is read from /proc/self/statm")
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc: what it keeps of freed memory is no leak
    if trim is not None:
        trim(0)
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def grown(act: Callable[[], Any], times: int) -> int:
    """Bytes that `times` calls leave behind, once a tenth as many have filled what is kept on purpose."""
    for _ in range(times // 10):
        act()
    before = resident()
    for _ in range(times):
        act()
    return resident() - before
