"""Where the physics steps of environments written by others can be met: in place of the method that makes them."""

from collections.abc import Iterable
from typing import Any

_METHOD = "_step_mujoco_simulation"  # of gymnasium's MujocoEnv: (command, physics steps)


class Stepped:
    """Takes the place of that method of one environment, and is pickled as that method."""

    def __init__(self, owner: Any, name: str, simulation: Any) -> None:
        self.owner, self.name, self.simulation = owner, name, simulation
        self.original = getattr(owner, name)
        # A subclass may do more in its own version: that is then called once a physics step.
        self.plain = getattr(self.original, "__module__", "") == "gymnasium.envs.mujoco.mujoco_env"

    def __reduce__(self) -> tuple[Any, ...]:
        return getattr, (self.owner, self.name)

    def __call__(self, ctrl: Any, n_frames: int) -> None:
        """A control step, with the simulation's hooks in it."""
        self.simulation.run(self.original, self.plain, ctrl, n_frames)


def stepper_of(env: Any) -> tuple[Any, str] | None:
    """Who steps the model of an environment, and through what; None where nothing is known to."""
    if hasattr(env, "substep_hooks"):
        return env, "substep_hooks"
    held: Iterable[Any] = (env, *vars(env).values())
    for thing in held:
        if getattr(thing, "data", None) is env.data and callable(getattr(thing, _METHOD, None)):
            return thing, _METHOD
    return None
