"""Joints that remember, against closed forms: a spring that yields, play between drive and joint."""

from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
from machines import make, plant_of, run

from nfc_gym.measured.segments import moved
from nfc_gym.physics.effects import FAMILIES, Context, Forces, Scales
from nfc_gym.physics.past import Past, trace
from nfc_gym.physics.segments import Segments

DT, MASS = 0.001, 2.0
RAIL = f"""
<mujoco><option timestep="{DT}" gravity="0 0 0"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
<geom type="sphere" size=".1" mass="{MASS}"/></body></worldbody>
<actuator><motor name="push" joint="rail"/></actuator></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(RAIL)


def _loop(level: float, transition: float, reach: float, count: int) -> float:
    """Work that hysteresis takes from a joint led once to and fro, when its first turns are over."""
    effect, theta = make("hysteresis", "rail", {"level": level, "transition": transition})
    effect.bind(MODEL)
    x = reach * np.sin(np.linspace(0, 6 * np.pi, 3 * count + 1))
    nominal = partial(getattr, MODEL)
    ctx = Context(MODEL, DT, np.zeros(1), np.zeros(1), np.zeros(1), {}, None, nominal)  # type: ignore[arg-type]
    memory, forces = effect.rest(ctx, theta), []
    for step in np.diff(x):
        ctx.v = np.array([step / DT])
        ctx.memory = memory = effect.follow(ctx, theta, memory)
        out = Forces(np.zeros(1), np.zeros((2, 6)))
        effect.force(ctx, theta, out)
        forces.append(out.qfrc[0])
    f, last = np.array([0.0, *forces]), slice(2 * count, 3 * count)
    return float((-(f[1:] + f[:-1]) / 2 * np.diff(x))[last].sum())


@pytest.mark.parametrize(("reach", "count"), [(0.3, 2000), (0.3, 8000), (0.05, 4000)])
def test_hysteresis_takes_the_area_of_its_loop_at_any_speed(reach: float, count: int) -> None:
    """4 level (X - D tanh(X / D)) a turn between -X and X, however fast: Dahl's equation integrated by hand."""
    level, transition = 3.0, 0.1
    area = 4 * level * (reach - transition * np.tanh(reach / transition))
    assert _loop(level, transition, reach, count) == pytest.approx(area, rel=2e-3)


def test_hysteresis_is_a_spring_at_first_and_dry_friction_at_last() -> None:
    level, transition = 3.0, 0.5
    effect, theta = make("hysteresis", "rail", {"level": level, "transition": transition})
    omega = np.sqrt(level / transition / MASS)
    q = run(RAIL, effect, theta, 1000, qvel=[0.001]).qpos[0, 0, :, 0]
    np.testing.assert_allclose(q, 0.001 / omega * np.sin(omega * np.arange(1001) * DT), atol=2e-6)
    v = run(RAIL, effect, theta, 4000, qvel=[20.0]).qvel[0, 0, :, 0]
    assert (v[1000] - v[4000]) / (3000 * DT) == pytest.approx(level / MASS, rel=1e-3)


def test_hysteresis_of_a_step_too_long_for_it_stays_stable() -> None:
    """A transition far below what a step can resolve: the mass still comes to rest, and no energy appears."""
    effect, theta = make("hysteresis", "rail", {"level": 50.0, "transition": 1e-6})
    v = np.abs(run(RAIL, effect, theta, 600, qvel=[1.0]).qvel[0, 0, :, 0])
    assert v.max() <= 1.0
    assert v[-1] < 1e-3


