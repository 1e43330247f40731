"""Minari data sets, written by `minari` itself: each episode is a log; damaged and foreign ones are refused."""

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.measured.checks import check
from nfc_gym.measured.dataset import load
from nfc_gym.measured.readers import log_parts, read_table

minari = pytest.importorskip("minari", reason="needs minari: pip install 'nfc_gym[minari]'")
pytest.importorskip("h5py", reason="needs h5py: pip install 'nfc_gym[minari]'")
from minari.data_collector import EpisodeBuffer  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:.*is set to None")  # of what minari would like to be told besides

MACHINE = (
    "<mujoco><worldbody><body name='b'><joint name='x' type='slide'/><geom size='.1'/></body></worldbody>"
    "<actuator><motor name='m' joint='x'/></actuator></mujoco>"
)
SPRING = """
version: 1
model: machine.xml
parameters: [{name: mass, field: body_mass, of: [b], unit: kg, low: 1, high: 9}]
logs: [{path: "spring/test-*"}]
time: {column: time}
controls: {"ctrl:m": {column: "actions[0]", unit: N}}
channels:
  "joint:x:pos": {column: "observations.state[0]", unit: m, noise: 0.01}
  "joint:x:vel": {column: "observations.state[1]", unit: m/s, noise: 0.01}
"""


