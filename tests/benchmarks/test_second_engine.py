"""The second engine's robots against the MuJoCo models that they are made of, and against falling and rolling."""

import os
import subprocess
import sys
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

pytest.importorskip("pybullet", reason="the second engine is of the extra bench")


def robot(name: str):
    from worlds.machines import ROBOTS

    return ROBOTS[name].compile(0)


@pytest.mark.parametrize("name", ["jackal", "quadcopter", "quadruped"])
def test_urdf_keeps_masses_and_joints(name: str) -> None:
    from bullet.urdf import to_urdf

    model = robot(name)
    root = ElementTree.fromstring(to_urdf(model))
    masses = sum(float(m.get("value")) for m in root.iter("mass"))
    assert masses == pytest.approx(mujoco.mj_getTotalmass(model), abs=1e-4)
    moving = {j.get("name") for j in root.findall("joint") if j.get("type") != "fixed"}
    assert moving == {model.joint(j).name for j in range(1, model.njnt)}


def test_no_line_of_the_urdf_is_broken_where_bullet_reads_it() -> None:
    from bullet.simulation import Simulation
    from bullet.urdf import to_urdf
    from worlds.world import World

    model = World("QuadrupedFlat", "psi", 5, engine="bullet").machine.compile(0)
    assert len(to_urdf(model)) > 8191 > max(map(len, to_urdf(model).splitlines()))
    Simulation(model, None).close()


@pytest.mark.parametrize("name", ["jackal", "quadcopter", "quadruped"])
def test_a_state_comes_back_as_it_was_put(name: str) -> None:
    from bullet.simulation import Simulation

    model = robot(name)
    sim, rng = Simulation(model, None), np.random.default_rng(0)
    qpos, qvel = model.key_qpos[0] + 0.05 * rng.standard_normal(model.nq), rng.standard_normal(model.nv)
    qpos[2] += 3
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    sim.place(qpos, qvel)
    back, speed = np.zeros(model.nq), np.zeros(model.nv)
    sim.read(back, speed)
    back[3:7] *= np.sign(back[3] * qpos[3])
    assert back == pytest.approx(qpos, abs=1e-6)
    assert speed == pytest.approx(qvel, abs=1e-6)
    sim.close()


def test_what_is_dropped_falls_as_galileo_says() -> None:
    from bullet.simulation import STEP, Simulation

    model = robot("jackal")
    sim = Simulation(model, None)
    qpos, qvel = model.key_qpos[0].copy(), np.zeros(model.nv)
    qpos[2] = 10.0
    sim.place(qpos, qvel)
    for _ in range(500):
        sim.step(np.zeros(4))
    sim.read(qpos, qvel)
    time = 500 * STEP
    assert 10.0 - qpos[2] == pytest.approx(9.81 * time**2 / 2, rel=0.01)
    assert qvel[2] == pytest.approx(-9.81 * time, rel=0.01)
    sim.close()


def test_wheels_roll_as_fast_as_they_turn() -> None:
    from worlds.judge import state_of
    from worlds.world import World

    env = World("JackalFlat", "nominal", 0, noisy=False, engine="bullet").make(2, context=["psi"])
    env.reset(seed=0)
    for _ in range(60):
        env.step(np.tile([0.4, 0.0], (2, 1)))
    speed = np.linalg.norm(state_of(env)[1][:, :2], axis=1)
    assert speed == pytest.approx(np.full(2, 0.8), rel=0.01)
    env.close()


def test_a_hovering_quadcopter_stays_and_a_standing_quadruped_stands() -> None:
    from worlds.judge import state_of
    from worlds.world import World

    for place, action in (("QuadcopterFlat", np.zeros(4)), ("QuadrupedFlat", np.zeros(12))):
        env = World(place, "nominal", 0, noisy=False, engine="bullet").make(1, context=["psi"])
        env.reset(seed=0)
        before = state_of(env)[0][0]
        for _ in range(50):
            _, _, ended, _, _ = env.step(action[None])
        assert not ended.any()
        assert np.linalg.norm(state_of(env)[0][0, :3] - before[:3]) < 0.08
        env.close()


def test_the_same_observations_and_goals_as_ours() -> None:
    from worlds.world import World

    spaces, firsts = [], []
    for engine in ("mujoco", "bullet"):
        env = World("JackalRough", "axle+snow", 3, noisy=False, engine=engine).make(2)
        firsts.append(env.reset(seed=11)[0])
        spaces.append(env.observation_space)
        env.close()
    assert spaces[0] == spaces[1]
    for key in ("goal", "proprio", "psi", "elevation"):
        assert firsts[0][key] == pytest.approx(firsts[1][key], abs=1e-5)


def test_what_it_cannot_carry_over_is_refused() -> None:
    from standin.pushes import Push
    from worlds.truth import Truth
    from worlds.world import World

    from nfc_gym.core import InputError

    with pytest.raises(InputError, match="ant is not in the second engine"):
        World("AntFlat", "nominal", 0, engine="bullet").make(1)
    pushed = World("QuadcopterFlat", "nominal", 0, engine="bullet")
    pushed.__dict__["truth"] = Truth(hidden=Push("base", np.ones(3)))
    with pytest.raises(InputError, match="velocities"):
        pushed.make(1)


def test_the_ground_is_where_the_map_says() -> None:
    import pybullet
    from bullet.simulation import Simulation

    from nfc_gym.terrain import make

    ground = make("rough", 0.8, 3)
    sim = Simulation(robot("jackal"), ground)
    points = np.random.default_rng(0).uniform(-12, 12, (200, 2))
    rays = [pybullet.rayTest([x, y, 5], [x, y, -5], physicsClientId=sim.client)[0][3][2] for x, y in points]
    # Cells are split along the other diagonal here and there: that is all that may differ.
    assert rays == pytest.approx(ground.height(points), abs=0.01)
    sim.close()


def test_workers_change_nothing_but_the_time() -> None:
    from worlds.world import World

    world = World("JackalRough", "axle+load", 1, engine="bullet")
    states = []
    for workers in (1, 2):
        env = world.make(3, context=["psi"], nthread=workers, max_episode_steps=6)
        env.reset(seed=4)
        for _ in range(10):  # over the end of an episode
            env.step(np.tile([0.5, 0.2], (3, 1)))
        states.append(np.concatenate(env.unwrapped.state(), 1))
        env.close()
        assert all(herd.process.returncode == 0 for herd in env.unwrapped._herds if workers > 1)
    assert np.array_equal(states[0], states[1])


def test_a_draw_that_it_refuses_is_left_out_of_a_search(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import hidden_worlds
    from worlds.world import World

    class Measured(Exception):
        pass

    def measure(policy: str, world: Any, *_: Any, **__: Any) -> None:
        raise Measured(world.seed)

    monkeypatch.setattr(hidden_worlds, "measure", measure)
    refused = [World("QuadcopterFlat", "effect", seed, engine="bullet").refused for seed in range(30)]
    first = next(k for k in range(30) if refused[k] and not refused[k + 1])
    asked = ["--engine", "bullet", "--places", "QuadcopterFlat", "--find", "1", "--seed", str(first)]
    with pytest.raises(Measured, match=str(first + 1)):
        next(hidden_worlds.worlds(hidden_worlds.parse(asked), None, "QuadcopterFlat", "effect"))
    assert f"QuadcopterFlat_effect_{first}_bullet is left out: {refused[first]}" in capsys.readouterr().out


def test_a_worker_loads_no_torch() -> None:
    asked = "import sys, bullet.worker; sys.exit('torch' in sys.modules)"
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", asked], env=env, check=True)
