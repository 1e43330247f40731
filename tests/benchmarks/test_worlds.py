"""Worlds that hide their truth: what is true acts, what is seen does not tell, each simulation is its own."""

import mujoco
import numpy as np
import pytest

from nfc_gym.core import InputError


def hidden_world(place: str, hidden=None, psi=None):
    """A world with a truth that is given, in place of one that is drawn; without noise."""
    from worlds.truth import Truth
    from worlds.world import World

    from nfc_gym.measured.hidden import Hidden

    world = World(place, "nominal", 0, noisy=False)
    world.__dict__["truth"] = Truth(psi or {}, hidden or Hidden())
    return world


def rollout(env, action, steps: int) -> np.ndarray:
    """Base states (T, n, 13)."""
    from worlds.judge import state_of

    rows = []
    for _ in range(steps):
        env.step(np.tile(action, (env.num_envs, 1)))
        rows.append(np.concatenate(state_of(env)[:2], 1))
    return np.array(rows)


def test_what_is_observed_does_not_tell_what_is_true() -> None:
    world = hidden_world("JackalFlat", psi={"base_mass": 30.0, "front_left_wheel_damping": 0.0})
    env = world.make(2, context=["psi"])
    observation, info = env.reset(seed=0)
    space = env.unwrapped.psi_space
    assert env.unwrapped.model.body("base").mass == pytest.approx(30.0)
    assert env.unwrapped.model.actuator("front_left").gainprm[0] == 0
    assert observation["psi"] == pytest.approx(np.tile(space.normalise(space.nominal), (2, 1)), abs=1e-6)
    assert env.unwrapped.psi == pytest.approx(np.tile(space.nominal, (2, 1)))
    assert space.nominal[0] == pytest.approx(15.08)
    believed = env.reset(seed=0, options={"psi": {"base_mass": 20.0}})[0]["psi"]
    assert believed[0, 0] == pytest.approx(space.normalise(np.r_[20.0, space.nominal[1:]])[0])
    assert env.unwrapped.fields.nominal("body_mass")[env.unwrapped.model.body("base").id] == pytest.approx(30.0)
    assert not any("mass" in key for key in info)


def test_a_lost_axle_gives_no_torque_and_the_others_do() -> None:
    env = hidden_world("JackalFlat", psi={"front_left_wheel_damping": 0.0}).make(1, context=["psi"])
    env.reset(seed=0)
    force = env.unwrapped.batch.bind("actuator_force")
    env.step(np.array([[0.5, 0.0]]))
    assert force[0, 0] == 0
    assert (np.abs(force[0, 1:]) > 0.1).all()


def test_a_push_accelerates_by_force_over_mass() -> None:
    from standin.pushes import Push

    env = hidden_world("QuadcopterFlat", Push("base", np.array([0.8, 0.0, 0.0]))).make(2, context=["psi"])
    env.reset(seed=3)
    states = rollout(env, np.zeros(4), 5)
    mass = mujoco.mj_getTotalmass(env.unwrapped.model)
    # It acts on the chassis' own centre of mass, so that the machine, whose centre is above, hardly turns in 0.1 s.
    assert states[-1, :, 7] == pytest.approx(np.full(2, 0.8 / mass * 0.1), rel=0.05)


@pytest.mark.parametrize("scenario", ["delay", "lag", "wind", "drag_quadratic"])
def test_each_simulation_of_many_goes_as_it_would_alone(scenario: str) -> None:
    from worlds.scenarios import EFFECTS

    kind = EFFECTS["quadcopter"][scenario]

    def states(n: int, seed: int) -> np.ndarray:
        env = hidden_world("QuadcopterFlat", kind.make(np.random.default_rng(0), kind.high / 3)).make(
            n, context=["psi"]
        )
        env.reset(seed=seed)
        rng = np.random.default_rng(1)
        return np.concatenate([rollout(env, rng.uniform(-0.2, 0.2, 4), 1) for _ in range(12)])

    assert states(3, 5)[:, 2] == pytest.approx(states(1, 7)[:, 0], abs=1e-12)


def test_memory_begins_anew_with_an_episode() -> None:
    from nfc_gym.measured.hidden import Delay

    names = ("front_left", "front_right", "rear_left", "rear_right")
    env = hidden_world("JackalFlat", Delay(names, 0.1)).make(1, context=["psi"])
    env.reset(seed=0)
    full = rollout(env, np.array([1.0, 0.0]), 20)
    env.reset(seed=0)
    rested = rollout(env, np.zeros(2), 3)
    assert np.abs(rested[:, 0, 7:9]).max() < 1e-3  # nothing of the last episode's commands is on its way
    assert full[-1, 0, 7] ** 2 + full[-1, 0, 8] ** 2 > 1


def test_a_wheel_sinks_as_deep_as_the_ground_is_said_to_be() -> None:
    from worlds.grounds import Ground

    heights = []
    for sinkage in (0.0, 0.02):
        env = hidden_world("JackalFlat", Ground("mud", 0.4, sinkage, 0.1)).make(1, context=["psi"])
        env.reset(seed=0)
        heights.append(rollout(env, np.zeros(2), 100)[-1, 0, 2])
    assert heights[0] - heights[1] == pytest.approx(0.02, abs=0.002)


