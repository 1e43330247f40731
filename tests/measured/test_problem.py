"""What is compared with what: residuals at the truth are noise; forces and sensors are those of the closed form."""

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from nfc_gym.core import Channel, InputError, Log
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.forward import ForwardProblem
from nfc_gym.measured.inverse import InverseProblem
from nfc_gym.measured.metric import metric
from nfc_gym.measured.segments import Segments
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.measured.steps import finer, interpolate
from nfc_gym.physics.effects import FAMILIES, build
from nfc_gym.physics.effects.inertial import complete_inertia
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

DT, MASS, LENGTH, DAMPING, GEAR = 0.005, 0.5, 0.3, 0.1, 2.0
SD_Q, SD_V = 0.002, 0.02
PENDULUM = f"""
<mujoco>
  <option timestep="{DT}" integrator="implicitfast"/>
  <worldbody>
    <body name="bob">
      <joint name="hinge" axis="0 1 0" damping="{DAMPING}"/>
      <geom name="ball" size="0.03" pos="0 0 -{LENGTH}" mass="{MASS}"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="{GEAR}"/></actuator>
</mujoco>
"""
BODY = f"""
<mujoco>
  <option timestep="{DT}"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint name="root"/>
      <geom name="hull" type="box" size="0.1 0.1 0.05" mass="2"/>
      <site name="imu"/>
    </body>
  </worldbody>
  <actuator><motor name="thrust" site="imu" gear="0 0 1 0 0 0"/></actuator>
  <sensor><accelerometer name="acc" site="imu"/><gyro name="gyro" site="imu"/></sensor>
</mujoco>
"""

OF_MASS = Parameter("mass", "body_mass", ("base",), "kg", 1, 4)


def torque(t: np.ndarray, seed: int) -> np.ndarray:
    a, b = np.random.default_rng(seed).uniform(0, 6, 2)
    return 0.4 * np.sin(3 * t + a) + 0.2 * np.sin(7 * t + b)


def run(model: mujoco.MjModel, seed: int, seconds: float = 3.0, clean: bool = False, every: int = 2) -> Log:
    """A swing stepped by MuJoCo alone and measured at every second step, with the declared noise."""
    rng = np.random.default_rng(1000 + seed)
    data = mujoco.MjData(model)
    data.qpos[0] = rng.uniform(-1, 1)
    t = np.arange(round(seconds / DT / every)) * DT * every
    u, q, v = torque(t, seed), np.empty(len(t)), np.empty(len(t))
    for k in range(len(t)):
        q[k], v[k] = data.qpos[0], data.qvel[0]
        data.ctrl[0] = u[k]
        mujoco.mj_step(model, data, every)
    noise = 0 if clean else 1
    q, v = q + noise * SD_Q * rng.normal(size=len(t)), v + noise * SD_V * rng.normal(size=len(t))
    channels = {"joint:hinge:pos": Channel(q, "rad", SD_Q), "joint:hinge:vel": Channel(v, "rad/s", SD_V)}
    return Log(f"run_{seed}", t, {"ctrl:motor": u}, channels)


@pytest.fixture(scope="module")
def plant() -> Plant:
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    return Plant(
        model, ParameterSpace(model, [Parameter("damping", "dof_damping", ("hinge",), "N m s", 0, 0.5)]), nthread=1
    )


def rollouts(plant: Plant, clean: bool = False, history: float = 0.0, logs: int = 5) -> RolloutProblem:
    runs = [run(plant.model, seed, clean=clean) for seed in range(logs)]
    states = [estimate_states(plant.model, log) for log in runs]
    return RolloutProblem(plant.model, runs, states, Layout(0.3, history, (0.1, 0.2, 0.3), 0.3, DT))


def chi2(problem: RolloutProblem, plant: Plant, x: np.ndarray) -> np.ndarray:
    return metric(problem, problem.covariance(plant, x)).whiten(problem.residual(plant, x[None]))[0] ** 2


