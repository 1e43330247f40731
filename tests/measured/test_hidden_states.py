"""Hidden states at a segment's start come from what the log shows before it."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured import segments
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.forward import ForwardProblem
from nfc_gym.measured.instant import track
from nfc_gym.measured.inverse import actuator_forces
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.effects import build
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments, Servo

DT, EVERY, LEVEL, TRANSITION = 0.005, 2, 0.25, 0.15
SD_Q, SD_V = 5e-4, 5e-3
PENDULUM = f"""
<mujoco>
  <option timestep="{DT}" integrator="implicitfast"/>
  <worldbody>
    <body name="bob"><joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom name="ball" size="0.03" pos="0 0 -0.3" mass="0.5"/></body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
MODEL = mujoco.MjModel.from_xml_string(PENDULUM)


def swing(seed: int, seconds: float = 3.0, fine: int = 5) -> Log:
    """A swing with Dahl's friction in small Euler steps of the test's own, at a fifth of the model's step."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.opt.timestep = DT / fine
    data, w = mujoco.MjData(model), 0.0
    t = np.arange(round(seconds / DT / EVERY)) * DT * EVERY
    phase = rng.uniform(0, 6, 2)
    u, q, v = 0.7 * np.sin(3 * t + phase[0]) + 0.5 * np.sin(7 * t + phase[1]), np.empty(len(t)), np.empty(len(t))
    for k in range(len(t)):
        q[k], v[k] = data.qpos[0], data.qvel[0]
        for _ in range(EVERY * fine):
            rate = data.qvel[0]
            w += model.opt.timestep * (rate - abs(rate) * w) / TRANSITION
            data.ctrl[0], data.qfrc_applied[0] = u[k], -LEVEL * w
            mujoco.mj_step(model, data)
    q, v = q + SD_Q * rng.normal(size=len(t)), v + SD_V * rng.normal(size=len(t))
    channels = {"joint:hinge:pos": Channel(q, "rad", SD_Q), "joint:hinge:vel": Channel(v, "rad/s", SD_V)}
    return Log(f"swing_{seed}", t, {"ctrl:motor": u}, channels, {"exo:time": t})


LOGS = [swing(s) for s in range(3)]


@pytest.fixture(scope="module")
def plant() -> Plant:
    effect, _ = build("hysteresis", "hinge", {"level": LEVEL, "transition": TRANSITION})
    return Plant(MODEL, ParameterSpace(MODEL, []), [effect], nthread=1)


def _problem() -> RolloutProblem:
    states = [estimate_states(MODEL, log) for log in LOGS]
    return RolloutProblem(MODEL, LOGS, states, Layout(0.2, 0.5, (0.1, 0.2), 0.2, DT))


def test_at_the_truth_a_spring_that_yields_leaves_only_noise(plant: Plant) -> None:
    """With the past the residual is what start and sensor noise make; with joints taken to begin at rest it is not."""
    problem, x = _problem(), np.array([[LEVEL, TRANSITION]])
    sigma = problem.covariance(plant, x[0])
    chi2 = []
    for past in (problem.segments.past, None):
        blind = problem.take(np.arange(len(problem)))
        blind.segments = replace(blind.segments, past=past)
        later = problem.time_of > 0.5  # the log shows a whole history before it
        r = blind.residual(plant, x)[0][later]
        chi2.append(np.einsum("si,sij,sj->s", r, np.linalg.inv(sigma[later]), r).mean() / r.shape[1])
    assert chi2[0] == pytest.approx(1.0, abs=0.35)
    assert chi2[1] > 3 * chi2[0]


def test_parts_of_a_problem_keep_their_past(plant: Plant) -> None:
    problem, x = _problem(), np.array([[LEVEL, TRANSITION], [0.1, 0.3]])
    some = np.array([7, 2, 20])
    np.testing.assert_array_equal(problem.take(some).residual(plant, x), problem.residual(plant, x)[:, some])


def test_the_past_before_a_log_begins_is_rest() -> None:
    past = _problem().segments.past
    assert past is not None
    q, v = past.motion(0)  # 0.5 s before each start
    np.testing.assert_array_equal(v[0], 0)
    np.testing.assert_array_equal(q[0], estimate_states(MODEL, LOGS[0]).qpos[0])
    lead, step = past.lead
    assert lead.shape[1] * step == pytest.approx(_problem().time_of.max() - 0.5)


THERMAL = build("thermal", "motor", {"fade": 0.4, "time_constant": 3.0, "reference": 0.6})


@pytest.fixture(scope="module")
def warm() -> Plant:
    return Plant(MODEL, ParameterSpace(MODEL, []), [THERMAL[0]], nthread=1)


def warmed(plant: Plant, seconds: float, linear: bool = False) -> Log:
    """What a drive that fades does in a log: commands of up to 8 Hz, louder and softer, and no noise."""
    t = np.arange(round(seconds / DT / EVERY)) * DT * EVERY
    loud = 0.5 + 0.5 * np.sin(0.4 * t) ** 2
    u = loud * (0.2 + 0.6 * np.sin(2 * np.pi * 2.3 * t) + 0.5 * np.sin(2 * np.pi * 8 * t + 1))
    fine = np.arange(EVERY * len(t)) * DT
    ctrl = np.interp(fine, t, u) if linear else np.repeat(u, EVERY)
    still = np.zeros((1, 1))
    motion = plant.shoot(THERMAL[1][None], Segments(DT, 0, still, still, ctrl[None, :, None], channels=frozenset()))
    q, v = (a[0, 0, : EVERY * len(t) : EVERY, 0] for a in (motion.qpos, motion.qvel))
    channels = {"joint:hinge:pos": Channel(q, "rad", 1e-6), "joint:hinge:vel": Channel(v, "rad/s", 1e-5)}
    return Log("warm", t, {"ctrl:motor": u}, channels, {"exo:time": t})


def _off(plant: Plant, log: Log, linear: bool = False) -> float:
    """Largest error of the true model, rad, in segments of 0.2 s."""
    kinds = frozenset({"ctrl:motor"}) if linear else frozenset()
    states, layout = estimate_states(MODEL, log, raw=True), Layout(0.2, 0.5, (0.2,), 0.2, DT, put_off=False)
    problem = RolloutProblem(MODEL, [log], [states], layout, linear=kinds)
    return float(np.abs(problem.residual(plant, THERMAL[1][None])[0][:, 0]).max())


@pytest.mark.parametrize("linear", [False, True])
def test_a_drive_is_as_warm_as_all_of_a_long_log_made_it(
    warm: Plant, linear: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands are thinned by what heats; at 200 steps of 0.3 s it is off by a 30th of what samples would make it."""
    log = warmed(warm, 60.0, linear)
    assert _off(warm, log, linear) < 1e-5
    monkeypatch.setattr(segments, "_ROOM", 0)
    assert _off(warm, log, linear) < 1.5e-3


