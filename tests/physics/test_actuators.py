"""Effects on commands and on what actuators make of them, against closed forms."""

import copy
from collections.abc import Sequence
from functools import partial

import mujoco
import numpy as np
import pytest
from machines import make, plant_of, run

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import Context, Effect, Scales, build, propose
from nfc_gym.physics.effects.each import each
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.segments import Segments

DT, MASS = 0.002, 2.0
RAIL = f"""
<mujoco><option timestep="{DT}" gravity="0 0 0"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
<geom type="sphere" size=".1" mass="{MASS}"/></body></worldbody>
<actuator><motor name="push" joint="rail" gear="2" ctrlrange="-5 5"/></actuator>
<sensor><actuatorfrc name="made" actuator="push"/></sensor></mujoco>"""


def _made(family: str, parameters: dict[str, float], ctrl: np.ndarray, history: int = 0, **more: object) -> np.ndarray:
    """Force that the motor makes at every step."""
    effect, theta = make(family, "push", parameters)
    t = run(RAIL, effect, theta, len(ctrl) - history, ctrl=ctrl[:, None], history=history, **more)  # type: ignore[arg-type]
    assert t.sensordata is not None
    return t.sensordata[0, 0, :-1, 0]


def _bound(family: str, parameters: dict[str, float], text: str = RAIL) -> tuple[Effect, np.ndarray]:
    """The effect at the motor of a rail, bound to it."""
    effect, theta = build(family, "push", parameters)
    effect.bind(mujoco.MjModel.from_xml_string(text))
    return effect, theta


def _with(actuator: str) -> str:
    """The rail with another actuator."""
    return RAIL.replace('<motor name="push" joint="rail" gear="2" ctrlrange="-5 5"/>', actuator)


def _pushed(text: str, rows: Sequence[tuple[str, dict[str, float]]], ctrl: np.ndarray) -> np.ndarray:
    """Force that the actuator of a rail makes at every step under effects, in their order."""
    effects, thetas = zip(*(build(family, "push", given) for family, given in rows), strict=True)
    model = mujoco.MjModel.from_xml_string(text)
    segments = Segments(DT, 0, np.zeros((1, 1)), np.zeros((1, 1)), ctrl[None, :, None])
    t = plant_of(model, *effects).shoot(np.concatenate(thetas)[None], segments, sensors=True)
    assert t.sensordata is not None
    return t.sensordata[0, 0, :-1, 0]


RNG = np.random.default_rng(5)
NOISE = RNG.uniform(-4, 4, 60)


def test_gain_and_loss_scale_the_force() -> None:
    np.testing.assert_allclose(_made("gain", {"gain": 1.3}, NOISE), 1.3 * NOISE)
    np.testing.assert_allclose(_made("loss", {"fraction": 0.4}, NOISE), 0.6 * NOISE)
    np.testing.assert_array_equal(_made("loss", {"fraction": 1.0}, NOISE), 0 * NOISE)


@pytest.mark.parametrize(("fraction", "names"), [(0.4, ("gain",)), (0.9, ())])
def test_a_loss_is_a_gain_below_one_by_another_name(fraction: float, names: tuple[str, ...]) -> None:
    loss, gain = build("loss", "push", {"fraction": fraction})[0], build("gain", "push", {"gain": 1.0})[0]
    assert loss.known_as(np.array([fraction])) == names  # a gain below 0.2 is no gain
    assert gain.known_as(np.array([1 - fraction])) == ("loss",)
    assert gain.known_as(np.array([1 + fraction])) == ()


def test_gain_scales_a_servo_as_a_whole() -> None:
    """Half the force of a position servo at any state, its limit included: not half the target."""
    text = RAIL.replace(
        '<motor name="push" joint="rail" gear="2" ctrlrange="-5 5"/>',
        '<position name="push" joint="rail" kp="30" kv="2" forcerange="-8 8"/>',
    )
    effect, theta = make("gain", "push", {"gain": 0.5})
    for q, v, u in ((0.1, 0.3, 0.2), (-0.4, -1.0, 0.5), (0.0, 0.0, 2.0)):
        arguments = {"qpos": np.array([q]), "qvel": [v], "ctrl": [u]}
        half = run(text, effect, theta, 1, **arguments).sensordata
        full = run(text, None, [], 1, **arguments).sensordata
        assert half is not None
        assert full is not None
        assert half[0, 0, 0, 0] == pytest.approx(0.5 * full[0, 0, 0, 0], rel=1e-12)


