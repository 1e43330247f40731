"""`RecordLog`: the measured loop's log format, read back by the measured loop itself."""

import pickle
import sys
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from fakes import CUBE, FakeEnv, NoModel, roll, same
from machines import make

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.core import Fidelity, InputError, MissingExtra
from nfc_gym.measured.checks import check
from nfc_gym.measured.dataset import load
from nfc_gym.measured.mapping import load_mapping
from nfc_gym.measured.readers import read_table
from nfc_gym.physics.names import names
from nfc_gym.physics.state import rotate
from nfc_gym.wrappers import ApplyEffects, Hallucinate, RecordLog, VectorRecordLog


def _drive(env: gym.Env, episodes: int, steps: int, most: float = 0.5) -> None:
    rng = np.random.default_rng(0)
    for seed in range(episodes):
        env.reset(seed=seed)
        for k in range(steps):
            if k % 10 == 0:
                action = rng.uniform(-most, most, env.action_space.shape)
            _, _, ended, truncated, _ = env.step(action)
            if ended or truncated:
                break
    env.close()


def test_columns_are_what_the_simulation_was(tmp_path: Path) -> None:
    env = RecordLog(FakeEnv(), tmp_path)
    base = env.unwrapped
    env.reset(seed=0)
    base.data.qvel[:] = [0.1, 0.2, 0.3, 1.0, 2.0, 3.0, 0.5]
    states, commands, sensors = [], [], []
    for k in range(12):
        states.append((base.data.time, base.data.qpos.copy(), base.data.qvel.copy()))
        commands.append(0.1 * k)
        aside = mujoco.MjData(base.model)
        aside.qpos[:], aside.qvel[:], aside.ctrl[:] = base.data.qpos, base.data.qvel, 0.1 * k
        mujoco.mj_forward(base.model, aside)
        sensors.append(aside.sensordata.copy())
        env.step(np.array([0.1 * k]))
    assert not list(tmp_path.glob("*.parquet"))
    env.close()
    table = read_table(tmp_path / "episode_0000.parquet")
    time, qpos, qvel = (np.array(s) for s in zip(*states, strict=True))
    np.testing.assert_array_equal(table["time"], time)
    np.testing.assert_array_equal(table["ctrl:twist"], commands)
    np.testing.assert_array_equal(table["body:cube:pos"], qpos[:, :3])
    np.testing.assert_allclose(table["body:cube:quat"], qpos[:, 3:7], rtol=1e-12)
    np.testing.assert_array_equal(table["body:cube:linvel"], qvel[:, :3])
    np.testing.assert_allclose(table["body:cube:angvel"], rotate(qpos[:, 3:7], qvel[:, 3:6]), rtol=1e-12)
    np.testing.assert_array_equal(table["joint:hinge:pos"], qpos[:, 7])
    np.testing.assert_array_equal(table["joint:hinge:vel"], qvel[:, 6])
    np.testing.assert_allclose(table["sensor:gyro"], np.array(sensors)[:, 1:], rtol=1e-12)
    assert set(table) == {"time", "ctrl:twist", "sensor:gyro"} | {
        *(f"body:cube:{q}" for q in ("pos", "quat", "linvel", "angvel")),
        *("joint:hinge:pos", "joint:hinge:vel"),
    }


def test_an_accelerometer_shows_the_command_of_its_own_step(tmp_path: Path) -> None:
    xml = (
        "<mujoco><option timestep='.005' gravity='0 0 0'/><worldbody><body><joint name='x' type='slide' axis='1 0 0'/>"
    )
    xml += (
        "<geom size='.1' mass='2'/><site name='s'/></body></worldbody><actuator><motor name='m' joint='x'/></actuator>"
    )
    xml += "<sensor><accelerometer name='a' site='s'/></sensor></mujoco>"
    for frames in (1, 4):
        env = RecordLog(FakeEnv(xml, frames), tmp_path / str(frames))
        env.reset(seed=0)
        for force in (0.0, 1.0, 3.0, -2.0):
            env.step(np.array([force]))
        env.close()
        table = read_table(tmp_path / str(frames) / "episode_0000.parquet")
        np.testing.assert_allclose(table["sensor:a"][:, 0], [0, 0.5, 1.5, -1], atol=1e-12)


