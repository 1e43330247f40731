"""Watching a policy: what an episode came to, pictures and videos of it."""

import weakref
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from nfc_gym import InputError
from nfc_gym.adaptation import load_policy, play
from nfc_gym.adaptation.play import film, sheet


def test_an_episode_is_what_it_is_without_looking(jackal: Path) -> None:
    first, second = play.play("JackalFlat", jackal, episodes=2, seed=3)
    assert first["length"] == 1000
    assert {"return", "length", "success"} == set(first)
    assert play.play("JackalFlat", jackal, seed=4) == [second]


def test_a_sheet_shows_a_dozen_moments_in_their_order(tmp_path: Path) -> None:
    frames = [np.full((6, 8, 3), [k, 0, 0], np.uint8) for k in range(100)]
    sheet(tmp_path / "sheet.png", frames)
    seen = cv2.imread(str(tmp_path / "sheet.png"))
    assert seen.shape == (18, 32, 3)
    tiles = seen[::6, ::8, 2].reshape(-1)
    assert (tiles[0], tiles[-1]) == (0, 99)
    assert (np.diff(tiles.astype(int)) > 0).all()


def test_a_sheet_that_cannot_be_made_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sheet.png").write_text("before")
    monkeypatch.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError("the disk is full")))
    with pytest.raises(OSError, match="the disk is full"):
        sheet(tmp_path / "sheet.png", [np.zeros((6, 8, 3), np.uint8)])
    assert [p.read_text() for p in tmp_path.iterdir()] == ["before"]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [({"episodes": 0}, "episodes is 0, want a whole number, 1 or more"), ({"seed": -1}, "seed is -1, want a whole")],
)
def test_episodes_that_cannot_be_are_named(jackal: Path, wrong: dict[str, int], told: str) -> None:
    with pytest.raises(InputError, match=told):
        play.play("JackalFlat", jackal, **wrong)


def test_a_video_plays_in_real_time(tmp_path: Path) -> None:
    with film(tmp_path / "v.mp4") as keep:
        for k in range(50):
            keep(np.full((360, 480, 3), 5 * k, np.uint8))
    read = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert read.get(cv2.CAP_PROP_FRAME_COUNT) / read.get(cv2.CAP_PROP_FPS) == pytest.approx(2.0, abs=0.1)
    assert [p.name for p in tmp_path.iterdir()] == ["v.mp4"]


def test_what_was_there_stays_until_the_whole_video_is(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_text("before")

    def interrupted() -> None:
        with film(tmp_path / "v.mp4") as keep:
            keep(np.zeros((360, 480, 3), np.uint8))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [p.read_text() for p in tmp_path.iterdir()] == ["before"]


def test_frames_of_a_video_are_written_as_they_come(
    jackal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None is kept, of however many episodes; and a video that cannot be written is told before the first."""
    frames: list[weakref.ref] = []

    def rendered(env: Any) -> np.ndarray:
        assert sum(frame() is not None for frame in frames) <= 1
        frame = np.zeros((360, 480, 3), np.uint8)
        frames.append(weakref.ref(frame))
        return frame

    monkeypatch.setattr("nfc_gym.adaptation.play.rendered", rendered)
    monkeypatch.setattr("nfc_gym.adaptation.play.EVERY_VIDEO", 100)
    said = Console(record=True, width=200, file=StringIO())
    play.play("JackalFlat", jackal, tmp_path / "v.avi", episodes=2, console=said)
    assert len(frames) == 20
    assert "v.avi: 20 frames" in said.export_text()
    monkeypatch.setattr("nfc_gym.adaptation.play.episode", None)
    monkeypatch.setattr(cv2.VideoWriter, "fourcc", lambda *_: -1)
    with pytest.raises(InputError, match="no video can be written there"):
        play.play("JackalFlat", jackal, tmp_path / "w.mp4")


def test_bad_input_is_named(jackal: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.gif: want a video"):
        play.play("JackalFlat", jackal, tmp_path / "x.gif")
    for at in ("/proc/none/x.png", "/proc/none/x.mp4"):
        with pytest.raises(InputError, match="/proc/none cannot be written"):  # before the policy is looked for
            play.play("JackalFlat", tmp_path / "gone.safetensors", at)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError, match=r"folder\.png is a folder"):
        play.play("JackalFlat", jackal, tmp_path / "folder.png")
    with pytest.raises(InputError, match="cannot act in AntFlat"):
        play.play("AntFlat", jackal)
    policy = load_policy(jackal)
    policy.about["training"]["task"] = "figure8"  # of which an Ant knows nothing
    policy.save(tmp_path / "eight.safetensors")
    with pytest.raises(InputError, match="cannot act in AntFlat"):
        play.play("AntFlat", tmp_path / "eight.safetensors")