def test_a_servo_of_another_gear_answers_a_scaled_command_with_the_stiffness_it_had() -> None:
    speed = _with('<velocity name="push" joint="rail" kv="3"/>')
    made = _pushed(speed, [("command_gain", {"gain": 0.8})], NOISE)
    velocity = np.r_[0, np.cumsum(made[:-1]) * DT / MASS]  # of the first steps, in which nothing else acts
    np.testing.assert_allclose(made[:3], 3 * (0.8 * NOISE - velocity)[:3], rtol=2e-2)
    rest = np.full(4000, 1.0)
    np.testing.assert_allclose(_pushed(speed, [("command_gain", {"gain": 0.8})], rest)[-1], 0, atol=1e-2)  # 0.8 m/s


def test_servos_alone_have_a_gain_of_their_command() -> None:
    three = """<motor name="torque" joint="rail"/><velocity name="speed" joint="rail" kv="1"/>
    <general name="volts" joint="rail" biastype="affine" biasprm="0 0 -2"/>"""
    model = mujoco.MjModel.from_xml_string(_with(three).replace('actuator="push"', 'actuator="torque"'))
    one = np.ones(1)
    proposed = propose(model, Scales(one, one, np.ones(3), np.ones(3), 0.01), only=["command_gain"], generic=False)
    assert {name for e in proposed for name in e.where} == {"speed", "volts"}


def test_offset_and_dead_zone_shift_the_command() -> None:
    np.testing.assert_allclose(_made("offset", {"offset": 0.7}, NOISE), NOISE + 0.7)
    dead = _made("dead_zone", {"width": 1.0}, NOISE)
    np.testing.assert_allclose(dead, np.sign(NOISE) * np.maximum(np.abs(NOISE) - 1.0, 0))


def test_saturation_removes_its_share_of_the_range() -> None:
    np.testing.assert_allclose(_made("saturation", {"removed": 0.5}, NOISE), np.clip(NOISE, -2.5, 2.5))
    np.testing.assert_allclose(_made("saturation", {"inverse_limit": 0.5}, NOISE), np.clip(NOISE, -2, 2))


def test_saturation_of_an_unlimited_command_is_refused() -> None:
    effect, _ = make("saturation", "push", {"removed": 0.5})
    with pytest.raises(InputError, match="range"):
        effect.bind(mujoco.MjModel.from_xml_string(RAIL.replace('ctrlrange="-5 5"', "")))


def test_lag_answers_a_step_exponentially() -> None:
    tau = 0.03
    ctrl = np.r_[np.zeros(10), np.ones(80)]
    time = np.arange(1, 81) * DT
    made = _made("lag", {"time_constant": tau}, ctrl)
    np.testing.assert_array_equal(made[:10], 0)
    np.testing.assert_allclose(made[10:], 1 - np.exp(-time / tau), atol=1e-12)


def test_lag_starts_in_the_state_that_history_left() -> None:
    """History's commands live on in the start; without history the first command is held since ever."""
    tau = 0.03
    made = _made("lag", {"time_constant": tau}, np.r_[np.zeros(5), np.ones(20), np.zeros(30)], history=25)
    left = 1 - np.exp(-20 * DT / tau)
    np.testing.assert_allclose(made, left * np.exp(-np.arange(1, 31) * DT / tau), atol=1e-12)
    np.testing.assert_allclose(_made("lag", {"time_constant": tau}, np.full(20, 2.0)), 2.0)


def test_lag_is_the_native_filter() -> None:
    """The same commands through MuJoCo's own exact filter: same force at every step."""
    spec = mujoco.MjSpec.from_string(RAIL)
    effect, theta = _bound("lag", {"time_constant": 0.05})
    assert effect.spec(spec, theta)
    native = run(spec.compile(), None, [], 60, ctrl=10 * NOISE[:, None]).sensordata  # beyond the command range, too
    assert native is not None
    np.testing.assert_allclose(_made("lag", {"time_constant": 0.05}, 10 * NOISE), native[0, 0, :-1, 0], atol=1e-12)


def test_delay_shifts_and_interpolates() -> None:
    whole = _made("delay", {"delay": 7 * DT}, NOISE)
    np.testing.assert_allclose(whole[7:], NOISE[:-7], atol=1e-9)
    np.testing.assert_allclose(whole[:7], NOISE[0], atol=1e-9)
    part = _made("delay", {"delay": 2.25 * DT}, NOISE)
    np.testing.assert_allclose(part[3:], 0.75 * NOISE[1:-2] + 0.25 * NOISE[:-3], atol=1e-9)
    with_history = _made("delay", {"delay": 7 * DT}, NOISE, history=10)
    np.testing.assert_allclose(with_history, NOISE[3:-7], atol=1e-9)


