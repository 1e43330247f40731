"""What no log tells of where roll-outs start: joints without a channel, and loops that do not close."""

from collections.abc import Iterator

import mujoco
import numpy as np

from nfc_gym.core import InputError, Log
from nfc_gym.measured.findings import Finding, Suspicion
from nfc_gym.measured.mapping import Mapping
from nfc_gym.measured.states import estimate_states

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_PLACES = 12  # rows of a log at which loops are looked at
_CLOSED = 1e-3  # of the model's extent, by which a loop may be open whatever the noise
_SURE = 5.0  # standard deviations of its sensors by which it may be


def unmeasured(mapping: Mapping, model: mujoco.MjModel) -> Iterator[Finding]:
    """Joints whose motion no channel tells: every roll-out starts with them at their reference, at rest or settled.

    A spring may well hold them there, which is worth a note; no channel measures a ball joint, and where none measures
    any other there is nothing to predict.
    """
    held: list[str] = []
    loose: list[str] = []
    settled = mapping.segments.start == "settled"
    for j in range(model.njnt):
        kind, name = int(model.jnt_type[j]), model.joint(j).name or f"number {j}"
        body = model.body(int(model.jnt_bodyid[j])).name
        if kind == _BALL:
            message = f"{name!r} is a ball joint, which no channel measures: roll-outs would start with it at its "
            advice = "put three hinges in its place, or weld it if it does not move"
            yield Finding("error", "model", f"joint {message}reference", advice)
        elif kind == _FREE:
            if not any(c.startswith(f"body:{body}:") for c in mapping.channels):
                loose.append(f"the free joint of {body!r}")
            else:
                yield from _without_attitude(mapping, body)
        elif not {f"joint:{name}:pos", f"joint:{name}:vel"} & set(mapping.channels):
            (held if model.jnt_stiffness[j] > 0 else loose).append(repr(name))
    if len(held) + len(loose) == int((model.jnt_type != _BALL).sum()):
        message = "no channel measures a joint or a free body of the model: there is no motion to begin with"
        yield Finding("error", "channels", message, "log joint:<name>:pos, or body:<name>:pos and quat")
        return
    if loose:
        how = "with the speed that it settles at" if settled else "at rest"
        message = f"no channel measures {', '.join(loose)}: every roll-out starts with it at its reference, {how}"
        advice = "log it, take out of the model what does not move, or say `segments.start: settled` for wheels"
        yield Finding("note" if settled else "warning", "channels", message, "" if settled else advice)
    if held:
        message = f"no channel measures {', '.join(held)}, which a spring holds: every roll-out starts with it there"
        yield Finding("note", "channels", message)


def _without_attitude(mapping: Mapping, body: str) -> Iterator[Finding]:
    """A free body whose attitude no channel measures: its rates say how it turns, and not from where."""
    if f"body:{body}:quat" not in mapping.channels:
        message = f"no channel measures the attitude of {body!r}: it is taken to stay at its reference all along"
        yield Finding("warning", "channels", message, f"log body:{body}:quat, or gravity will pull the wrong way")


def open_loops(model: mujoco.MjModel, log: Log) -> Iterator[Suspicion]:
    """Equality constraints that measured states do not meet: roll-outs would start with a blow that closes them."""
    if not model.neq:
        return
    try:
        states = estimate_states(model, log)
    except InputError:  # told elsewhere
        return
    data = mujoco.MjData(model)
    rows = np.unique(np.linspace(0, len(log) - 1, _PLACES).astype(int))
    found: dict[int, list[tuple[float, float]]] = {}
    for row in rows:
        data.qpos[:] = states.qpos[row]
        mujoco.mj_fwdPosition(model, data)
        equal = np.flatnonzero(data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
        if not len(equal):
            return
        jacobian = np.zeros((data.nefc, model.nv))
        if mujoco.mj_isSparse(model):
            mujoco.mju_sparse2dense(jacobian, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
        else:
            jacobian[:] = data.efc_J.reshape(data.nefc, model.nv)
        noise = np.sqrt((jacobian[equal] ** 2) @ states.qpos_sd[row] ** 2)
        for number in np.unique(data.efc_id[equal]):
            mine = data.efc_id[equal] == number
            worst = int(np.abs(data.efc_pos[equal[mine]]).argmax())
            at = abs(float(data.efc_pos[equal[mine]][worst]))
            found.setdefault(int(number), []).append((at, float(noise[mine][worst])))
    for number, pairs in found.items():
        gap, noise = np.median(np.array(pairs), 0)
        if gap > _SURE * noise + _CLOSED * model.stat.extent:
            name = model.equality(number).name or f"number {number}"
            yield Suspicion(
                "warning", "model", f"loop {number}",
                f"equality {name!r} is off by {gap:.2g} (m or rad) in the measured states, which roll-outs start from",
                "measure every joint of the loop, with zeros that agree",
            )  # fmt: skip
