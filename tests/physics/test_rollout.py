"""Batched shooting against a plain loop of `mj_step`, bit for bit."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from machines import candidates, plant_of, probe, zoo, zoo_segments

from nfc_gym.physics.activations import Activations
from nfc_gym.physics.effects import Effect, build
from nfc_gym.physics.effects.base import Context, Forces
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments, Servo

MODEL = zoo()
NONE = np.zeros((1, 0))


def _plain(model: mujoco.MjModel, segments: Segments, s: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(qpos, qvel, sensordata) of segment s from a loop over one MjData."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = segments.qpos[s], segments.qvel[s]
    for k in range(segments.history):
        Activations(model, segments.dt).advance(segments.ctrl[s, k], data.act, settle=k == 0)
    if segments.history == 0:
        Activations(model, segments.dt).advance(segments.ctrl[s, 0], data.act, settle=True)
    rows = []
    for k in range(segments.steps):
        before = data.qpos.copy(), data.qvel.copy()
        data.ctrl[:] = segments.ctrl[s, segments.history + k]
        mujoco.mj_step(model, data)
        rows.append((*before, data.sensordata.copy()))
    mujoco.mj_forward(model, data)
    rows.append((data.qpos.copy(), data.qvel.copy(), data.sensordata.copy()))
    q, v, sensors = (np.array(a) for a in zip(*rows, strict=True))
    return q, v, sensors


@pytest.mark.parametrize("history", [0, 15])
def test_without_effects_it_is_a_loop_of_mj_step(history: int) -> None:
    segments = zoo_segments(MODEL, 1, size=3, history=history)
    t = plant_of(MODEL).shoot(NONE, segments, sensors=True)
    assert t.sensordata is not None
    for s in range(3):
        for mine, theirs in zip((t.qpos, t.qvel, t.sensordata), _plain(MODEL, segments, s), strict=True):
            np.testing.assert_array_equal(mine[0, s], theirs)
    assert t.stable.all()


class Watching(Effect):
    """Does nothing, before every step."""

    family = "watching"

    def __init__(self) -> None:
        super().__init__(("all",), [])

    def force(self, ctx: Context, theta: np.ndarray, out: Forces) -> None: ...


@pytest.mark.parametrize("family", [None, "lag", "thermal", "coulomb"])
@pytest.mark.parametrize(("history", "settle"), [(0, 0), (15, 0), (15, 7)])
def test_steps_in_one_call_are_those_with_hooks_in_between(family: str | None, history: int, settle: int) -> None:
    segments = replace(zoo_segments(MODEL, 3, size=3, history=history), settle=settle)
    effects = [candidates(MODEL)[family][0]] if family else []
    x = np.concatenate([NONE[0], *map(probe, effects)])[None]
    for sensors in (False, True):
        whole = plant_of(MODEL, *effects).shoot(x, segments, sensors)
        watched = plant_of(MODEL, *effects, Watching()).shoot(x, segments, sensors)
        for field in ("qpos", "qvel", "sensordata", "stable", "touched"):
            np.testing.assert_array_equal(getattr(whole, field), getattr(watched, field))
    assert whole.touched.any()


def test_sensors_that_nobody_asks_for_are_not_computed_and_the_motion_is_the_same() -> None:
    class Reading(Effect):
        family = "reading"

        def __init__(self) -> None:
            super().__init__(("all",), [])

        def force(self, ctx: Context, theta: np.ndarray, out: Forces) -> None:
            ctx.data("sensordata")

    segments = zoo_segments(MODEL, 1, size=3)
    with_them, without = (plant_of(MODEL).shoot(NONE, segments, sensors=s) for s in (True, False))
    np.testing.assert_array_equal(with_them.qpos, without.qpos)
    np.testing.assert_array_equal(with_them.qvel, without.qvel)
    with pytest.raises(LookupError, match="sensordata"):
        plant_of(MODEL, Reading()).shoot(NONE, segments)


def test_psi_is_what_a_model_edited_by_hand_does() -> None:
    space = ParameterSpace(
        MODEL,
        [
            Parameter("m", "body_mass", ("craft",), "kg", 0.1, 5),
            Parameter("d", "dof_damping", ("shoulder",), "1", 0, 1),
        ],
    )
    segments = zoo_segments(MODEL, 2)
    x = np.array([[1.0, 0.02], [1.7, 0.3]])
    t = Plant(MODEL, space, nthread=1).shoot(x, segments)
    for p in range(2):
        model = zoo()
        fields = ModelFields(model)
        space.write(fields, x[p])
        fields.commit()
        for s in range(len(segments)):
            np.testing.assert_array_equal(t.qpos[p, s], _plain(model, segments, s)[0])


def test_rows_do_not_depend_on_threads_or_company() -> None:
    effects = [
        found[0]
        for family, found in candidates(MODEL).items()
        if family in ("delay", "stribeck", "drag_linear", "payload", "slip")
    ]
    segments = zoo_segments(MODEL, 3, size=3)
    x = np.stack([np.concatenate([share * (probe(e) - e.null) + e.null for e in effects]) for share in (0.0, 0.5, 1.0)])
    whole = Plant(MODEL, ParameterSpace(MODEL, []), effects, nthread=1).shoot(x, segments)
    for threads in (2, 3):
        again = Plant(MODEL, ParameterSpace(MODEL, []), effects, nthread=threads).shoot(x, segments)
        np.testing.assert_array_equal(whole.qpos, again.qpos)
    alone = Plant(MODEL, ParameterSpace(MODEL, []), effects, nthread=1).shoot(x[1:2], segments)
    np.testing.assert_array_equal(whole.qpos[1:2], alone.qpos)
    own = np.broadcast_to(x[:, None], (3, 3, x.shape[1]))
    np.testing.assert_array_equal(
        Plant(MODEL, ParameterSpace(MODEL, []), effects, nthread=1).shoot(own, segments).qpos, whole.qpos
    )


def test_history_settles_a_filter_at_its_first_command_and_advances_it() -> None:
    """The rotors' filter (50 ms) after a history of two commands, in closed form: the force of the first step."""
    segments = zoo_segments(MODEL, 4, size=1, history=20, steps=1)
    segments.ctrl[0, :, 0] = np.r_[np.full(8, 4.0), np.full(13, 9.0)]
    seen: list[np.ndarray] = []

    class Watch(Effect):
        family = "watch"
        summary = "Records what the first force hook sees"

        def force(self, ctx: Context, theta: np.ndarray, out: Forces) -> None:
            seen.append(ctx.data("actuator_force").copy())

    watch = Watch(("world",), (Param("none", "1", 0.0, 1.0),))
    plant_of(MODEL, watch).shoot(np.zeros((1, 1)), segments)
    expected = 9.0 + (4.0 - 9.0) * np.exp(-12 * segments.dt / 0.05)
    assert seen[0][0, 0] == pytest.approx(expected, rel=1e-12)