@pytest.mark.parametrize("delay", [1, 3, 4.5])
def test_delay_is_the_native_one(delay: float) -> None:
    """From rest at zero command MuJoCo's own buffer gives the same, also between two steps."""
    ctrl = np.r_[np.zeros(10), NOISE]
    spec = mujoco.MjSpec.from_string(RAIL)
    effect, theta = _bound("delay", {"delay": delay * DT})
    assert effect.spec(spec, theta)
    native = run(spec.compile(), None, [], len(ctrl), ctrl=ctrl[:, None]).sensordata
    assert native is not None
    np.testing.assert_allclose(_made("delay", {"delay": delay * DT}, ctrl), native[0, 0, :-1, 0], atol=1e-9)


def test_delay_shorter_than_a_step_is_not_native() -> None:
    effect, theta = _bound("delay", {"delay": DT / 2})
    assert not effect.spec(mujoco.MjSpec.from_string(RAIL), theta)


def test_rows_of_one_batch_keep_their_own_delays() -> None:
    model = mujoco.MjModel.from_xml_string(RAIL)
    effect, _ = make("delay", "push", {"delay": 0.0})
    segments = Segments(DT, 0, np.zeros((1, 1)), np.zeros((1, 1)), NOISE[None, :, None])
    delays = np.array([[0.0], [3 * DT], [8 * DT]])
    t = plant_of(model, effect).shoot(delays, segments, sensors=True)
    for row, steps in enumerate((0, 3, 8)):
        assert t.sensordata is not None
        np.testing.assert_allclose(t.sensordata[row, 0, steps:-1, 0], NOISE[: 60 - steps], atol=1e-9)


def test_torque_speed_line_limits_driving_but_not_braking() -> None:
    """peak 5: at fall * speed = 0.6 a driving force is at most 2, a braking one still 5."""
    heavy = RAIL.replace(f'mass="{MASS}"', 'mass="1e6"')
    effect, theta = make("torque_speed", "push", {"fall": 0.3})
    effect_of = lambda u, v: run(heavy, effect, theta, 5, qvel=[v], ctrl=[u]).qvel[0, 0, :, 0]  # noqa: E731
    force = lambda u, v: np.diff(effect_of(u, v))[1:] / DT * 1e6 / 2  # noqa: E731
    np.testing.assert_allclose(force(5.0, 2.0), 2.0, rtol=1e-3)
    np.testing.assert_allclose(force(1.5, 2.0), 1.5, rtol=1e-3)
    np.testing.assert_allclose(force(-5.0, 2.0), -5.0, rtol=1e-3)
    np.testing.assert_allclose(force(-5.0, -2.0), -2.0, rtol=1e-3)
    np.testing.assert_allclose(force(5.0, 0.0), 5.0, rtol=1e-3)


@pytest.mark.parametrize("inertia", [0.3, 0.05, 1e-3])
@pytest.mark.parametrize("gear", [2.0, -0.5])
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_no_joint_is_driven_beyond_its_no_load_speed(inertia: float, gear: float, integrator: str) -> None:
    """However light it is: a mass of 1 g would take 10 N through a step of 2 ms to 20 m/s, and the line ends at 3."""
    text = RAIL.replace(f'mass="{MASS}"', f'mass="{inertia}"').replace('gear="2"', f'gear="{gear}"')
    text = text.replace("<option", f'<option integrator="{integrator}"')
    effect, theta = make("torque_speed", "push", {"fall": 1 / 3})
    steps = max(100, round(10_000 * inertia))  # seven time constants under the least of the pushes
    for u in (5.0, -5.0, 2.0):
        v = run(text, effect, theta, steps, ctrl=[u]).qvel[0, 0, :, 0] * np.sign(u * gear)
        assert v.max() <= 3 + 1e-9
        assert v[-1] == pytest.approx(3.0, rel=1e-2)