@pytest.mark.parametrize(
    "name",
    ["Ant-v5", *(f"nfc_gym/{robot}-v0" for robot in ("JackalFlat", "AntRough", "QuadcopterFlat", "QuadrupedFlat"))],
)
def test_a_recorded_log_passes_the_check(name: str, tmp_path: Path) -> None:
    kwargs = {"terrain_pool": 1} if "Rough" in name else {}
    env = RecordLog(gym.make(name, max_episode_steps=80, **kwargs), tmp_path)
    _drive(env, 4, 80, 0.1 if "Quadcopter" in name else 0.5)  # what flies must not fall
    assert len(list(tmp_path.glob("episode_*.parquet"))) == 4
    findings = check(tmp_path / "mapping.yaml")
    assert [f for f in findings if f.severity == "error"] == []
    mapping = load_mapping(tmp_path / "mapping.yaml")
    noise = {
        name: channel.noise for log in load(tmp_path / "mapping.yaml").logs for name, channel in log.channels.items()
    }
    assert all((n is None) == name.startswith("sensor:") and (n is None or n <= 0.1) for name, n in noise.items())
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert len(mapping.controls) == model.nu == env.unwrapped.model.nu
    if "nfc_gym" in name:
        assert [p.name for p in mapping.declared] == list(env.unwrapped.psi_space.names)


