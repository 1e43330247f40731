"""The coordinates a fit walks in, and what walks in them where derivatives mislead."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.arena import alternatives, contains
from nfc_gym.measured.box import box
from nfc_gym.measured.fit import COARSE, TINY, TURNING, _Asked, fit, fitted, polish
from nfc_gym.measured.metric import Metric, loss
from nfc_gym.measured.race import Race
from nfc_gym.measured.screen import probe_sets
from nfc_gym.physics.effects.air import DragLinear
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.drive import Loss
from nfc_gym.physics.effects.each import each
from nfc_gym.physics.effects.friction import Coulomb, DirectionalFriction, Stribeck
from nfc_gym.physics.effects.inertial import Payload
from nfc_gym.physics.effects.load import ExternalForce, Slope, Wind
from nfc_gym.physics.effects.thermal import Thermal
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

XML = """
<mujoco><worldbody>
  <body name="box"><freejoint/><geom type="box" size="0.2 0.1 0.05" mass="4" pos="0.01 0 0"/>
    <body name="lid" pos="0 0 0.1"><joint name="hinge" damping="0.1"/><geom size="0.05" mass="0.5"/></body></body>
</worldbody></mujoco>"""


def plant(**anchored: bool) -> Plant:
    spec = mujoco.MjSpec.from_string(XML)
    for name in ("box", "lid"):
        spec.body(name).simple = 0
    given = {"unit": "1", "low": 0.0, "high": 1.0, **anchored}
    model = spec.compile()
    space = ParameterSpace(model, [Parameter("drag", field="dof_damping", of=("hinge",), **given)])
    return Plant(model, space, [Payload(("box",))], nthread=1)


def test_coordinates_and_parameters_are_each_others_inverse() -> None:
    limits = box(plant())
    x = np.array([0.3, 0.7, 0.2, -0.1, 0.05])
    np.testing.assert_allclose(limits.x(limits.at(x), x), x, rtol=1e-12)
    np.testing.assert_allclose(limits.at(x)[2:] * limits.scale[2:], 0.7 * x[2:], rtol=1e-12)


def test_a_lump_without_mass_has_no_place_but_finite_parameters() -> None:
    limits = box(plant())
    x = limits.x(np.zeros((3, 5)), plant().null)
    assert np.isfinite(x).all()
    assert (x >= limits.low).all()
    assert (x <= limits.high).all()


def test_slopes_turn_steps_of_the_coordinates_into_steps_of_the_parameters() -> None:
    limits = box(plant())
    x = np.array([0.3, 0.7, 0.2, -0.1, 0.05])
    step = 1e-5 * np.array([1.0, -2.0, 0.5, 3.0, -1.0])
    moved = limits.x(limits.at(x) + step, x)
    np.testing.assert_allclose(moved - x, limits.slopes(x) @ step, atol=1e-8)


def test_an_anchored_parameter_is_no_coordinate() -> None:
    limits = box(plant(anchored=True))
    x = np.array([0.1, 0.7, 0.2, -0.1, 0.05])
    assert limits.at(x).shape == (4,)
    assert limits.x(limits.at(x), x)[0] == 0.1


class Hollows:
    """Two numbers a block; the residual is the distance to (0.6, -0.4), and jumps on a fine grid of its own."""

    rough = True

    def __init__(self, index: Any = slice(None)) -> None:
        self.columns = SimpleNamespace(__len__=lambda: 2)
        rng = np.random.default_rng(0)
        self.phase, self.size = rng.uniform(0, 1, (40, 2))[index], 0.3
        self.mask = np.ones(self.phase.shape, bool)

    def __len__(self) -> int:
        return len(self.phase)

    def part(self, index: np.ndarray) -> "Hollows":
        return Hollows(index)

    def residual(self, plant: Any, x: np.ndarray) -> np.ndarray:
        off = np.repeat(x[:, None], len(self), 1) - np.array([0.6, -0.4])
        jumps = np.floor(37 * x[:, None].sum(-1, keepdims=True) + self.phase) % 2
        return 10 * off + self.size * (jumps - 0.5)


def rugged() -> tuple[Any, Metric, Any]:
    problem = Hollows()
    wide = np.full(2, 2.0)
    same = lambda x: x  # noqa: E731
    space = SimpleNamespace(low=-wide, high=wide, free=np.ones(2, bool))
    flat = SimpleNamespace(space=space, effects=(), null=np.zeros(2), chart=same, unchart=same)
    return problem, Metric(np.tile(np.eye(2), (40, 1, 1)), problem.mask), flat


def test_a_coarse_step_sees_past_jumps() -> None:
    problem, under, flat = rugged()
    found = fit(problem, under, flat, np.array([-1.5, 1.5]), 12)
    np.testing.assert_allclose(found.x, [0.6, -0.4], atol=0.02)
    slopes = found.jacobian[..., 0, 0]
    assert abs(float(slopes.mean()) - 10) < 2 * 0.3 / COARSE


@pytest.mark.parametrize("serve", [1, 2, 3])
def test_where_bodies_touch_slopes_may_serve_for_some_iterations(serve: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In between they turn with the step: along it they are what the residual did."""
    problem, under, flat = rugged()
    ask = _Asked(problem, under, flat, np.zeros(2), None, lambda: None, serve)
    taken: list[float] = []
    slopes = ask.slopes
    monkeypatch.setattr(ask, "slopes", lambda x, size: taken.append(size) or slopes(x, size))
    places, turned = np.array([[0.0, 0.0], [0.3, -0.1], [0.5, -0.3], [0.55, -0.35]]), []
    for z in places:
        ask.derivative(z, COARSE)
        turned.append(ask.jacobian)
    assert len(taken) == {1: 4, 2: 2, 3: 2}[serve]
    moved = ask.white(ask.limits.x(places[1], ask.start)) - ask.white(ask.limits.x(places[0], ask.start))
    along = abs(turned[1] @ (places[1] - places[0]) - moved).max()
    assert (along < 1e-12) == (serve > 1)
    ask.derivative(places[-1] + 0.01, TINY)  # differences of another size are another question
    assert taken[-1] == TINY


