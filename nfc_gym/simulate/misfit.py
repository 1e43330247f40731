"""What a window shows beside what the model predicts for it: the inputs of a structure head.

An effect changes the motion of half a second by little, and psi by much. Shown the motion alone, a network cannot tell
a payload from a heavier robot. It is therefore shown the motion and its misfit: what was observed less what the model,
calibrated and without any effect, predicts from where the window begins under the same commands. Both are seen from
where the window began, facing as the robot then faced; the misfit is in standard deviations of the sensors and passes
through asinh, since effects of all sizes are to be told apart.
"""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.mirror import Mirror, together
from nfc_gym.envs.quadcopter import Quadcopter
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.windows import Windows
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.roll import step

Array = NDArray[np.float64]
_JOINT_SPEED = 0.15  # rad/s: how well the speed of a joint is known whose angle alone is measured
_OFF = (0.003, 0.01, 0.03)  # of their values: by how much calibrated parameters miss the true ones, each as likely
_LEAST = 1e-3  # of a state without noise: what its misfit is measured in
_ROWS = 2048  # windows replayed at once


def entries(machine: Machine) -> tuple[list[int], list[list[int]], list[int]]:
    """Indices in `proprio`: the base's quaternion (4), horizontal pairs that turn with it, its place (2 or 3)."""
    found = place_of(machine.state_names) or {"quat": [], "pos": [], "turned": []}
    # The Quadcopter's first entries are its goal seen from it: its place, but for the sign.
    pos = [0, 1, 2] if issubclass(machine.kind, Quadcopter) else list(found["pos"])
    return list(found["quat"]), [list(p) for p in found["turned"]] + ([pos[:2]] if pos else []), pos


def levelled(machine: Machine, states: Array, first: Array) -> Array:
    """States (W, K, s) as seen from where they began, facing as in `first` (W, s)."""
    quat, pairs, pos = entries(machine)
    out = states.copy()
    if not quat:
        return out
    w, x, y, z = (first[:, i, None] for i in quat)
    half = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) / 2
    c, s = np.cos(half), np.sin(half)
    w, x, y, z = (states[..., i] for i in quat)
    turned = np.stack((c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w), -1)
    out[..., quat] = np.where(turned[..., :1] < 0, -turned, turned)
    out[..., pos] -= out[:, :1, pos]
    c, s = np.cos(2 * half), np.sin(2 * half)
    for a, b in pairs:
        out[..., a], out[..., b] = c * out[..., a] + s * out[..., b], c * out[..., b] - s * out[..., a]
    return out


def shown(machine: Machine, seen: Array, predicted: Array, noise: Array) -> NDArray[np.float32]:
    """(W, H+1, 2 s) motion and misfit.

    Args:
      machine: the robot.
      seen: (W, H+1, s) as observed, noise included.
      predicted: (W, H+1, s) of a model without effects from the same starts.
      noise: (s,) standard deviations of the sensors.
    """
    first = predicted[:, 0]
    motion, expected = levelled(machine, seen, first), levelled(machine, predicted, first)
    missed = np.arcsinh((motion - expected) / np.maximum(noise, _LEAST))
    return np.concatenate([motion, missed], -1).astype(np.float32)


def images(machine: Machine) -> list[Mirror]:
    """How what is `shown` looks in each of a robot's mirrors: motion and misfit go over into their images alike."""
    return [mirror._replace(states=together([mirror.states, mirror.states])) for mirror in machine.mirrors]


