"""What a model leaves over at each sample of a log: the generalised force that its measured motion would still need."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.hidden import Array
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.rollout import Plant

_EACH = 1500  # samples of a log at most


@dataclass(frozen=True)
class Leftover:
    """(n, nq), (n, nv), (n, nv), (n, nu), (n, nu) states, accelerations, commands and their rates; force (n, nv).

    force = M (measured acceleration - the model's at the measured state), N or N m.
    """

    qpos: Array
    qvel: Array
    qacc: Array
    ctrl: Array
    rate: Array
    force: Array

    def __len__(self) -> int:
        return len(self.qpos)


def leftover(bench: Bench, logs: Sequence[Log], plant: Plant, x: Array) -> Leftover:
    """Of the model at x (size,), without effects, on some logs."""
    model = bench.spec.copy().compile()
    fields = ModelFields(model)
    plant.space.write(fields, x[: len(plant.space)])
    fields.commit()
    parts = [_of_log(bench, model, log) for log in logs]
    return Leftover(*(np.concatenate(a) for a in zip(*parts, strict=True)))


def _of_log(bench: Bench, model: mujoco.MjModel, log: Log) -> tuple[Array, ...]:
    states, data = bench.states[log.name], mujoco.MjData(model)
    sent = np.stack([log.controls[f"ctrl:{model.actuator(a).name}"] for a in range(model.nu)], 1)
    act, rate = activations(model, sent, log.interval), np.gradient(sent, log.interval, axis=0)
    rows = np.unique(np.linspace(3, len(log) - 4, min(len(log) - 6, _EACH)).astype(int))  # the ends are extrapolated
    force = np.zeros((len(rows), model.nv))
    for out, k in zip(force, rows, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = states.qpos[k], states.qvel[k], sent[k]
        if model.na:
            data.act[:] = act[k]
        mujoco.mj_forward(model, data)
        mujoco.mj_mulM(model, data, out, states.qacc[k] - data.qacc)
    return states.qpos[rows], states.qvel[rows], states.qacc[rows], sent[rows], rate[rows], force


def activations(model: mujoco.MjModel, sent: Array, interval: float) -> Array:
    """Activations (T, na) of actuators with a first-order filter, from the commands (T, nu) before."""
    act = np.zeros((len(sent), model.na))
    if not model.na:
        return act
    keep = np.exp(-interval / model.actuator_dynprm[:, 0])
    act[0] = sent[0]
    for k in range(1, len(sent)):
        act[k] = sent[k - 1] + keep * (act[k - 1] - sent[k - 1])
    return act
