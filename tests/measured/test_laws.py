"""Laws that no library has: found on the right degree of freedom, with the right order, phase, power and place."""

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from hidden_laws import BLOCK, CRAFT, STEP, WHEEL, Machine, Push, hover, nothing, record, slide, swing

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.owned import Data
from nfc_gym.measured.remainder import LawSearch, Remainder
from nfc_gym.measured.settle import settle
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.physics.effects import Scales, build, complete_inertia, propose
from nfc_gym.physics.effects.base import TIME
from nfc_gym.physics.effects.law import Law
from nfc_gym.physics.effects.law_waves import LawWave
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

KNOWN = {"wheel": ("dof_damping", "wheel"), "rail": ("dof_damping", "rail"), "flight": ("body_mass", "craft")}


@dataclass
class Case:
    """A machine's logs as problems, and its calibrated model."""

    model: mujoco.MjModel
    arena: Arena
    calibrated: Fit
    laws: list[Law]

    def explain(self) -> Remainder:
        """What the law search makes of it."""

        def again(current: Fit) -> Arena:
            data = self.arena.fit_data
            fitted, under, extra = settle(data.problem, data.sigma, current.plant, current.x)
            return Arena(data, self.arena.select, fitted, under, extra, self.arena.rng, lambda text: None)

        return LawSearch(self.laws, 0.02, again, lambda arena: arena.current).run(self.arena, self.calibrated)


def problem_of(model: mujoco.MjModel, machine: Machine, seeds: range) -> RolloutProblem:
    logs = [record(machine, seed) for seed in seeds]
    layout = Layout(0.3, 0.0, (0.1, 0.2, 0.3), 0.3, STEP)
    return RolloutProblem(model, logs, [estimate_states(model, log) for log in logs], layout)


def case(machine: Machine, seed: int) -> Case:
    spec = mujoco.MjSpec.from_string(machine.text.format(known=machine.given))
    complete_inertia(spec)
    model = spec.compile()
    field, of = KNOWN[model.joint(0).name]
    known = Parameter("known", field, (of,), low=0.5 * machine.given, high=2 * machine.given)
    plant = Plant(model, ParameterSpace(model, [known]), nthread=1)
    fit_on, select_on = (problem_of(model, machine, range(seed + a, seed + b)) for a, b in ((0, 3), (3, 5)))
    sigma = fit_on.covariance(plant, plant.null)
    fitted, under, extra = settle(fit_on, sigma, plant, plant.null)
    data = Data(fit_on, fit_on.covariance(plant, fitted.x))
    select = Data(select_on, select_on.covariance(plant, fitted.x))
    rng = np.random.default_rng(seed)
    arena = Arena(data, select, fitted, under, extra, rng, lambda text: None)
    speed = np.sqrt((fit_on.segments.qvel**2).mean(0)) + 1e-2
    scales = Scales(np.full(model.nv, 0.1), speed, np.ones(model.nu), np.ones(model.nu), 0.01)
    laws = [e for e in propose(model, scales) if isinstance(e, Law)]
    return Case(model, arena, fitted, laws)


def one(found: Remainder) -> tuple[Law, dict[str, float]]:
    """The first law that was believed, with its values."""
    assert found.laws, found.scanned
    values = found.fitted.plant.split(found.fitted.x)[1][0]
    return found.laws[0], dict(zip((p.name for p in found.laws[0].params), values, strict=True))


def push_joint(f: Callable[[float, float], float]) -> Push:
    """A hidden generalised force f(q, v) on the first degree of freedom."""

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        data.qfrc_applied[0] = f(data.qpos[0], data.qvel[0])

    return push