def predicted(machine: Machine, starts: Array, psi: Array, actions: Array, threads: int = 1) -> Array:
    """(W, H+1, s) observations of simulations without effects on a plane; nan from where one comes apart.

    Args:
      machine: the robot.
      starts: (W, nq + nv + na) where they begin: positions, velocities, states of the actuators.
      psi: (W, d) in physical units.
      actions: (W, H, a).
      threads: of the physics; 0 takes every core, and the bits are the same.
    """
    n, nq, moving = len(starts), machine.model.nq, machine.model.nq + machine.model.nv
    sims = machine.simulations(n, threads, [])
    sims.begin(np.arange(n), {"psi": psi})
    robot, view = sims.robot, sims.view
    view.qpos[...], view.qvel[...] = starts[:, :nq], starts[:, nq:moving]
    if machine.model.na:
        sims.batch.bind("act")[...] = starts[:, moving:]
    sims.batch.forward()
    view.now = robot.derive(view)
    out = [np.concatenate(robot.proprio(view), -1)]
    for action in np.moveaxis(actions, 1, 0):
        view.ctrl[...] = robot.actuate(np.clip(action, -1, 1), view)
        step(sims, np.ones(n, bool), machine.kind.frame_skip)
        view.task.update(robot.advance(view, action))
        view.before, view.now = view.now, robot.derive(view)
        out.append(np.concatenate(robot.proprio(view), -1))
    return np.stack(out, 1)


def of_windows(
    machine: Machine, windows: Windows, rows: NDArray[np.intp], noise: float, rng: np.random.Generator, threads: int = 1
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Motion and misfit (W, H+1, 2 s) of some windows of a training set, and which of them (W,) are of use.

    The start is known as well as the sensors tell it, and the parameters as well as a calibration does: off by some
    percent, drawn anew for each window and shared by parameters of one kind. What unlike errors of like parameters
    would do (four arms of unlike mass) is large, and a calibration finds it.

    Args:
      machine: the robot, on a plane.
      windows: of it.
      rows: (W,) which.
      noise: what multiplies the sensor noise of the set's manifest.
      rng: of noise, starts and parameters.
      threads: of the physics; 0 takes every core, and the bits are the same.
    """
    sd, space, nq = noise * np.array(windows.manifest.state_noise), machine.space, machine.model.nq
    model = machine.model
    kinds, alike = np.unique([p.field for p in space.parameters], return_inverse=True)
    out, good = [], []
    for at in range(0, len(rows), _ROWS):
        batch = windows.take(rows[at : at + _ROWS], ["states", "actions", "psi", "start"])
        n = len(batch["psi"])
        psi = space.low + batch["psi"] * (space.high - space.low)
        psi = psi * (1 + rng.choice(_OFF, (n, 1)) * rng.standard_normal((n, len(kinds)))[:, alike])
        starts = batch["start"][:, 1 : 1 + nq + model.nv + model.na]  # the simulator's state begins with the time
        starts = starts + rng.standard_normal(starts.shape) * _start_noise(machine, sd)
        starts[:, 3:7] /= np.linalg.norm(starts[:, 3:7], axis=1, keepdims=True)
        with np.errstate(all="ignore"):
            psi, actions = np.clip(psi, space.low, space.high), batch["actions"].astype(float)
            expected = predicted(machine, starts, psi, actions, threads)
            seen = batch["states"] + sd * rng.standard_normal(batch["states"].shape)
            both = shown(machine, seen, expected, sd)
        fine = np.asarray(np.isfinite(both).all((1, 2)))
        out.append(np.where(fine[:, None, None], both, 0.0).astype(np.float32))
        good.append(fine)
    return np.concatenate(out), np.concatenate(good)


def _start_noise(machine: Machine, sd: Array) -> Array:
    """(nq + nv + na) standard deviations of a start: as sensors tell it; actuators are known."""
    model, names = machine.model, machine.state_names
    of = {name.replace("@body", ""): s for name, s in zip(names, sd, strict=True)}
    out = np.zeros(model.nq + model.nv + model.na)
    for kind, width, at in (("pos", 3, 0), ("quat", 4, 3), ("linvel", 3, model.nq), ("angvel", 3, model.nq + 3)):
        values = [s for name, s in of.items() if name.startswith("body:") and f":{kind}." in name]
        out[at : at + width] = values[0] if values else (sd[0] if kind == "pos" else 0.0)
    for j in range(model.njnt):
        if model.jnt_qposadr[j] >= 7:
            out[model.jnt_qposadr[j]] = of.get(f"joint:{model.joint(j).name}:pos", 0.0)
            out[model.nq + model.jnt_dofadr[j]] = of.get(f"joint:{model.joint(j).name}:vel", _JOINT_SPEED)
    return out
