"""States from faulty sensors: what `sense` did to the channels is undone in the states that are read from them."""

from itertools import product

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured.cuts import Layout, cut
from nfc_gym.measured.segments import lay, pick, repeat
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.effects import build
from nfc_gym.physics.effects.base import Array, Effect
from nfc_gym.physics.effects.sensors import resolve_channel, true_state
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.state import quat_multiply, rotate, rotate_back, vector_to_quat

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="b" pos="0 0 1"><freejoint/><geom size=".1" mass="1"/></body>
  <body pos="5 0 0"><joint name="j" axis="0 1 0"/><geom size=".1" mass="1"/></body>
</worldbody></mujoco>""")
DT, ROWS, ROW = 0.01, 121, 60
J, B = "joint:j:", "body:b:"

# What is measured; faults sit on the first.
MEASURED = [
    (J + "pos",), (J + "pos", J + "vel"), (J + "vel", J + "pos"),
    (B + "pos",), (B + "pos", B + "linvel"), (B + "pos", B + "quat", B + "linvel@body"),
    (B + "pos", B + "linvel", B + "quat", B + "linvel@body"),
    (B + "quat",), (B + "quat", B + "angvel@body"), (B + "quat", B + "angvel"), (B + "quat", B + "linvel@body"),
    (B + "quat", B + "angvel", B + "linvel@body"), (B + "quat", B + "angvel@body", B + "angvel"),
    (B + "linvel", B + "pos"), (B + "linvel@body", B + "quat"), (B + "linvel@body", B + "linvel", B + "quat"),
    (B + "angvel@body", B + "quat"), (B + "angvel", B + "quat"), (B + "angvel", B + "angvel@body", B + "quat"),
]  # fmt: skip
TURN = {"x": 0.1, "y": -0.2, "z": 0.15}
FAULTS = {
    "sensor_bias": [{"bias": 0.3}, {"x": 0.3, "y": -0.1, "z": 0.2}],
    "sensor_gain": [{"gain": 1.3}],
    "sensor_delay": [{"delay": 0.05}],
    "misalignment": [TURN],
}


def possible(family: str, channel: str) -> list[dict[str, float]]:
    """The parameters that a family can have on a channel."""
    dim = resolve_channel(MODEL, channel).dim
    if family == "sensor_delay":
        return FAULTS[family]
    if family == "misalignment":
        return FAULTS[family] if dim > 1 else []
    return {1: FAULTS[family][:1], 3: FAULTS[family], 4: []}[dim]


def chains(channel: str) -> list[list[tuple[str, dict[str, float]]]]:
    """Every fault of a channel alone, and any two of them in either order."""
    single = [(family, parameters) for family in FAULTS for parameters in possible(family, channel)]
    return [[one] for one in single] + [list(two) for two in product(single, single)]


def truth(spin: float) -> dict[str, Array]:
    """Every channel (T, n) along a straight flight that turns at a constant rate, and a joint at a constant speed."""
    t = np.arange(ROWS)[:, None] * DT
    rate, speed = spin * np.array([0.3, -0.5, 1.0]), np.array([1.0, 0.4, -0.2])
    quat = quat_multiply(np.tile(vector_to_quat(np.array([0.4, 0.3, 0.2])), (ROWS, 1)), vector_to_quat(rate * t))
    rates, speeds = np.tile(rate, (ROWS, 1)), np.tile(speed, (ROWS, 1))
    body = {"pos": [0.5, -1.0, 1.2] + speed * t, "quat": quat, "linvel": speeds, "angvel@body": rates}
    body |= {"angvel": rotate(quat, rates), "linvel@body": rotate_back(quat, speeds)}
    return {J + "pos": 0.2 + 0.7 * t, J + "vel": np.full_like(t, 0.7)} | {B + k: v for k, v in body.items()}


def log_of(values: dict[str, Array], channels: tuple[str, ...], faults: list[tuple[Effect, Array]]) -> Log:
    """The channels as they are measured with faults."""
    seen = {}
    for name in channels:
        value = values[name]
        for effect, theta in faults:
            value = effect.sense(name, value, theta, DT)
        seen[name] = Channel(value[:, 0] if value.shape[1] == 1 else value, "1", 1e-9)
    return Log("run", np.arange(ROWS) * DT, {}, seen)


def bound(channel: str, chain: list[tuple[str, dict[str, float]]]) -> list[tuple[Effect, Array]]:
    faults = [build(family, [channel], parameters) for family, parameters in chain]
    for effect, _ in faults:
        effect.bind(MODEL)
    return faults


def check(values: dict[str, Array], channels: tuple[str, ...], faults: list[tuple[Effect, Array]]) -> float:
    """Asserts that states without the faults are those of right sensors; returns by how much the faults were off."""
    right, wrong = (estimate_states(MODEL, log_of(values, channels, some)) for some in ([], faults))
    q, v = wrong.qpos[ROW], wrong.qvel[ROW]
    found_q, found_v = true_state([e for e, _ in faults], [th for _, th in faults], q, v, frozenset(channels))
    integrated = slice(7, 8) if J + "vel" in channels and J + "pos" not in channels else slice(0)
    found_q[integrated] = right.qpos[ROW, integrated]
    np.testing.assert_allclose(found_q, right.qpos[ROW], atol=1e-8)
    np.testing.assert_allclose(found_v, right.qvel[ROW], atol=1e-8)
    return float(np.abs(np.concatenate([q - right.qpos[ROW], v - right.qvel[ROW]])).max())


@pytest.mark.parametrize("channels", MEASURED, ids=" ".join)
def test_any_two_faults_of_a_channel_are_undone(channels: tuple[str, ...]) -> None:
    """A state holds no acceleration, so that a delayed velocity is only known where velocities stay the same."""
    off = []
    for chain in chains(channels[0]):
        late = any(family == "sensor_delay" for family, _ in chain) and channels[0].endswith("linvel@body")
        off.append(check(truth(0.0 if late else 1.0), channels, bound(channels[0], chain)))
    read_from_others = {B + "linvel@body": B + "linvel", B + "angvel": B + "angvel@body"}
    assert (max(off) > 0.05) == (read_from_others.get(channels[0]) not in channels)


def test_faults_of_several_channels_are_undone_together() -> None:
    """An orientation turns the velocities that are measured in its frame, and a delay moves on along the true speed."""
    attitude, speed = B + "quat", B + "linvel@body"
    tilted, scaled = bound(attitude, [("misalignment", TURN)]), bound(speed, [("sensor_gain", {"gain": 1.3})])
    late = bound(B + "pos", [("sensor_gain", {"gain": 0.8}), ("sensor_delay", {"delay": 0.03})])
    spun = bound(B + "angvel", [("sensor_bias", {"x": 0.1, "y": 0.2, "z": 0.0}), ("misalignment", TURN)])
    channels = (B + "pos", attitude, speed, B + "angvel")
    for faults in ([*tilted, *scaled], [*scaled, *tilted], [*late, *spun, *tilted, *scaled], [*tilted, *spun, *late]):
        assert check(truth(1.0), channels, faults) > 0.05


@pytest.mark.parametrize("channels", MEASURED, ids=" ".join)
def test_faults_of_no_size_change_no_bit(channels: tuple[str, ...]) -> None:
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=(4, MODEL.nq)), rng.normal(size=(4, MODEL.nv))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    for family in FAULTS:
        for parameters in possible(family, channels[0]):
            effect, theta = bound(channels[0], [(family, parameters)])[0]
            found = true_state([effect], [np.tile(effect.null, (4, 1))], q, v, frozenset(channels))
            np.testing.assert_array_equal(found[0], q)
            np.testing.assert_array_equal(found[1], v)
            assert not np.array_equal(effect.null, theta)


@pytest.mark.parametrize("speed", [(), (J + "vel",)])
def test_roll_outs_of_a_log_begin_at_the_true_state(speed: tuple[str, ...]) -> None:
    """A speed that has a channel of its own has no part in the gain of the position."""
    faults = bound(J + "pos", [("sensor_gain", {"gain": 1.3}), ("sensor_bias", {"bias": 0.3})])
    log = log_of(truth(1.0), (J + "pos", *speed), faults)
    states, layout = estimate_states(MODEL, log), Layout(0.2, 0.0, (0.2,), 0.2, float(MODEL.opt.timestep))
    where = cut([log], layout)
    segments = lay(MODEL, [log], [states], where, layout, {})
    plant = Plant(MODEL, ParameterSpace(MODEL, []), [e for e, _ in faults], nthread=1)
    rolled = plant.shoot(np.concatenate([th for _, th in faults])[None], segments)
    np.testing.assert_allclose(rolled.qpos[0, :, 0, 7], truth(1.0)[J + "pos"][where.start, 0], atol=1e-8)
    np.testing.assert_allclose(rolled.qvel[0, :, 0, 6], 0.7, atol=1e-8)


@pytest.mark.parametrize("late", [("pos",), ("vel",), ("pos", "vel")])
def test_a_joint_that_swings_begins_where_it_is_and_not_where_a_late_sensor_saw_it(late: tuple[str, ...]) -> None:
    """At 3 rad/s its speed changes by 0.18 rad/s in 20 ms; the rest is of third order, 27 x 0.02^2 / 2."""
    delay, time = 0.02, DT * np.arange(ROWS)
    course = {"pos": lambda t: np.sin(3 * t), "vel": lambda t: 3 * np.cos(3 * t)}
    channels = {"pos": ("rad", 1e-5), **({"vel": ("rad/s", 1e-5)} if "vel" in late else {})}
    log = Log("swing", time, {}, {
        J + k: Channel(course[k](time - delay * (k in late)), *of) for k, of in channels.items()
    })  # fmt: skip
    layout = Layout(0.2, 0.0, (0.2,), 0.2, float(MODEL.opt.timestep))
    states, where = estimate_states(MODEL, log), cut([log], layout)
    segments = lay(MODEL, [log], [states], where, layout, {})
    faults = [bound(J + k, [("sensor_delay", {"delay": delay})])[0] for k in late]
    plant = Plant(MODEL, ParameterSpace(MODEL, []), [e for e, _ in faults], nthread=1)
    start = time[where.start]
    for some in (
        segments,
        pick(
            repeat(segments, 2, *[np.tile(a, (2, 1)) for a in (segments.qpos, segments.qvel)]), np.arange(len(segments))
        ),
    ):
        rolled = plant.shoot(np.concatenate([th for _, th in faults])[None], some)
        np.testing.assert_allclose(rolled.qpos[0, :, 0, 7], course["pos"](start), atol=1e-3)
        np.testing.assert_allclose(rolled.qvel[0, :, 0, 6], course["vel"](start), atol=8e-3)


def _stepping(noise: float | None) -> tuple[Log, Array]:
    """A joint whose speed is another after each command, measured to 1e-4 rad/s, and that speed."""
    rng = np.random.default_rng(0)
    speed = np.repeat(rng.normal(size=ROWS // 3 + 1), 3)[:ROWS] + 1e-4 * rng.normal(size=ROWS)
    position, speed_ = Channel(DT * np.cumsum(speed), "rad", 1e-4), Channel(speed, "rad/s", noise)
    return Log("steps", DT * np.arange(ROWS), {}, {J + "pos": position, J + "vel": speed_}), speed


def test_a_motion_that_no_polynomial_follows_is_taken_as_it_is_measured() -> None:
    """Where the log says how well: else what jumps is told from noise by nothing."""
    log, speed = _stepping(1e-4)
    states = estimate_states(MODEL, log)
    np.testing.assert_array_equal(states.qvel[:, 6], speed)
    np.testing.assert_allclose(states.qvel_sd[:, 6], 1e-4)
    for noise in (None, 0.5):
        assert np.abs(estimate_states(MODEL, _stepping(noise)[0]).qvel[:, 6] - speed).max() > 0.3


def test_the_speed_of_a_motion_that_no_cubic_follows_is_known_as_badly_as_the_curve_fits() -> None:
    """A crank that turns ten radians a second and swings about that six times as fast, measured by its angle alone."""
    rng, time = np.random.default_rng(1), DT * np.arange(ROWS)
    angle, speed = 10 * time + 0.5 * np.sin(60 * time), 10 + 30 * np.cos(60 * time)

    def errors(noise: float | None) -> tuple[Array, Array]:
        channel = Channel(angle + 5e-4 * rng.normal(size=ROWS), "rad", noise)
        states = estimate_states(MODEL, Log("turns", time, {}, {J + "pos": channel}))
        return states.qvel[:, 6] - speed, states.qvel_sd[:, 6]

    error, sd = errors(5e-4)
    cubics, _ = errors(None)
    assert np.sqrt(np.mean(error**2)) < 0.35 * np.sqrt(np.mean(cubics**2))
    assert np.mean(np.abs(error) < 3 * sd) > 0.9