LAG = build("lag", "motor", {"time_constant": 0.3})
FILTER = PENDULUM.replace("<motor ", '<general dyntype="filterexact" dynprm="0.03" actearly="true" ')


def late(seconds: float) -> Log:
    """Commands that arrive with a lag of 0.3 s, in a plain loop and without noise."""
    data, t = mujoco.MjData(MODEL), np.arange(round(seconds / DT / EVERY)) * DT * EVERY
    u = 0.7 * np.sin(3 * t) + 0.5 * np.sin(1.1 * t)
    y, q, v = u[0], np.empty(len(t)), np.empty(len(t))
    for k in range(len(t)):
        q[k], v[k] = data.qpos[0], data.qvel[0]
        for _ in range(EVERY):
            y = u[k] + np.exp(-DT / LAG[1][0]) * (y - u[k])
            data.ctrl[0] = y
            mujoco.mj_step(MODEL, data)
    channels = {"joint:hinge:pos": Channel(q, "rad", 1e-6), "joint:hinge:vel": Channel(v, "rad/s", 1e-5)}
    return Log("late", t, {"ctrl:motor": u}, channels, {"exo:time": t})


@pytest.mark.parametrize("kind", ["effect", "filter"])
def test_what_is_later_than_the_history_is_led_through_the_commands_before_it(kind: str) -> None:
    """A lag, and a model's own filter whose time constant is a parameter; 0.5 s hold less than two of 0.3 s."""
    log, model = late(12.0), mujoco.MjModel.from_xml_string(FILTER if kind == "filter" else PENDULUM)
    psi = [Parameter("tau", "actuator_dynprm[0]", ("motor",), "s", 0.005, 0.5)] if kind == "filter" else []
    effects = [] if kind == "filter" else [LAG[0]]
    plant = Plant(model, ParameterSpace(model, psi), effects, nthread=1)
    states, layout = estimate_states(model, log, raw=True), Layout(0.2, 0.5, (0.2,), 0.2, DT, put_off=False)
    problem = RolloutProblem(model, [log], [states], layout)
    true, other = (np.abs(problem.residual(plant, np.array([[tau]]))[0][:, 0]).max() for tau in (0.3, 0.25))
    assert true < 2e-4
    assert other > 100 * true


def served(seconds: float) -> Log:
    """A firmware servo swings the bob for a minute, its drive fades as it warms up: a plain loop, and no noise."""
    fade, slow, reference = THERMAL[1]
    data, heat = mujoco.MjData(MODEL), None
    t = np.arange(round(seconds / DT / EVERY)) * DT * EVERY
    goal, q, v = 0.8 * np.sin(2 * t) + 0.3 * np.sin(5 * t), np.empty(len(t)), np.empty(len(t))
    for k in range(len(t)):
        q[k], v[k] = data.qpos[0], data.qvel[0]
        for _ in range(EVERY):
            made = float(np.clip(4 * (goal[k] - data.qpos[0]) - 0.1 * data.qvel[0], -0.9, 0.9))
            target = (made / reference) ** 2
            heat = target if heat is None else target + np.exp(-DT / slow) * (heat - target)
            data.ctrl[0] = made * (1 - fade * heat)
            mujoco.mj_step(MODEL, data)
    terms = {"gain": np.full(len(t), 4.0), "supply": np.ones(len(t)), "damping": np.full(len(t), 0.1)}
    channels = {"joint:hinge:pos": Channel(q, "rad", 1e-6), "joint:hinge:vel": Channel(v, "rad/s", 1e-5)}
    return Log("served", t, {"ctrl:motor": goal}, channels, {"exo:time": t}, servo={"ctrl:motor": terms})