def test_a_light_joint_holds_a_load_with_all_of_its_force() -> None:
    """At rest, and at a speed that a load holds, the line is what it says, also where a step could cross it."""
    text = RAIL.replace(f'mass="{MASS}"', 'mass="1e-3" ').replace('axis="1 0 0"', 'axis="1 0 0" damping="4"')
    effect, theta = make("torque_speed", "push", {"fall": 1 / 3})
    v = run(text, effect, theta, 500, ctrl=[5.0]).qvel[0, 0, -1, 0]
    assert 4 * v == pytest.approx(10 * (1 - v / 3), rel=1e-6)
    held = text.replace('damping="4"', 'damping="1" stiffness="100"')
    assert run(held, effect, theta, 2000, ctrl=[5.0]).qpos[0, 0, -1, 0] == pytest.approx(0.1, rel=1e-6)


def test_supply_sag_follows_the_measured_voltage() -> None:
    volts = np.linspace(12.6, 9.0, 60)
    made = _made("supply_sag", {"exponent": 2.0, "reference": 12.0}, NOISE, exogenous={"exo:supply": volts})
    np.testing.assert_allclose(made, NOISE * (volts / 12.0) ** 2, rtol=1e-12)


def test_supply_sag_by_time_falls_evenly_and_never_turns_round() -> None:
    time = np.linspace(0, 30, 61)
    made = _made("supply_sag", {"rate": 0.04}, np.full(61, 2.0), exogenous={"exo:time": time})
    np.testing.assert_allclose(made, 2 * np.maximum(1 - 0.04 * time, 1e-6), rtol=1e-12)


def test_supply_sag_by_time_is_looked_for_only_by_name_and_without_a_voltage() -> None:
    model, one = mujoco.MjModel.from_xml_string(RAIL), np.ones(1)

    def found(signals: dict[str, float], *only: str) -> list[list[str]]:
        scales = Scales(one, one, one, one, 0.01, {"exo:time": 1.0} | signals)
        effects = propose(model, scales, only=only, generic=False)
        return [[p.name for p in e.params] for e in effects if e.family == "supply_sag"]

    assert found({}) == found({}, "loss") == []
    assert found({}, "loss", "supply_sag") == [["rate"]]
    assert found({"exo:supply": 12.0}, "supply_sag") == [["exponent", "reference"]]
    effect, _ = make("supply_sag", "push", {"rate": 0.04})
    assert (effect.signals, effect.settings) == (("exo:time",), {})
    every, _ = make("supply_sag", "all", {"rate": 0.04})
    every.bind(model)
    assert every.where == ("push",)


def test_supply_sag_without_a_voltage_says_so() -> None:
    with pytest.raises(InputError, match="exo:supply"):
        _made("supply_sag", {"exponent": 2.0, "reference": 12.0}, NOISE)


def _moment(model: mujoco.MjModel, signals: dict[str, np.ndarray]) -> Context:
    """What `demand` reads of a log whose state does not matter."""
    nothing, nominal = np.zeros(0), partial(getattr, model)
    return Context(model, DT, nothing, nothing, nothing, signals, nominal, nominal)


@pytest.mark.parametrize(
    ("family", "parameters"),
    [
        ("gain", {"gain": 1.3}),
        ("loss", {"fraction": 0.4}),
        ("offset", {"offset": 0.3}),
        ("supply_sag", {"exponent": 1.0, "reference": 12.0}),
        ("supply_sag", {"rate": 0.5}),
        ("lag", {"time_constant": 0.02}),
        ("delay", {"delay": 0.01}),
    ],
)
def test_demand_inverts_the_effect(family: str, parameters: dict[str, float]) -> None:
    """From the force that was made back to the command (a smooth one, so that rates can be taken), ends aside."""
    time = np.arange(400) * DT
    ctrl = 2 * np.sin(6 * time)
    volts = 12.6 - time
    signals = {"exo:supply": volts, "exo:time": time}
    made = _made(family, parameters, ctrl, exogenous=signals)
    effect, theta = make(family, "push", parameters)
    model = mujoco.MjModel.from_xml_string(RAIL)
    effect.bind(model)
    back = effect.demand(made[:, None], theta, _moment(model, signals))[:, 0]
    np.testing.assert_allclose(back[50:-50], ctrl[50:-50], atol=0.02)


def test_thermal_fades_a_step_as_it_heats_up() -> None:
    """After a step to the reference the heat rises as 1 - exp(-t / tau), and the force falls with it."""
    ctrl = np.r_[np.zeros(5), np.full(100, 2.0)]
    made = _made("thermal", {"fade": 0.3, "time_constant": 0.1, "reference": 2.0}, ctrl)
    time = np.arange(1, 101) * DT
    np.testing.assert_allclose(made[5:], 2 * (1 - 0.3 * (1 - np.exp(-time / 0.1))), atol=1e-12)