def test_a_fit_whose_slopes_turn_ends_where_it_should() -> None:
    problem, under, flat = rugged()
    found = fit(problem, under, flat, np.array([-1.5, 1.5]), 12, serve=TURNING)
    np.testing.assert_allclose(found.x, [0.6, -0.4], atol=0.02)


@pytest.mark.parametrize("rough", [True, False])
def test_parameters_alone_end_where_the_fit_ends(rough: bool) -> None:
    problem, under, flat = rugged()
    problem.rough = rough
    start = np.array([-1.5, 1.5])
    np.testing.assert_array_equal(fitted(problem, under, flat, start, 8), fit(problem, under, flat, start, 8).x)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_polish_is_never_worse_and_mends_a_poor_start(seed: int) -> None:
    problem, under, flat = rugged()
    poor = fit(problem, under, flat, np.array([-1.5, 1.5]), 0)
    better = polish(problem, under, flat, poor.x, 120, seed)
    assert loss(under.whiten(problem.residual(flat, better[None]))).sum() <= loss(poor.white).sum()
    np.testing.assert_allclose(better, [0.6, -0.4], atol=0.05)


def test_a_polish_takes_no_draw_for_better_that_some_blocks_alone_speak_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(self: Race, plant: Plant, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(len(x), np.inf), np.zeros(len(x))

    problem, under, flat = rugged()
    start = np.array([-1.5, 1.5])
    monkeypatch.setattr(Race, "ranked", lost)
    np.testing.assert_array_equal(polish(problem, under, flat, start, 40, 0), start)


def test_places_with_values_of_their_own_are_probed_at_one_shape() -> None:
    """Twelve joints with three speeds each would be half a million sets."""
    members: list[Effect] = [Stribeck((f"j{i}",)) for i in range(12)]
    sets = probe_sets(each(members))
    assert len(sets) == 3 * 2
    assert all(len(rows) == 24 for rows in sets)


def test_a_law_covers_its_special_cases_only() -> None:
    coulomb, both = Coulomb(("a",)), each([Coulomb(("a",)), Coulomb(("b",))])
    assert contains(both, coulomb)
    assert not contains(coulomb, both)
    assert contains(DirectionalFriction(("a",)), coulomb)
    assert not contains(DirectionalFriction(("b",)), coulomb)
    assert contains(Wind(("a",)), ExternalForce(("a",)))
    assert contains(Wind(("a",)), DragLinear(("a",)))
    assert contains(Thermal(("a",)), Loss(("a",)))
    assert not contains(Coulomb(("a", "b")), coulomb), "one value for both is a claim of its own"


def test_alternatives_to_a_law_are_told_without_what_contains_them() -> None:
    pool: list[Effect] = [Wind(("a",)), ExternalForce(("a",)), Slope(("world",)), Stribeck(("j",)), Coulomb(("j",))]
    slope, push, wind = "slope:world", "external_force:a", "wind:a"
    assert alternatives(Slope(("world",)), [wind, push, push], pool) == [push]
    assert alternatives(Slope(("world",)), [wind, "gone:a"], pool) == [wind, "gone:a"], "what it contains is not there"
    assert alternatives(Wind(("a",)), [slope, push], pool) == [slope, push], "the law's own special case is one"
    assert alternatives(DirectionalFriction(("j",)), ["stribeck:j", "coulomb:j"], pool) == ["coulomb:j"]
