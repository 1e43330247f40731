"""The Quadruped's laws against numbers worked out by hand."""

import mujoco
import numpy as np
import pytest
from views import blank, proprio, random_fields, robot_of, view_of, yawed

from nfc_gym.envs.quadruped import EDGE, FORWARD, SIDEWAYS, TURNING, Quadruped

ROBOT, MODEL = robot_of(Quadruped)
HALF = np.sqrt(0.5)
PARTS = ("base_hull", "FL_thigh", "FR_thigh", "RL_thigh", "RR_thigh")


def task(command: tuple[float, ...] = (0.0, 0.0, 0.0), shape: tuple[int, ...] = ()) -> dict[str, np.ndarray]:
    return {
        "command": np.broadcast_to(command, (*shape, 3)).copy(),
        "action": np.zeros((*shape, 12)),
        "rate": np.zeros(shape),
    }


def test_every_entry_of_proprio() -> None:
    """Facing +y and moved off the origin; every entry a number of its own."""
    fields = blank(MODEL)
    fields["qpos"][:] = [5, -6, 0.7, HALF, 0, 0, HALF, *(0.1 * np.arange(12))]
    fields["qvel"][:] = [1, 2, 3, 0.4, 0.5, 0.6, *(10 + np.arange(12))]
    memory = task((0.5, -0.1, 0.2)) | {"action": 0.01 * np.arange(12)}
    expected = [
        *(2, -1, 3),
        *(0.4, 0.5, 0.6),
        *(0, 0, -1),
        *(0.5, -0.1, 0.2),
        *(0.1 * np.arange(12)),
        *(10 + np.arange(12)),
        *(0.01 * np.arange(12)),
    ]
    np.testing.assert_allclose(proprio(ROBOT, view_of(ROBOT, MODEL, fields, memory)), expected, atol=1e-12)
    assert len(expected) == ROBOT.proprio_size == 48


@pytest.mark.parametrize(
    ("axis", "down"),
    [(0, (0, -np.sin(0.4), -np.cos(0.4))), (1, (np.sin(0.4), 0, -np.cos(0.4)))],
)
def test_gravity_of_a_tilted_trunk(axis: int, down: tuple[float, ...]) -> None:
    """Rolled left up: down points to its right. Nose down: down points ahead."""
    fields = blank(MODEL)
    fields["qpos"][3:7] = [np.cos(0.2), 0, 0, 0]
    fields["qpos"][4 + axis] = np.sin(0.2)
    np.testing.assert_allclose(proprio(ROBOT, view_of(ROBOT, MODEL, fields, task()))[6:9], down, atol=1e-12)


def test_turning_and_shifting_the_world_changes_nothing() -> None:
    fields = random_fields(MODEL, np.random.default_rng(0), (20,))
    memory = task((0.3, 0.1, -0.2), (20,))
    here = proprio(ROBOT, view_of(ROBOT, MODEL, fields, memory))
    there = proprio(ROBOT, view_of(ROBOT, MODEL, yawed(fields, -2.1, [4.0, 7.0]), memory))
    np.testing.assert_allclose(there, here, atol=1e-9)


def test_every_term_of_the_reward() -> None:
    """Facing +y; 0.3 m/s too slow ahead, 0.1 m/s of drift to the left, one foot of two on the ground sliding."""
    fields = blank(MODEL)
    fields["qpos"][3:7] = [HALF, 0, 0, HALF]
    fields["qvel"][:6] = [-0.1, 0.2, 0.05, 0.3, -0.4, 0.6]
    fields["actuator_force"][:2] = [3.0, -4.0]
    sensors = fields["sensordata"]
    sensors[MODEL.sensor("FL_foot_touch").adr[0]] = 30.0
    sensors[MODEL.sensor("RR_foot_touch").adr[0]] = 20.0
    for foot, velocity in {"FR": (1, 1, 1), "RR": (0.3, -0.4, 9)}.items():
        start = MODEL.sensor(f"{foot}_foot_velocity").adr[0]
        sensors[start : start + 3] = velocity
    memory = task((0.5, 0.0, 0.4)) | {"rate": np.array(2.0)}
    terms = ROBOT.reward(view_of(ROBOT, MODEL, fields, memory), np.zeros(12))
    expected = {
        "linear": np.exp(-(0.3**2 + 0.1**2) / 0.25),
        "yaw": 0.5 * np.exp(-(0.2**2) / 0.25),
        "vertical": -2 * 0.05**2,
        "rolling": -0.02 * 0.25,
        "torque": -1e-5 * 25,
        "rate": -0.02,
        "slip": -0.1 * 0.25,
    }
    assert tuple(terms) == ROBOT.terms == tuple(expected)
    for name, value in expected.items():
        assert terms[name] == pytest.approx(value, abs=1e-9), name


def test_standing_still_under_a_zero_command_earns_nearly_all() -> None:
    data = mujoco.MjData(MODEL)
    mujoco.mj_resetDataKeyframe(MODEL, data, 0)
    mujoco.mj_step(MODEL, data, nstep=100)
    fields = {name: getattr(data, name) for name in blank(MODEL)}
    view = view_of(ROBOT, MODEL, fields, task())
    assert 1.49 < sum(ROBOT.reward(view, np.zeros(12)).values()) < 1.5
    assert not ROBOT.terminated(view)