def test_order_and_phase_of_a_harmonic() -> None:
    rng = np.random.default_rng(11)
    order, size, phase = rng.integers(2, 9), rng.uniform(0.02, 0.05), rng.uniform(0, 2 * np.pi)
    machine = Machine(WHEEL, 0.01, 0.012, swing(0.1), push_joint(lambda q, v: size * np.cos(order * q - phase)))
    law, found = one(case(machine, 11).explain())
    assert law.id == "law_harmonic:wheel"
    assert found["order"] == pytest.approx(order, abs=0.02)
    assert np.hypot(found["cosine"], found["sine"]) == pytest.approx(size, rel=0.05)
    off = np.arctan2(found["sine"], found["cosine"]) - phase
    assert np.abs(np.angle(np.exp(1j * off))) < np.radians(10)
    values = np.array([found[p.name] for p in law.params])
    assert f"repeats {order} times a turn" in law.say(values)
    assert f"{np.hypot(found['cosine'], found['sine']):.3g} N m" in law.say(values)


def test_an_eccentric_wheel_repeats_once_a_turn() -> None:
    """Gravity on a centre of mass beside the axle, at an angle drawn by chance."""
    rng = np.random.default_rng(21)
    lever, angle = rng.uniform(0.003, 0.006), rng.uniform(0, 2 * np.pi)
    push = push_joint(lambda q, v: 9.81 * lever * np.cos(q - angle))
    law, found = one(case(Machine(WHEEL, 0.01, 0.012, swing(0.1), push), 21).explain())
    assert law.id == "law_harmonic:wheel"
    assert found["order"] == pytest.approx(1, abs=0.05)
    assert "once a turn" in law.say(np.array([found[p.name] for p in law.params]))


def test_power_of_a_speed() -> None:
    rng = np.random.default_rng(31)
    power, top = rng.uniform(1.6, 2.8), rng.uniform(0.05, 0.1)
    push = push_joint(lambda q, v: -top * np.sign(v) * (abs(v) / 6) ** power)
    law, found = one(case(Machine(WHEEL, 0.01, 0.012, swing(0.25), push), 31).explain())
    assert law.id == "law_power:wheel"
    assert found["power"] == pytest.approx(power, abs=0.3)
    assert found["level"] * 6 ** found["power"] == pytest.approx(top, rel=0.2)


def test_friction_by_place() -> None:
    rng = np.random.default_rng(41)
    start, level = rng.uniform(-0.4, 0.1), rng.uniform(0.8, 1.6)

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        model.dof_frictionloss[0] = level if start < data.qpos[0] < start + 0.8 else 0.0

    law, found = one(case(Machine(BLOCK, 0.5, 0.6, slide, push), 41).explain())
    assert law.id == "law_friction:rail+rail"
    assert found["start"] == pytest.approx(start, abs=0.1)
    assert found["end"] == pytest.approx(start + 0.8, abs=0.1)
    assert found["level"] == pytest.approx(level, rel=0.15)


def test_lift_near_the_ground_is_seen_on_the_right_axis() -> None:
    rng = np.random.default_rng(51)
    level, height = rng.uniform(2, 4), rng.uniform(0.2, 0.5)

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        data.xfrc_applied[1, 2] = level / (1 + (data.qpos[2] / height) ** 2)

    found = case(Machine(CRAFT, 1.0, 1.02, hover, push), 51).explain()
    law, values = one(found)
    assert law.id in ("law_height:flight[2]", "law_height:flight[2]@body")
    assert next(iter(found.scanned.places)).startswith("flight[2]")
    z = np.linspace(0.3, 1.0, 8)
    truth, said = level / (1 + (z / height) ** 2), values["level"] / (1 + (z / values["height"]) ** 2)
    np.testing.assert_allclose(said, truth, atol=0.15 * level)