def test_behind_a_firmware_servo_a_drive_is_as_warm_as_what_the_servo_made(
    warm: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is known at every other step; as warm as goals would make it, it is off by sixty times as much."""
    log, laws = served(20.0), {"ctrl:motor": Servo(0, 0, 0, 0.9)}
    states, layout = estimate_states(MODEL, log, raw=True), Layout(0.2, 0.5, (0.2,), 0.2, DT, put_off=False)

    def off() -> float:
        problem = RolloutProblem(MODEL, [log], [states], layout, laws)
        residual = problem.residual(warm, THERMAL[1][None])[0, problem.time_of > 2, 0]
        return float(np.abs(residual).max())

    assert off() < 2e-3
    monkeypatch.setattr(segments, "served", lambda *_: {})
    assert off() > 5e-2


def test_thinned_commands_keep_what_laws_need() -> None:
    """Of every two steps mean and mean square, against sums over a fine grid; beyond a log's ends its values hold."""
    rng = np.random.default_rng(3)
    time, values = np.cumsum(rng.uniform(0.5, 1.5, 40)), rng.normal(size=40)
    edges = np.stack([np.linspace(-5.0, 31.0, 13), np.linspace(20.0, 50.0, 13)])
    share = (np.arange(120_000) + 0.5) / 120_000
    for steps, (first, last) in zip(segments._thinned(time, values, edges), edges[:, [0, -1]], strict=True):
        along = segments.resample(time, values, first + (last - first) * share, linear=False)
        for power in (1, 2):
            means = [(a**power).reshape(6, -1).mean(1) for a in (steps, along)]
            np.testing.assert_allclose(*means, atol=1e-3)


def test_a_part_of_a_log_knows_what_was_commanded_before_it(warm: Plant) -> None:
    """But not what was measured: that of another part changes nothing."""
    log = warmed(warm, 12.0)
    part = log.part(700, len(log), "warm@select")
    assert _off(warm, part) < 1e-5
    assert _off(warm, replace(part, before=None)) > 1e-3
    after = np.arange(len(log)) >= 700
    unlike = {k: replace(c, values=np.where(after, c.values, 9.0)) for k, c in log.channels.items()}
    other = replace(log, channels=unlike)
    assert _off(warm, other.part(700, len(log), "warm@select")) == _off(warm, part)


def test_inverse_problems_lead_hidden_states_along_the_log(plant: Plant) -> None:
    """The torque that the motion needs holds the loop: within the noise of the accelerations of what was commanded."""
    log = LOGS[0]
    log = replace(log, channels=log.channels | {"force:motor": Channel(log.controls["ctrl:motor"], "N m", 1e-3)})
    t = track(MODEL, log, estimate_states(MODEL, log), ["force:motor"], 1)
    error = [
        np.std((actuator_forces(plant, x[None], [t])[0][0] - t.measured)[20:-20])
        for x in (np.array([LEVEL, TRANSITION]), np.array([0.0, TRANSITION]))
    ]
    assert error[0] < 0.35 * error[1]


def test_forward_problems_lead_hidden_states_along_each_log() -> None:
    """A scale in the joint reads the spring that yields, in two logs of unequal length and at two parameters."""
    text = PENDULUM.replace(
        "</actuator>", '</actuator><sensor><accelerometer name="acc" site="tip"/></sensor>'
    ).replace("</body>", '<site name="tip" pos="0 0 -0.3"/></body>')
    model = mujoco.MjModel.from_xml_string(text)
    logs = [
        replace(log, channels=log.channels | {"sensor:acc": Channel(np.zeros((len(log), 3)), "m/s^2", 0.1)})
        for log in (LOGS[0], LOGS[1].part(0, 120, "short"))
    ]
    effect, _ = build("hysteresis", "hinge", {"level": LEVEL, "transition": TRANSITION})
    plant = Plant(model, ParameterSpace(model, []), [effect], nthread=1)
    problem = ForwardProblem(model, logs, [estimate_states(model, log) for log in logs], 0.2)
    x = np.array([[LEVEL, TRANSITION], [0.0, TRANSITION]])
    for t, values in zip(problem.tracks, problem.evaluate(plant, x, problem.tracks), strict=True):
        w, dt = 0.0, t.dt
        inertia = 0.5 * 0.3**2 + 0.4 * 0.5 * 0.03**2
        for k, rate in enumerate(t.qvel[:, 0]):
            side = np.sign(rate)
            w = side + (w - side) * np.exp(-abs(rate) * dt / TRANSITION)
            # the tip turns about y, 0.3 m below it: its own x is minus the lever times the angular acceleration
            np.testing.assert_allclose((values[0] - values[1])[k, 0], 0.3 * LEVEL * w / inertia, rtol=1e-6, atol=1e-9)
