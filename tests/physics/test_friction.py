"""Dry friction against closed forms: a mass on a rail, a gear under load."""

import numpy as np
import pytest
from machines import make, run

DT, MASS = 0.001, 2.0
RAIL = f"""
<mujoco><option timestep="{DT}" gravity="0 0 0"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
<geom type="sphere" size=".1" mass="{MASS}"/></body></worldbody>
<actuator><motor name="push" joint="rail"/></actuator></mujoco>"""


def _rail(
    family: str, parameters: dict[str, float], speed: float, steps: int, push: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    effect, theta = make(family, "rail", parameters)
    t = run(RAIL, effect, theta, steps, qvel=[speed], ctrl=[push])
    return t.qpos[0, 0, :, 0], t.qvel[0, 0, :, 0]


@pytest.mark.parametrize("speed", [1.0, -1.5])
def test_coulomb_brakes_at_level_over_mass_and_holds(speed: float) -> None:
    level = 3.0
    q, v = _rail("coulomb", {"level": level}, speed, 1500)
    stop = abs(speed) * MASS / level
    half = int(stop / 2 / DT)
    assert v[half] == pytest.approx(speed - np.sign(speed) * level / MASS * half * DT, rel=1e-3)
    assert q[-1] == pytest.approx(np.sign(speed) * speed**2 * MASS / (2 * level), rel=5e-3)
    # at rest it stays at rest
    later = int(stop / DT) + 50
    assert np.abs(v[later:]).max() < 1e-6


def test_coulomb_holds_below_its_level_and_slides_above() -> None:
    """The creep under 0.8 of the level stays under 2 % of what the load would add in each step."""
    q, v = _rail("coulomb", {"level": 1.0}, 0.0, 500, push=0.8)
    assert np.abs(v).max() < 0.02 * 0.8 / MASS * DT
    q, v = _rail("coulomb", {"level": 1.0}, 0.0, 500, push=1.5)
    assert v[-1] == pytest.approx(0.5 / MASS * 500 * DT, rel=1e-3)
    assert q[-1] > 0


def test_coulomb_adds_to_declared_friction() -> None:
    effect, theta = make("coulomb", "rail", {"level": 1.0})
    declared = RAIL.replace('type="slide"', 'type="slide" frictionloss="2" solreffriction=".002 1"')
    v = run(declared, effect, theta, 200, qvel=[1.0]).qvel[0, 0, :, 0]
    assert v[-1] == pytest.approx(1.0 - 3.0 / MASS * 200 * DT, rel=1e-3)


def test_stribeck_follows_its_curve() -> None:
    """m dv/dt = -(level + rise exp(-(v/vs)^2)), integrated by a fine Runge-Kutta scheme of the test's own."""
    level, rise, vs = 1.0, 2.0, 0.3
    _, v = _rail("stribeck", {"level": level, "rise": rise, "speed": vs}, 1.0, 800)
    slope = lambda x: -(level + rise * np.exp(-((x / vs) ** 2))) / MASS  # noqa: E731
    x = 1.0
    for k in range(1, 801):
        a = slope(x)
        b = slope(x + DT / 2 * a)
        x += DT * b
        assert v[k] == pytest.approx(x, abs=2e-3)


def test_stribeck_breaks_away_above_level_plus_rise() -> None:
    parameters = {"level": 1.0, "rise": 2.0, "speed": 0.1}
    assert np.abs(_rail("stribeck", parameters, 0.0, 300, push=2.9)[1]).max() < 1e-4
    # once moving only the level is left
    v = _rail("stribeck", parameters, 0.0, 3000, push=3.3)[1]
    assert (v[-1] - v[-501]) / (500 * DT) == pytest.approx(2.3 / MASS, rel=0.01)


def test_directional_friction_has_two_levels() -> None:
    parameters = {"forward": 1.0, "backward": 3.0}
    ahead = _rail("directional_friction", parameters, 1.0, 300)[1]
    astern = _rail("directional_friction", parameters, -1.0, 300)[1]
    assert ahead[-1] == pytest.approx(1.0 - 1.0 / MASS * 300 * DT, rel=1e-3)
    assert astern[-1] == pytest.approx(-1.0 + 3.0 / MASS * 300 * DT, rel=1e-3)


def test_load_friction_takes_its_share_of_the_drive() -> None:
    """A motor's push F leaves F (1 - motor) to accelerate the mass."""
    v = _rail("load_friction", {"level": 0.0, "motor": 0.25, "external": 0.5}, 1.0, 400, push=4.0)[1]
    assert v[-1] == pytest.approx(1.0 + 4.0 * 0.75 / MASS * 400 * DT, rel=2e-3)


def test_load_friction_counts_gravity_as_load() -> None:
    """A hoist: the mass falls with g (1 - external), since friction is external * weight."""
    text = RAIL.replace('gravity="0 0 0"', 'gravity="-10 0 0"')
    effect, theta = make("load_friction", "rail", {"level": 0.0, "motor": 0.0, "external": 0.3})
    v = run(text, effect, theta, 300, ctrl=[0.0]).qvel[0, 0, :, 0]
    assert v[-1] == pytest.approx(-10 * 0.7 * 300 * DT, rel=5e-3)


def test_load_friction_adds_both_sides_of_a_held_gear() -> None:
    """Held against gravity with the motor, both flanks carry the weight: level (motor + external) * weight holds it."""
    text = RAIL.replace('gravity="0 0 0"', 'gravity="-10 0 0"')
    weight = 10 * MASS
    for motor, external in ((0.2, 0.15), (0.0, 0.35)):
        effect, theta = make("load_friction", "rail", {"level": 0.0, "motor": motor, "external": external})
        # the motor carries 75 % of the weight, 25 % is left for friction
        carried = 0.75 * motor + external
        v = run(text, effect, theta, 300, ctrl=[0.75 * weight]).qvel[0, 0, :, 0]
        assert carried > 0.25
        assert np.abs(v[10:]).max() < 1e-3


def test_load_friction_grows_with_the_square_of_the_drive() -> None:
    effect, theta = make("load_friction", "rail", {"square": 0.1})
    v = run(RAIL, effect, theta, 400, qvel=[1.0], ctrl=[4.0]).qvel[0, 0, :, 0]
    assert v[-1] == pytest.approx(1.0 + (4.0 - 0.1 * 16.0) / MASS * 400 * DT, rel=2e-3)


def test_directional_friction_has_two_viscous_parts() -> None:
    time = np.arange(301) * DT
    for start, k in ((1.0, 2.0), (-1.0, 5.0)):
        v = _rail("directional_friction", {"forward_viscous": 2.0, "backward_viscous": 5.0}, start, 300)[1]
        np.testing.assert_allclose(v, start * np.exp(-k / MASS * time), atol=2e-3)
