"""What the entries of `proprio` are, in the names of logs: how a residual of them reaches the physical state.

`joint:<name>:pos|vel` and `body:<name>:pos|quat|linvel|angvel.<axis>` (`@body` before the dot: in its own frame);
`obs` is what no part of the state stands behind alone (commands, last actions, forces, angles to a target).
"""

import mujoco

OBSERVED = "obs"


def observed(count: int) -> list[str]:
    """Entries that are no physical state."""
    return [OBSERVED] * count


def base(model: mujoco.MjModel, quantity: str, axes: str = "xyz") -> list[str]:
    """Components of the floating base's pose or velocity."""
    return [f"body:{model.body(1).name}:{quantity}.{axis}" for axis in axes]


def joints(model: mujoco.MjModel, quantity: str) -> list[str]:
    """A quantity of every joint behind the floating base's, in the model's order."""
    return [f"joint:{model.joint(j).name}:{quantity}" for j in range(1, model.njnt)]


def torso(model: mujoco.MjModel) -> list[str]:
    """The twelve numbers that Ant's and Humanoid's proprio begin with (`Runner.torso`)."""
    return [*base(model, "pos", "z"), *base(model, "linvel@body"), *base(model, "angvel@body"), *observed(5)]
