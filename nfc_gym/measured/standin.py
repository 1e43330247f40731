"""A stand-in for a real machine: a plain `mj_step` loop with one hidden effect, whose logs `nfc-gym demo` works on.

It shares nothing with the simulator that the loop fits but the robot's MJCF: another time step, psi drawn anew, noisy
sensors, and formulas of its own for every effect. Nothing of `nfc_gym.physics` is used here.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from nfc_gym import assets
from nfc_gym.measured.hidden import STEP, Array, Coulomb, Delay, Hidden, Kind, Lag, Loss, Payload, Slope

SAMPLE = 0.01  # s between samples, and between commands
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
JACKAL_NOISE = {
    "pos": 0.0005,
    "quat": 0.0005,
    "linvel": 0.01,
    "angvel": 0.01,
    "wheel": 0.05,
}  # m, rad, m/s, rad/s, rad/s
_RADIUS, _TRACK = 0.098, 0.37559  # m, of the Jackal's data sheet


def _deck(rng: np.random.Generator, mass: float) -> Payload:
    angle = rng.uniform(0, 2 * np.pi)
    return Payload("base", mass, np.array([0.17 * np.cos(angle), 0.12 * np.sin(angle), 0.15]))


def _lean(rng: np.random.Generator, angle: float) -> Slope:
    heading = rng.uniform(0, 2 * np.pi)
    return Slope(angle * np.cos(heading), angle * np.sin(heading))


JACKAL_KINDS: dict[str, Kind] = {
    "loss": Kind(lambda rng, s: Loss(str(rng.choice(WHEELS)), s), 0.3, 0.9, "1"),
    "payload": Kind(_deck, 1.5, 6.0, "kg"),
    "delay": Kind(lambda rng, s: Delay(WHEELS, s), 0.02, 0.08, "s"),
    "lag": Kind(lambda rng, s: Lag(WHEELS, s), 0.02, 0.08, "s"),
    "coulomb": Kind(lambda rng, s: Coulomb(f"{rng.choice(WHEELS)}_wheel", s), 0.8, 3.0, "N m"),
    "slope": Kind(_lean, 0.02, 0.08, "rad"),
}


@dataclass(frozen=True)
class Machine:
    """A machine with its own psi and one hidden effect.

    Attributes:
      psi: true parameters by the names of the mapping.
      hidden: the effect.
    """

    psi: Mapping[str, float]
    hidden: Hidden = field(default_factory=Hidden)


def draw_psi(nominal: Mapping[str, float], rng: np.random.Generator, spread: float = 0.15) -> dict[str, float]:
    """Each value times a factor within 1 +- spread."""
    return {name: float(value * (1 + rng.uniform(-spread, spread))) for name, value in nominal.items()}


# Nominal values. wheel_armature is not the MJCF's 0.005: with so light a drive behind so stiff a servo the motion
# depends on the step (0.1 m/s between 5 ms and 0.5 ms). 20 g cm^2 times the square of a gear of 158 is 0.05 kg m^2.
JACKAL_PSI = {
    "base_mass": 15.08,
    "wheel_servo": 5.0,
    "wheel_friction": 0.8,
    "wheel_damping": 0.01,
    "wheel_armature": 0.05,
}


def build_jackal(machine: Machine) -> mujoco.MjModel:
    """The Jackal's MJCF with the machine's psi and what its effect does to the hardware."""
    spec = mujoco.MjSpec.from_file(str(assets.path("jackal")))
    spec.option.timestep = STEP
    base, grown = spec.body("base"), machine.psi["base_mass"] / JACKAL_PSI["base_mass"]
    base.mass, base.inertia = base.mass * grown, np.asarray(base.inertia) * grown
    for wheel in WHEELS:
        servo = spec.actuator(wheel)
        servo.gainprm[0], servo.biasprm[2] = machine.psi["wheel_servo"], -machine.psi["wheel_servo"]
        joint = spec.joint(f"{wheel}_wheel")
        joint.damping[0], joint.armature = machine.psi["wheel_damping"], machine.psi["wheel_armature"]
        spec.geom(f"{wheel}_wheel").friction[0] = machine.psi["wheel_friction"]
    machine.hidden.shape(spec)
    return spec.compile()


def excitation(rng: np.random.Generator, time: Array, size: float) -> Array:
    """A rich signal (T,) within about +- size: three sines between 0.15 and 2 Hz, and steps of 0.5 to 1.5 s."""
    sines = sum(
        np.sin(2 * np.pi * f * time + p)
        for f, p in zip(rng.uniform(0.15, 2.0, 3), rng.uniform(0, 2 * np.pi, 3), strict=True)
    )
    edges = np.cumsum(rng.uniform(0.5, 1.5, int(time[-1] / 0.5) + 2))
    steps = rng.uniform(-1, 1, len(edges) + 1)[np.searchsorted(edges, time)]
    return size * (0.25 * sines + 0.5 * steps)


def ramped(wish: Array) -> Array:
    """A wheel command (T,) that follows `wish` at no more than 60 rad/s^2 (6 m/s^2), as a rover's own limiter does."""
    out, most = np.empty_like(wish), 60.0 * SAMPLE
    last = 0.0
    for k, w in enumerate(wish):
        last += np.clip(w - last, -most, most)
        out[k] = last
    return out


