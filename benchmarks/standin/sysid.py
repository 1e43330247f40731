"""The baseline `mujoco.sysid`: the same psi fitted to the same logs by MuJoCo's own toolbox, default residual."""

import contextlib
import io
import logging
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from mujoco import sysid

from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.hidden import Array
from nfc_gym.physics.parameters import Parameter

from .residual import activations

_WRITE: dict[str, Callable[[mujoco.MjSpec, str, float], None]] = {}


def _writes(
    name: str,
) -> Callable[[Callable[[mujoco.MjSpec, str, float], None]], Callable[[mujoco.MjSpec, str, float], None]]:
    def register(function: Callable[[mujoco.MjSpec, str, float], None]) -> Callable[[mujoco.MjSpec, str, float], None]:
        _WRITE[name] = function
        return function

    return register


@_writes("body_mass")
def _mass(spec: mujoco.MjSpec, name: str, value: float) -> None:
    body = spec.body(name)
    body.inertia = np.asarray(body.inertia) * value / body.mass
    body.mass = value


@_writes("servo_kv")
def _servo(spec: mujoco.MjSpec, name: str, value: float) -> None:
    actuator = spec.actuator(name)
    actuator.gainprm[0], actuator.biasprm[2] = value, -value


@_writes("servo_kp")
def _position_servo(spec: mujoco.MjSpec, name: str, value: float) -> None:
    actuator = spec.actuator(name)
    actuator.gainprm[0], actuator.biasprm[1] = value, -value


@_writes("geom_friction[0]")
def _friction(spec: mujoco.MjSpec, name: str, value: float) -> None:
    spec.geom(name).friction[0] = value


@_writes("dof_damping")
def _damping(spec: mujoco.MjSpec, name: str, value: float) -> None:
    spec.joint(name).damping[0] = value


@_writes("dof_armature")
def _armature(spec: mujoco.MjSpec, name: str, value: float) -> None:
    spec.joint(name).armature = value


@_writes("jnt_stiffness")
def _stiffness(spec: mujoco.MjSpec, name: str, value: float) -> None:
    spec.joint(name).stiffness[0] = value


def _parameter(p: Parameter, nominal: float) -> sysid.Parameter:
    def modify(spec: mujoco.MjSpec, param: sysid.Parameter) -> None:
        for name in p.of:
            _WRITE[p.field](spec, name, float(param.value[0]))

    return sysid.Parameter(p.name, nominal, p.low, p.high, frozen=False, modifier=modify)


def identify(bench: Bench, logs: Sequence[Log], iterations: int = 20) -> Array:
    """Psi (d,) fitted by `mujoco.sysid` to pieces as long as the loop's segments, each from its measured start."""
    logging.getLogger().setLevel(logging.ERROR)
    space = bench.plant.space
    spec = bench.spec.copy()
    for p, value in zip(space.parameters, space.nominal, strict=True):
        if p.anchored:
            for name in p.of:
                _WRITE[p.field](spec, name, float(value))
    starts, controls, measured = _pieces(bench, logs)
    sequences = sysid.ModelSequences(
        "machine",
        spec,
        [f"piece {i}" for i in range(len(starts))],
        starts,
        controls,
        measured,
        allow_missing_sensors=True,
    )
    wanted = sysid.ParameterDict(
        {
            p.name: _parameter(p, float(n))
            for p, n in zip(space.parameters, space.nominal, strict=True)
            if not p.anchored
        }
    )
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    with contextlib.redirect_stdout(io.StringIO()):  # the optimizer prints each iteration, whatever `verbose` says
        found, _ = sysid.optimize(wanted, residual, optimizer="mujoco", verbose=False, max_iters=iterations)
    values = {p.name: float(found[p.name].value[0]) for p in space.parameters if not p.anchored}
    return space.vector(values)


def _pieces(bench: Bench, logs: Sequence[Log]) -> tuple[list[Array], list[sysid.TimeSeries], list[sysid.TimeSeries]]:
    model = bench.plant.model
    joints = [c.split(":")[1:] for c in logs[0].channels if c.startswith("joint:")]
    body = model.body(int(model.jnt_bodyid[0])).name  # the free base's
    names = [f"{body}_qpos", f"{body}_qvel", *(f"{name}_q{what}" for name, what in joints)]
    starts, controls, measured = [], [], []
    for log in logs:
        states = bench.states[log.name]
        sent = np.stack([log.controls[f"ctrl:{model.actuator(a).name}"] for a in range(model.nu)], 1)
        channels = [f"body:{body}:{c}" for c in ("pos", "quat", "linvel", "angvel@body")] + [
            f"joint:{name}:{what}" for name, what in joints
        ]
        seen = np.concatenate([log.channels[c].values.reshape(len(log), -1) for c in channels], 1)
        act = activations(model, sent, log.interval)
        length = round(bench.dataset.mapping.segments.length / log.interval)
        for s in range(0, len(log) - length, length):
            part, clock = slice(s, s + length + 1), np.arange(length + 1) * log.interval
            starts.append(
                sysid.create_initial_state(model, states.qpos[s], states.qvel[s], act[s] if model.na else None)
            )
            controls.append(sysid.TimeSeries.from_control_names(clock, sent[part], model))
            measured.append(sysid.TimeSeries.from_names(clock, seen[part], model, names))
    return starts, controls, measured