def test_hidden_states_are_led_along_the_measured_past() -> None:
    """Segments cut from a longer motion, with its past, go on as the motion did; without a past they do not."""
    cut, steps = 707, 300  # 7 ms after the drive has turned: a rotor is in its gap
    for family, values in (
        ("hysteresis", {"level": 3.0, "transition": 0.05}),
        ("backlash", {"gap": 0.02, "rotor": 0.02}),
    ):
        effect, theta = make(family, "rail", values)
        ctrl = 4 * np.sign(np.sin(np.arange(cut + steps) * DT * 2 * np.pi / 0.35))[:, None]
        whole = run(RAIL, effect, theta, cut + steps, ctrl=ctrl)
        q, v = whole.qpos[0, 0], whole.qvel[0, 0]
        start, speed = q[cut][None], v[cut][None]
        past = Past.given(q[None, : cut + 1], v[None, : cut + 1])
        plant = plant_of(MODEL, effect)
        again = [
            plant.shoot(theta[None], Segments(DT, cut, start, speed, ctrl[None], past=p)).qpos[0, 0]
            for p in (past, None)
        ]
        np.testing.assert_allclose(again[0], q[cut:], atol=1e-9, err_msg=family)
        assert np.abs(again[1] - q[cut:]).max() > 1e-5, family
        fine = Segments(DT / 2, 2 * cut, start, speed, np.repeat(ctrl, 2, 0)[None], past=past.refine().repeat(1))
        model = mujoco.MjModel.from_xml_string(RAIL)
        model.opt.timestep = DT / 2
        finer = plant_of(model, effect).shoot(theta[None], fine).qpos[0, 0, ::2]
        assert np.abs(finer - q[cut:]).max() < 0.2 * np.abs(again[1] - q[cut:]).max(), family


@pytest.mark.parametrize("family", ["hysteresis", "backlash"])
def test_noise_of_a_start_is_that_of_what_led_its_rotor_there(family: str) -> None:
    """A rotor in its gap begins as if all of its past had been off like the start; other memories as measured."""
    cut, steps, off = 707, 300, 0.05
    sizes = {"hysteresis": {"level": 3.0, "transition": 0.05}, "backlash": {"gap": 0.02, "rotor": 0.02}}
    effect, theta = make(family, "rail", sizes[family])
    ctrl = 4 * np.sign(np.sin(np.arange(cut + steps) * DT * 2 * np.pi / 0.35))[:, None]
    whole = run(RAIL, effect, theta, cut + steps, ctrl=ctrl)
    q, v = whole.qpos[0, 0, None, : cut + 1], whole.qvel[0, 0, None, : cut + 1]
    measured, led = Past.given(q, v), Past.given(q, v + off)
    as_told = Segments(DT, cut, q[:, -1], v[:, -1], ctrl[None], past=measured)
    begun = moved(as_told, q[:, -1], v[:, -1] + off)
    plant = plant_of(MODEL, effect)
    found, wanted, other = (
        plant.shoot(theta[None], s).qpos for s in (begun, replace(begun, off=None, past=led), replace(begun, off=None))
    )
    if family == "backlash":
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
        assert np.abs(found - other).max() > 1e-4
    else:
        np.testing.assert_array_equal(found, other)


def test_pasts_are_picked_and_repeated() -> None:
    q = np.arange(12.0).reshape(3, 4, 1)
    past = Past.given(q, 10 * q)
    np.testing.assert_array_equal(past.pick(np.array([2, 0])).motion(1)[0][:, 0], [9, 1])
    np.testing.assert_array_equal(past.pick(np.array([1])).repeat(2).motion(3)[1][:, 0], [70, 70])
    np.testing.assert_array_equal(past.refine().motion(3)[0][:, 0], [1.5, 5.5, 9.5])


def _geared(rotor: float, drive: str = '<motor name="push" joint="rail"/>') -> str:
    """The rail with a rotor in its armature."""
    return RAIL.replace("axis=", f'armature="{rotor}" axis=').replace('<motor name="push" joint="rail"/>', drive)


