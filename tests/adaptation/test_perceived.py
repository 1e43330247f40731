"""Rough ground from what a robot perceived of it: as it is, and good enough to infer psi on."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rounds import fewer

from nfc_gym import InputError
from nfc_gym.adaptation.assimilation import Assimilation
from nfc_gym.adaptation.perceived import perceived_ground
from nfc_gym.adaptation.trajectory import LOOK, Trajectory, execute
from nfc_gym.terrain import Heightfield
from nfc_gym.terrain.egocentric import elevation

ROUGH = "nfc_gym/JackalRough-v0"


class Alarm:
    """Finds transition 60 most unusual."""

    count = 0

    def reset(self, rows: Any = None) -> None:
        self.count = 0

    def update(self, obs: Any, action: Any, next_obs: Any) -> float:
        self.count += 1
        return 2.0 if self.count == 60 else 0.0


def forward(observation: Any) -> np.ndarray:
    """Weaving ahead, as a function of where it is."""
    return np.array([0.8, 0.6 * np.sin(3 * observation["proprio"][10])])


@pytest.fixture(scope="module")
def driven() -> tuple[Trajectory, Heightfield]:
    """A heavy rover on rough ground, and the ground."""
    env: Any = gym.make(ROUGH, context=["psi", "elevation"], max_episode_steps=110, terrain_pool=2)
    env.unwrapped.reset(seed=1, options={"psi": {"base_mass": 28.0}})

    class Heavy(gym.Wrapper):
        def reset(self, **kwargs: Any) -> Any:
            return self.env.reset(seed=kwargs["seed"], options={"psi": {"base_mass": 28.0}})

    return execute(forward, Heavy(env), Alarm(), 1.0, 1), env.unwrapped.heightfield


def error(found: Heightfield, true: Heightfield, trajectory: Trajectory) -> float:
    """Root mean square under and around the wheels, m."""
    around = np.random.default_rng(0).uniform(-0.4, 0.4, (len(trajectory.estimate), 40, 2))
    points = (trajectory.estimate[:, None, :2] + around).reshape(-1, 2)
    assert true.height(points).std() > 0.01, "rough it is"
    return float(np.sqrt(((found.height(points) - true.height(points)) ** 2).mean()))


def test_the_ground_is_what_was_perceived(driven: tuple[Trajectory, Heightfield]) -> None:
    """To a hundredth of its relief, where averaging maps that were turned back leaves a third."""
    trajectory, true = driven
    assert trajectory.looks.tolist() == list(range(0, 110, LOOK))
    found, off = perceived_ground(trajectory)
    assert error(found, true, trajectory) < 3e-4
    assert off < 2e-3
    assert found.origin == true.origin
    assert found.heights.shape == true.heights.shape


def test_noise_of_the_maps_is_averaged_and_told(driven: tuple[Trajectory, Heightfield]) -> None:
    trajectory, true = driven
    noise = 0.02 * np.random.default_rng(0).standard_normal(trajectory.maps.shape)
    found, off = perceived_ground(replace(trajectory, maps=(trajectory.maps + noise).astype(np.float32)))
    assert error(found, true, trajectory) < 0.02
    assert 0.01 < off < 0.025


def test_the_belief_is_as_with_the_true_ground(
    driven: tuple[Trajectory, Heightfield], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Heights that are 5 mm off, or a map that is four cells off, would be seen."""
    fewer(monkeypatch, 0.4, 0.4, draws=40)
    trajectory, true = driven[0].until_alarm(), driven[1]
    perceived, given = (
        Assimilation(ROUGH, ground=g, delta_s=False, effects=False).infer(trajectory) for g in (None, true)
    )
    sd = np.sqrt(np.diag(given.covariance))
    assert sd.min() < 0.9, "something is told"
    plane = Heightfield(np.full((256, 256), true.height_at(0, 0)))
    wrong = Assimilation(ROUGH, ground=plane, delta_s=False, effects=False).infer(trajectory)
    off, blind = (np.sqrt(np.mean(((q.mean - given.mean) / sd) ** 2)) for q in (perceived, wrong))
    assert off < 0.3, "noise is drawn on the ground as it is there, on several as it may be here"
    assert blind > 2 * off, "the ground matters"


def test_what_is_missing_is_said(driven: tuple[Trajectory, Heightfield]) -> None:
    trajectory, _ = driven
    with pytest.raises(InputError, match=r"no elevation maps: .*'elevation'.*`ground=`"):
        perceived_ground(replace(trajectory, maps=trajectory.maps[:0], looks=trajectory.looks[:0]))
    with pytest.raises(InputError, match="no state estimate that says where the base was"):
        perceived_ground(replace(trajectory, estimate=np.zeros((111, 0))))


def test_maps_are_kept_and_files_without_them_are_read(driven: tuple[Trajectory, Heightfield], tmp_path: Path) -> None:
    trajectory, _ = driven
    trajectory.save(tmp_path / "new.npz")
    again = Trajectory.load(tmp_path / "new.npz")
    for f in fields(Trajectory):
        np.testing.assert_array_equal(getattr(again, f.name), getattr(trajectory, f.name))
    later = ("maps", "looks", "alarm_map")
    with np.load(tmp_path / "new.npz") as archive:
        np.savez(tmp_path / "old.npz", **{k: archive[k] for k in archive.files if k not in later})
    assert len(Trajectory.load(tmp_path / "old.npz").maps) == 0
    cut = trajectory.until_alarm()
    assert len(cut) == 60
    assert cut.looks.tolist() == [0, 25, 50]


def test_a_posterior_sees_the_map_at_the_alarm(driven: tuple[Trajectory, Heightfield]) -> None:
    """And not the last that was kept on the way."""
    trajectory, true = driven
    cut = trajectory.until_alarm()
    quat = cut.estimate[60, 3:7]
    seen = elevation(true, cut.estimate[60, :3], 2 * np.arctan2(quat[3], quat[0]))
    off = {k: float(np.abs(m - m.mean() - (seen - seen.mean())).mean())
           for k, m in (("alarm", cut.elevation), ("kept", cut.maps[-1]))}  # fmt: skip
    assert off["alarm"] < 0.2 * off["kept"]
    older = replace(trajectory, alarm_map=np.zeros((0, 0), np.float32)).until_alarm()
    np.testing.assert_array_equal(older.elevation, trajectory.maps[2], "of a file without it, the last by then")


def test_a_world_without_maps_has_none() -> None:
    env = gym.make("nfc_gym/JackalFlat-v0", context=["psi"], max_episode_steps=5)
    trajectory = execute(lambda o: np.zeros(2), env, Alarm(), 1.0, 0)
    assert trajectory.maps.shape == (0, 128, 128)
    assert trajectory.until_alarm().elevation.size == 0