class Witness(gym.Wrapper):
    """Writes down by itself what a simulation is before each step, and what drove it."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.seen: list[list[tuple]] = []

    def reset(self, **kwargs):
        self.seen.append([])
        return super().reset(**kwargs)

    def step(self, action):
        data = self.unwrapped.data
        before = (data.time, data.qpos.copy(), data.qvel.copy())
        result = super().step(action)
        self.seen[-1].append((*before, data.ctrl.copy()))
        return result


@pytest.mark.parametrize(
    ("name", "root"), [("Ant-v5", "torso"), ("nfc_gym/AntRough-v0", "torso"), ("nfc_gym/JackalFlat-v0", "base")]
)
def test_what_is_loaded_is_to_the_bit_what_the_simulation_was(name: str, root: str, tmp_path: Path) -> None:
    kwargs = {"terrain_pool": 1} if "Rough" in name else {}
    env = Witness(RecordLog(gym.make(name, max_episode_steps=80, **kwargs), tmp_path))
    _drive(env, 3, 80)
    data = load(tmp_path / "mapping.yaml")
    model = env.unwrapped.model
    assert len(data.logs) == len(env.seen) == 3
    for log, episode in zip(data.logs, env.seen, strict=True):
        time, qpos, qvel, ctrl = (np.array(v) for v in zip(*episode, strict=True))
        assert (log.time == time - time[0]).all()
        assert list(log.controls) == [f"ctrl:{n}" for n in names(model).actuators]
        for i, values in enumerate(log.controls.values()):
            assert (values == ctrl[:, i]).all()
        channels = {key: channel.values for key, channel in log.channels.items()}
        unit = qpos[:, 3:7] / np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        assert (channels[f"body:{root}:pos"] == qpos[:, :3]).all()
        assert (channels[f"body:{root}:quat"] == unit).all()
        assert (channels[f"body:{root}:linvel"] == qvel[:, :3]).all()
        assert (channels[f"body:{root}:angvel"] == rotate(unit, qvel[:, 3:6])).all()
        for j in range(1, model.njnt):
            q, v, joint = model.jnt_qposadr[j], model.jnt_dofadr[j], names(model).joints[j]
            assert (channels[f"joint:{joint}:pos"] == qpos[:, q]).all()
            assert (channels[f"joint:{joint}:vel"] == qvel[:, v]).all()


def test_rows_of_a_vector_environment_are_loaded_as_single_ones_are(tmp_path: Path) -> None:
    kwargs = {"max_episode_steps": 40, "context": []}
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (4, 3, 2)), 10, axis=0)
    many = VectorRecordLog(gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=3, **kwargs), tmp_path / "many")
    many.reset(seed=7)
    one = RecordLog(gym.make("nfc_gym/JackalFlat-v0", **kwargs), tmp_path / "one")
    for k in range(40):
        many.step(actions[k])
    many.close()
    for row in range(3):
        one.reset(seed=7 + row)
        for k in range(40):
            one.step(actions[k, row])
    one.close()
    both = [load(tmp_path / folder / "mapping.yaml") for folder in ("many", "one")]
    for folder in ("many", "one"):
        assert not [f for f in check(tmp_path / folder / "mapping.yaml") if f.severity == "error"]
    assert [log.name for log in both[0].logs] == [log.name for log in both[1].logs]
    for a, b in zip(both[0].logs, both[1].logs, strict=True):
        same(a.time, b.time)
        same(dict(a.controls), dict(b.controls))
        same({k: c.values for k, c in a.channels.items()}, {k: c.values for k, c in b.channels.items()})


def test_the_model_beside_the_logs_moves_as_the_environment_did(tmp_path: Path) -> None:
    """From the recorded start, under the recorded commands, the written model makes the recorded motion."""
    _drive(RecordLog(gym.make("nfc_gym/JackalFlat-v0", max_episode_steps=60), tmp_path), 1, 60)
    table = read_table(tmp_path / "episode_0000.parquet")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7] = table["body:base:pos"][0], table["body:base:quat"][0]
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in range(model.nu)]
    shown = []
    for k in range(len(table["time"])):
        shown.append(data.qpos[:3].copy())
        data.ctrl[:] = [table[f"ctrl:{n}"][k] for n in names]
        mujoco.mj_step(model, data, nstep=4)
    np.testing.assert_allclose(shown, table["body:base:pos"], atol=2e-3)


def test_effects_act_on_what_is_measured_but_not_on_what_is_commanded(tmp_path: Path) -> None:
    effects = [make("gain", "twist", {"gain": -0.5}), make("sensor_bias", "joint:hinge:pos", {"bias": 0.25})]
    for k, wrap in enumerate(
        (lambda e, p: RecordLog(ApplyEffects(e, effects), p), lambda e, p: ApplyEffects(RecordLog(e, p), effects))
    ):
        folder = tmp_path / str(k)
        env = wrap(FakeEnv(), folder)
        observation, _ = env.reset(seed=0)
        for _ in range(5):
            env.step(np.array([0.8]))
        env.close()
        table = read_table(folder / "episode_0000.parquet")
        np.testing.assert_array_equal(table["ctrl:twist"], 0.8)
        assert table["joint:hinge:pos"][0] == observation[7] + 0.25


def test_files_are_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyarrow.parquet as pq

    env = RecordLog(FakeEnv(), tmp_path)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(1))

    def fail(table, path) -> None:
        Path(path).write_bytes(b"PAR1 half")
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(pq, "write_table", fail)
        with pytest.raises(OSError, match="space"):
            env.reset()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.xml"]
    env.reset()
    env.step(np.zeros(1))
    env.step(np.zeros(1))
    env.close()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["episode_0000.parquet", "mapping.yaml", "model.xml"]


def test_recorders_that_write_at_once_take_no_number_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyarrow.parquet as pq

    envs = [RecordLog(FakeEnv(), tmp_path) for _ in range(3)]
    for k, env in enumerate(envs):
        env.reset(seed=0)
        for _ in range(k + 2):
            env.step(np.zeros(1))
    write, waiting = pq.write_table, envs[1:]

    def amid(table: object, path: object) -> None:
        if waiting:  # another one begins while this one has begun
            waiting.pop().flush()
        write(table, path)

    monkeypatch.setattr(pq, "write_table", amid)
    envs[0].flush()
    files = sorted(p.name for p in tmp_path.iterdir())
    assert files == [*(f"episode_000{k}.parquet" for k in range(3)), "mapping.yaml", "model.xml"]
    assert {len(read_table(tmp_path / name)["time"]) for name in files[:3]} == {2, 3, 4}
    assert "by: log" in (tmp_path / "mapping.yaml").read_text()


def test_processes_record_into_one_folder(tmp_path: Path) -> None:
    made = lambda: gym.wrappers.TimeLimit(RecordLog(FakeEnv(), tmp_path), 3)  # noqa: E731
    envs = gym.vector.AsyncVectorEnv([made] * 3, context="fork")
    envs.reset(seed=0)
    for _ in range(15):
        envs.step(np.zeros((3, 1)))
    envs.close()
    files = [f"episode_{k:04d}.parquet" for k in range(12)]
    assert sorted(p.name for p in tmp_path.iterdir()) == [*files, "mapping.yaml", "model.xml"]


def test_recorders_that_begin_at_once_have_one_model(tmp_path: Path) -> None:
    other = FakeEnv(CUBE.replace('mass="1"', 'mass="2"'))
    one, two = (RecordLog(env, tmp_path) for env in (FakeEnv(), other))
    one.reset(seed=0)
    two.reset(seed=0)  # the folder holds no episode yet
    for _ in range(2):
        one.step(np.zeros(1))
    with pytest.raises(InputError, match="holds logs of another model"):
        one.flush()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.xml"]


def test_episodes_are_numbered_on_and_short_ones_leave_nothing(tmp_path: Path) -> None:
    for _ in range(2):
        env = RecordLog(FakeEnv(), tmp_path)
        env.reset()
        env.reset()
        env.step(np.zeros(1))
        env.reset()
        _drive(env, 1, 3)
    assert sorted(p.name for p in tmp_path.glob("*.parquet")) == ["episode_0000.parquet", "episode_0001.parquet"]
    same(roll(RecordLog(FakeEnv(), tmp_path), 4), roll(FakeEnv(), 4))


def test_pickle_goes_on_in_the_same_folder(tmp_path: Path) -> None:
    env = RecordLog(gym.make("Ant-v5"), tmp_path)
    again = pickle.loads(pickle.dumps(env))
    _drive(again, 1, 4)
    assert len(read_table(tmp_path / "episode_0000.parquet")["time"]) == 4
    assert str(tmp_path) in env.spec.to_json()


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_rows_of_a_vector_environment_have_files_of_their_own(mode, tmp_path: Path) -> None:
    arguments = {"num_envs": 2, "max_episode_steps": 5, "autoreset_mode": mode, "context": []}
    env = VectorRecordLog(gym.make_vec("nfc_gym/JackalFlat-v0", **arguments), tmp_path / "many")
    env.reset(seed=7)
    actions = np.random.default_rng(0).uniform(-1, 1, (9, 2, 2))
    for k in range(9):
        _, _, ended, truncated, _ = env.step(actions[k])
        if mode is gym.vector.AutoresetMode.DISABLED and (ended | truncated).any():
            env.reset(options={"reset_mask": ended | truncated})
    env.close()
    files = sorted((tmp_path / "many").glob("*.parquet"))
    assert [len(read_table(f)["time"]) for f in files] == [
        5,
        5,
        *[3 if mode is gym.vector.AutoresetMode.NEXT_STEP else 4] * 2,
    ]
    for row in range(2):
        single = RecordLog(gym.make("nfc_gym/JackalFlat-v0", context=[]), tmp_path / f"one{row}")
        single.reset(seed=7 + row)
        for k in range(5):
            single.step(actions[k, row])
        single.close()
        same(read_table(files[row]), read_table(tmp_path / f"one{row}" / "episode_0000.parquet"))


def test_bad_input_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="NoModel"):
        RecordLog(NoModel(), tmp_path)
    env = FakeEnv()
    env.fullpath = "gone.xml"
    with pytest.raises(InputError, match="model_file"):
        RecordLog(env, tmp_path).reset()
    with pytest.raises(InputError, match="nq, nv"):
        RecordLog(FakeEnv(), tmp_path, gym.make("Ant-v5").unwrapped.fullpath).reset()
    with pytest.raises(InputError, match="terrain_pool=1"):
        VectorRecordLog(gym.make_vec("nfc_gym/JackalRough-v0", num_envs=2, terrain_pool=2), tmp_path)
    for wrong in (None, 5, "", b"logs"):
        with pytest.raises(InputError, match=f"path is {wrong!r}, want the name of a folder"):
            RecordLog(FakeEnv(), wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="VectorRecordLog"):
        RecordLog(gym.make_vec("Ant-v5", 1), tmp_path)  # type: ignore[arg-type]
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pyarrow", None)
        patch.setattr("nfc_gym.wrappers.record_folder.find_spec", lambda name: None if name == "pyarrow" else name)
        with pytest.raises(MissingExtra, match=r"pyarrow.*nfc_gym\[measured\]"):
            RecordLog(FakeEnv(), tmp_path)


def test_a_folder_that_cannot_be_made_or_written_is_refused() -> None:
    for path in ("/proc/none", "/proc"):
        with pytest.raises(InputError, match=f"^{path} cannot be written .*: choose another `path` of RecordLog"):
            RecordLog(FakeEnv(), path).reset()


def test_two_recorders_have_two_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="RecordLog around RecordLog: both record into"):
        RecordLog(RecordLog(FakeEnv(), tmp_path / "a"), tmp_path / "b" / ".." / "a")
    envs = gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=2)
    with pytest.raises(InputError, match="both record into"):
        VectorRecordLog(VectorRecordLog(envs, tmp_path / "a"), tmp_path / "a")
    _drive(RecordLog(RecordLog(FakeEnv(), tmp_path / "c"), tmp_path / "d"), 2, 5)
    one, other = (RecordLog(FakeEnv(), tmp_path / "e") for _ in range(2))
    for env, steps in ((one, 5), (other, 6)):  # side by side none overwrites the other's
        _drive(env, 1, steps)
        env.close()
    lengths = [len(read_table(f)["time"]) for f in sorted((tmp_path / "e").glob("*.parquet"))]
    assert lengths == [5, 6]


def test_other_ground_needs_another_folder(tmp_path: Path) -> None:
    env = RecordLog(gym.make("nfc_gym/JackalRough-v0", terrain_pool=2), tmp_path)
    env.reset(options={"terrain_id": 0})
    env.step(np.zeros(2))
    env.step(np.zeros(2))
    env.reset(options={"terrain_id": 0})
    for _ in range(2):
        with pytest.raises(InputError, match="terrain_id"):
            env.reset(options={"terrain_id": 1})


def test_wheels_that_turn_and_jump_are_no_doubt(tmp_path: Path) -> None:
    """A rover's wheels turn many times to and fro, and their speeds are others between two samples."""
    env = RecordLog(gym.make("nfc_gym/JackalFlat-v0", max_episode_steps=160), tmp_path)
    rng = np.random.default_rng(0)
    for episode in range(3):
        env.reset(seed=episode)
        for command in rng.uniform(-1, 1, (8, 2)).astype(np.float32):
            for _ in range(20):
                env.step(command)
    env.close()
    assert [str(f) for f in check(tmp_path / "mapping.yaml") if f.severity != "note"] == []