def collect(
    folder: Path, monkeypatch: pytest.MonkeyPatch, lengths: tuple[int, ...], infos: bool = True, **kwargs: Any
) -> Path:
    """A data set of random episodes; minari's own `DataCollector` would need jax."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    env, episodes = gym.make("Spring-v0", **kwargs), []
    for n in lengths:
        seen = [env.reset(seed=0)] + [env.step(np.array([0.1 * i], np.float32))[::4] for i in range(n)]
        observations = {
            "state": np.stack([o["state"] for o, _ in seen]),
            "nested": (np.stack([o["nested"][0] for o, _ in seen]),),
        }
        told = {"time": np.array([info["time"] for _, info in seen])} if infos else None
        ends = {"terminations": [False] * n, "truncations": [False] * n}
        actions = 0.1 * np.arange(n, dtype=np.float32)[:, None]
        episodes.append(
            EpisodeBuffer(observations=observations, actions=actions, rewards=[1.0] * n, infos=told, **ends)
        )
    named = {"dataset_id": "spring/test-v0", "algorithm_name": "none", "author": "none", "author_email": "none"}
    minari.create_dataset_from_buffers(buffer=episodes, env=env, code_permalink="none", **named)
    env.close()
    return folder / "spring" / "test-v0"


@pytest.fixture(autouse=True)
def _registered() -> Any:
    gym.register("Spring-v0", "spring:Spring", max_episode_steps=100)
    yield
    gym.registry.pop("Spring-v0", None)


def test_episodes_are_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = collect(tmp_path, monkeypatch, (5, 1, 7))
    for path in (root, root / "data", root / "data" / "main_data.hdf5"):
        assert log_parts(path) == ("episode_0", "episode_2")  # one step is no motion
        table = read_table(path, "episode_2")
        np.testing.assert_array_equal(table["observations.nested.0"][:, 0], np.arange(7))
        np.testing.assert_allclose(table["observations.state"][:, 0], np.cos(0.02 * np.arange(7)), rtol=1e-6)
        np.testing.assert_allclose(table["actions"][:, 0], 0.1 * np.arange(7), rtol=1e-6)
        np.testing.assert_array_equal(table["time"], 0.5 + 0.02 * np.arange(7))
        assert set(table) >= {"rewards", "terminations", "truncations"}
    with pytest.raises(InputError, match="no episode 'episode_9'; there are 3, from episode_0 on"):
        read_table(root, "episode_9")


def test_time_without_infos_is_that_of_the_environment_registered_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = collect(tmp_path, monkeypatch, (5,), infos=False, frame_skip=3)
    np.testing.assert_allclose(read_table(root, "episode_0")["time"], 0.06 * np.arange(5))
    gym.registry.pop("Spring-v0")
    from nfc_gym.measured.readers import minari_set

    minari_set._interval.cache_clear()
    assert "time" not in read_table(root, "episode_0")


def test_a_mapping_of_a_data_set_is_checked_and_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect(tmp_path, monkeypatch, (60, 60, 60))
    (tmp_path / "machine.xml").write_text(MACHINE)
    (tmp_path / "mapping.yaml").write_text(SPRING)
    assert [str(f) for f in check(tmp_path / "mapping.yaml") if f.severity == "error"] == []
    data = load(tmp_path / "mapping.yaml")
    assert [log.name for log in data.logs] == [f"test-v0/episode_{i}" for i in range(3)]
    assert sorted(data.splits.values()) == ["fit", "select", "verify"]
    assert {file.name for file in data.files} == {"main_data.hdf5", "metadata.json"}
    np.testing.assert_allclose(data.logs[0].channels["joint:x:pos"].values, np.cos(0.02 * np.arange(60)), rtol=1e-6)


def test_a_data_set_that_tells_no_time_takes_an_interval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect(tmp_path, monkeypatch, (60, 60, 60), infos=False)
    gym.registry.pop("Spring-v0")
    from nfc_gym.measured.readers import minari_set

    minari_set._interval.cache_clear()
    text = SPRING.replace("time: {column: time}", "time: {interval: 0.02}")
    (tmp_path / "machine.xml").write_text(MACHINE)
    (tmp_path / "mapping.yaml").write_text(text)
    assert [str(f) for f in check(tmp_path / "mapping.yaml") if f.severity == "error"] == []
    for log in load(tmp_path / "mapping.yaml").logs:
        np.testing.assert_allclose(log.time, 0.02 * np.arange(60))
        np.testing.assert_allclose(log.channels["joint:x:pos"].values, np.cos(log.time), rtol=1e-6)
    (tmp_path / "mapping.yaml").write_text(SPRING)
    with pytest.raises(InputError, match=r"no column 'time'.*of a log without a clock say `interval`"):
        load(tmp_path / "mapping.yaml")


def test_damaged_and_foreign_data_sets_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = collect(tmp_path, monkeypatch, (5, 6))
    file, notes = root / "data" / "main_data.hdf5", root / "data" / "metadata.json"
    whole, said = file.read_bytes(), notes.read_text()
    for part in (0.05, 0.5, 0.95):
        file.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(InputError, match="truncated or not a"):
            read_table(root, log_parts(root)[0])
    file.write_bytes(whole)
    for text, words in (("{", "truncated or not a json"), ("{}", "lacks action_space"), ("[]", "not of a Minari")):
        notes.write_text(text)
        with pytest.raises(InputError, match=words):
            log_parts(root)
    future = json.dumps(json.loads(said) | {"minari_version": "99.0.0"})
    notes.write_text(future)
    with pytest.raises(InputError, match=r"99\.0\.0"):
        log_parts(root)
    notes.unlink()
    with pytest.raises(InputError, match=r"no metadata\.json beside it"):
        log_parts(file)


def test_no_program_that_a_data_set_names_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = collect(tmp_path, monkeypatch, (5,), infos=False)
    (tmp_path / "trap.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    notes = root / "data" / "metadata.json"
    said = json.loads(notes.read_text())
    spec = json.loads(said["env_spec"]) | {"id": "trap:Spring-v1", "entry_point": "trap:Env"}
    notes.write_text(json.dumps(said | {"env_spec": json.dumps(spec)}))
    assert "time" not in read_table(root, "episode_0")
    assert "trap" not in sys.modules


def test_an_absent_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = collect(tmp_path, monkeypatch, (5,))
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(InputError, match=r"needs minari, which is not installed; pip install 'nfc_gym\[minari\]'"):
        log_parts(root)