@pytest.mark.parametrize(("machine", "seed"), [(WHEEL, 61), (BLOCK, 63), (CRAFT, 64)])
def test_no_law_is_proposed_for_a_machine_that_lacks_nothing(
    machine: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even where nobody asks first whether anything is left."""
    monkeypatch.setattr("nfc_gym.measured.remainder.SILENT", -1.0)
    given, command = {WHEEL: (0.01, swing(0.1)), BLOCK: (0.5, slide), CRAFT: (1.0, hover)}[machine]
    found = case(Machine(machine, given, 1.05 * given, command, nothing), seed).explain()
    assert found.scanned is not None
    assert found.laws == []


@pytest.mark.parametrize(("floor", "there"), [("", False), ('<geom type="plane" size="9 9 1"/>', True)])
def test_a_place_on_the_ground_may_push_and_one_in_the_air_does_not(floor: str, there: bool) -> None:
    text = CRAFT.format(known=1.0).replace("<worldbody>", f"<worldbody>{floor}")
    model = mujoco.MjModel.from_xml_string(text)
    scales = Scales(np.full(model.nv, 0.1), np.ones(model.nv), np.ones(model.nu), np.ones(model.nu), 0.01)
    ids = [e.id for e in propose(model, scales)]
    assert any(i.startswith(("law_place:", "law_friction:")) for i in ids) == there
    assert "law_height:flight[2]" in ids


def test_a_wave_swings_once_at_least_in_what_was_recorded() -> None:
    """A battery that runs down over a log is no swing: with less than a period to see, any slow change is one."""
    seconds = np.random.default_rng().uniform(5.0, 60.0)
    ctx: Any = SimpleNamespace(exogenous={TIME: np.linspace(0.0, seconds, 500)})
    law = LawWave(("rail",), LawWave.sized(1.0, "N"))
    slowest = 2 * np.pi / seconds
    for rate in (slowest * 1.05, 10 * slowest):
        wave = law.at(ctx, np.array([0.3, 0.1, rate])).params[-1]
        assert 0.99 * slowest < wave.low <= rate <= wave.high
    assert law.grid(ctx).min() > 0.99 * slowest


def test_two_harmonics_of_one_joint_are_two_laws() -> None:
    push = push_joint(lambda q, v: 0.04 * np.cos(3 * q - 1) + 0.03 * np.cos(7 * q - 2))
    found = case(Machine(WHEEL, 0.01, 0.012, swing(0.1), push), 81).explain()
    assert [law.id for law in found.laws] == ["law_harmonic:wheel", "law_harmonic:wheel+wheel"]
    orders = sorted(theta[2] for theta in found.fitted.plant.split(found.fitted.x)[1])
    np.testing.assert_allclose(orders, [3, 7], atol=0.02)


def test_a_law_that_leaves_another_without_a_size_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a swing does beside one of nearly its frequency; here whatever comes second."""
    alone = lambda current, blocks, law: len(current.plant.effects) < 2  # noqa: E731
    monkeypatch.setattr("nfc_gym.measured.yardstick.differs", alone)
    push = push_joint(lambda q, v: 0.04 * np.cos(3 * q - 1) + 0.03 * np.cos(7 * q - 2))
    found = case(Machine(WHEEL, 0.01, 0.012, swing(0.1), push), 81).explain()
    assert len(found.laws) == 1
    assert [r.accepted for r in found.rounds] == [[found.laws[0].id], []]
    assert "would not differ from nothing" in found.rounds[1].reason


@pytest.mark.parametrize(("friction", "claimed"), [(0.0, False), (0.05, True)])
def test_a_named_effect_stays_only_if_no_law_outdoes_it(friction: float, claimed: bool) -> None:
    """A cogging torque, with or without true dry friction, and dry friction named in the model to beat."""

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        model.dof_frictionloss[0] = friction
        data.qfrc_applied[0] = 0.03 * np.cos(5 * data.qpos[0] - 2)

    tried = case(Machine(WHEEL, 0.01, 0.012, swing(0.15), push), 91)
    data, calibrated = tried.arena.fit_data, tried.calibrated
    named, level = build("coulomb", "wheel", {"level": 0.02})
    plant = calibrated.plant.with_effects([named])
    fitted, under, extra = settle(data.problem, data.sigma, plant, np.concatenate([calibrated.x, level]))
    tried.arena = Arena(data, tried.arena.select, fitted, under, extra, tried.arena.rng, lambda text: None)
    found = tried.explain()
    assert [law.id for law in found.laws][:1] == ["law_harmonic:wheel"]
    assert found.dropped == ([] if claimed else ["coulomb:wheel"])
    assert (named in found.fitted.plant.effects) == claimed
