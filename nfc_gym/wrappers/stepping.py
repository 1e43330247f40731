"""Where physics steps of environments written by others can be met: in place of the method that makes them."""

from collections.abc import Iterable
from typing import Any


class Stepped:
    """Takes the place of a method of one environment, and is pickled as that method."""

    def __init__(self, owner: Any, name: str, simulation: Any) -> None:
        self.owner, self.name, self.simulation = owner, name, simulation
        self.original = getattr(owner, name)
        # A subclass may do more in its own version: that is then called once a physics step.
        self.plain = getattr(type(owner), name).__module__ == "gymnasium.envs.mujoco.mujoco_env"

    def __reduce__(self) -> tuple[Any, ...]:
        return getattr, (self.owner, self.name)

    def __call__(self, *args: Any) -> None:
        if self.name == "_mujoco_step":
            self.simulation.run_robot(self.original, args[0], int(self.owner.n_substeps))
        else:
            self.simulation.run(self.original, self.plain, *args)


def stepper_of(env: Any) -> tuple[Any, str] | None:
    """Who steps the model of an environment, and through what; None where nothing is known to."""
    if hasattr(env, "substep_hooks"):
        return env, "substep_hooks"
    held: Iterable[Any] = (env, *vars(env).values())
    for thing in held:
        if getattr(thing, "data", None) is not env.data:
            continue
        for name in ("_step_mujoco_simulation", "_mujoco_step"):
            if callable(getattr(thing, name, None)):
                return thing, name
    return None
