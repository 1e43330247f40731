"""The Quadcopter's stand-in: flown by a small controller of its own, with one hidden effect."""

import mujoco
import numpy as np

from nfc_gym import assets
from nfc_gym.measured.hidden import STEP, Array, Delay, Hidden, Kind, Loss, Payload
from nfc_gym.measured.standin import SAMPLE, Machine, body_columns, excitation

ROTORS = ("front_left", "front_right", "rear_left", "rear_right")
NOISE = {"pos": 0.0005, "quat": 0.0005, "linvel": 0.01, "angvel": 0.01, "mount": 0.001}  # m, rad, m/s, rad/s, rad
PSI = {"base_mass": 0.6, "arm_mass": 0.1, "mount_stiffness": 4.0}
VOLTS = 11.9  # of the battery at which the rotors make the thrust that the model says
_AT = 0.12  # m, a rotor's x and y
_YAW = 0.016  # N m for each N, the rotors' reaction torque
_MAX = 4.905  # N
_X, _Y = _AT * np.array([1, 1, -1, -1]), _AT * np.array([1, -1, 1, -1])
_SPIN = _YAW * np.array([-1, 1, 1, -1])


class Wind(Hidden):
    """Steady wind of (3,) m/s against a linear drag: F = drag (wind - velocity) at the chassis' centre."""

    family = "wind"

    def __init__(self, wind: Array, drag: float) -> None:
        values = {f"push_{axis}": float(drag * w) for axis, w in zip("xyz", wind, strict=True)} | {"drag": drag}
        super().__init__(("base",), values, f"wind of {np.linalg.norm(wind):.2f} m/s on a drag of {drag:.3g} N s/m")
        self.wind, self.drag = wind, drag

    def begin(self, model: mujoco.MjModel) -> None:
        self.body = model.body("base").id

    def push(self, data: mujoco.MjData) -> None:
        data.xfrc_applied[self.body, :3] += self.drag * (self.wind - data.qvel[:3])


class AirDrag(Hidden):
    """Air drag by the square of the speed, the same along all axes."""

    family = "drag_quadratic"

    def __init__(self, factor: float) -> None:
        super().__init__(("base",), dict.fromkeys("xyz", factor), f"air drag of {factor:.3g} N s^2/m^2")
        self.factor = factor

    def begin(self, model: mujoco.MjModel) -> None:
        self.body = model.body("base").id

    def push(self, data: mujoco.MjData) -> None:
        velocity = data.qvel[:3]
        data.xfrc_applied[self.body, :3] -= self.factor * np.sqrt(velocity @ velocity) * velocity


class Sag(Hidden):
    """Thrust commands are worth (volts / 11.9) ** exponent."""

    family = "supply_sag"

    def __init__(self, exponent: float) -> None:
        values = {"exponent": exponent, "reference": VOLTS}
        super().__init__(ROTORS, values, f"thrust goes with the supply to the power {exponent:.3g}")
        self.exponent = exponent

    def command(self, u: Array) -> Array:
        return u * (self.volts / VOLTS) ** self.exponent

    volts = VOLTS


def _sling(rng: np.random.Generator, mass: float) -> Payload:
    angle = rng.uniform(0, 2 * np.pi)
    return Payload("base", mass, np.array([0.06 * np.cos(angle), 0.06 * np.sin(angle), -0.05]))


def _breeze(rng: np.random.Generator, speed: float) -> Wind:
    heading = rng.uniform(0, 2 * np.pi)
    return Wind(speed * np.array([np.cos(heading), np.sin(heading), 0.0]), 0.12)


KINDS: dict[str, Kind] = {
    "loss": Kind(lambda rng, s: Loss(str(rng.choice(ROTORS)), s), 0.002, 0.3, "1"),
    "payload": Kind(_sling, 0.002, 0.25, "kg"),
    "wind": Kind(_breeze, 0.02, 8.0, "m/s"),
    "drag_quadratic": Kind(lambda rng, s: AirDrag(s), 0.005, 1.0, "N s^2/m^2"),
    "delay": Kind(lambda rng, s: Delay(ROTORS, s), 0.001, 0.02, "s"),
    "supply_sag": Kind(lambda rng, s: Sag(s), 0.02, 3.0, "1"),
}


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

    def __init__(self, rng: np.random.Generator, time: Array) -> None:
        self.wish = np.stack([excitation(rng, time, s) for s in (1.2, 1.2, 0.6)], 1) + np.array([0.0, 0.0, 3.0])
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


def fly(machine: Machine, seconds: float, seed: int) -> dict[str, Array]:
    """One log: columns by name, (T,) each, at 100 Hz; thrusts as commanded, the battery's volts, and noisy motion."""
    rng = np.random.default_rng(seed)
    model = build(machine)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] = 3.0
    hidden = machine.hidden
    hidden.begin(model)
    time = np.arange(0, seconds, SAMPLE)
    pilot = Pilot(rng, time)
    volts = VOLTS + 0.6 * (1 - 2 * time / seconds) + 0.15 * excitation(rng, time, 1.0)
    qpos, qvel, sent = np.zeros((len(time), model.nq)), np.zeros((len(time), model.nv)), np.zeros((len(time), 4))
    for k in range(-200, len(time)):
        u = pilot.fly(k, data.qpos, data.qvel)
        if k >= 0:
            qpos[k], qvel[k], sent[k] = data.qpos, data.qvel, u
        if isinstance(hidden, Sag):
            hidden.volts = volts[max(k, 0)]
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
    return {"time": time, **thrusts, "volts": volts, **body_columns(qpos, qvel, NOISE, rng), **angles}
