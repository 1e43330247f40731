"""What Ant and Humanoid share: invariances, targets, progress, and one robot equal to a row of many."""

import numpy as np
import pytest
from views import proprio, random_fields, robot_of, view_of, yawed

from nfc_gym.envs.ant import Ant
from nfc_gym.envs.humanoid import Humanoid
from nfc_gym.envs.robot import DT
from nfc_gym.envs.runner import ONWARD, RING, Runner


@pytest.fixture(params=[Ant, Humanoid])
def kind(request: pytest.FixtureRequest) -> type[Runner]:
    return request.param


def test_turning_and_shifting_the_world_changes_yaw_alone(kind: type[Runner]) -> None:
    robot, model = robot_of(kind)
    rng = np.random.default_rng(0)
    fields = random_fields(model, rng, (20,))
    target, angle, shift = rng.normal(size=(20, 2)), 0.9, np.array([3.0, -5.0])
    task = {"target": target, "action": rng.normal(size=(20, kind.action_size))}
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    here = view_of(robot, model, fields, task)
    there = view_of(robot, model, yawed(fields, angle, shift), task | {"target": target @ turn.T + shift})
    a, b = proprio(robot, here), proprio(robot, there)
    yaw = 7
    np.testing.assert_allclose(np.delete(b, yaw, 1), np.delete(a, yaw, 1), atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * (b[:, yaw] - a[:, yaw])), np.exp(1j * angle), atol=1e-9)


def test_one_robot_is_a_row_of_many_to_the_bit(kind: type[Runner]) -> None:
    robot, model = robot_of(kind)
    rng = np.random.default_rng(1)
    first, second = (random_fields(model, rng, (17,)) for _ in range(2))
    target = rng.normal(size=(17, 2))
    target[0] = second["qpos"][0, :2] + 0.1  # reached
    task = {"target": target, "action": rng.uniform(-1, 1, (17, kind.action_size))}
    action = rng.uniform(-1, 1, (17, kind.action_size))

    def laws(pick: object) -> list[np.ndarray]:
        view = view_of(robot, model, {k: v[pick] for k, v in first.items()}, {k: v[pick] for k, v in task.items()})
        before = view.now
        view = view_of(robot, model, {k: v[pick] for k, v in second.items()}, view.task)
        view.task.update(robot.advance(view, action[pick]))
        view.before, view.now = before, robot.derive(view)
        terms = robot.reward(view, action[pick])
        return [proprio(robot, view), view.task["target"], robot.terminated(view), *terms.values()]

    many = laws(slice(None))
    for i in range(17):
        for one, row in zip(laws(i), many, strict=True):
            np.testing.assert_array_equal(one, row[i])


def test_progress_adds_up_to_the_way_made(kind: type[Runner]) -> None:
    """Along a straight line to the target the summed progress is the distance over the control step, for any steps."""
    robot, model = robot_of(kind)
    task = {"target": np.array([0.0, 9.0]), "action": np.zeros(kind.action_size)}
    rng = np.random.default_rng(0)
    fields = random_fields(model, rng, ())
    fields["qpos"][:2] = 0
    view, total = view_of(robot, model, fields, task), 0.0
    for step in rng.uniform(-0.02, 0.05, 30):
        before = view.now
        fields["qpos"][1] += step
        view.before, view.now = before, robot.derive(view)
        total += robot.reward(view, np.zeros(kind.action_size))["progress"]
    assert total == pytest.approx(fields["qpos"][1] / DT, rel=1e-9)


def test_who_reaches_a_target_is_given_the_next(kind: type[Runner]) -> None:
    """Only the one within a metre; the next lies as far from the middle, 16.8 m on. The step itself is paid in full."""
    robot, model = robot_of(kind)
    fields = random_fields(model, np.random.default_rng(0), (2,))
    fields["qpos"][:, :2] = [[8.5, 0.0], [7.5, 0.0]]
    task = {"target": np.array([[RING, 0.0], [RING, 0.0]]), "action": np.zeros((2, kind.action_size))}
    view = view_of(robot, model, fields, task)
    before = view.now
    fields["qpos"][:, 0] += 0.04
    view.task.update(robot.advance(view, task["action"]))
    target = view.task["target"]
    np.testing.assert_array_equal(target[1], [RING, 0])
    np.testing.assert_allclose(target[0], [RING * np.cos(ONWARD), RING * np.sin(ONWARD)])
    assert (
        np.linalg.norm(target[0] - [RING, 0])
        == pytest.approx(2 * RING * np.sin(ONWARD / 2))
        == pytest.approx(16.78, abs=0.01)
    )
    view.before, view.now = before, robot.derive(view)
    np.testing.assert_allclose(robot.reward(view, task["action"])["progress"], 2.0)


def test_targets_never_lead_off_the_map(kind: type[Runner]) -> None:
    robot, model = robot_of(kind)
    fields = random_fields(model, np.random.default_rng(0), ())
    task = {"target": np.array([RING, 0.0]), "action": np.zeros(kind.action_size)}
    view = view_of(robot, model, fields, task)
    seen = []
    for _ in range(50):
        fields["qpos"][:2] = view.task["target"]
        view.task.update(robot.advance(view, task["action"]))
        seen.append(view.task["target"])
    np.testing.assert_allclose(np.linalg.norm(seen, axis=-1), RING)
    assert len(np.unique(np.round(seen, 6), axis=0)) == 50