def test_a_drive_that_is_too_hot_gives_nothing_and_never_turns_round() -> None:
    """At 1.5 times the reference the heat goes to 2.25, beyond the 1 / 0.6 at which the last of the force is gone."""
    made = _made("thermal", {"fade": 0.6, "time_constant": 0.02, "reference": 1.0}, np.r_[0.0, np.full(100, 1.5)])
    assert made[1] > 1
    assert (made >= 0).all()
    np.testing.assert_array_equal(made[-20:], 0)


def test_heat_and_sag_are_not_looked_for_in_goals_of_position_servos() -> None:
    text = RAIL.replace("</actuator>", '<position name="hold" joint="rail" kp="3"/></actuator>')
    model, one = mujoco.MjModel.from_xml_string(text), np.ones(1)
    scales = Scales(one, one, np.ones(2), np.ones(2), 0.01, {"exo:supply": 12.0})
    found = {e.id for e in propose(model, scales, only=("thermal", "supply_sag", "dead_zone"), generic=False)}
    assert found == {"thermal:push", "supply_sag:push", "dead_zone:push"}


@pytest.mark.parametrize(
    ("family", "parameters", "signals", "wanted"),
    [
        ("dead_zone", {"width": 0.4}, {}, 4.6),
        ("supply_sag", {"exponent": 1.0, "reference": 12.0}, {"exo:supply": np.full(9, 9.0)}, 3.75),
        ("thermal", {"fade": 0.3, "time_constant": 0.1, "reference": 5.0}, {}, 3.5),
    ],
)
def test_a_drive_is_given_no_more_than_its_range(
    family: str, parameters: dict[str, float], signals: dict[str, np.ndarray], wanted: float
) -> None:
    """MuJoCo clips a command of 9 to 5: a drive loses of the 5, and is heated by them alone."""
    np.testing.assert_allclose(_made(family, parameters, np.full(9, 9.0), exogenous=signals), wanted)


def test_of_delays_that_differ_the_model_carries_all_or_none() -> None:
    """MJCF has no delay shorter than a step: were the longer one in the model, it would act there and beside it."""
    two = RAIL.replace("</actuator>", '<motor name="pull" joint="rail"/></actuator>')
    spec = mujoco.MjSpec.from_string(two)
    both = each([build("delay", name, {"delay": 0.0})[0] for name in ("push", "pull")])
    both.bind(mujoco.MjModel.from_xml_string(two))
    assert not both.spec(spec, np.array([DT / 2, 0.03]))
    assert [a.delay for a in spec.actuators] == [0, 0]
    assert both.spec(spec, np.array([0.02, 0.03]))
    assert [a.delay for a in spec.actuators] == [0.02, 0.03]


def test_wires_that_are_swapped_turn_the_force_and_its_limits_round() -> None:
    """A force range of -1 to 3 N becomes one of -3 to 1 N."""
    text = _with('<motor name="push" joint="rail" forcerange="-1 3"/>')
    expected = -np.clip(NOISE, -1, 3)
    np.testing.assert_allclose(_pushed(text, [("gain", {"gain": -1.0})], NOISE), expected)
    effect, theta = _bound("gain", {"gain": -1.0}, text)
    spec = mujoco.MjSpec.from_string(text)
    assert effect.spec(spec, theta)
    np.testing.assert_allclose(
        run(spec.compile(), None, [], 60, ctrl=NOISE[:, None]).sensordata[0, 0, :-1, 0], expected
    )
    back = effect.demand(expected[:, None], theta, _moment(mujoco.MjModel.from_xml_string(text), {}))
    np.testing.assert_allclose(back[:, 0], -expected)


def test_a_dead_motor_with_a_limit_is_native() -> None:
    """MJCF has no force range of zero width."""
    text = _with('<motor name="push" joint="rail" forcerange="-2 2" forcelimited="true"/>')
    effect, theta = _bound("loss", {"fraction": 1.0}, text)
    spec = mujoco.MjSpec.from_string(text)
    assert effect.spec(spec, theta)
    made = run(spec.compile(), None, [], 60, ctrl=NOISE[:, None]).sensordata
    assert made is not None
    np.testing.assert_array_equal(made, 0)