@pytest.mark.parametrize("outside", [True, False])
def test_the_model_is_of_the_ground_that_the_first_action_chose(tmp_path: Path, outside: bool) -> None:
    slopes = 0.05 * np.random.default_rng(0).standard_normal((8, 1, 1)) * np.tile(np.linspace(-1, 1, 256), (256, 1))
    env = gym.make("nfc_gym/JackalRough-v0", context=["psi"], terrain_pool=1)
    chosen = Fidelity(delta_e=slopes)
    env = (
        RecordLog(Hallucinate(env, chosen, samples=8), tmp_path)
        if outside
        else Hallucinate(RecordLog(env, tmp_path), chosen, samples=8)
    )
    for _ in range(2):
        env.reset(seed=0)
        for _ in range(3):
            env.step(np.array([0, 0, 1], np.float32))
    driven = env.unwrapped.heightfield.heights
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    heights = model.geom("ground").pos[2] + model.hfield_size[0, 2] * model.hfield_data.reshape(256, 256)
    np.testing.assert_allclose(heights, driven, atol=1e-5)
    env.reset(seed=0)
    with pytest.raises(InputError, match="other ground"):
        env.step(np.array([0, 0, -1], np.float32))
    env.close()
    assert len(list(tmp_path.glob("*.parquet"))) == 2