def test_derived_fields_are_current_at_the_first_step() -> None:
    """A hook that reads a field of MjData sees the start state's value at once, not zeros."""
    segments = zoo_segments(MODEL, 5, size=2, history=0, steps=2)
    seen: list[np.ndarray] = []

    class Watch(Effect):
        family = "watch"
        summary = "Records what the force hook sees"

        def force(self, ctx: Context, theta: np.ndarray, out: Forces) -> None:
            seen.append(ctx.data("xipos").copy())

    plant_of(MODEL, Watch(("world",), (Param("none", "1", 0.0, 1.0),))).shoot(np.zeros((1, 1)), segments)
    for s in range(2):
        data = mujoco.MjData(MODEL)
        data.qpos[:], data.qvel[:] = segments.qpos[s], segments.qvel[s]
        mujoco.mj_forward(MODEL, data)
        np.testing.assert_array_equal(seen[0][s], data.xipos)
        np.testing.assert_array_equal(seen[1][s], data.xipos)  # one substep behind


def test_effects_act_in_their_order() -> None:
    """An offset before a dead zone is not a dead zone before an offset."""
    first, a = build("offset", "push", {"offset": 0.4})
    second, b = build("dead_zone", "push", {"width": 0.3})
    segments = zoo_segments(MODEL, 6)
    one = plant_of(MODEL, first, second).shoot(np.concatenate([a, b])[None], segments).qpos
    two = plant_of(MODEL, second, first).shoot(np.concatenate([b, a])[None], segments).qpos
    shifted = replace(segments, ctrl=segments.ctrl.copy())
    push = MODEL.actuator("push").id
    wish = np.clip(segments.ctrl[..., push] + 0.4, *MODEL.actuator_ctrlrange[push])  # what reaches the drive
    shifted.ctrl[..., push] = wish - np.clip(wish, -0.3, 0.3)
    np.testing.assert_array_equal(one, plant_of(MODEL).shoot(NONE, shifted).qpos)
    assert np.abs(one - two).max() > 1e-6