def test_psi_is_off_by_as_much_as_is_asked() -> None:
    from worlds.machines import ROBOTS, nominal_space
    from worlds.truth import FIXED, RANDOMISED, psi_off

    for kind in ROBOTS.values():
        space = nominal_space(kind)
        psi = psi_off(space, np.random.default_rng(1), 0.25)
        assert all(p.name in psi for p in space.parameters if p.field != FIXED)
        value = np.array([psi.get(n, v) for n, v in zip(space.names, space.nominal, strict=True)])
        room = np.where(value > space.nominal, space.high - space.nominal, space.nominal - space.low)
        share = np.abs(value - space.nominal) / room
        odd = share > RANDOMISED
        assert odd.sum() == max(1, sum(p.field != FIXED for p in space.parameters) // 4)
        assert share[odd] == pytest.approx(np.full(odd.sum(), RANDOMISED + 0.25))
        beyond = psi_off(space, np.random.default_rng(1), 1.0)
        assert all(v > 0 or space.low[space.names.index(n)] == 0 for n, v in beyond.items())


def test_seeds_draw_worlds_and_the_same_seed_the_same_one() -> None:
    from worlds.world import World

    first, again, other = (World("AntRough", "psi+effect", s) for s in (4, 4, 5))
    assert first.truth.text == again.truth.text != other.truth.text
    assert first.terrain == again.terrain != other.terrain
    one, two = (w.make(2, context=["psi"]).reset(seed=9)[0]["proprio"] for w in (first, again))
    assert np.array_equal(one, two)


def test_every_robot_has_worlds_in_which_it_can_be_stepped() -> None:
    from worlds.machines import ROBOTS
    from worlds.world import World

    for name in ROBOTS:
        for seed in range(2):
            env = World(f"{name.capitalize()}Flat", "psi+effects", seed).make(2, context=["psi"])
            env.reset(seed=0)
            observation, reward, *_ = env.step(env.action_space.sample())
            assert np.isfinite(observation["proprio"]).all()
            assert np.isfinite(reward).all()


def test_errors_of_a_perceived_map_are_of_the_size_that_is_asked() -> None:
    from worlds.perception import perceived
    from worlds.world import World

    from nfc_gym.terrain import make

    ground = make("rough", 0.5, 0)
    seen = perceived(ground, 0.02, np.random.default_rng(0))
    error = seen.heights.astype(float) - ground.heights
    assert np.median(np.abs(error)) == pytest.approx(0.6745 * 0.02, rel=0.15)  # blotches are few
    env = World("JackalRough", "axle", 0).make(2, context=["psi"])
    env.reset(seed=0)
    truth, shown = env.unwrapped.heightfield[0], env.unwrapped.perceived[0]
    assert 0.002 < np.std(truth.heights - shown.heights) < 0.05


def test_one_simulation_is_an_ordinary_environment() -> None:
    from gymnasium.utils.env_checker import check_env
    from worlds.world import World

    check_env(World("JackalFlat", "axle+load", 0).single(context=["psi"]), skip_render_check=True)


@pytest.mark.parametrize(("place", "scenario", "said"), [
    ("JackalHilly", "axle", "JackalHilly"), ("AntFlat", "axle", "no 'axle' for the ant"),
    ("JackalFlat", "axle+rocks", "no 'rocks'"),
])  # fmt: skip
def test_a_world_that_there_is_not_is_refused(place: str, scenario: str, said: str) -> None:
    from worlds.world import World

    with pytest.raises(InputError, match=said):
        World(place, scenario, 0)


def test_psi_of_a_single_world_is_what_is_believed() -> None:
    from worlds.world import World

    world = World("JackalFlat", "psi+effect", 0).single(context=["psi"])
    nominal = world.unwrapped.psi_space.nominal
    world.reset(seed=0)
    np.testing.assert_array_equal(world.unwrapped.psi, nominal)
    world.reset(seed=0, options={"psi": 1.01 * nominal})
    np.testing.assert_allclose(world.unwrapped.psi, 1.01 * nominal)


def test_estimates_of_an_episode_are_the_same_whatever_was_run_before() -> None:
    """A mission that is resumed sees what one without an interruption sees."""
    from worlds.world import World

    found = []
    for before in (0, 2):
        world = World("JackalFlat", "axle", 0).single(context=["psi"])
        for k in range(before):
            world.reset(seed=k)
            assert world.data.qpos.size
        world.reset(seed=7)
        found.append(np.concatenate([world.data.qpos, world.data.qvel]))
    np.testing.assert_array_equal(*found)
    world.reset(seed=8)
    assert (world.data.qpos[:3] != found[0][:3]).any()


def test_a_state_is_estimated_in_the_terms_of_the_model_that_is_known() -> None:
    from worlds.machines import ROBOTS
    from worlds.world import World

    nominal = ROBOTS["jackal"].compile(0)
    for noisy, size in ((False, 0.0), (True, 0.02)):
        world = World("JackalFlat", "axle+load", 0, noisy=noisy).single(context=["psi"])
        world.reset(seed=0)
        found = world.data
        assert (found.qpos.shape, found.qvel.shape) == ((nominal.nq,), (nominal.nv,))
        true = world.many.unwrapped.batch.bind("qpos")[0]
        assert len(true) == nominal.nq + 1  # the load's place, which nobody senses
        error = np.abs(found.qpos[:3] - true[:3]).max()
        assert error <= size
        assert (error > 0) == noisy
        assert np.linalg.norm(found.qpos[3:7]) == pytest.approx(1.0)
