"""One shard: what its arrays say is what was simulated."""

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import safetensors.numpy

from nfc_gym.core import InputError
from nfc_gym.envs.contract import robot_class
from nfc_gym.physics.fields import ModelFields
from nfc_gym.simulate import ground, motion
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.residuals import Given, sizes
from nfc_gym.simulate.roll import Task, roll
from nfc_gym.simulate.run import manifest_of
from nfc_gym.simulate.shard import Plan, make_shard, workshop

JACKAL = "nfc_gym/JackalFlat-v0"
IDS = [
    f"nfc_gym/{r}{g}-v0" for r in ("Ant", "Quadruped", "Humanoid", "Quadcopter", "Jackal") for g in ("Flat", "Rough")
]


def plan(environment: str, windows: int, shards: int = 1, effects: float = 0.5, **more: float) -> Plan:
    return Plan(manifest_of(environment, windows * shards, 0, windows, {}), effects=effects, **more)


@cache
def shard(environment: str, windows: int, effects: float = 0.5, motor: float = 0.02) -> dict[str, np.ndarray]:
    return safetensors.numpy.load(make_shard(plan(environment, windows, effects=effects, motor=motor), 0))


def task(machine: Machine, n: int, given: list[Given]) -> Task:
    rng, habit = np.random.default_rng(1), machine.habit
    steps = habit.warm[1] + habit.horizon
    u = rng.random((n, motion.count(steps, machine.kind.action_size)))
    return Task(
        psi=machine.space.sample(rng, n),
        which=np.zeros(n, int),
        start=rng.random((n, ground.count(machine))),
        signal=motion.signals(u, steps, machine.kind.action_size, machine.dt, habit.swing, habit.offset),
        jitter=np.zeros((n, steps, machine.kind.action_size)),
        warm=rng.integers(*habit.warm, n),
        guided=np.zeros(n, bool),
        given=given,
    )


def test_any_number_of_threads_gives_the_same_bits() -> None:
    made = plan("nfc_gym/JackalRough-v0", 8)
    assert make_shard(made, 0, nthread=1) == make_shard(made, 0, nthread=3)


def test_seeds_and_shards_differ() -> None:
    made = plan(JACKAL, 8, shards=2)
    other = replace(made, manifest=replace(made.manifest, seed=1))
    assert len({make_shard(made, 0), make_shard(made, 1), make_shard(other, 0)}) == 3


@pytest.mark.parametrize("environment", IDS)
def test_every_robot_moves_in_its_windows(environment: str) -> None:
    made, machine = shard(environment, 8), Machine(environment)
    assert made["states"].shape == (8, machine.habit.horizon + 1, machine.kind.proprio_size)
    assert (np.abs(np.diff(made["states"], axis=1)).max((1, 2)) > 0.05).all()
    assert (np.abs(made["actions"]) <= 1).all()
    assert ((made["psi"] >= 0) & (made["psi"] <= 1)).all()
    assert (made["terrain_kind"] >= 0).all() == machine.rough
    none = made["family"] == 0
    assert not made["delta_s"][none].any()
    assert (made["effect"] < 0).tolist() == none.tolist()


def test_one_plain_simulation_repeats_a_window_from_its_start() -> None:
    """psi, start, actions and states of windows without effects fit together, by MuJoCo alone."""
    made, machine = shard(JACKAL, 8, effects=0.0, motor=0.0), Machine(JACKAL)
    kind = robot_class(machine.kwargs["robot"])
    for i in range(4):
        model = kind.compile(0)
        fields = ModelFields(model)
        low, high = machine.space.low, machine.space.high
        machine.space.write(fields, low + made["psi"][i].astype(float) * (high - low))
        fields.commit()
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, made["start"][i], mujoco.mjtState.mjSTATE_INTEGRATION.value)
        robot = machine.settings.robot(model)
        for k, action in enumerate(made["actions"][i].astype(float)):
            assert made["states"][i, k, :4].tolist() == data.qpos[3:7].astype(np.float32).tolist()
            assert made["pose"][i, k].tolist() == data.qpos[:7].astype(np.float32).tolist()
            data.ctrl[:] = robot.actuate(action, None)
            mujoco.mj_step(model, data, nstep=kind.frame_skip)
        assert made["states"][i, -1, 10:13].tolist() == data.qpos[:3].astype(np.float32).tolist()


def test_effects_at_their_null_leave_no_residual_and_the_same_motion() -> None:
    machine, shop = Machine(JACKAL), workshop(JACKAL)
    firsts = [next(e for e in shop.effects if e.family == f) for f in shop.by_family]
    given = [Given(e, slice(i, i + 1), e.null[None]) for i, e in enumerate(firsts)]
    with_, without = (roll(machine, task(machine, len(firsts), g), [], None, 1) for g in (given, []))
    assert not with_.delta_s.any()
    np.testing.assert_array_equal(with_.states, without.states)