@pytest.mark.parametrize("gap", [0.02, 1e-4])
def test_backlash_coasts_while_its_rotor_crosses_the_gap(gap: float) -> None:
    """For sqrt(2 gap J / F) after the drive turns; then both go on with the momentum that the drive gave its rotor."""
    rotor, force, first, count = 0.05, 5.0, 101, 1000
    effect, theta = make("backlash", "rail", {"gap": gap, "rotor": rotor})
    ctrl = np.where(np.arange(count) < first, -force, force)[:, None]
    t, nominal = run(_geared(rotor), effect, theta, count, ctrl=ctrl), run(_geared(rotor), None, [], count, ctrl=ctrl)
    v, rate = t.qvel[0, 0, :, 0], force / (MASS + rotor)
    crossing = np.sqrt(2 * gap * rotor / force)
    np.testing.assert_allclose(v[first : first + int(crossing / DT)], -rate * first * DT, rtol=1e-9)
    assert v[-1] == pytest.approx(nominal.qvel[0, 0, -1, 0], rel=1e-3)
    if crossing > 5 * DT:
        behind = (nominal.qpos - t.qpos)[0, 0, -1, 0]
        assert behind == pytest.approx(rate * crossing**2 / 2, rel=0.1)  # within half a step of 20


def test_a_rotor_that_the_model_forgot_crosses_the_gap_with_the_inertia_of_its_effect() -> None:
    """Play and armature at one joint are the play of a drive whose rotor the model knows."""
    force, first, count = 5.0, 101, 600
    ctrl = np.where(np.arange(count) < first, -force, force)[:, None]
    play, small = make("backlash", "rail", {"gap": 0.02, "rotor": 0.01})
    inertia, own = make("armature", "rail", {"inertia": 0.05})
    segments = Segments(DT, 0, np.zeros((1, 1)), np.zeros((1, 1)), ctrl[None])
    both = plant_of(MODEL, play, inertia).shoot(np.concatenate([small, own])[None], segments)
    whole, theta = make("backlash", "rail", {"gap": 0.02, "rotor": 0.05})
    known = run(_geared(0.05), whole, theta, count, ctrl=ctrl)
    np.testing.assert_allclose(both.qpos, known.qpos, atol=1e-12)


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_a_joint_that_coasts_leaves_its_rotor_behind(off: float) -> None:
    """What slows it slows its own mass alone, also where the engine keeps a lone body's inertia apart."""
    rotor, damping, count = 1.5, 0.8, 60
    effect, theta = make("backlash", "rail", {"gap": 0.5, "rotor": rotor})
    text = _geared(rotor).replace("axis=", f'damping="{damping}" axis=').replace("<geom ", f'<geom pos="0 {off} 0" ')
    ctrl = np.where(np.arange(count) < 1, -1.0, 1.0)[:, None]  # the rotor leaves the flank that it was led to
    v = run(text, effect, theta, count, qvel=[1.0], ctrl=ctrl).qvel[0, 0, 2:, 0]
    np.testing.assert_allclose(v[1:] / v[:-1], 1 - damping / MASS * DT, rtol=1e-6)


def test_backlash_loses_what_plastic_impacts_lose() -> None:
    """The drive's work on its rotor is the energy of both masses, less J M / (J + M) dv^2 / 2 in each impact."""
    rng, rotor, count = np.random.default_rng(0), 0.02, 1000
    effect, theta = make("backlash", "rail", {"gap": 0.01, "rotor": rotor})
    model = mujoco.MjModel.from_xml_string(_geared(rotor))
    ctrl = np.repeat(rng.normal(size=20), 50)[:, None] * 5
    t = run(model, effect, theta, count, ctrl=ctrl)
    q, v = t.qpos[0, 0], t.qvel[0, 0]
    nominal = lambda name: np.broadcast_to(getattr(model, name), (count, *getattr(model, name).shape))  # noqa: E731
    ctx = Context(model, DT, q[:-1], v[:-1], ctrl, {}, None, nominal)  # type: ignore[arg-type]
    effect.bind(model)
    _, speed, share, hit, _ = trace(effect, ctx, np.tile(theta, (count, 1)), [np.arange(count)[:, None]])
    own = np.concatenate([v[:1], np.where(share > 0, v[1:], speed)])[:, 0]  # the rotor's speed
    force, v, share, hit = ctrl[:, 0], v[:, 0], share[:, 0], hit[:, 0]
    alone = (1 - share) * DT
    work = force * ((own[:-1] + force / rotor * alone / 2) * alone + (v[1:] + v[:-1]) / 2 * share * DT)
    energy = (MASS * v**2 + rotor * own**2) / 2
    impacts = hit**2 / (2 * rotor) * MASS / (MASS + rotor)
    assert (impacts > 1e-4).sum() > 5
    assert work.sum() - energy[-1] == pytest.approx(impacts.sum(), rel=0.05)


