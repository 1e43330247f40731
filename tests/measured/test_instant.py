"""Problems without roll-outs: means without what is masked, commands that come late, forces led back to commands."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured.delivered import delivered
from nfc_gym.measured.forward import ForwardProblem
from nfc_gym.measured.inverse import InverseProblem
from nfc_gym.measured.metric import metric
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.effects import FAMILIES, build, propose
from nfc_gym.physics.effects.base import Effect, Scales
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

STEP, SD = 0.004, 0.1
MOTOR = '<motor name="motor" joint="slide"/>'


def cart(actuator: str = MOTOR) -> mujoco.MjModel:
    """1 kg on a slide, with an accelerometer: it shows the force that pushes."""
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{STEP}" gravity="0 0 0"/><worldbody><body>
  <joint name="slide" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/><site name="s"/>
</body></worldbody>
<actuator>{actuator}</actuator><sensor><accelerometer name="acc" site="s"/></sensor></mujoco>""")


def pushed(u: np.ndarray, dt: float, **channel: object) -> Log:
    """Commands of a cart that nobody watches move; its accelerometer is read along x."""
    rest = np.zeros(len(u))
    channels = {
        "joint:slide:pos": Channel(rest, "m", 1e-3),
        "joint:slide:vel": Channel(rest, "m/s", 1e-3),
        "sensor:acc": Channel(u[:, None], "m/s^2", SD, axes=(0,), **channel),  # type: ignore[arg-type]
    }
    return Log("cart", dt * np.arange(len(u)), {"ctrl:motor": u}, channels)


def plant_of(model: mujoco.MjModel, *effects: Effect, psi: tuple[Parameter, ...] = ()) -> Plant:
    return Plant(model, ParameterSpace(model, psi), effects, nthread=1)


def forward(model: mujoco.MjModel, log: Log, *pairs: tuple, linear: bool = False) -> np.ndarray:
    """(T,) what the accelerometer is predicted to read."""
    which = frozenset({"ctrl:motor"} if linear else ())
    problem = ForwardProblem(model, [log], [estimate_states(model, log)], 0.2, 1, which)
    x = np.concatenate([np.zeros(0), *(theta for _, theta in pairs)])
    return problem.along(plant_of(model, *(e for e, _ in pairs)), x[None], problem.tracks)[0][0, :, 0]


@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize("bad", [99.0, np.nan, -1e6])
def test_what_stands_in_masked_rows_does_not_matter(bad: float, stride: int) -> None:
    rng = np.random.default_rng(0)
    u, mask = np.sin(np.arange(600) * 0.05), rng.random(600) > 0.2
    mask[100:130] = False
    model = cart()
    found = []
    for wrong in (u, np.where(mask, u, bad)):
        log = pushed(u, STEP, smooth=9, mask=mask)
        values = (wrong + SD * np.random.default_rng(1).normal(size=600))[:, None]
        log = replace(log, channels=log.channels | {"sensor:acc": replace(log.channels["sensor:acc"], values=values)})
        problem = ForwardProblem(model, [log], [estimate_states(model, log)], 0.2, stride)
        plant = plant_of(model)
        found.append((problem.residual(plant, plant.null[None]), problem.covariance(plant, plant.null)))
    for good, other in zip(*found, strict=True):
        np.testing.assert_array_equal(good, other)


def test_whitening_knows_how_many_samples_a_mean_is_of() -> None:
    """At the ends of a log and beside masked rows as elsewhere: unit variance over 150 draws of the noise."""
    rng = np.random.default_rng(2)
    u, mask = np.sin(np.arange(60) * 0.05), np.ones(60, bool)
    mask[[*range(20, 26), *range(30, 33), 40, 42, 44]] = False
    model = cart()
    log = pushed(u, STEP, smooth=9, mask=mask)
    plant = plant_of(model)
    problem = ForwardProblem(model, [log], [estimate_states(model, log)], 14 * 4 * STEP)
    white, x = metric(problem, problem.covariance(plant, plant.null)).whiten, plant.null
    draws = [white(problem.synthetic(plant, x, rng).residual(plant, x[None]))[0][problem.mask] for _ in range(150)]
    spread = np.std(draws, 0)
    assert len(spread) >= 9
    np.testing.assert_allclose(spread, 1, atol=0.2)


