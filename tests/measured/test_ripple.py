"""Speeds that positions tell, under held commands: what a machine that is known in full shows of them."""

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured.ripple import _share, unrippled
from nfc_gym.measured.states import estimate_states

ROW, FINE, ROWS, NOISE = 0.01, 0.0005, 500, 1e-5
SERVO = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody><body>
<joint name="j" axis="0 1 0" damping="{damping}" armature="{armature}"/><geom type="capsule" fromto="0 0 0 .1 0 0"
 size=".02" mass=".2"/></body></worldbody><actuator>{actuator}</actuator></mujoco>"""
POSITION = SERVO.format(damping=0.2, armature=0.08, actuator='<position name="a" joint="j" kp="70" kv="5"/>')
SPEED = SERVO.replace("{actuator}", '<velocity name="a" joint="j" kv="{kv}"/>')


def speed(kv: float) -> str:
    return SPEED.format(damping=0.002, armature=0.002, kv=kv)


def run(xml: str, straight: bool = False) -> tuple[mujoco.MjModel, Log, np.ndarray]:
    """A log of positions under goals that are held from row to row (or climb between them), and the true speeds."""
    model = mujoco.MjModel.from_xml_string(xml)
    real = mujoco.MjModel.from_xml_string(xml)
    real.opt.timestep, real.opt.integrator = FINE, int(mujoco.mjtIntegrator.mjINT_RK4)
    data = mujoco.MjData(real)
    time = ROW * np.arange(ROWS)
    goal = lambda t: 0.5 * np.sin(7 * t) + 0.3 * np.sin(3.1 * t + 1)  # noqa: E731
    places, speeds = np.empty(ROWS), np.empty(ROWS)
    for k, t in enumerate(time):
        places[k], speeds[k] = data.qpos[0], data.qvel[0]
        for s in range(round(ROW / FINE)):
            data.ctrl[0] = goal(t + s * FINE if straight else t)
            mujoco.mj_step(real, data)
    noisy = places + NOISE * np.random.default_rng(0).normal(size=ROWS)
    log = Log("run", time, {"ctrl:a": goal(time)}, {"joint:j:pos": Channel(noisy, "rad", NOISE)})
    return model, log, speeds


def off(model: mujoco.MjModel, log: Log, speeds: np.ndarray, **options) -> tuple[float, float]:
    """By how many standard deviations speeds are off, before and after, in those of before: start and end left out.

    Those of afterwards, which are asked to cover what is left, are larger.
    """
    states = estimate_states(model, log)
    told = unrippled(model, log, states, {}, **options)
    left = [np.abs(s.qvel[:, 0] - speeds)[60:-5] for s in (states, told)]
    assert np.sqrt(np.square(left[1] / told.qvel_sd[60:-5, 0]).mean()) < 1.2
    return tuple(float(np.sqrt(np.square(e / states.qvel_sd[60:-5, 0]).mean())) for e in left)


@pytest.mark.parametrize(
    ("xml", "before"),
    [(POSITION, 10), (speed(0.15), 2), (speed(5), 10)],
    ids=["pos", "slow", "fast"],
)
def test_speeds_at_rows_of_held_commands_are_as_good_as_they_claim(xml: str, before: float) -> None:
    """Of a servo of positions, of a slow one of speeds, and of one that has reached each goal before the next."""
    first, last = off(*run(xml))
    assert first > before
    assert last < max(1.1, first / 4)


def test_commands_that_climb_between_rows_make_no_ripple() -> None:
    first, last = off(*run(POSITION, straight=True), straight=frozenset({"ctrl:a"}))
    assert first == last < 1.2


def test_a_speed_that_is_measured_stays_as_it_is() -> None:
    model, log, speeds = run(POSITION)
    log.channels["joint:j:vel"] = Channel(speeds, "rad/s", 0.01)
    states = estimate_states(model, log)
    assert unrippled(model, log, states, {}) is states


@pytest.mark.parametrize("x", [1e-4, 9.9e-3, 1.01e-2, 0.3, 3.0, 40.0])
def test_the_offset_of_a_steady_climb(x: float) -> None:
    """v' = (u - v) / tau under u = 0, 1, 2, ... each held for x tau: the speed at rows against the mean course."""
    fade, v = np.exp(-x), 0.0
    before = np.arange(20 + round(30 / x)) if x > 0.05 else None
    if before is None:  # its end by the closed form of the steady state, which v(k) = k - c solves
        v, k = -1 / (1 - fade), 0
    else:
        for k in before:
            v = k + (v - k) * fade
        k = len(before)
    course = k - 0.5 + (v - k) * (1 - fade) / x  # the mean over the row that begins, less half a row of the climb
    share = _share(np.array([x]), np.array([x / (1 + x)]))
    assert share[0] == pytest.approx(course - v, rel=1e-4, abs=1e-9)