@pytest.mark.parametrize("history", [0.0, 0.2])
def test_at_the_truth_the_residual_is_noise(plant: Plant, history: float) -> None:
    problem = rollouts(plant, history=history, logs=60)
    right, wrong = np.array([DAMPING]), np.array([2 * DAMPING])
    assert problem.columns.group == ("joint angle",) * 3 + ("joint speed",) * 3
    assert problem.columns.channel == ("joint:hinge:pos",) * 3 + ("joint:hinge:vel",) * 3
    np.testing.assert_allclose(problem.columns.horizon, [0.1, 0.2, 0.3] * 2)
    assert chi2(problem, plant, right).mean() == pytest.approx(1, abs=0.2)
    assert chi2(problem, plant, wrong).mean() > 3


def test_synthetic_data_are_noise_at_their_own_parameters(plant: Plant) -> None:
    rng, x = np.random.default_rng(0), np.array([0.25])
    problem = rollouts(plant)
    twins = [problem.synthetic(plant, x, rng) for _ in range(8)]
    assert np.mean([chi2(t, plant, x).mean() for t in twins]) == pytest.approx(1, abs=0.15)
    assert all(chi2(t, plant, np.array([DAMPING])).mean() > 2 for t in twins)
    assert chi2(problem, plant, x).mean() > 2  # the original is left as it was
    differ = twins[0].residual(plant, x[None]) - twins[1].residual(plant, x[None])
    assert (differ != 0).all()


def test_covariance_holds_the_noise_of_the_start(plant: Plant) -> None:
    """Sensor noise alone is too little: a start speed that is off carries through the segment, as repeats show."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.opt.timestep = dt = DT / 10  # so fine that the discretisation adds nothing
    fine, x = Plant(model, plant.space, nthread=1), np.array([DAMPING])
    log = run(plant.model, 0)
    problem = RolloutProblem(model, [log], [estimate_states(model, log)], Layout(0.3, 0, (0.1, 0.2, 0.3), 0.3, dt))
    sigma = np.einsum("sii->si", problem.covariance(fine, x))
    sensor = np.repeat([SD_Q**2, SD_V**2], 3)
    assert (sigma >= sensor * (1 - 1e-9)).all()
    assert (sigma[:, :3] > 1.2 * SD_Q**2).all()
    rng = np.random.default_rng(1)
    errors = np.stack([problem.synthetic(fine, x, rng).residual(fine, x[None])[0] for _ in range(80)])
    found = errors.var(0)
    assert (found > 1.05 * sensor)[:, :3].mean() > 0.9
    assert np.mean(found / sigma) == pytest.approx(1, abs=0.1)


def test_what_bends_with_the_start_is_noise_too(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of f = 3 z + 2 z^2 the variance is 17 for z ~ N(0, 1); a step to one side would say 25, to the other 1."""
    problem, x = rollouts(plant, logs=1), np.array([DAMPING])

    def bent(plant: Plant, x: np.ndarray, segments: Segments, copies: int) -> np.ndarray:
        off = segments.qpos - np.concatenate([problem.segments.qpos] * copies)
        z = off.reshape(copies, len(problem), 1) / problem._start_sd[0]
        return np.repeat(3 * z + 2 * z**2, len(problem.columns), -1)

    monkeypatch.setattr(problem, "_again", bent)
    carried = problem._carried(plant, x, np.zeros((len(problem), len(problem.columns))))
    np.testing.assert_allclose(np.square(carried).sum(0), 17.0, rtol=1e-9)


def test_rollouts_of_clean_logs_start_where_the_machine_was(plant: Plant) -> None:
    """Without noise what remains is the local fit's own error at the start, far below the declared noise."""
    residual = rollouts(plant, clean=True).residual(plant, np.array([[DAMPING]]))[0]
    assert np.sqrt((residual[:, :3] ** 2).mean()) < 0.2 * SD_Q
    assert np.sqrt((residual[:, 3:] ** 2).mean()) < 0.2 * SD_V