@pytest.mark.parametrize("smooth", [1, 6, 21])
def test_a_measured_acceleration_is_averaged_to_its_ends(smooth: int) -> None:
    """A steady rise is its own mean, where windows reach as far to either side; masked rows are bridged."""
    t = np.linspace(0, 0.79, 80)
    mask = np.ones(80, bool)
    mask[[10, 11, 50]] = False
    rise = 2.0 + 3.0 * t
    channels = {
        "joint:slide:vel": Channel(np.sin(t), "m/s", 1e-3),
        "joint:slide:acc": Channel(np.where(mask, rise, np.nan), "m/s^2", smooth=smooth, mask=mask),
    }
    found = estimate_states(cart(), Log("rise", t, {}, channels)).qacc[:, 0]
    # an even window has no middle: half a sample earlier
    np.testing.assert_allclose(found, rise, atol=1e-9 if smooth % 2 else 3.0 * 0.005 + 1e-9)


@pytest.mark.parametrize("dt", [0.001, 0.002, 0.004])
def test_native_delays_are_whole_where_the_log_is_faster_than_the_physics(dt: float) -> None:
    model = cart('<motor name="motor" joint="slide" delay="0.02" nsample="6" interp="linear"/>')
    u = np.random.default_rng(3).normal(size=200)
    late = round(0.02 / dt)
    np.testing.assert_allclose(forward(model, pushed(u, dt))[late:], u[:-late], atol=1e-9)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("native", [False, True])
def test_commands_go_on_between_rows_as_their_hold_says(native: bool, linear: bool) -> None:
    """Rows every 40 ms, and what came 28 ms ago."""
    late = 7 * STEP
    actuator = MOTOR.replace("/>", f' delay="{late}" nsample="9"/>') if native else MOTOR
    pairs = () if native else (build("delay", "motor", {"delay": late}),)
    log = pushed(np.random.default_rng(4).normal(size=50), 10 * STEP)
    u = log.controls["ctrl:motor"]
    wanted = np.interp(log.time - late, log.time, u) if linear else np.concatenate([u[:1], u[:-1]])
    np.testing.assert_allclose(forward(cart(actuator), log, *pairs, linear=linear), wanted, atol=1e-9)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize(
    "actuator",
    [
        '<general name="motor" joint="slide" dyntype="filterexact" dynprm="0.05"/>',
        '<general name="motor" joint="slide" dyntype="filterexact" dynprm="0.05" actrange="-.3 .3" actlimited="true"/>',
        '<general name="motor" joint="slide" dyntype="integrator" actrange="-.05 .05" actlimited="true"/>',
        '<general name="motor" joint="slide" dyntype="integrator" actrange="-9 9" actlimited="true"/>',
    ],
)
def test_activations_get_to_where_steps_of_the_physics_lead_them(actuator: str, linear: bool) -> None:
    """Within their bounds at once, beyond them step by step."""
    log = pushed(np.random.default_rng(5).normal(size=40), 5 * STEP)
    u = log.controls["ctrl:motor"]
    keep, act = np.exp(-STEP / 0.05), np.clip(u[0], -0.3, 0.3) if "-.3" in actuator else u[0]
    bound = 0.3 if "-.3" in actuator else 0.05 if "-.05" in actuator else np.inf
    sums = "integrator" in actuator
    act, wanted = 0.0 if sums else act, []
    for k in range(40):
        wanted.append(act)
        for part in range(5):
            wish = u[k] + (part / 5 * (u[min(k + 1, 39)] - u[k]) if linear else 0.0)
            act = np.clip(act + STEP * wish if sums else wish + keep * (act - wish), -bound, bound)
    np.testing.assert_allclose(forward(cart(actuator), log, linear=linear), wanted, atol=1e-9)


LATE = (
    '<general name="motor" joint="slide" dyntype="filterexact" dynprm="{tau}" delay="{delay}" nsample="9"'
    ' interp="linear" ctrlrange="-{most} {most}" ctrllimited="true"/>'
)
OF_LATE = {"tau": ("actuator_dynprm[0]", 0.01, 0.5), "delay": ("actuator_delay", 0.0, 0.03)}
OF_LATE["most"] = ("actuator_ctrlrange[1]", 0.1, 9.0)