def two_masses(force: np.ndarray, gap: float, rotor: float) -> np.ndarray:
    """Speed of the rail's mass after each step: it and its rotor by finer steps, with plastic impacts at two stops."""
    fine, half, found = 50, gap / 2, []
    place, v, own, h = np.sign(force[0]) * half, 0.0, 0.0, DT / fine  # it begins where the first force leads
    for f in force:
        for _ in range(fine):
            if abs(place) >= half and f * place > 0:
                v = own = v + h * f / (MASS + rotor)
                continue
            own += h * f / rotor
            place += h * (own - v)
            if abs(place) > half:
                place, v = np.sign(place) * half, (MASS * v + rotor * own) / (MASS + rotor)
                own = v
        found.append(v)
    return np.array(found)


@pytest.mark.parametrize("held", [7, 50])
def test_backlash_is_two_masses_also_where_the_drive_turns_before_its_rotor_has_crossed(held: int) -> None:
    """Impulses come within steps, so that speeds are compared in the mean."""
    rotor, gap, count = 0.3, 0.03, 2100
    effect, theta = make("backlash", "rail", {"gap": gap, "rotor": rotor})
    ctrl = np.repeat(np.random.default_rng(1).normal(size=count // held), held) * 5
    v = run(_geared(rotor), effect, theta, len(ctrl), ctrl=ctrl[:, None]).qvel[0, 0, 1:, 0]
    truth = two_masses(ctrl, gap, rotor)
    assert np.sqrt(np.mean((v - truth) ** 2)) < 0.03 * truth.std()


def test_backlash_knows_whether_commands_are_clipped() -> None:
    """Where the model says that they are not, their range is no limit of the drive."""
    motor, flag = '<motor name="push" joint="rail"/>', '<flag clampctrl="disable"/></option>'
    ranged = RAIL.replace(motor, '<motor name="push" joint="rail" ctrlrange="-1 1"/>').replace(
        "/><world", f">{flag}<world"
    )
    effect, theta = make("backlash", "rail", {"gap": 0.01, "rotor": 0.2})
    ctrl = np.where(np.arange(300) // 60 % 2, 4.0, -4.0)[:, None]
    found, wanted = (run(text, effect, theta, 300, ctrl=ctrl).qpos for text in (ranged, RAIL))
    np.testing.assert_array_equal(found, wanted)


def test_backlash_lets_go_of_a_servos_damping_too() -> None:
    """In the gap a stiff servo's damping is gone as well as its force: the joint keeps its speed."""
    effect, theta = make("backlash", "rail", {"gap": 0.5, "rotor": 0.5})
    text = _geared(0.5, '<velocity name="push" joint="rail" kv="500"/>').replace(
        "<option ", '<option integrator="implicitfast" '
    )
    ctrl = np.where(np.arange(60) < 20, 1.0, 0.0)[:, None]
    v = run(text, effect, theta, 60, qvel=[0.9], ctrl=ctrl).qvel[0, 0, :, 0]
    assert v[20] == pytest.approx(1.0, rel=1e-2)
    np.testing.assert_allclose(v[22:48], v[22], rtol=1e-9)
    assert v[-1] < 0.5


def test_thermal_heat_begins_where_the_log_does() -> None:
    """Two seconds at full command before a history of 50 ms: the drive has faded as if all of it had been history."""
    effect, theta = make("thermal", "push", {"fade": 0.5, "time_constant": 2.0, "reference": 1.0})
    plant, cut = plant_of(MODEL, effect), 2000
    ctrl = np.concatenate([np.zeros(1), np.ones(cut + 100)])[:, None]
    whole = run(RAIL, effect, theta, 100, ctrl=ctrl[: cut + 100], history=cut)

    def lay(index: np.ndarray) -> object:
        from nfc_gym.physics.past import Before

        still = np.zeros((1, 51, 1))
        lead = np.concatenate([np.zeros(1), np.ones(195)])[None, :, None]
        return Before(still, still, lead, (cut - 50) * DT / 195)

    seg = Segments(DT, 50, np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 150, 1)), past=Past(lay, np.arange(1)))  # type: ignore[arg-type]
    short = plant.shoot(theta[None], seg)
    assert short.qvel[0, 0, -1, 0] == pytest.approx(whole.qvel[0, 0, -1, 0], rel=5e-3)
    settled = run(RAIL, effect, theta, 100, ctrl=[1.0], history=50).qvel[0, 0, -1, 0]
    assert abs(settled / whole.qvel[0, 0, -1, 0] - 1) > 0.1


def test_thermal_heat_of_a_log_that_begins_with_its_history() -> None:
    """With nothing commanded before the history the drive's heat settles at the history's first command."""
    effect, theta = make("thermal", "push", {"fade": 0.5, "time_constant": 2.0, "reference": 1.0})
    still = np.zeros((1, 51, 1))
    seg = Segments(DT, 50, np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 150, 1)), past=Past.given(still, still))
    found = plant_of(MODEL, effect).shoot(theta[None], seg)
    assert found.qvel[0, 0, -1, 0] == run(RAIL, effect, theta, 100, ctrl=[1.0], history=50).qvel[0, 0, -1, 0]