@pytest.mark.parametrize("slow", [False, True])
def test_rows_under_a_mask_are_not_compared(plant: Plant, slow: bool) -> None:
    """Neither what stands in them (a gap, rows between a slow sensor's samples) nor a start that was read there."""
    log = run(plant.model, 0)
    keep = np.arange(len(log)) % 5 == 0 if slow else np.abs(log.time - 1.0) > 0.1
    held = np.maximum.accumulate(np.where(keep, np.arange(len(log)), 0))
    angle = Channel(log.channels["joint:hinge:pos"].values[held], "rad", SD_Q, mask=keep, rate=20.0)
    channels = {"joint:hinge:pos": angle, "joint:hinge:vel": log.channels["joint:hinge:vel"]}
    spoilt = replace(log, channels=channels)
    layout = Layout(0.3, 0, (0.1, 0.2, 0.3), 0.09, DT)
    problem = RolloutProblem(plant.model, [spoilt], [estimate_states(plant.model, spoilt)], layout)
    x = np.array([DAMPING])
    rows = np.rint((problem.time_of[:, None] + np.array(layout.horizons)) / log.interval).astype(int)
    np.testing.assert_array_equal(problem.mask[:, :3], keep[rows])
    assert problem.mask[:, 3:].all()
    assert 0 < problem.mask[:, :3].mean() < 1
    residual = problem.residual(plant, x[None])[0]
    assert (residual[~problem.mask] == 0).all()
    assert np.isfinite(residual).all()
    whole = RolloutProblem(plant.model, [log], [estimate_states(plant.model, log)], layout)
    assert chi2(problem, plant, x)[problem.mask].mean() == pytest.approx(chi2(whole, plant, x).mean(), abs=0.25)
    twin = problem.synthetic(plant, x, np.random.default_rng(0))
    np.testing.assert_array_equal(twin.mask, problem.mask)


def test_take_picks_blocks(plant: Plant) -> None:
    problem, x = rollouts(plant), np.array([0.2])
    index = np.array([7, 0, 31])
    some = problem.take(index)
    assert len(some) == 3
    np.testing.assert_array_equal(some.log_of, problem.log_of[index])
    np.testing.assert_array_equal(some.time_of, problem.time_of[index])
    np.testing.assert_allclose(some.residual(plant, x[None])[0], problem.residual(plant, x[None])[0, index], atol=1e-12)
    np.testing.assert_allclose(some.covariance(plant, x), problem.covariance(plant, x)[index], atol=1e-15)
    np.testing.assert_allclose(
        some.take(np.array([2])).residual(plant, x[None])[0], some.residual(plant, x[None])[0, 2:], atol=1e-12
    )