def test_known_fields_follow_the_log() -> None:
    """A constant known field is a model compiled so; a varying one equals a loop that writes it at every step."""
    damping = np.linspace(0.0, 2.0, 55)
    segments = zoo_segments(MODEL, 7, size=1)
    known = {("dof_damping", ("shoulder",)): damping[None]}
    t = plant_of(MODEL).shoot(NONE, replace(segments, known=known))
    model, data = zoo(), mujoco.MjData(MODEL)
    data.qpos[:], data.qvel[:] = segments.qpos[0], segments.qvel[0]
    for k in range(segments.history):
        Activations(model, segments.dt).advance(segments.ctrl[0, k], data.act, settle=k == 0)
    for k in range(segments.steps):
        model.dof_damping[model.joint("shoulder").dofadr[0]] = damping[segments.history + k]
        data.ctrl[:] = segments.ctrl[0, segments.history + k]
        mujoco.mj_step(model, data)
        np.testing.assert_array_equal(t.qpos[0, 0, k + 1], data.qpos)


def test_firmware_servo_closes_its_loop_at_every_step() -> None:
    joint = MODEL.joint("shoulder")
    servo = Servo(MODEL.actuator("push").id, int(joint.qposadr[0]), int(joint.dofadr[0]), 0.5)
    segments = zoo_segments(MODEL, 8, size=1, history=0)
    shape = segments.ctrl.shape[:2]
    terms = {"gain": np.full(shape, 3.0), "supply": np.full(shape, 1.5), "damping": np.full(shape, 0.2)}
    t = plant_of(MODEL).shoot(NONE, replace(segments, servo=[(servo, terms)]))
    data = mujoco.MjData(MODEL)
    data.qpos[:], data.qvel[:] = segments.qpos[0], segments.qvel[0]
    Activations(MODEL, segments.dt).advance(segments.ctrl[0, 0], data.act, settle=True)
    for k in range(segments.steps):
        data.ctrl[:] = segments.ctrl[0, k]
        wish = 3.0 * (data.ctrl[servo.actuator] - data.qpos[servo.qpos]) - 0.2 * data.qvel[servo.dof]
        data.ctrl[servo.actuator] = 1.5 * np.clip(wish, -0.5, 0.5)
        mujoco.mj_step(MODEL, data)
        np.testing.assert_array_equal(t.qpos[0, 0, k + 1], data.qpos)


@pytest.mark.parametrize("order", [1, -1])
def test_effects_of_a_drive_act_behind_its_firmware_servo_and_those_of_a_goal_before_it(order: int) -> None:
    joint = MODEL.joint("shoulder")
    servo = Servo(MODEL.actuator("push").id, int(joint.qposadr[0]), int(joint.dofadr[0]), 0.5)
    segments = zoo_segments(MODEL, 8, size=1, history=0)
    shape = segments.ctrl.shape[:2]
    terms = {"gain": np.full(shape, 3.0), "supply": np.full(shape, 1.5), "damping": np.full(shape, 0.2)}
    effects = [build("dead_zone", "push", {"width": 0.2}), build("offset", "push", {"offset": 0.1})][::order]
    for effect, _ in effects:
        effect.bind(MODEL)
    plant = plant_of(MODEL, *(e for e, _ in effects))
    theta = np.concatenate([theta for _, theta in effects])[None]
    t = plant.shoot(theta, replace(segments, servo=[(servo, terms)]))
    data = mujoco.MjData(MODEL)
    data.qpos[:], data.qvel[:] = segments.qpos[0], segments.qvel[0]
    for k in range(segments.steps):
        data.ctrl[:] = segments.ctrl[0, k]
        wish = 3.0 * (data.ctrl[servo.actuator] + 0.1 - data.qpos[servo.qpos]) - 0.2 * data.qvel[servo.dof]
        made = 1.5 * np.clip(wish, -0.5, 0.5)
        data.ctrl[servo.actuator] = made - np.clip(made, -0.2, 0.2)
        if k == 0:
            Activations(MODEL, segments.dt).advance(data.ctrl, data.act, settle=True)
        mujoco.mj_step(MODEL, data)
        np.testing.assert_allclose(t.qpos[0, 0, k + 1], data.qpos, rtol=0, atol=1e-12)


def test_rows_that_blow_up_are_marked_and_leave_the_others_alone() -> None:
    segments = zoo_segments(MODEL, 9)
    space = ParameterSpace(MODEL, [Parameter("k", "jnt_stiffness", ("rail",), "N/m", -1e9, 1e9)])
    t = Plant(MODEL, space, nthread=1).shoot(np.array([[2.0], [-1e9]]), segments)
    assert t.stable[0].all()
    assert not t.stable[1].any()
    np.testing.assert_array_equal(t.qpos[0], plant_of(MODEL).shoot(NONE, segments).qpos[0])
