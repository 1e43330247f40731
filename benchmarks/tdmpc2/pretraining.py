"""Pretraining in the package's simulator under random psi and terrain, as `nfc-gym pretrain` does it for PPO."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.policy import check_suffix
from nfc_gym.adaptation.ppo import Diverged
from nfc_gym.adaptation.pretraining import RECIPES, SPREAD
from nfc_gym.adaptation.record import Record, in_words
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.worlds import training_env, vector_env
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable
from nfc_gym.inference.jobs import device_of
from nfc_gym.inference.random import mixed
from nfc_gym.simulate.machine import full_id

from .agent import Agent
from .collecting import sizes_of
from .run import Run, Schedule
from .settings import discount, settings_of
from .world_model import WorldModel

FIRST = 5  # episodes at random before anything is learned, as published
EACH = 100  # control steps that each simulation takes at random at least


@dataclass(frozen=True, kw_only=True)
class Pretraining:
    """Arguments of a run.

    Attributes:
      seed: of weights, actions, psi and terrain.
      envs: simulations; all of them are planned for at once.
      first: control steps at random before anything is learned; 0 is five episodes, at least 100 of each simulation.
      ratio: updates a control step; the published one is 1.
      net: of `settings.NETS`.
      spread: share of the prior, around nominal, that psi is uniform over.
      episodes: that judge the result.
    """

    seed: int = 0
    envs: int = 64
    first: int = 0
    ratio: float = 0.25
    net: str = "5M"
    spread: float = SPREAD
    episodes: int = 16

    def __post_init__(self) -> None:
        if self.envs < 1 or self.ratio <= 0 or self.episodes < 1:
            raise InputError(
                f"envs {self.envs}, ratio {self.ratio:g}, episodes {self.episodes}: want one simulation or more, some "
                "updates a control step, and an episode or more"
            )


def pretrain(
    environment: str, out: str | Path, arguments: Pretraining, *, steps: int, seconds: float | None = None,
    device: str = "auto", threads: int = 0, console: Console | None = None,
) -> Agent:  # fmt: skip
    """Train a world model, and write it; the same call goes on with what was interrupted.

    Args:
      environment: id, `nfc_gym/AntFlat-v0` or `AntFlat`.
      out: file that ends in `.safetensors`. Beside it the state of the run, `.training`, and its curves, `.log`.
      arguments: see `Pretraining`.
      steps: control steps of all simulations together.
      seconds: stop after so long; None is without limit.
      device: of the networks; the simulations run on the processor.
      threads: of the physics; 0 takes every core.
      console: is told.

    Returns:
      The agent, its return in the nominal world in `about`.

    Raises:
      InputError: arguments that cannot be, or the state of another run beside `out`.
      Diverged: a loss was not finite; `out` then holds the last weights that were kept.
    """
    path, name = Path(out), full_id(environment)
    check_suffix(path)
    require_writable(path.absolute().parent)
    episode = RECIPES[robot_of(name)].episode
    envs = training_env(name, arguments.envs, threads=threads, seed=arguments.seed, spread=arguments.spread,
                        episode=episode, settings={})  # fmt: skip
    sizes = sizes_of(envs)
    torch.manual_seed(arguments.seed)
    model = WorldModel(sizes, settings_of(arguments.net, sizes.action, episodic=True)).to(device_of(device)).eval()
    first = arguments.first or max(1000, FIRST * episode, EACH * arguments.envs)
    schedule = Schedule(seed=arguments.seed, first=first, ratio=arguments.ratio)
    record = Record(path.with_name(path.name + ".log"), console)
    run = Run(envs, model, discount(episode), schedule, most=steps, record=record)
    agent = Agent(model, run.gamma, envs.sight)
    state, diverged = path.with_name(path.name + ".training"), None
    if state.is_file():
        run.load(state)
        record.say(f"going on from step {run.steps:,} of {steps:,}")
    try:
        run.train(steps, seconds, state)
    except Diverged as e:
        diverged = str(e)
        if state.is_file():
            run.load(state)
    envs.close()
    judged = nominal(agent, name, arguments, threads)
    agent.about = {"pretraining": asdict(arguments), "steps": run.steps, "seconds": round(run.elapsed, 1),
                   "updates": run.learner.updates, "episode": episode, "nominal": judged,
                   "device": model.device.type} | ({"diverged": diverged} if diverged else {})  # fmt: skip
    agent.save(path)
    record.say(f"{path}: in the nominal world {in_words(judged)}; {run.elapsed:.0f} s of training")
    if diverged:
        raise Diverged(f"{name}: {diverged}. {path} holds the weights of step {run.steps:,}; try another --seed")
    return agent


def nominal(agent: Agent, name: str, arguments: Pretraining, threads: int) -> dict[str, Any]:
    """Whole episodes in the nominal world, without exploring, and how long they took [s]."""
    envs = VectorSight(vector_env(name, arguments.episodes, threads=threads))
    agent.begin(arguments.episodes)
    began = time.monotonic()
    score = evaluate(agent, envs, seed=mixed(arguments.seed, 64) % 2**31).summary()
    envs.close()
    return score | {"seconds": time.monotonic() - began}


def robot_of(name: str) -> str:
    """`nfc_gym/AntFlat-v0` -> `ant`."""
    return name.removeprefix("nfc_gym/").removesuffix("-v0").removesuffix("Flat").removesuffix("Rough").lower()