def test_what_was_just_rolled_out_is_not_rolled_out_again(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    rolled: list[float] = []
    shoot = Plant.shoot
    monkeypatch.setattr(
        Plant, "shoot", lambda self, x, *rest, **kw: rolled.append(x[0, 0]) or shoot(self, x, *rest, **kw)
    )
    problem, fine = rollouts(plant), rollouts(plant).halved()
    one, other = np.array([[0.1]]), np.array([[0.2]])
    first = problem.residual(plant, one)
    problem.residual(plant, other)
    assert (problem.residual(plant.with_effects([]), one) == first).all()
    assert rolled == [0.1, 0.2]
    twice = [fine.residual(finer(plant), one) for _ in range(2)]
    assert len(rolled) == 3
    assert (twice[0] != first).any()
    moved = problem.redrawn(np.random.default_rng(0))  # other starts are another question
    assert (moved.residual(plant, one) != first).any()
    assert len(problem.take(np.array([3])).residual(plant, one)[0]) == 1


def test_a_part_and_the_whole_share_what_they_know(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    rolled: list[int] = []
    shoot = Plant.shoot
    monkeypatch.setattr(
        Plant,
        "shoot",
        lambda self, x, segments, **kw: rolled.append(len(x) * len(segments)) or shoot(self, x, segments, **kw),
    )
    problem, x = rollouts(plant), np.array([[0.1], [0.2]])
    expected, index = rollouts(plant).residual(plant, x), np.array([7, 0, 31])
    rolled.clear()
    np.testing.assert_array_equal(problem.part(index).residual(plant, x), expected[:, index])
    np.testing.assert_array_equal(problem.residual(plant, x), expected)
    assert rolled == [6, 2 * (len(problem) - 3)]
    np.testing.assert_array_equal(problem.part(index).residual(plant, x), expected[:, index])
    assert len(rolled) == 2
    problem.take(index).residual(plant, x)  # whoever may change what it took shares nothing
    assert rolled[2:] == [6]


def test_an_unstable_roll_out_has_no_residual(plant: Plant) -> None:
    problem = rollouts(plant, logs=1)
    residual = problem.residual(plant, np.array([[DAMPING], [-400.0]]))
    assert np.isfinite(residual[0]).all()
    assert np.isnan(residual[1]).all()


def test_too_short_logs_are_named(plant: Plant) -> None:
    log = run(plant.model, 0, seconds=0.2)
    with pytest.raises(
        InputError, match=r"no log is long enough for one segment of 0\.3 s \(the longest has 0\.19 s\)"
    ):
        RolloutProblem(plant.model, [log], [estimate_states(plant.model, log)], Layout(0.3, 0, (0.1, 0.3), 0.3, DT))


def test_interpolation_between_steps() -> None:
    grid = np.arange(5.0).reshape(1, 1, 5, 1) ** 2
    out = interpolate(grid, np.array([[0.0, 0.5, 2.25, 4.0]]), quaternion=False)
    np.testing.assert_allclose(out[0, 0, :, 0], [0, 0.5, 4 + 0.25 * 5, 16])


def analytic(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return 0.8 * np.sin(3 * t), 2.4 * np.cos(3 * t), -7.2 * np.sin(3 * t)


def forces(q: np.ndarray, v: np.ndarray, a: np.ndarray, damping: float) -> np.ndarray:
    """What the motor must give for the motion of a ball on a rod: (I a + d v + m g l sin q) / gear."""
    inertia = MASS * (LENGTH**2 + 0.4 * 0.03**2)
    return (inertia * a + damping * v + MASS * 9.81 * LENGTH * np.sin(q)) / GEAR


def test_inverse_problem_gives_the_forces_of_the_closed_form(plant: Plant) -> None:
    t = np.arange(0, 3, 0.005)
    q, v, a = analytic(t)
    sd = 1e-3
    measured = forces(q, v, a, DAMPING) + sd * np.random.default_rng(0).normal(size=len(t))
    channels = {
        "joint:hinge:pos": Channel(q, "rad", 1e-4),
        "joint:hinge:vel": Channel(v, "rad/s", 1e-4),
        "joint:hinge:acc": Channel(a, "rad/s^2", 1e-4),
        "force:motor": Channel(measured, "N m", sd),
    }
    log = Log("swing", t, {"ctrl:motor": np.zeros_like(t)}, channels)
    problem = InverseProblem(plant.model, [log], [estimate_states(plant.model, log)], 0.25)
    x = np.array([[DAMPING], [0.3]])
    predicted = problem.evaluate(plant, x, problem.tracks)[0]
    for row, damping in zip(predicted, x[:, 0], strict=True):
        np.testing.assert_allclose(row[:, 0], forces(q, v, a, damping), atol=1e-4)
    residual = problem.residual(plant, x)
    assert (residual[0] ** 2 / sd**2).mean() == pytest.approx(1, abs=0.2)
    assert (residual[1] ** 2 / sd**2).mean() > 100
    assert problem.columns.group[0] == "torque"
    assert problem.columns.place[0] == "actuator:motor"
    assert problem.columns.channel[0] == "force:motor"
    np.testing.assert_allclose(problem.take(np.array([4, 2])).residual(plant, x), residual[:, [4, 2]], atol=1e-12)
    twin = problem.synthetic(plant, x[1], np.random.default_rng(1))
    assert (twin.residual(plant, x[1:]) ** 2 / sd**2).mean() == pytest.approx(1, abs=0.2)


def flight(rotating: bool) -> Log:
    """A body that leans, under a thrust that varies: its accelerometer shows thrust / mass along its own z."""
    t = np.arange(0, 2, 0.01)
    thrust = 20 + 5 * np.sin(4 * t)
    angle = 0.4 * t if rotating else np.full_like(t, 0.3)
    quat = np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * t, 0 * t], 1)
    position = np.stack([0 * t, 0 * t, 1 + 0.3 * t], 1)
    acc = np.stack([0 * t, 0 * t, thrust / 2.0], 1)
    channels = {
        "body:base:pos": Channel(position, "m", 1e-3),
        "body:base:quat": Channel(quat, "1", 1e-4),
        "sensor:acc": Channel(acc + 0.01 * np.random.default_rng(0).normal(size=acc.shape), "m/s^2", 0.01),
        "sensor:gyro": Channel(np.stack([np.full_like(t, 0.4 if rotating else 0.0), 0 * t, 0 * t], 1), "rad/s", 0.01),
    }
    return Log("flight", t, {"ctrl:thrust": thrust}, channels)


@pytest.mark.parametrize("rotating", [False, True])
def test_forward_problem_reads_the_accelerometer_of_the_closed_form(rotating: bool) -> None:
    model = mujoco.MjModel.from_xml_string(BODY)
    plant = Plant(model, ParameterSpace(model, [OF_MASS]), nthread=1)
    log = flight(rotating)
    problem = ForwardProblem(model, [log], [estimate_states(model, log)], 0.25)
    predicted = problem.evaluate(plant, np.array([[2.0], [3.0]]), problem.tracks)[0]
    for row, mass in zip(predicted, (2.0, 3.0), strict=True):
        np.testing.assert_allclose(row[:, :2], 0, atol=1e-6)
        np.testing.assert_allclose(row[:, 2], log.controls["ctrl:thrust"] / mass, rtol=1e-6)
        np.testing.assert_allclose(row[:, 3:], log.channels["sensor:gyro"].values, atol=1e-6)
    residual = problem.residual(plant, np.array([[2.0]]))[0]
    acc = np.array([g == "sensor acc" for g in problem.columns.group])
    assert (residual[:, acc] ** 2).mean() == pytest.approx(1e-4, rel=0.2)


def test_forward_problem_pushes_by_laws_that_read_the_state() -> None:
    """A body that leans by 0.3 rad climbs at 0.3 m/s: along its own axis air pushes back by c v cos 0.3."""
    model = mujoco.MjModel.from_xml_string(BODY)
    space = ParameterSpace(model, [OF_MASS])
    drag, quadratic = (FAMILIES[f](("base",)) for f in ("drag_linear", "drag_quadratic"))
    plant = Plant(model, space, [drag, quadratic], nthread=1)
    log = flight(False)
    problem = ForwardProblem(model, [log], [estimate_states(model, log)], 0.25)
    x = np.array([[2.0, *(2.0 * np.ones(3)), *np.zeros(3)], [2.0, *np.zeros(3), *(5.0 * np.ones(3))]])
    predicted = problem.evaluate(plant, x, problem.tracks)[0]
    for row, force in zip(predicted, (2.0 * 0.3, 5.0 * 0.3**2), strict=True):
        wanted = (log.controls["ctrl:thrust"] - force * np.cos(0.3)) / 2.0
        np.testing.assert_allclose(row[:, 2], wanted, rtol=1e-4)


def movable() -> mujoco.MjModel:
    """The body, with a centre of mass that effects may shift."""
    spec = mujoco.MjSpec.from_string(BODY)
    complete_inertia(spec)
    return spec.compile()


@pytest.mark.parametrize("family", [None, "drag_linear", "payload", "sensor_delay"])
def test_forward_problem_of_some_blocks_is_that_part_of_the_whole(
    family: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only samples of these blocks are evaluated, but for what remembers the samples before."""
    model = movable()
    log = flight(False)
    smooth = replace(log.channels["sensor:acc"], smooth=6)
    log = replace(log, channels={**log.channels, "sensor:acc": smooth})
    where = "sensor:acc" if family == "sensor_delay" else "base"
    effects = [FAMILIES[family]((where,))] if family else []
    plant = Plant(model, ParameterSpace(model, [OF_MASS]), effects, nthread=1)
    x = np.stack([np.concatenate([[m], *(e.null + 0.02 for e in effects)]) for m in (2.0, 2.5)])
    problem = ForwardProblem(model, [log], [estimate_states(model, log)], 0.25)
    whole, few = problem.residual(plant, x), np.array([1, 4])
    sizes: list[int] = []

    def counted(model: mujoco.MjModel, nsim: int, nthread: int) -> Batch:
        sizes.append(nsim)
        return Batch(model, nsim, nthread)

    monkeypatch.setattr("nfc_gym.measured.forward.Batch", counted)
    np.testing.assert_array_equal(problem.take(few).residual(plant, x), whole[:, few])
    assert (max(sizes) == 2 * len(problem.tracks[0].time)) == (family == "sensor_delay")


def test_forward_problem_has_the_constants_of_each_parameter_vector() -> None:
    """A lump changes what MuJoCo derives from masses: the body's inverse weight, by which rows would differ."""
    model = movable()
    lump = FAMILIES["payload"](("base",))
    plant = Plant(model, ParameterSpace(model, [OF_MASS]), [lump], nthread=1)
    log = flight(True)
    problem = ForwardProblem(model, [log], [estimate_states(model, log)], 0.25)
    x = np.stack([np.concatenate([[m], lump.null + s]) for m, s in ((2.0, 0.0), (3.0, 0.05))])
    together = problem.residual(plant, x)
    for k in (0, 1):
        np.testing.assert_array_equal(together[k], problem.residual(plant, x[[k]])[0])
    assert np.abs(together[0] - together[1]).max() > 1


def test_inverse_dynamics_under_any_friction_are_worked_out_once(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    t = np.arange(0, 3, 0.005)
    q, v, a = analytic(t)
    values = {"pos": (q, "rad"), "vel": (v, "rad/s"), "acc": (a, "rad/s^2")}
    channels = {f"joint:hinge:{k}": Channel(c, unit, 1e-4) for k, (c, unit) in values.items()}
    channels["force:motor"] = Channel(forces(q, v, a, DAMPING), "N m", 1e-3)
    log = Log("swing", t, {"ctrl:motor": np.zeros_like(t)}, channels)
    problem = InverseProblem(plant.model, [log], [estimate_states(plant.model, log)], 0.25)
    calls: list[int] = []
    solve = mujoco.mj_inverse
    monkeypatch.setattr(mujoco, "mj_inverse", lambda m, d: calls.append(1) or solve(m, d))
    bare = problem.residual(plant, np.array([[DAMPING]]))
    assert len(calls) == len(t)
    rubbing = plant.with_effects([FAMILIES["coulomb"](("hinge",))])  # whose joint holds otherwise than a free one
    little, much = (problem.residual(rubbing, np.array([[DAMPING, level]])) for level in (0.05, 0.15))
    assert len(calls) == 2 * len(t)
    assert np.abs(little - bare).max() == pytest.approx(0.05 / GEAR, rel=0.01)
    assert np.abs(much - bare).max() == pytest.approx(0.15 / GEAR, rel=0.01)
    np.testing.assert_array_equal(problem.residual(plant, np.array([[DAMPING]])), bare)
    assert len(calls) == 2 * len(t)
    problem.residual(plant, np.array([[2 * DAMPING]]))
    assert len(calls) == 3 * len(t)


@pytest.mark.parametrize(("kind", "word"), [(InverseProblem, "force:<actuator>"), (ForwardProblem, "sensor:<name>")])
def test_instant_problems_say_which_channel_they_need(plant: Plant, kind: Callable, word: str) -> None:
    log = run(plant.model, 0)
    with pytest.raises(InputError, match=word):
        kind(plant.model, [log], [estimate_states(plant.model, log)], 0.25)


STEP = 0.002


def carriage(actuator: str, extra: str = "") -> mujoco.MjModel:
    """1 kg on a slide, with an accelerometer: it shows the force that pushes."""
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{STEP}" gravity="0 0 0"/>
<worldbody><body>
  <joint name="slide" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/><site name="s"/>
</body></worldbody>
{extra}<actuator>{actuator}</actuator><sensor><accelerometer name="acc" site="s"/></sensor></mujoco>""")


def driven(model: mujoco.MjModel, every: int, rows: int = 120, effect: tuple | None = None) -> Log:
    """What the accelerometer reads of a cart that a wave of commands, held from row to row, pushes about."""
    data, table, memory = mujoco.MjData(model), [], None
    u0 = np.zeros(1)
    if effect is not None:
        memory = effect[0].state0((), u0, effect[1], STEP)
    for k in range(rows):
        given = np.array([np.sin(6 * np.pi * k * every * STEP)])
        for part in range(every):
            u = given
            if effect is not None:
                u, memory = effect[0].action(given, effect[1], memory, {}, STEP)
            data.ctrl[:] = u
            if part == 0:
                mujoco.mj_forward(model, data)
                table.append((given[0], data.qpos[0], data.qvel[0], *data.sensordata))
            mujoco.mj_step(model, data)
    values = np.array(table)
    channels = {
        "sensor:acc": Channel(values[:, 3:], "m/s^2", 1e-2),
        "joint:slide:pos": Channel(values[:, 1], "m", 1e-6),
        "joint:slide:vel": Channel(values[:, 2], "m/s", 1e-6),
    }
    return Log("cart", every * STEP * np.arange(rows), {"ctrl:motor": values[:, 0]}, channels)


def bare(model: mujoco.MjModel, *effects: tuple) -> tuple[Plant, np.ndarray]:
    theta = np.concatenate([np.zeros(0), *(th for _, th in effects)])
    return Plant(model, ParameterSpace(model, []), [e for e, _ in effects], nthread=1), theta[None]


def forward(model: mujoco.MjModel, logs: list[Log], *effects: tuple, stride: int = 1) -> list[np.ndarray]:
    """The accelerometer along each log, (T, 3)."""
    problem = ForwardProblem(model, logs, [estimate_states(model, log) for log in logs], 0.2, stride)
    return [values[0] for values in problem.along(*bare(model, *effects), problem.tracks)]


FILTER = '<general name="motor" joint="slide" dyntype="filterexact" dynprm="0.05"/>'
LATE = '<motor name="motor" joint="slide" delay="0.025" nsample="14" interp="linear"/>'


@pytest.mark.parametrize("every", [1, 10])
@pytest.mark.parametrize("actuator", [FILTER, FILTER.replace("/>", ' actearly="true"/>'), LATE])
def test_forward_problems_pass_commands_on_as_the_machine_does(actuator: str, every: int) -> None:
    """A command's own sample has not felt it yet, but for `actearly`; a native delay holds what came before it."""
    model = carriage(actuator)
    log = driven(model, every)
    acc = log.channels["sensor:acc"].values
    np.testing.assert_allclose(forward(model, [log])[0], acc, atol=1e-9)
    assert acc[:, 0].std() > 0.3


@pytest.mark.parametrize("every", [1, 10])
@pytest.mark.parametrize(("family", "size"), [("lag", {"time_constant": 0.05}), ("delay", {"delay": 0.025})])
def test_forward_problems_pass_commands_on_as_roll_outs_do(family: str, size: dict[str, float], every: int) -> None:
    """What remembers commands goes on in steps of the physics, however far apart the rows of a log are."""
    model = carriage('<motor name="motor" joint="slide"/>')
    effect, theta = build(family, "motor", size)
    effect.bind(model)
    log = driven(model, every, effect=(effect, theta))
    found = forward(model, [log], (effect, theta))[0]
    np.testing.assert_allclose(found, log.channels["sensor:acc"].values, atol=1e-9)


def test_forward_problems_of_thinned_logs_hold_every_command() -> None:
    model = carriage(FILTER)
    log = driven(model, 5)
    np.testing.assert_allclose(forward(model, [log], stride=4)[0], forward(model, [log])[0][::4], atol=1e-12)


def test_forward_problems_step_each_log_at_its_own_rate() -> None:
    model = carriage(FILTER)
    logs = [driven(model, 2), driven(model, 10)]
    for log, values in zip(logs, forward(model, logs), strict=True):
        np.testing.assert_allclose(values, log.channels["sensor:acc"].values, atol=1e-9)


@pytest.mark.parametrize(
    ("family", "size"),
    [
        ("coulomb", {"level": 2.0}),
        ("stribeck", {"level": 1.5, "rise": 0.5 * np.e, "speed": 1.0}),
        ("directional_friction", {"forward": 2.0, "backward": 5.0, "forward_viscous": 0.0, "backward_viscous": 0.0}),
        ("load_friction", {"level": 1.7, "motor": 0.1, "external": 0.0, "square": 0.0}),
    ],
)
def test_forward_problems_rub(family: str, size: dict[str, float]) -> None:
    """1 kg that slides at 1 m/s under 2 N of friction, pushed by 3 N."""
    model = carriage('<motor name="motor" joint="slide"/>')
    t = 0.01 * np.arange(100)
    channels = {
        "sensor:acc": Channel(np.zeros((100, 3)), "m/s^2", 1e-2),
        "joint:slide:pos": Channel(t, "m", 1e-6),
        "joint:slide:vel": Channel(np.ones(100), "m/s", 1e-6),
    }
    log = Log("cart", t, {"ctrl:motor": np.full(100, 3.0)}, channels)
    np.testing.assert_allclose(forward(model, [log], build(family, "slide", size))[0][:, 0], 1.0, atol=1e-6)


def hauled(model: mujoco.MjModel, acceleration: float, *named: str) -> tuple[Log, InverseProblem]:
    """The cart at a constant acceleration, with the forces of some actuators measured."""
    t = 0.01 * np.arange(100)
    channels = {f"force:{name}": Channel(np.ones(100), "N", 1e-2) for name in named}
    channels["joint:slide:pos"] = Channel(acceleration * t**2 / 2, "m", 1e-6)
    log = Log("cart", t, {}, channels, {"exo:supply": np.full(100, 6.0)})
    return log, InverseProblem(model, [log], [estimate_states(model, log)], 0.2)


def test_inverse_problems_pull_by_the_lever_of_a_tendon() -> None:
    tendon = '<tendon><fixed name="t"><joint joint="slide" coef="2"/></fixed></tendon>'
    model = carriage('<motor name="motor" tendon="t" gear="3"/>', tendon)
    _, problem = hauled(model, 1.5, "motor")
    np.testing.assert_allclose(problem.along(*bare(model), problem.tracks)[0][0, :, 0], 0.25, rtol=1e-6)
    assert problem.columns.unit[0] == "N"


def test_inverse_problems_tell_a_joint_from_a_tendon_that_pulls_at_it_too() -> None:
    """m1 on one slide, and a tendon over it and another: two joints tell the forces of two actuators."""
    model = mujoco.MjModel.from_xml_string("""
<mujoco><option gravity="0 0 0"/><worldbody>
  <body><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
  <body pos="0 1 0"><joint name="other" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
</worldbody><tendon><fixed name="t"><joint joint="slide" coef="0.5"/><joint joint="other" coef="-1"/></fixed></tendon>
<actuator><motor name="m1" joint="slide"/><motor name="m2" tendon="t"/></actuator></mujoco>""")
    t = 0.01 * np.arange(100)
    channels = {f"force:{m}": Channel(np.ones(100), "N", 1e-2) for m in ("m1", "m2")}
    channels |= {"joint:slide:pos": Channel(t**2, "m", 1e-6), "joint:other:pos": Channel(-1.5 * t**2, "m", 1e-6)}
    log = Log("carts", t, {}, channels)
    problem = InverseProblem(model, [log], [estimate_states(model, log)], 0.2)
    # m2 pulls with 3 N at the other, of which half comes to the first, whose motor adds the rest of its 2 N.
    np.testing.assert_allclose(problem.along(*bare(model), problem.tracks)[0][0], np.tile([0.5, 3.0], (100, 1)), 1e-6)


MOTORS = '<motor name="m1" joint="slide"/>'


@pytest.mark.parametrize(
    ("actuators", "named", "words"),
    [
        (MOTORS + '<motor name="m2" joint="slide" gear="0.01"/>', ["m1"], r"m2 can move the same joint"),
        (MOTORS + '<motor name="m2" joint="slide"/>', ["m1", "m2"], r"m2 can move the same joint"),
        (MOTORS + '<motor name="m2" site="s" gear="1 0 0 0 0 0"/>', ["m1"], r"m2 can move the same joint"),
        ('<motor name="m2" site="s" gear="1 0 0 0 0 0"/>', ["m2"], r"hinges, on slides and on fixed tendons"),
    ],
)
def test_inverse_problems_refuse_forces_that_the_motion_does_not_tell(
    actuators: str, named: list[str], words: str
) -> None:
    with pytest.raises(InputError, match=rf"force:{named[0]} cannot be compared .*{words}"):
        hauled(carriage(actuators), 1.0, *named)


def test_inverse_problems_undo_the_last_effect_on_a_command_first() -> None:
    model = carriage('<motor name="motor" joint="slide"/>')
    effects = [
        build("offset", "motor", {"offset": 0.5}),
        build("supply_sag", "motor", {"exponent": 1.0, "reference": 12.0}),
        build("gain", "motor", {"gain": 0.8}),
    ]
    for order, force in ((effects, 0.8 * (1 + 0.5) * 0.5), ([effects[1], effects[0], effects[2]], 0.8 * (0.5 + 0.5))):
        _, problem = hauled(model, force, "motor")
        found = problem.along(*bare(model, *order), problem.tracks)[0]
        np.testing.assert_allclose(found[0, :, 0], 1.0, rtol=1e-6)
