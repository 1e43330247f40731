"""What the legged stand-ins share: the loop that steps a machine on a floor, and the columns that it logs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array, Hidden
from nfc_gym.measured.standin import body_columns

STEP = 0.001  # s: a foot's touch-down is over in ten milliseconds
CONTROL = 0.01  # s between commands
SAMPLE = 0.005  # s between samples


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what a legged machine logs.

    Speeds come from differences of encoder counts. Sensors ten times as fine would not show more: a foot's touch-down
    in the model, at its own time step, differs from the machine's by some 0.2 rad/s in a knee's speed.

    Attributes:
      body: pos m, quat rad, linvel m/s, angvel rad/s, as `standin.body_columns` takes them.
      angle, speed: rad and rad/s of every joint.
    """

    body: Mapping[str, float]
    angle: float
    speed: float


NOISE = Noise({"pos": 0.001, "quat": 0.001, "linvel": 0.02, "angvel": 0.02}, 0.001, 0.1)


def walk(
    model: mujoco.MjModel,
    hidden: Hidden,
    command: Callable[[int, mujoco.MjData], Array],
    seconds: float,
    rest: float,
) -> tuple[Array, Array, Array]:
    """True states (T, nq), (T, nv) and commands (T, nu), from keyframe 0 on; `rest` s come first and are not logged.

    `command(k, data)` is asked every 10 ms; k is negative while the machine rests.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    hidden.begin(model)
    turns, before = round(seconds / CONTROL), round(rest / CONTROL)
    data.time = -before * CONTROL
    each, often = round(CONTROL / model.opt.timestep), round(SAMPLE / model.opt.timestep)
    rows: list[tuple[Array, Array, Array]] = []
    for k in range(-before, turns):
        u = command(k, data)
        for i in range(each):
            if k >= 0 and i % often == 0:
                rows.append((data.qpos.copy(), data.qvel.copy(), u))
            data.ctrl[:] = hidden.command(u)
            data.qfrc_applied[:], data.xfrc_applied[:] = 0, 0
            hidden.push(data)
            mujoco.mj_step(model, data)
    qpos, qvel, sent = (np.array(a) for a in zip(*rows, strict=True))
    return qpos, qvel, sent


def columns(
    model: mujoco.MjModel, joints: Sequence[str], qpos: Array, qvel: Array, sent: Array, rng: np.random.Generator
) -> dict[str, Array]:
    """Noisy columns (T,) each: time, `<joint>_command`, the base's, and `<joint>_angle`, `<joint>_speed`."""
    out = {"time": np.arange(len(qpos)) * SAMPLE}
    out |= {f"{j}_command": sent[:, model.actuator(j).id] for j in joints}
    out |= body_columns(qpos, qvel, NOISE.body, rng)
    for j in joints:
        joint = model.joint(j)
        out[f"{j}_angle"] = qpos[:, joint.qposadr[0]] + NOISE.angle * rng.normal(size=len(qpos))
        out[f"{j}_speed"] = qvel[:, joint.dofadr[0]] + NOISE.speed * rng.normal(size=len(qpos))
    return out


def grow(spec: mujoco.MjSpec, bodies: Sequence[str], factor: float) -> None:
    """Scale the mass of bodies and with it their inertia."""
    for name in bodies:
        body = spec.body(name)
        body.mass, body.inertia = body.mass * factor, np.asarray(body.inertia) * factor