SATURATIONS = [{"inverse_limit": 1 / 0.5}, {"inverse_limit": 1 / 100.0}]


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("given", ["", 'forcerange="-9 9"', 'forcerange="-.1 .1" forcelimited="false"'])
def test_of_two_limits_on_a_force_the_stricter_counts(given: str, order: int) -> None:
    text = _with(f'<motor name="push" joint="rail" {given}/>')
    rows = [("saturation", limit) for limit in SATURATIONS[::order]]
    np.testing.assert_allclose(_pushed(text, rows, NOISE), np.clip(NOISE, -0.5, 0.5))
    spec = mujoco.MjSpec.from_string(text)
    for family, limit in rows:
        effect, theta = _bound(family, limit, text)
        assert effect.spec(spec, theta)
    np.testing.assert_allclose(spec.compile().actuator_forcerange[0], [-0.5, 0.5])


def test_what_is_cut_and_then_shifted_is_so_in_the_model_too() -> None:
    """The effect that acts first goes into the spec last; clip(u, -3, 3) + 2.5 is itself clipped at 5."""
    rows = [("saturation", {"removed": 0.4}), ("offset", {"offset": 2.5})]
    spec = mujoco.MjSpec.from_string(RAIL)
    for family, given in reversed(rows):
        effect, theta = _bound(family, given)
        assert effect.spec(spec, theta)
    expected = np.minimum(np.clip(NOISE, -3, 3) + 2.5, 5)
    np.testing.assert_allclose(_pushed(RAIL, rows, NOISE), expected)
    native = run(spec.compile(), None, [], 60, ctrl=NOISE[:, None]).sensordata
    assert native is not None
    np.testing.assert_allclose(native[0, 0, :-1, 0], expected)


def test_a_range_without_width_is_not_native() -> None:
    effect, theta = _bound("saturation", {"removed": 1.0})
    spec = mujoco.MjSpec.from_string(RAIL)
    assert not effect.spec(spec, theta)
    assert list(spec.actuator("push").ctrlrange) == [-5, 5]


@pytest.mark.parametrize(
    ("actuator", "native"),
    [
        ('<general name="push" joint="rail" gaintype="affine" gainprm="1 .8 .1" ctrlrange="-2 2"/>', True),
        ('<general name="push" joint="rail" dyntype="filterexact" dynprm=".1" actrange="-2 1.5"/>', True),
        ('<position name="push" joint="rail" kp="9" kv="1" ctrlrange="-3 3"/>', True),
        ('<intvelocity name="push" joint="rail" kp="10" actrange="-2 2"/>', False),
        ('<general name="push" joint="rail" dyntype="integrator"/>', False),
    ],
)
@pytest.mark.parametrize("row", [("offset", {"offset": 0.7}), ("command_gain", {"gain": 1.4})])
def test_what_is_done_to_a_command_is_native_where_mjcf_can_say_it(
    actuator: str, native: bool, row: tuple[str, dict[str, float]]
) -> None:
    text = _with(actuator)
    effect, theta = _bound(*row, text)
    spec = mujoco.MjSpec.from_string(text)
    before = spec.to_xml()
    assert effect.spec(spec, theta) == native
    if not native:
        assert spec.to_xml() == before
        return
    runs = [
        run(model, own, values, 60, ctrl=NOISE[:, None])
        for model, own, values in ((spec.compile(), None, []), (mujoco.MjModel.from_xml_string(text), effect, theta))
    ]
    np.testing.assert_allclose(runs[0].qpos, runs[1].qpos, atol=1e-12)
    assert np.abs(runs[0].qpos).max() > 1e-4


def test_a_lag_or_delay_is_not_native_in_a_step_of_stages() -> None:
    staged = RAIL.replace('gravity="0 0 0"', 'gravity="0 0 0" integrator="RK4"')
    for family, given in (("lag", {"time_constant": 0.05}), ("delay", {"delay": 0.05})):
        effect, theta = _bound(family, given, staged)
        assert not effect.spec(mujoco.MjSpec.from_string(staged), theta)


def test_a_lag_before_a_tighter_limit_is_not_native() -> None:
    """MuJoCo clips what it filters, and not what the filter gives."""
    spec = mujoco.MjSpec.from_string(RAIL)
    cut, share = _bound("saturation", {"removed": 0.4})
    lag, tau = _bound("lag", {"time_constant": 0.05})
    assert cut.spec(spec, share)
    assert not lag.spec(spec, tau)


TWO = """
<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
<body><joint name="first" axis="0 1 0"/><geom size=".1" mass="1" pos=".2 0 0"/></body>
<body pos="1 0 0"><joint name="second" axis="0 1 0"/><geom size=".1" mass="1" pos=".2 0 0"/></body></worldbody>
<tendon><fixed name="belt"><joint joint="second" coef="2"/></fixed></tendon>
<actuator><motor name="drive" {0} ctrlrange="-1 1"/></actuator></mujoco>"""


