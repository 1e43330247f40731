"""Native delays last as long as the model says, whatever the physics step is."""

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nfc_gym import InputError
from nfc_gym.measured.bench import make_bench
from nfc_gym.measured.buffers import make_room, require_room, set_step
from nfc_gym.measured.checks import check, require
from nfc_gym.measured.steps import finer
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments

DT, DELAY = 0.002, 0.02
MOTOR = f'<motor name="motor" joint="slide" delay="{DELAY}" nsample="{{}}" interp="{{}}"/>'
CART = """
<mujoco>
  <option timestep="{}" gravity="0 0 0"/>
  <worldbody><body name="cart"><joint name="slide" type="slide"/><geom size="0.1" mass="1"/></body></worldbody>
  <actuator>{}</actuator>
</mujoco>
"""
PENDULUM_DELAY = '<position name="servo" joint="hinge" kp="10" delay="0.04" nsample="20" interp="linear" '


def cart(nsample: int = 10, interp: str = "linear") -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(CART.format(DT, MOTOR.format(nsample, interp)))


def plant_of(spec: mujoco.MjSpec) -> Plant:
    model = spec.compile()
    return Plant(model, ParameterSpace(model, []), nthread=1)


def speeds(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """A command that steps, and the speed (K,) of a joint that nothing else moves."""
    model, dt = plant.model, float(plant.model.opt.timestep)
    command = np.where(np.arange(round(0.2 / dt)) * dt > 0.05 - 1e-9, 1.0, 0.0)
    still = model.qpos0[None], np.zeros((1, model.nv))
    segments = Segments(dt, 0, *still, command[None, :, None], channels=frozenset())
    return command, plant.shoot(plant.null[None], segments).qvel[0, 0, :, 0]


def late(plant: Plant) -> float:
    """Seconds from the command's step to the motion that it makes."""
    command, speed = speeds(plant)
    rows = np.flatnonzero(np.abs(speed) > 1e-9)[0] - 1 - np.flatnonzero(command)[0]
    return float(rows * plant.model.opt.timestep)


@pytest.mark.parametrize("nsample", [10, 11, 5])  # of 5 samples the model makes 10 ms
@pytest.mark.parametrize("interp", ["zoh", "linear"])
def test_room_changes_nothing_but_what_finer_steps_see(nsample: int, interp: str) -> None:
    spec, roomy = cart(nsample, interp), cart(nsample, interp)
    make_room(roomy)
    plain, plant, expected = plant_of(spec), plant_of(roomy), min(DELAY, nsample * DT)
    np.testing.assert_allclose(speeds(plant)[1], speeds(plain)[1], rtol=1e-13, atol=1e-15)
    for _ in range(3):  # as given, halved by a problem, and halved again by that problem's noise
        assert late(plant) == pytest.approx(expected, abs=1e-9)
        plant = finer(plant) if plant.model.opt.timestep > DT / 4 else plant


def test_a_model_without_room_is_refused() -> None:
    with pytest.raises(InputError, match=r"actuator motor: 10 samples hold no delay of 0.02 s at a step of 0.001 s"):
        finer(plant_of(cart()))
    require_room(cart(20).compile(), DT / 2)


@pytest.mark.parametrize("step", [0.001, 0.0005, 0.004, 0.0003])
def test_another_step_keeps_the_time_that_buffers_hold(step: float) -> None:
    spec = cart()
    set_step(spec, step)
    assert spec.option.timestep == step
    assert late(plant_of(spec)) == pytest.approx(DELAY, abs=step * (1 - 1e-9))


def test_sensors_keep_their_delay_and_periodic_ones_their_own_time() -> None:
    text = CART.format(DT, MOTOR.format(10, "zoh")).replace(
        "</actuator>",
        "</actuator><sensor>"
        '<jointpos name="late" joint="slide" delay="0.02" nsample="10"/>'
        '<jointpos name="slow" joint="slide" delay="0.02" nsample="3" interval="0.01"/></sensor>',
    )
    spec = mujoco.MjSpec.from_string(text)
    set_step(spec, DT / 2)
    assert [sensor.nsample for sensor in spec.sensors] == [20, 3]
    make_room(spec)
    require_room(spec.compile(), DT / 8)


@pytest.mark.parametrize("timestep", [None, 0.001])
def test_a_bench_delays_as_its_model_says(build: Callable[..., Path], machine: str, timestep: float | None) -> None:
    model = machine.replace('<position name="servo" joint="hinge" kp="10" ', PENDULUM_DELAY)
    edits = [] if timestep is None else [("{length: 0.4}", f"{{length: 0.4, timestep: {timestep}}}")]
    bench = make_bench(require(build(None, *edits, logs=3, model=model))[0], nthread=1)
    for plant in (bench.plant, finer(bench.plant)):
        assert late(plant) == pytest.approx(0.04, abs=1e-9)
    assert bench.spec.actuators[0].nsample * bench.spec.option.timestep >= 0.04 - 1e-9


def test_a_buffer_that_is_too_short_for_its_delay_is_told(build: Callable[..., Path], machine: str) -> None:
    found = {}
    for count in (20, 12):
        servo = PENDULUM_DELAY.replace('nsample="20"', f'nsample="{count}"')
        findings = check(build(model=machine.replace('<position name="servo" joint="hinge" kp="10" ', servo)))
        found[count] = [f for f in findings if "samples hold no delay" in f.message]
    assert not found[20]
    (warning,) = found[12]
    assert warning.severity == "warning"
    assert "actuator servo: 12 samples hold no delay of 0.04 s at a step of 0.002 s" in warning.message
