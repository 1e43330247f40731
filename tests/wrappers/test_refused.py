"""A reset that is refused, by whomever, leaves the running episode of a wrapped environment as it is."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fakes import CUBE, FakeEnv, same

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.core import Fidelity, InputError
from nfc_gym.measured.readers import read_table
from nfc_gym.wrappers import (
    ApplyEffects,
    Hallucinate,
    PerceiveTerrain,
    PerturbSignals,
    RandomizePsi,
    RecordLog,
    ResidualDynamics,
    ResidualTerrain,
)

DELAY = {"family": "delay", "where": "front_left", "parameters": {"delay": 0.017}}
NOISE = {"proprio": {"sd": 0.1, "bias_sd": 0.1, "delay": 2}, "action": {"delay": 1}}
RISES = 0.01 * np.random.default_rng(0).standard_normal((8, 256, 256))


def _own() -> gym.Env:
    return gym.make("nfc_gym/JackalRough-v0", terrain_pool=2, context=["psi"])


def _residual(env: Any) -> Any:
    bias = 0.01 * np.random.default_rng(0).standard_normal((9, env.unwrapped.model.nv))
    return ResidualDynamics(env, bias, covariance=np.full(env.unwrapped.model.nv, 1e-5))


def _imagined() -> Any:
    env, rng = _own(), np.random.default_rng(0)
    space = env.unwrapped.psi_space
    psi = space.nominal * (1 + 0.02 * rng.standard_normal((8, len(space))))
    posterior = Fidelity(psi=psi, delta_s=0.01 * rng.standard_normal((8, 10)), delta_e=RISES)
    return Hallucinate(PerturbSignals(env, NOISE), posterior, modes=1, samples=8)


OWN: dict[str, Callable[[], Any]] = {
    "psi": lambda: RandomizePsi(_own(), 0.5),
    "dynamics": lambda: _residual(_own()),
    "terrain": lambda: ResidualTerrain(_own(), RISES),
    "signals": lambda: PerturbSignals(_own(), NOISE),
    "camera": lambda: PerceiveTerrain(_own()),
    "effects": lambda: ApplyEffects(_own(), [DELAY]),
    "hallucinated": _imagined,
    "all": lambda: PerturbSignals(
        PerceiveTerrain(ApplyEffects(_residual(ResidualTerrain(RandomizePsi(_own(), 0.5), RISES)), [DELAY])), NOISE
    ),
}
READ = ("psi", "delta_s", "delta_e")


def _told(env: Any) -> list[Any]:
    """What the wrappers of a stack say of the episode."""
    out = []
    while env is not env.unwrapped:
        out += [getattr(env, name) for name in READ if name in vars(type(env))]
        out += [vars(env.fidelity)] if isinstance(env, Hallucinate) else []
        env = env.env
    return out


@pytest.mark.parametrize("stack", OWN)
@pytest.mark.parametrize(
    "bad",
    [
        {"options": {"nope": 1}},
        {"options": {"psi": {"base_mass": -1.0}}, "seed": 5},
        {"options": {"terrain_residual": np.full((256, 256), 50.0)}, "seed": 5},
        {"seed": -1},
    ],
    ids=["option", "psi", "ground", "seed"],
)
def test_an_own_environment_goes_on(stack: str, bad: dict[str, Any]) -> None:
    shown = []
    for refused in (False, True):
        env = OWN[stack]()
        rng, size = np.random.default_rng(0), env.action_space.shape
        env.reset(seed=0)
        out: list[Any] = [env.step(rng.uniform(-1, 1, size)) for _ in range(3)]
        if refused:
            with pytest.raises((InputError, gym.error.Error)):
                env.reset(**bad)
        out += [_told(env), env.step(rng.uniform(-1, 1, size))]
        out += [env.reset(), _told(env), env.step(rng.uniform(-1, 1, size))]
        shown.append(out)
    same(shown[1], shown[0])


RAMP = CUBE.replace(
    '<geom name="floor" type="plane" size="5 5 .1"/>', '<geom name="floor" type="hfield" hfield="ramp" pos="0 0 -.2"/>'
).replace("<worldbody>", '<asset><hfield name="ramp" nrow="5" ncol="5" size="1 1 .4 .1"/></asset><worldbody>')
MASSES = {"cube": (0.5, 2.0)}
DRY = {"family": "coulomb", "where": "hinge", "parameters": {"level": 0.2}}
LATE = {"family": "delay", "where": "twist", "parameters": {"delay": 0.03}}
FOREIGN: dict[str, Callable[[Any], Any]] = {
    "psi": lambda e: RandomizePsi(e, MASSES),
    "dynamics": _residual,
    "effects": lambda e: ApplyEffects(e, [DRY, LATE]),
    "psi around effects": lambda e: RandomizePsi(ApplyEffects(e, [DRY, LATE]), MASSES),
    "effects around psi": lambda e: ApplyEffects(_residual(RandomizePsi(e, MASSES)), [DRY, LATE]),
    "terrain": lambda e: ResidualTerrain(e, 0.1 * np.random.default_rng(0).uniform(size=(4, 5, 5))),
    "hallucinated": lambda e: Hallucinate(e, np.array([[1.0], [1.1], [0.9]]), space=["cube"], samples=3),
}
FIELDS = ("body_mass", "dof_frictionloss", "hfield_data", "hfield_size", "geom_pos")


@pytest.mark.parametrize("stack", FOREIGN)
def test_an_environment_of_others_goes_on(stack: str) -> None:
    shown = []
    for refused in (False, True):
        env = FOREIGN[stack](FakeEnv(RAMP))
        size = env.action_space.shape
        env.reset(seed=0)
        out: list[Any] = [env.step(np.full(size, (k + 1) / 3))[0] for k in range(3)]
        if refused:
            with pytest.raises(gym.error.Error):
                env.reset(seed=-1)
        out += [_told(env), env.unwrapped.init_qpos, [getattr(env.unwrapped.model, name).copy() for name in FIELDS]]
        out += [env.step(np.full(size, 0.7))[0], env.reset()[0], _told(env), env.step(np.full(size, 0.2))[0]]
        shown.append(out)
    same(shown[1], shown[0])


def test_a_recorder_goes_on(tmp_path: Path) -> None:
    env = RecordLog(FakeEnv(), tmp_path)
    env.reset(seed=0)
    env.step(np.zeros(1))
    for _ in range(2):
        with pytest.raises(gym.error.Error):
            env.reset(seed=-1)
        env.step(np.zeros(1))
    env.close()
    assert [p.name for p in tmp_path.glob("*.parquet")] == ["episode_0000.parquet"]
    assert len(read_table(tmp_path / "episode_0000.parquet")["time"]) == 3
