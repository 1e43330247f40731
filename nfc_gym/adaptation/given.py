"""What `adapt` is given, looked at before anything is done with it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

from nfc_gym.adaptation.agent import Agent
from nfc_gym.adaptation.sight import Sight
from nfc_gym.core.errors import InputError
from nfc_gym.simulate.machine import full_id


def check_fit(agent: Agent, world: Any) -> None:
    """Refuse an agent that cannot act in a world.

    Raises:
      InputError: it is no agent, the world is a vector environment or none of this package's, of another robot, or has
        another action; the agent's actor does not take what the world shows, or wants more; its actions are discrete.
    """
    if not isinstance(agent, Agent):
        raise InputError(
            f"adapt: want an Agent(actor, loss, sight), got {type(agent).__name__}; ppo_agent(policy) makes one"
        )
    if isinstance(world, VectorEnv) or not hasattr(world.unwrapped, "psi_space"):
        raise InputError("adapt: the world is one environment of this package, single, with wrappers around it")
    theirs, mine = Sight.of(world), agent.sight
    if (mine.proprio, mine.goal) != (theirs.proprio, theirs.goal):
        raise InputError(f"adapt: the agent is of another robot than {theirs.environment}: {mine.says()}")
    if mine.cells is not None and theirs.cells is None:
        raise InputError(f"adapt: the agent looks at elevation, and {theirs.environment} is flat ground")
    try:
        size = agent.action_size()
    except RuntimeError as e:
        raise InputError(f"adapt: the agent's actor does not take an observation of ({mine.size},): {e}") from e
    if world.action_space.shape != (size,):
        raise InputError(
            f"adapt: the agent's actions have {size} entries, those of {theirs.environment} {world.action_space.shape}"
        )


def simulator_of(world: Any, environment: str | None) -> str:
    """Full id of the simulator of a world."""
    spec = getattr(world, "spec", None)
    if environment is None and spec is None:
        raise InputError(
            "adapt: the world was not made by gymnasium.make and names no simulator: give its id, as in "
            "environment='nfc_gym/JackalFlat-v0'"
        )
    return full_id(environment or spec.id)  # type: ignore[union-attr]


def episode_of(world: Any, environment: str) -> int:
    """Control steps of a world's episode, or else of its simulator's."""
    specs = (getattr(world, "spec", None), gymnasium.spec(environment))
    return next((s.max_episode_steps for s in specs if s is not None and s.max_episode_steps), 1000)


def with_task(settings: Mapping[str, Any], world: Any) -> dict[str, Any]:
    """Settings of a simulator under which it asks for what a world does.

    Raises:
      InputError: they name another task.
    """
    task, first = world.unwrapped.robot.task, world.unwrapped.robot.tasks[0]
    given = settings.get("task", task) or first
    if given != task:
        raise InputError(f"adapt: settings has the task {given!r}, and the world's is {task!r}: leave it out")
    return {**settings} if task == first else {**settings, "task": task}


def run_folder(folder: Path) -> Path:
    """The folder of a run, with its place for curves, made where it is not there yet."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"adapt: {folder} is a file; `folder` is where trajectories and state are kept")
    try:
        (folder / "log").mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(f"adapt: folder {folder} cannot be written ({e.strerror or e}); choose another one") from None
    return folder
