"""Pretraining in the package's simulator under random psi and terrain, as `nfc-gym pretrain` does it for PPO."""

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.policy import check_suffix
from nfc_gym.adaptation.ppo import Diverged
from nfc_gym.adaptation.pretraining import SPREAD, recipe_of
from nfc_gym.adaptation.record import Record, in_words
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.worlds import training_env, vector_env
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable
from nfc_gym.inference.jobs import device_of
from nfc_gym.inference.random import mixed
from nfc_gym.simulate.machine import full_id

from .agent import Agent, load_agent
from .collecting import sizes_of
from .run import Run, Schedule
from .settings import discount, settings_of
from .speed import Speed
from .world_model import WorldModel

FIRST = 5  # episodes at random before anything is learned, as published
EACH = 100  # control steps that each simulation takes at random at least
ONWARD = 25  # control steps of each simulation before a model that was trained before learns on


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
      task: of the robots that have several; None is the environment's own.
    """

    seed: int = 0
    envs: int = 64
    first: int = 0
    ratio: float = 0.25
    net: str = "5M"
    spread: float = SPREAD
    episodes: int = 16
    task: str | None = None

    def __post_init__(self) -> None:
        if self.envs < 1 or self.ratio <= 0 or self.episodes < 1:
            raise InputError(
                f"envs {self.envs}, ratio {self.ratio:g}, episodes {self.episodes}: want one simulation or more, some "
                "updates a control step, and an episode or more"
            )

    @property
    def settings(self) -> dict[str, Any]:
        """Of the environment."""
        return {} if self.task is None else {"task": self.task}


def pretrain(
    environment: str, out: str | Path, arguments: Pretraining, *, steps: int, seconds: float | None = None,
    device: str = "auto", threads: int = 0, console: Console | None = None, start: str | Path | None = None,
    speed: Speed | None = None,
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
      start: file of a world model of the same robot whose weights the first ones are; one of flat ground will do for
        rough ground. Then nothing is done at random.
      speed: see `Speed`.

    Returns:
      The agent, its return in the nominal world in `about`.

    Raises:
      InputError: arguments that cannot be, or the state of another run beside `out`.
      Diverged: a loss was not finite; `out` then holds the last weights that were kept.
    """
    path, name = Path(out), full_id(environment)
    check_suffix(path)
    require_writable(path.absolute().parent)
    episode = recipe_of(name, task=arguments.task).episode
    envs = training_env(name, arguments.envs, threads=threads, seed=arguments.seed, spread=arguments.spread,
                        episode=episode, settings=arguments.settings)  # fmt: skip
    sizes = sizes_of(envs)
    torch.manual_seed(arguments.seed)
    model = WorldModel(sizes, settings_of(arguments.net, sizes.action, episodic=True)).to(device_of(device)).eval()
    at_random = max(1000, FIRST * episode, EACH * arguments.envs)
    first = arguments.first or (at_random if start is None else ONWARD * arguments.envs)
    schedule = Schedule(seed=arguments.seed, first=first, random=start is None, ratio=arguments.ratio)
    record = Record(path.with_name(path.name + ".log"), console)
    run = Run(envs, model, discount(episode), schedule, most=steps, record=record, speed=speed)
    # It is judged with another number of robots, once: to compile that too takes longer than it saves.
    agent = Agent(model, run.gamma, envs.sight, speed=replace(run.speed, compiled=False))
    state, diverged = path.with_name(path.name + ".training"), None
    if state.is_file():
        run.load(state)
        record.say(f"going on from step {run.steps:,} of {steps:,}")
    elif start is not None:
        begin_from(agent, start)
        record.say(f"begins with the weights of {start}")

    def about(judged: dict[str, Any] | None) -> dict[str, Any]:
        return {"pretraining": asdict(arguments), "steps": run.steps, "seconds": round(run.elapsed, 1),
                "updates": run.learner.updates, "episode": episode, "nominal": judged,
                "device": model.device.type}  # fmt: skip

    def keep() -> None:
        agent.about = about(None)
        agent.save(path)

    try:
        run.train(steps, seconds, state, kept=keep)
    except Diverged as e:
        diverged = str(e)
        if state.is_file():
            run.load(state)
    envs.close()
    keep()  # judging takes its time too
    judged = nominal(agent, name, arguments, threads)
    agent.about = about(judged) | ({"diverged": diverged} if diverged else {})
    agent.save(path)
    record.say(f"{path}: in the nominal world {in_words(judged)}; {run.elapsed:.0f} s of training")
    if diverged:
        raise Diverged(f"{name}: {diverged}. {path} holds the weights of step {run.steps:,}; try another --seed")
    return agent


def begin_from(agent: Agent, start: str | Path) -> None:
    """Take the weights of another world model; what it did not see of this environment has no weight at first.

    Raises:
      InputError: it is of another robot, of another size, or sees what comes first otherwise.
    """
    other, model = load_agent(start), agent.model
    a, b = other.sight, agent.sight
    same = a is not None and b is not None and (a.proprio, a.goal) == (b.proprio, b.goal)
    if not same or a is None or b is None or (a.cells not in (None, b.cells)) or a.size > b.size:
        raise InputError(f"{start} is of {'no environment' if a is None else a.says()}: no start for {b and b.says()}")
    tensors, wide = dict(other.model.state_dict()), model.encoder[0][0].weight
    key = "encoder.0.0.weight"
    tensors[key] = torch.cat([tensors[key], torch.zeros(len(wide), wide.shape[1] - tensors[key].shape[1])], 1)
    try:
        model.load_state_dict(tensors)
    except RuntimeError as e:
        raise InputError(f"{start} is another network ({' '.join(str(e).split())})") from None


def nominal(agent: Agent, name: str, arguments: Pretraining, threads: int) -> dict[str, Any]:
    """Whole episodes in the nominal world, without exploring, and how long they took [s]."""
    envs = VectorSight(vector_env(name, arguments.episodes, threads=threads, **arguments.settings))
    agent.begin(arguments.episodes)
    began = time.monotonic()
    score = evaluate(agent, envs, seed=mixed(arguments.seed, 64) % 2**31).summary()
    envs.close()
    return score | {"seconds": time.monotonic() - began}
