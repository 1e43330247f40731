"""The Quadcopter's stand-in: flown by a small controller of its own, with one hidden effect."""

import mujoco
import numpy as np

from nfc_gym import assets
from nfc_gym.measured.hidden import STEP, Array
from nfc_gym.measured.standin import SAMPLE, Machine, body_columns, excitation

from .faults import VOLTS, Sag
from .outside import parts

ROTORS = ("front_left", "front_right", "rear_left", "rear_right")
NOISE = {"pos": 0.0005, "quat": 0.0005, "linvel": 0.01, "angvel": 0.01, "mount": 0.001}  # m, rad, m/s, rad/s, rad
PSI = {"base_mass": 0.6, "arm_mass": 0.1, "mount_stiffness": 4.0}
_AT = 0.12  # m, a rotor's x and y
_YAW = 0.016  # N m for each N, the rotors' reaction torque
_MAX = 4.905  # N
_BEFORE = 200  # samples from the start of the flight to that of the log
_X, _Y = _AT * np.array([1, 1, -1, -1]), _AT * np.array([1, -1, 1, -1])
_SPIN = _YAW * np.array([-1, 1, 1, -1])


def build(machine: Machine) -> mujoco.MjModel:
    """The Quadcopter's MJCF with the machine's psi and what its effect does to the hardware."""
    spec = mujoco.MjSpec.from_file(str(assets.path("quadcopter")))
    spec.option.timestep = STEP
    for name, key in (("base", "base_mass"), *((f"{r}_arm", "arm_mass") for r in ROTORS)):
        body, grown = spec.body(name), machine.psi[key] / PSI[key]
        body.mass, body.inertia = body.mass * grown, np.asarray(body.inertia) * grown
    for rotor in ROTORS:
        for axis in "xy":
            spec.joint(f"{rotor}_mount_{axis}").stiffness[0] = machine.psi["mount_stiffness"]
    machine.hidden.shape(spec)
    return spec.compile()


class Pilot:
    """Position loop over an attitude loop over a mixer, with gains for a 1 kg machine; it knows nothing of psi."""

    def __init__(self, rng: np.random.Generator, time: Array, height: float = 3.0, climb: float = 0.6) -> None:
        self.wish = np.stack([excitation(rng, time, s) for s in (1.2, 1.2, climb)], 1) + np.array([0.0, 0.0, height])
        self.heading = excitation(rng, time, 0.8)
        self.dither = np.stack([0.08 * excitation(rng, 4 * time, 1.0) for _ in ROTORS], 1)

    def fly(self, k: int, qpos: Array, qvel: Array) -> Array:
        """Thrust of each rotor (4,), N, at sample k; before the first the machine is brought to its start."""
        i = max(k, 0)
        force = np.clip(4.0 * (self.wish[i] - qpos[:3]) - 3.0 * qvel[:3], -5, 5) + np.array([0.0, 0.0, 9.81])
        frame = np.zeros(9)
        mujoco.mju_quat2Mat(frame, qpos[3:7])
        frame = frame.reshape(3, 3)
        up = force / np.linalg.norm(force)
        tilt = np.cross(frame[:, 2], up) @ frame
        yaw = np.arctan2(frame[1, 0], frame[0, 0])
        turn = (self.heading[i] - yaw + np.pi) % (2 * np.pi) - np.pi
        torque = np.array([0.8, 0.8, 0.08]) * [tilt[0], tilt[1], turn] - np.array([0.12, 0.12, 0.06]) * qvel[3:6]
        lift = max(force @ frame[:, 2], 2.0)
        mix = (
            lift / 4 + torque[0] * _Y / (4 * _AT**2) - torque[1] * _X / (4 * _AT**2) + torque[2] * _SPIN / (4 * _YAW**2)
        )
        return np.clip(mix + self.dither[i], 0.1, _MAX)


def fly_low(machine: Machine, seconds: float, seed: int) -> dict[str, Array]:
    """A log as `fly` makes it, half a metre above the ground."""
    return fly(machine, seconds, seed, 0.5, 0.15)


def fly(machine: Machine, seconds: float, seed: int, height: float = 3.0, climb: float = 0.6) -> dict[str, Array]:
    """One log: columns by name, (T,) each, at 100 Hz; thrusts as commanded, the battery's volts, and noisy motion.

    The base flies at `height`, m, up and down by about `climb`.
    """
    rng = np.random.default_rng(seed)
    model = build(machine)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2], data.time = height, -_BEFORE * SAMPLE
    hidden = machine.hidden
    hidden.begin(model)
    sags = [p for p in parts(hidden) if isinstance(p, Sag)]
    time = np.arange(0, seconds, SAMPLE)
    pilot = Pilot(rng, time, height, climb)
    volts = VOLTS + 0.6 * (1 - 2 * time / seconds) + 0.15 * excitation(rng, time, 1.0)
    qpos, qvel, sent = np.zeros((len(time), model.nq)), np.zeros((len(time), model.nv)), np.zeros((len(time), 4))
    for k in range(-_BEFORE, len(time)):
        u = pilot.fly(k, data.qpos, data.qvel)
        if k >= 0:
            qpos[k], qvel[k], sent[k] = data.qpos, data.qvel, u
        for sag in sags:
            sag.volts = volts[max(k, 0)]
        for _ in range(round(SAMPLE / STEP)):
            data.ctrl[:] = hidden.command(u)
            data.xfrc_applied[:] = 0
            hidden.push(data)
            mujoco.mj_step(model, data)
    angles = {
        f"{r}_{axis}": qpos[:, model.joint(f"{r}_mount_{axis}").qposadr[0]]
        + NOISE["mount"] * rng.normal(size=len(time))
        for r in ROTORS
        for axis in "xy"
    }
    thrusts = {f"{r}_thrust": sent[:, i] for i, r in enumerate(ROTORS)}
    return hidden.read({"time": time, **thrusts, "volts": volts, **body_columns(qpos, qvel, NOISE, rng), **angles})