@pytest.mark.parametrize("family", ["payload", "external_force"])
def test_the_residual_is_the_mean_of_single_steps_without_the_effect(family: str) -> None:
    """Worked out anew by plain MuJoCo, one robot, its states set step by step."""
    machine, shop = Machine(JACKAL), workshop(JACKAL)
    effect = next(e for e in shop.effects if e.id == f"{family}:base")
    theta = sizes(effect, np.random.default_rng(3).random((2, 2 * len(effect.params))))
    job = task(machine, 2, [Given(effect, slice(0, 2), theta)])
    done = roll(machine, job, [], None, 1)
    kind, full = robot_class(machine.kwargs["robot"]), mujoco.mjtState.mjSTATE_INTEGRATION
    for i in range(2):
        with_, without = kind.compile(0), kind.compile(0)
        for model in (with_, without):
            fields = ModelFields(model)
            machine.space.write(fields, job.psi[i])
            if model is with_:
                effect.model(fields, theta[i])
            fields.commit()
        a, b, total = mujoco.MjData(with_), mujoco.MjData(without), np.zeros(3)
        mujoco.mj_setState(with_, a, done.start[i], full)
        state, base, robot = done.start[i].copy(), with_.body("base").id, machine.settings.robot(with_)
        for action in done.actions[i].astype(float):
            mujoco.mj_getState(with_, a, state, full)
            mujoco.mj_setState(without, b, state, full)
            a.ctrl[:] = b.ctrl[:] = robot.actuate(action, None)
            if family == "external_force":
                a.xfrc_applied[base, :3] = theta[i]
            mujoco.mj_step(with_, a, nstep=kind.frame_skip)
            mujoco.mj_step(without, b, nstep=kind.frame_skip)
            a.xfrc_applied[:] = 0
            total += a.qvel[3:6] - b.qvel[3:6]
        rates = [machine.state_names.index(f"body:base:angvel@body.{axis}") for axis in "xyz"]
        assert np.abs(total).max() > 1e-4
        np.testing.assert_allclose(done.delta_s[i, rates], total / machine.habit.horizon, rtol=1e-9, atol=1e-12)


def test_a_runners_residual_is_no_turn_round() -> None:
    """Yaw, roll and the angle to the target jump from pi to -pi; what changes in a step is small all the same."""
    machine = Machine("nfc_gym/AntFlat-v0")
    before, after = np.zeros((2, 52)), np.zeros((2, 52))
    before[:, :12], after[:, :12] = 3.1, -3.1
    change = machine.difference(after, before)
    np.testing.assert_allclose(change[:, 7:10], 2 * np.pi - 6.2)
    np.testing.assert_allclose(change[:, [0, 6, 10, 11]], -6.2)
    assert machine.difference(before, before).tolist() == np.zeros((2, 52)).tolist()
    yaw = np.arctan2(*shard(machine.environment, 8)["pose"][:, :, [6, 3]].transpose(2, 0, 1)) * 2
    wrapped = (yaw + np.pi) % (2 * np.pi) - np.pi
    assert machine.angles[0] == 7
    np.testing.assert_allclose(np.cos(shard(machine.environment, 8)["states"][..., 7] - wrapped), 1, atol=0.2)


def test_sizes_stay_within_bounds_and_off_the_null() -> None:
    rng = np.random.default_rng(0)
    for effect in workshop(JACKAL).effects:
        theta = sizes(effect, rng.random((200, 2 * len(effect.params))))
        assert (theta >= effect.low - 1e-5 * np.abs(effect.low)).all(), effect.id
        assert (theta <= effect.high + 1e-5 * np.abs(effect.high)).all(), effect.id
        sizing = [i for i, p in enumerate(effect.params) if not p.shape]
        assert (theta[:, sizing] != effect.null[sizing]).any(1).all(), effect.id


def test_a_machine_that_always_falls_is_said_so() -> None:
    def roll_over(observation: np.ndarray) -> np.ndarray:
        return np.tile([3.0, -3.0, 3.0, -3.0], (len(observation), 1))

    made = replace(plan("nfc_gym/QuadcopterFlat-v0", 2, effects=0.0), policy=roll_over, policy_share=1.0)
    with pytest.raises(InputError, match="ended early"):
        make_shard(made, 0)


@pytest.mark.parametrize("name", ["JackalFlat", "JackalFlat-v0", "nfc_gym/JackalFlat", "nfc_gym:nfc_gym/JackalFlat-v0"])
def test_an_environment_goes_by_its_short_name_too(name: str) -> None:
    assert Machine(name).environment == "nfc_gym/JackalFlat-v0"