def test_the_torque_speed_line_of_a_belt_is_that_of_the_joint_it_moves() -> None:
    """A fixed tendon that goes twice as fast as its joint is a gear of two, and no-load speed is that of the belt."""
    ends = {}
    for name, wiring, fall in (("belt", 'tendon="belt"', 0.3), ("gear", 'joint="second" gear="2"', 0.6)):
        effect, theta = build("torque_speed", "drive", {"fall": fall})
        t = run(TWO.format(wiring), effect, theta, 1500, qvel=[1.0, 0.0], ctrl=1.0)
        ends[name] = t.qvel[0, 0, -1]
    np.testing.assert_allclose(ends["belt"], ends["gear"], atol=1e-9)
    np.testing.assert_allclose(ends["belt"], [1.0, 1 / 0.6], rtol=1e-3)


def test_a_torque_speed_line_wants_a_speed() -> None:
    text = TWO.replace("</body></worldbody>", '<site name="tip"/></body></worldbody>').format('site="tip" gear="0 0 1"')
    effect, _ = build("torque_speed", "drive", {"fall": 0.3})
    with pytest.raises(InputError, match="moves no hinge"):
        effect.bind(mujoco.MjModel.from_xml_string(text))


def test_a_limit_is_not_looked_for_where_nothing_pushes() -> None:
    model = mujoco.MjModel.from_xml_string(_with('<position name="push" joint="rail" kp="30"/>'))
    one = np.ones(1)
    for push, found in ((0.0, 0), (2.0, 1)):
        proposed = propose(model, Scales(one, one, one, push * one, 0.01), only=("saturation",), generic=False)
        assert len(proposed) == found


@pytest.mark.parametrize(
    ("actuator", "said"),
    [
        ('<position name="push" joint="rail" kp="30"/>', "force limited to 4.000 ± 0.039 N."),
        ('<position name="push" joint="hinge" kp="30"/>', "torque limited to 4.000 ± 0.039 N m."),
    ],
)
def test_a_limit_has_a_unit_and_an_interval(actuator: str, said: str) -> None:
    """4 is one over 0.25, and 1.96 x 0.02 = 0.00125 x 1.96 / 0.25^2."""
    hinge = '<body><joint name="hinge" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body></worldbody>'
    model = mujoco.MjModel.from_xml_string(_with(actuator).replace("</worldbody>", hinge))
    one = np.ones(model.nv)
    (effect,) = propose(model, Scales(one, one, one[:1], one[:1], 0.01), only=("saturation",), generic=False)
    assert effect.say(np.array([0.25]), np.array([0.00125])) == f"Saturation below the model's limits at push: {said}"
    assert effect.say(np.array([0.25])) == effect.say(np.array([0.25]), np.array([np.nan]))


@pytest.mark.parametrize(
    ("family", "parameters"),
    [
        ("offset", {"offset": 0.3}),
        ("dead_zone", {"width": 0.4}),
        ("supply_sag", {"exponent": 1.5, "reference": 12.0}),
        ("lag", {"time_constant": 0.02}),
        ("lag", {"time_constant": 0.0}),
        ("delay", {"delay": 0.0107}),
        ("thermal", {"fade": 0.3, "time_constant": 0.05, "reference": 2.0}),
    ],
)
def test_a_course_of_commands_is_what_walking_along_it_makes(family: str, parameters: dict[str, float]) -> None:
    """Of two parameter vectors and three logs at once; where a command rests, to the bit."""
    effect, theta = make(family, "push", parameters)
    effect.bind(mujoco.MjModel.from_xml_string(RAIL))
    rng = np.random.default_rng(0)
    ctrl = np.cumsum(rng.normal(size=(2, 3, 300, 1)), -2) / 5
    ctrl[..., :20, :] = ctrl[..., :1, :]
    thetas = np.stack([theta, 0.7 * theta])[:, None].repeat(3, 1)
    volts = {"exo:supply": rng.uniform(9, 12, (2, 3, 300))}
    found = effect.course(ctrl, thetas, volts, DT)
    memory = effect.state0((2, 3), ctrl[..., 0, :], thetas, DT)
    for k in range(300):
        now = {name: v[..., k] for name, v in volts.items()}
        walked, memory = effect.action(ctrl[..., k, :], thetas, memory, now, DT)
        np.testing.assert_allclose(found[..., k, :], walked, rtol=1e-13, atol=1e-14)
        if k < 20:
            np.testing.assert_array_equal(found[..., k, :], walked)