def test_generic_memory_stands_for_laws_it_does_not_know() -> None:
    """A Bouc-Wen joint (n = 2, sigma = 0.6) led through turns: memory explains it, a function of place does not."""
    x = np.concatenate([np.linspace(0, 0.3, 300), np.linspace(0.3, -0.2, 500), np.linspace(-0.2, 0.25, 450)])
    w, truth = 0.0, []
    for step in np.diff(x):
        s = np.sign(step)
        w += step / 0.06 * (1 - 0.6 * s * abs(w) * w + (0.6 - 1) * w * w)
        truth.append(w)
    y = np.array(truth)
    scales = Scales(
        np.ones(1), np.full(1, 0.5), np.ones(1), np.ones(1), 0.01, {"exo:time": 1.0}, {"joint:rail:pos": (0.2, 1e-3)}
    )

    def unexplained(family: str) -> float:
        effect = FAMILIES[family].propose(MODEL, scales)[0]
        effect.bind(MODEL)
        ctx = Context(MODEL, DT, np.zeros(1), np.zeros(1), np.zeros(1), {}, None, None)  # type: ignore[arg-type]
        memory, columns = effect.rest(ctx, effect.null), []
        for step, place in zip(np.diff(x), x[1:], strict=True):
            ctx.q, ctx.v = np.array([place]), np.array([step / DT])
            if family == "generic_memory":
                ctx.memory = memory = effect.follow(ctx, effect.null, memory)
            column = []
            for unit in np.eye(6):
                out = Forces(np.zeros(1), np.zeros((2, 6)))
                effect.force(ctx, unit, out)
                column.append(out.qfrc[0])
            columns.append(column)
        a = np.array(columns)
        rest = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
        return float((rest**2).mean() / (y**2).mean())

    assert unexplained("generic_memory") < 0.01
    assert unexplained("generic_position") > 0.2