def drive_jackal(machine: Machine, seconds: float, seed: int) -> dict[str, Array]:
    """One log: columns by name, (T,) each, at 100 Hz; wheel commands as sent, everything else with sensor noise."""
    rng = np.random.default_rng(seed)
    model = build_jackal(machine)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    machine.hidden.begin(model)
    time = np.arange(0, seconds, SAMPLE)
    speed, turn = excitation(rng, time, 1.2), excitation(rng, time, 3.0)
    left, right = (speed - turn * _TRACK / 2) / _RADIUS, (speed + turn * _TRACK / 2) / _RADIUS
    left, right = ramped(left), ramped(right)
    commands = np.stack([left, right, left, right], 1)
    yaw = rng.uniform(-np.pi, np.pi)
    data.qpos[3:7] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    qpos, qvel = run(model, data, machine.hidden, lambda k: commands[k], len(time))
    noisy = body_columns(qpos, qvel, JACKAL_NOISE, rng)
    for i, wheel in enumerate(WHEELS):
        noisy[f"{wheel}_speed"] = qvel[:, 6 + i] + JACKAL_NOISE["wheel"] * rng.normal(size=len(time))
    sent = {f"{wheel}_command": commands[:, i] for i, wheel in enumerate(WHEELS)}
    return machine.hidden.read({"time": time, **sent, **noisy})


def run(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    hidden: Hidden,
    command: Callable[[int], Array],
    samples: int,
    settle: float = 1.0,
) -> tuple[Array, Array]:
    """True states (T, nq), (T, nv) before each new command; a second at rest comes first and is not logged."""
    each = round(SAMPLE / model.opt.timestep)
    rest = round(settle / SAMPLE)
    qpos, qvel = np.zeros((samples, model.nq)), np.zeros((samples, model.nv))
    for k in range(-rest, samples):
        if k >= 0:
            qpos[k], qvel[k] = data.qpos, data.qvel
        u = command(k) if k >= 0 else np.zeros(model.nu)
        for _ in range(each):
            data.ctrl[:] = hidden.command(u)
            data.qfrc_applied[:], data.xfrc_applied[:] = 0, 0
            hidden.push(data)
            mujoco.mj_step(model, data)
    return qpos, qvel


def body_columns(qpos: Array, qvel: Array, noise: Mapping[str, float], rng: np.random.Generator) -> dict[str, Array]:
    """Noisy columns of a free base: x y z, qw qx qy qz, vx vy vz (world), wx wy wz (body)."""
    quat = np.empty((len(qpos), 4))
    for row, true, wobble in zip(quat, qpos[:, 3:7], noise["quat"] * rng.normal(size=(len(qpos), 3)), strict=True):
        row[:] = true
        mujoco.mju_quatIntegrate(row, wobble, 1.0)
    parts = {
        "xyz": (qpos[:, :3], noise["pos"], ("x", "y", "z")),
        "v": (qvel[:, :3], noise["linvel"], ("vx", "vy", "vz")),
        "w": (qvel[:, 3:6], noise["angvel"], ("wx", "wy", "wz")),
    }
    out = {name: quat[:, i] for i, name in enumerate(("qw", "qx", "qy", "qz"))}
    for values, sd, names in parts.values():
        measured = values + sd * rng.normal(size=values.shape)
        out |= {name: measured[:, i] for i, name in enumerate(names)}
    return out