def test_change_of_action_is_remembered() -> None:
    view = view_of(ROBOT, MODEL, blank(MODEL), task() | {"action": np.full(12, 0.5)})
    memory = ROBOT.advance(view, np.full(12, -0.5))
    assert memory["rate"] == 12.0
    np.testing.assert_array_equal(memory["action"], np.full(12, -0.5))


@pytest.mark.parametrize(
    ("place", "command", "turned"),
    [
        ((EDGE + 0.1, 0), (1.0, 0.2, 0.5), True),
        ((EDGE - 0.1, 0), (1.0, 0.2, 0.5), False),
        ((EDGE + 0.1, 0), (-1.0, 0.2, 0.5), False),
        ((0, -EDGE - 0.1), (0.0, -0.4, 0.5), True),
    ],
)
def test_a_command_off_the_map_is_turned_round(
    place: tuple[float, float], command: tuple[float, float, float], turned: bool
) -> None:
    """Heading +x. The yaw rate stays."""
    fields = blank(MODEL)
    fields["qpos"][:2] = place
    view = view_of(ROBOT, MODEL, fields, task(command))
    after = {**view.task, **ROBOT.advance(view, np.zeros(12))}["command"]
    sign = -1 if turned else 1
    np.testing.assert_array_equal(after, [sign * command[0], sign * command[1], command[2]])


@pytest.mark.parametrize("part", ["base_touch", "RL_thigh_touch", "FL_thigh_touch"])
def test_ends_when_trunk_or_thigh_touch(part: str) -> None:
    fields = blank(MODEL)
    fields["sensordata"][MODEL.sensor("FL_foot_touch").adr[0]] = 50.0
    assert not ROBOT.terminated(view_of(ROBOT, MODEL, fields, task()))
    fields["sensordata"][MODEL.sensor(part).adr[0]] = 5.0
    assert ROBOT.terminated(view_of(ROBOT, MODEL, fields, task()))


@pytest.mark.parametrize(("tilt", "ended"), [(0.98, False), (1.02, True)])
def test_ends_when_it_leans_too_far(tilt: float, ended: bool) -> None:
    fields = blank(MODEL)
    fields["qpos"][3:7] = [np.cos(tilt / 2), HALF * np.sin(tilt / 2), HALF * np.sin(tilt / 2), 0]
    assert ROBOT.terminated(view_of(ROBOT, MODEL, fields, task())) == ended


def test_a_fallen_robot_is_felt_by_its_trunk_or_thighs() -> None:
    """Dropped on its side, and on its belly with the legs drawn up, in the simulation."""
    for quat, pose in (([HALF, HALF, 0, 0], [0, 0.9, -1.8] * 4), ([1, 0, 0, 0], [0, 2.4, -0.85] * 4)):
        data = mujoco.MjData(MODEL)
        mujoco.mj_resetDataKeyframe(MODEL, data, 0)
        data.qpos[2:7] = [0.2, *quat]
        data.qpos[7:] = data.ctrl[:] = pose
        mujoco.mj_step(MODEL, data, nstep=300)
        hull = data.sensordata[ROBOT.hull]
        names = {MODEL.geom(g).name for c in data.contact for g in c.geom}
        assert [force > 5 for force in hull] == [part in names for part in PARTS]
        assert hull.max() > 5


def test_actions_are_added_to_the_default_pose() -> None:
    view = view_of(ROBOT, MODEL, blank(MODEL), task())
    home = MODEL.key("home").ctrl
    np.testing.assert_array_equal(ROBOT.actuate(np.zeros(12), view), home)
    np.testing.assert_allclose(ROBOT.actuate(np.full(12, -1.0), view), home - 0.25)


def test_one_robot_is_a_row_of_many_to_the_bit() -> None:
    rng = np.random.default_rng(1)
    fields = random_fields(MODEL, rng, (17,))
    fields["qpos"][:5, 0] += 12
    memory = {"command": rng.normal(size=(17, 3)), "action": rng.normal(size=(17, 12)), "rate": rng.random(17)}
    action = rng.uniform(-1, 1, (17, 12))

    def laws(pick: object) -> list[np.ndarray]:
        view = view_of(ROBOT, MODEL, {k: v[pick] for k, v in fields.items()}, {k: v[pick] for k, v in memory.items()})
        view.task.update(ROBOT.advance(view, action[pick]))
        terms = ROBOT.reward(view, action[pick])
        return [proprio(ROBOT, view), view.task["command"], ROBOT.terminated(view), *terms.values()]

    many = laws(slice(None))
    for i in range(17):
        for one, row in zip(laws(i), many, strict=True):
            np.testing.assert_array_equal(one, row[i])


def test_commands_fill_their_ranges_and_some_say_stand() -> None:
    u = np.random.default_rng(0).random((2000, ROBOT.draws))
    command = ROBOT.begin(u, lambda xy: np.zeros(xy.shape[:-1])).task["command"]
    still = (command == 0).all(-1)
    assert 0.07 < still.mean() < 0.13
    for values, (low, high) in zip(command[~still].T, (FORWARD, SIDEWAYS, TURNING), strict=True):
        assert low <= values.min() < low + 0.02
        assert high - 0.02 < values.max() < high
