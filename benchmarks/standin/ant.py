"""The Ant's stand-in: crawls by torques that are sums of sines, with one hidden effect or more."""

import mujoco
import numpy as np

from nfc_gym import assets
from nfc_gym.measured.hidden import Array
from nfc_gym.measured.standin import Machine, excitation

from .legged import CONTROL, STEP, columns, grow, walk

LEGS = ("front_left", "front_right", "rear_left", "rear_right")
JOINTS = tuple(f"{leg}_{part}" for leg in LEGS for part in ("hip", "ankle"))
PSI = {
    "torso_mass": 3.0,
    "hip_mass": 0.3,
    "leg_mass": 0.4,
    "foot_mass": 0.6,
    "hip_stiffness": 5.0,
    "ankle_stiffness": 5.0,
    "foot_friction": 1.0,
}


def build(machine: Machine) -> mujoco.MjModel:
    """The Ant's MJCF with the machine's psi and what its effect does to the hardware."""
    spec = mujoco.MjSpec.from_file(str(assets.path("ant")))
    spec.option.timestep = STEP
    grow(spec, ["torso"], machine.psi["torso_mass"] / PSI["torso_mass"])
    for part in ("hip", "leg", "foot"):
        grow(spec, [f"{leg}_{part}" for leg in LEGS], machine.psi[f"{part}_mass"] / PSI[f"{part}_mass"])
    for leg in LEGS:
        for part in ("hip", "ankle"):
            spec.joint(f"{leg}_{part}").stiffness[0] = machine.psi[f"{part}_stiffness"]
        spec.geom(f"{leg}_foot").friction[0] = machine.psi["foot_friction"]
    machine.hidden.shape(spec)
    return spec.compile()


def torques(rng: np.random.Generator, time: Array) -> Array:
    """Commands (T, 8), shares of 30 N m: hips to and fro, ankles about what carries the weight, each its own sines."""
    ready = np.clip(time / 0.3, 0, 1)  # it begins at rest, on the ankles' lower stops
    out = np.zeros((len(time), 8))
    for i in range(4):
        out[:, 2 * i] = ready * excitation(rng, time, 0.5)
        out[:, 2 * i + 1] = ready * (0.4 + excitation(rng, time, 0.4))
    return np.clip(out, -1, 1)


def log(machine: Machine, seconds: float, seed: int) -> dict[str, Array]:
    """One log: columns by name, (T,) each, at 200 Hz; torque commands as sent, everything else with sensor noise."""
    rng = np.random.default_rng(seed)
    model = build(machine)
    sent = torques(rng, np.arange(round(seconds / CONTROL)) * CONTROL)
    qpos, qvel, sent = walk(
        model, machine.hidden, lambda k, data: sent[k] if k >= 0 else np.zeros(model.nu), seconds, rest=0.5
    )
    return machine.hidden.read(columns(model, JOINTS, qpos, qvel, sent, rng))