def test_a_limit_that_is_none_gives_a_motor_no_torque_speed_line() -> None:
    text = _with('<motor name="push" joint="rail" gear="2"/>')
    model, moved = mujoco.MjModel.from_xml_string(text), []
    for rows in ([], [("torque_speed", {"fall": 0.5}), ("saturation", {"inverse_limit": 0.0})]):
        pairs = [build(family, "push", given) for family, given in rows]
        segments = Segments(DT, 0, np.zeros((1, 1)), np.ones((1, 1)), np.full((1, 60, 1), 3.0))
        x = np.concatenate([np.zeros(0), *(theta for _, theta in pairs)])
        moved.append(plant_of(model, *(e for e, _ in pairs)).shoot(x[None], segments).qvel)
    np.testing.assert_array_equal(*moved)


def test_a_torque_speed_line_of_a_motor_without_a_limit_is_refused() -> None:
    """It would do nothing, without a word; with a limit of the model or of an effect beside it it does."""
    effect, theta = build("torque_speed", "push", {"fall": 0.5})
    with pytest.raises(InputError, match="nothing limits the force of 'push'"):
        run(_with('<motor name="push" joint="rail"/>'), effect, theta, 3)
    run(_with('<motor name="push" joint="rail" forcerange="-1 1"/>'), effect, theta, 3)
    run(_with('<motor name="push" joint="rail" ctrlrange="-1 1"/>'), effect, theta, 3)


MUSCLE = """
<mujoco><option timestep=".002" gravity="0 0 0"/><worldbody><body>
<joint name="knee" axis="0 1 0" range="-1 1" limited="true" damping="20"/>
<geom size=".1" mass="1" pos="0 0 -.3"/></body></worldbody>
<actuator><muscle name="push" joint="knee" lengthrange="-1 1" {}/></actuator>
<sensor><actuatorfrc name="made" actuator="push"/></sensor></mujoco>"""


@pytest.mark.parametrize("strength", ['scale="80"', 'force="5"', 'force="9" forcerange="-3 0"'])
@pytest.mark.parametrize(
    ("family", "parameters", "share"),
    [("gain", {"gain": 0.5}, 0.5), ("loss", {"fraction": 1.0}, 0.0), ("gain", {"gain": -1.0}, 0.0)],
)
def test_a_muscle_loses_strength_and_keeps_its_lengths(
    strength: str, family: str, parameters: dict[str, float], share: float
) -> None:
    """A share of the force at every activation and length, as it contracts and as it is stretched; it never pushes."""
    text = MUSCLE.format(strength)
    effect, theta = make(family, "push", parameters)
    model = mujoco.MjModel.from_xml_string(text)
    effect.bind(model)
    spec = mujoco.MjSpec.from_string(text)
    assert effect.spec(spec, theta)
    for weak in (_edited(model, effect, theta), mujoco.MjModel.from_xml_string(spec.to_xml())):
        for q, v, act in ((-0.8, 0.0, 0.2), (0.3, 0.5, 1.0), (0.9, -0.5, 0.4), (0.9, 0.0, 0.0)):
            whole, left = (_muscle_force(m, q, v, act) for m in (model, weak))
            assert whole < 0
            assert left == pytest.approx(share * whole, rel=1e-6)


def _edited(model: mujoco.MjModel, effect: Effect, theta: np.ndarray) -> mujoco.MjModel:
    out = copy.copy(model)
    fields = ModelFields(out, model)
    effect.model(fields, theta)
    fields.commit()
    return out


def _muscle_force(model: mujoco.MjModel, q: float, v: float, act: float) -> float:
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.act[0] = q, v, act
    mujoco.mj_forward(model, data)
    return float(data.actuator_force[0])


def test_what_scales_an_unknown_force_is_not_guessed() -> None:
    """The half of a user's law may be anything."""
    text = RAIL.replace("</actuator>", '<general name="own" joint="rail" gaintype="user" biastype="user"/></actuator>')
    for family, parameters in (("gain", {"gain": 0.5}), ("loss", {"fraction": 0.5})):
        with pytest.raises(InputError, match="the force of 'own' is not known; actuators of which it is: push"):
            make(family, "own", parameters)[0].bind(mujoco.MjModel.from_xml_string(text))