@pytest.mark.parametrize(("name", "values"), [("tau", (0.05, 0.2)), ("delay", (0.012, 0.027)), ("most", (0.4, 1.3))])
def test_what_leads_the_models_own_filters_may_be_a_parameter(name: str, values: tuple[float, float]) -> None:
    """It then does what it does as written in the model, in several parameter vectors at once."""
    nominal = {"tau": 0.03, "delay": 0.02, "most": 2.0}
    log = pushed(np.random.default_rng(8).normal(size=60) ** (2 if name == "most" else 1), 5 * STEP)
    field, low, high = OF_LATE[name]
    plant = plant_of(cart(LATE.format(**nominal)), psi=(Parameter(name, field, ("motor",), "1", low, high),))
    problem = ForwardProblem(plant.model, [log], [estimate_states(plant.model, log)], 0.2, 1)
    found = problem.along(plant, np.array(values)[:, None], problem.tracks)[0][..., 0]
    for value, own in zip(values, found, strict=True):
        wanted = forward(cart(LATE.format(**{**nominal, name: value})), log)
        np.testing.assert_allclose(own, wanted, atol=1e-9)


def test_parameter_vectors_that_differ_in_what_no_command_feels_share_their_commands() -> None:
    model = cart()
    mass = Parameter("mass", "actuator_gainprm[0]", ("motor",), "1", 0.1, 9.0)
    lag, _ = build("lag", "motor", {"time_constant": 0.03})
    plant = plant_of(model, FAMILIES["damping_poly"](("slide",)), lag, psi=(mass,))
    logs = [pushed(np.random.default_rng(6 + n).normal(size=n), 2 * STEP) for n in (40, 25)]
    problem = ForwardProblem(model, logs, [estimate_states(model, log) for log in logs], 0.05)
    x = np.array([[1.0, 0, 0, 0, 0.03], [2.0, 0, 0, 0, 0.01], [3.0, 1, 2, 3, 0.03], [1.0, 0, 0, 0, 0.0]])
    together = delivered(plant, x, problem.tracks)
    for row in range(len(x)):
        for alone, of in zip(delivered(plant, x[[row]], problem.tracks), together, strict=True):
            np.testing.assert_array_equal(alone.ctrl[0], of.ctrl[row])
    np.testing.assert_array_equal(together[0].ctrl[3, :, 0], logs[0].controls["ctrl:motor"])


@pytest.mark.parametrize("order", [1, -1])
def test_an_offset_is_undone_under_the_gain_that_it_met(order: int) -> None:
    """A fitted strength s and a gain g: the motion needs s g (u + offset), and commanded was s u."""
    model, t = cart(), np.arange(100) * 0.01
    log = Log("still", t, {}, {
        "joint:slide:acc": Channel(np.full(100, 3.0), "m/s^2"), "joint:slide:vel": Channel(0 * t, "m/s", 1e-3),
        "force:motor": Channel(0 * t, "N", 1e-3),
    })  # fmt: skip
    pairs = [build("offset", "motor", {"offset": 0.3}), build("gain", "motor", {"gain": 0.5})][::order]
    strength = Parameter("strength", "actuator_gainprm[0]", ("motor",), "1", 0.1, 9.0)
    plant = plant_of(model, *(e for e, _ in pairs), psi=(strength,))
    problem = InverseProblem(model, [log], [estimate_states(model, log)], 0.2)
    x = np.concatenate([[4.0], *(theta for _, theta in pairs)])
    found = problem.along(plant, x[None], problem.tracks)[0][0, :, 0]
    np.testing.assert_allclose(found, 3.0 / 0.5 - 4.0 * 0.3, atol=1e-9)


def test_effects_that_follow_the_drives_own_force_say_so() -> None:
    """No inverse problem shows them: it knows what the motion needs, and never what a command would have made."""
    model = cart('<motor name="motor" joint="slide" forcerange="-1 1"/>')
    scales = Scales(np.ones(1), np.ones(1), np.ones(1), np.ones(1), 0.01)
    assert {e.family for e in propose(model, scales) if e.driven} == {"torque_speed"}
