"""Parameters that slide together: found where only ratios show, said in words, and gone once one is anchored."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.core.log import Channel, Log
from nfc_gym.measured import gauge
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.metric import metric
from nfc_gym.measured.remarks import on_parameters
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

CART = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="1.5"/><geom size="0.1" mass="2"/></body>
  </worldbody>
  <actuator><motor name="motor" joint="rail" gear="3"/></actuator>
</mujoco>
"""
# m dv/dt = g u - d v: all three may be scaled by one factor, and no motion changes.
PSI = {
    "cart_mass": ("body_mass", "cart", "kg", 1.0, 3.0),
    "motor_gain": ("actuator_gear[0]", "motor", "N", 1.0, 5.0),
    "drag": ("dof_damping", "rail", "N s/m", 0.0, 3.0),
}


def fitted(*anchored: str, names: tuple[str, ...] = tuple(PSI)) -> Fit:
    model = mujoco.MjModel.from_xml_string(CART)
    space = ParameterSpace(
        model,
        [
            Parameter(n, field, (of,), unit, low, high, anchored=n in anchored)
            for n, (field, of, unit, low, high) in PSI.items()
            if n in names
        ],
    )
    rng, data, rows = np.random.default_rng(0), mujoco.MjData(model), []
    time = np.arange(400) * 0.01
    push = np.sin(3 * time) + 0.7 * np.sign(np.sin(1.3 * time))
    for u in push:
        rows.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 2)
    q, v = np.array(rows).T + rng.normal(size=(2, 400)) * [[0.001], [0.01]]
    channels = {
        "joint:rail:pos": Channel(q, "m", noise=0.001),
        "joint:rail:vel": Channel(v, "m/s", noise=0.01),
    }
    log = Log("run", time, {"ctrl:motor": push}, channels)
    problem = RolloutProblem(model, [log], [estimate_states(model, log)], Layout(0.4, 0.0, (0.1, 0.4), 0.4, 0.005))
    plant = Plant(model, space, nthread=1)
    under = metric(problem, problem.covariance(plant, plant.null))
    return fit(problem, under, plant, plant.null * 1.05 if not anchored else plant.null)


def test_mass_gain_and_drag_scale_together() -> None:
    found = fitted()
    (slide,) = gauge.slides(found)
    assert set(slide.names) == set(PSI)
    assert slide.same_factor
    assert slide.relative == pytest.approx([1, 1, 1], abs=0.05)
    (text,) = gauge.said(found)
    assert "cart_mass, motor_gain and drag can all be scaled by the same factor" in text
    assert "weigh what cart_mass stands for and mark it `anchored: true`" in text.lower()


@pytest.mark.parametrize("known", ["cart_mass", "motor_gain", "drag"])
def test_an_anchor_fixes_the_scale(known: str) -> None:
    found = fitted(known)
    assert gauge.slides(found) == []
    for name, value in zip(found.plant.space.names, found.x, strict=True):
        assert value == pytest.approx(found.plant.space.nominal[found.plant.space.names.index(name)], rel=0.05)


def test_what_cannot_slide_is_not_said_to() -> None:
    assert gauge.said(fitted(names=("cart_mass", "drag"))) == []


def flat(slopes: np.ndarray, names: tuple[str, ...], x: tuple[float, ...]) -> Fit:
    """A fit of parameters between 0 and 4 whose Jacobian is given; no machine is behind it."""
    size = len(names)
    parameters = [Parameter(n, "geom_friction[0]", (n,), "1", 0.0, 4.0) for n in names]
    same = lambda a: a  # noqa: E731
    space = SimpleNamespace(
        low=np.zeros(size), high=np.full(size, 4.0), free=np.ones(size, bool), names=names, parameters=parameters
    )
    plant: Any = SimpleNamespace(space=space, effects=(), null=np.array(x), chart=same, unchart=same)
    return Fit(plant, np.array(x), np.zeros(slopes.shape[:-1]), slopes)


def test_opposite_changes_are_said_as_such() -> None:
    """Two columns that are copies: what one gains the other must lose, in the proportion of their values."""
    column = np.full((20, 10), 30.0)
    found = flat(np.stack([column, column, np.eye(20, 10) * 300], -1), ("a", "b", "c"), (1.0, 2.0, 1.0))
    (slide,) = gauge.slides(found)
    assert set(slide.names) == {"a", "b"}
    assert sorted(slide.relative) == pytest.approx([-0.5, 1.0])
    assert not slide.same_factor
    assert "more of a looks like less of b" in slide.say("a", "measure a")


def test_a_parameter_that_never_shows_is_no_slide() -> None:
    column = np.full((20, 10), 30.0)
    assert gauge.slides(flat(np.stack([column, 0 * column], -1), ("a", "b"), (1.0, 2.0))) == []


def test_two_slides_are_told_one_by_one() -> None:
    one, two = np.zeros((20, 10)), np.zeros((20, 10))
    one[:, :5], two[:, 5:] = 30.0, 30.0
    found = flat(np.stack([one, two, one, -two], -1), ("a", "b", "c", "d"), (1.0, 1.0, 1.0, 1.0))
    pairs = {frozenset(s.names): s.relative for s in gauge.slides(found)}
    assert set(pairs) == {frozenset("ac"), frozenset("bd")}
    assert np.prod(pairs[frozenset("ac")]) == pytest.approx(-1)
    assert np.prod(pairs[frozenset("bd")]) == pytest.approx(1)


@pytest.mark.parametrize(("estimate", "words"), [(3.999, "ask for 4.00 or more"), (0.001, "ask for 0 or less")])
def test_a_prior_that_was_left_is_a_finding(estimate: float, words: str) -> None:
    found = flat(np.zeros((20, 10, 1)), ("a",), (estimate,))
    (finding,) = on_parameters(found, [{"name": "a", "estimate": estimate, "left_prior": True}])
    assert finding["kind"] == "left_prior"
    assert finding["text"].startswith("a left its prior")
    assert words in finding["text"]
    assert "0 to 4.00 was declared" in finding["text"]
    assert on_parameters(found, [{"name": "a", "estimate": 2.0, "left_prior": False}]) == []
