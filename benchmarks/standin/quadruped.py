"""The Quadruped's stand-in: an open-loop trot by its position servos, with one hidden effect or more."""

import mujoco
import numpy as np

from nfc_gym import assets
from nfc_gym.measured.hidden import Array
from nfc_gym.measured.standin import Machine, excitation

from .legged import CONTROL, STEP, columns, grow, walk

LEGS = ("FL", "FR", "RL", "RR")
PARTS = ("abduction", "hip", "knee")
JOINTS = tuple(f"{leg}_{part}" for leg in LEGS for part in PARTS)
PSI = {"base_mass": 5.2, "thigh_mass": 0.95, "shank_mass": 0.15, "hip_stiffness": 35.0, "foot_friction": 0.8}


def build(machine: Machine) -> mujoco.MjModel:
    """The Quadruped's MJCF with the machine's psi and what its effect does to the hardware."""
    spec = mujoco.MjSpec.from_file(str(assets.path("quadruped")))
    spec.option.timestep = STEP
    grow(spec, ["base"], machine.psi["base_mass"] / PSI["base_mass"])
    grow(spec, [f"{leg}_thigh" for leg in LEGS], machine.psi["thigh_mass"] / PSI["thigh_mass"])
    grow(spec, [f"{leg}_shank" for leg in LEGS], machine.psi["shank_mass"] / PSI["shank_mass"])
    for leg in LEGS:
        servo = spec.actuator(f"{leg}_abduction")
        servo.gainprm[0], servo.biasprm[1] = machine.psi["hip_stiffness"], -machine.psi["hip_stiffness"]
        spec.geom(f"{leg}_foot").friction[0] = machine.psi["foot_friction"]
    machine.hidden.shape(spec)
    return spec.compile()


def gait(rng: np.random.Generator, time: Array, stance: Array) -> Array:
    """Servo targets (T, 12), rad: a trot about the standing pose, with stride, turn, sway and crouch that vary.

    Diagonal legs step together. A leg swings sideways and to and fro, and bends its knee while it swings forward.
    """
    phase = 2 * np.pi * np.cumsum(rng.uniform(1.6, 2.4) + excitation(rng, time, 0.4)) * CONTROL
    stride, turn, sway, crouch = (excitation(rng, time, size) for size in (0.22, 0.10, 0.10, 0.12))
    lift = 0.35 + excitation(rng, time, 0.15)
    ready = np.clip(time / 0.3, 0, 1)  # it begins at a stand
    out = np.tile(stance, (len(time), 1))
    for i, leg in enumerate(LEGS):
        side = 1.0 if leg[1] == "L" else -1.0
        swing = phase + (0.0 if leg in ("FL", "RR") else np.pi)
        out[:, 3 * i] += ready * (sway + 0.04 * side * np.sin(swing))
        knee = lift * np.maximum(0, np.sin(swing))
        out[:, 3 * i + 1] += ready * (crouch + (0.1 + stride - side * turn) * np.cos(swing) + 0.5 * knee)
        out[:, 3 * i + 2] += ready * (-2 * crouch - knee)
    for j in range(12):
        out[:, j] += ready * excitation(rng, 3 * time, 0.04)
    return out


def log(machine: Machine, seconds: float, seed: int) -> dict[str, Array]:
    """One log: columns by name, (T,) each, at 200 Hz; servo targets as sent, everything else with sensor noise."""
    rng = np.random.default_rng(seed)
    model = build(machine)
    time = np.arange(round(seconds / CONTROL)) * CONTROL
    targets = gait(rng, time, model.key_ctrl[0])
    qpos, qvel, sent = walk(
        model, machine.hidden, lambda k, data: targets[k] if k >= 0 else model.key_ctrl[0], seconds, rest=0.5
    )
    return machine.hidden.read(columns(model, JOINTS, qpos, qvel, sent, rng))
