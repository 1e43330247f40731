"""Watch a policy: episodes in its environment, as a video or a sheet of pictures, and what they came to."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from nfc_gym.adaptation.policy import Policy, load_policy
from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.core.files import replacing, require_writable
from nfc_gym.core.whole import require_whole
from nfc_gym.simulate.machine import full_id

VIDEOS, PICTURES = (".mp4", ".avi"), (".png", ".jpg", ".jpeg")
_SHEET = (3, 4)  # rows and columns
_SIZE = (480, 360)  # width and height of a frame
EVERY_VIDEO, EVERY_SHEET = 2, 10  # control steps between two frames: 25 a second, or enough to choose from
Frame = NDArray[np.uint8]


def play(
    environment: str, policy: str | Path | None = None, out: str | Path | None = None, *, episodes: int = 1,
    seed: int = 0, console: Console | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Run whole episodes in the nominal world.

    Args:
      environment: id.
      policy: file; default the environment's pretrained one.
      out: a video, or a picture with a dozen moments of the first episode; None shows nothing.
      episodes: how many; the k-th begins from seed + k.
      seed: see above.
      console: is told.

    Returns:
      For each episode `return`, `length`, where there is a goal `success` (it was reached at any time).

    Raises:
      InputError: no such environment or policy, one that does not fit, an `out` of another kind, or nothing can be
        written there.
      MissingExtra: nothing can be rendered here.
    """
    require_whole("play: episodes", episodes, 1)
    require_whole("play: seed", seed, 0)
    name, path = full_id(environment), None if out is None else Path(out)
    if path is not None:
        _require_place(path)
    loaded = load_policy(name if policy is None else policy)
    env = _shown(name, loaded, path is not None)
    films = path is not None and path.suffix.lower() in VIDEOS
    every = EVERY_VIDEO if films else EVERY_SHEET
    console, frames, found = console or Console(), list[Frame](), list[dict[str, Any]]()
    with ExitStack() as stack:
        stack.callback(env.close)
        keep: Callable[[Frame], Any] | None = None if path is None else frames.append
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
        if path is not None and films:  # opened first: where nothing can be written it is told before any work
            keep = stack.enter_context(film(path))
        bar = stack.enter_context(Progress(*Progress.get_default_columns(), console=console, transient=True))
        for k in range(episodes):
            task = bar.add_task(f"episode {k}", total=env.spec.max_episode_steps if env.spec else None)
            score = episode(
                env, loaded, seed + k, every, keep if k == 0 or films else None, partial(bar.advance, task)
            )  # fmt: skip
            bar.remove_task(task)
            found.append(score)
            console.print(f"episode {k}: " + ", ".join(f"{key} {value:.4g}" for key, value in score.items()))
    if path is not None:
        if not films:
            sheet(path, frames)
        count = sum(-(-score["length"] // every) for score in found)
        shown = f"{count} frames" if films else "a dozen moments of episode 0"
        console.print(f"{path}: {shown}", markup=False, emoji=False)
    return found


def _require_place(path: Path) -> None:
    """Raises `InputError` where a video or a picture cannot be written."""
    if path.suffix.lower() not in VIDEOS + PICTURES:
        raise InputError(f"{path}: want a video ({', '.join(VIDEOS)}) or a picture ({', '.join(PICTURES)})")
    require_writable(path.absolute().parent)
    if path.is_dir():
        raise InputError(f"{path} is a folder: name the file to write in it")


def _shown(name: str, policy: Policy, pictures: bool) -> gymnasium.Env:
    """The environment on the policy's task, with the context that it looks at, that renders where `pictures` are taken.

    Raises:
      InputError: the policy does not fit it.
    """
    look: dict[str, Any] = {"render_mode": "rgb_array", "width": _SIZE[0], "height": _SIZE[1]} if pictures else {}
    context = ["psi", "elevation"] if policy.sight.cells else ["psi"]
    env = gymnasium.make(name, context=context, **look, **policy.settings(name))
    policy.require(env)
    return env


def episode(
    env: Any, policy: Policy | Callable[[Any], Any], seed: int, every: int, keep: Callable[[Frame], Any] | None = None,
    told: Callable[[], None] = lambda: None,
) -> dict[str, Any]:  # fmt: skip
    """One episode; `keep` is given a frame each so many control steps, `told` is called after each step."""
    observation, info = env.reset(seed=seed)
    total, length, over, reached = 0.0, 0, False, False
    while not over:
        if keep is not None and length % every == 0:
            keep(rendered(env))
        observation, reward, ended, truncated, info = env.step(policy(observation))
        total, length, over = total + float(reward), length + 1, bool(ended or truncated)
        reached |= bool(info.get("success", False))
        told()
    score: dict[str, Any] = {"return": total, "length": length}
    return score | {"success": reached} if "success" in info else score


def rendered(env: Any) -> Frame:
    """A picture; raises `MissingExtra` where there is no graphics library."""
    try:
        return env.render()
    except InputError:
        raise
    except Exception as e:
        raise MissingExtra(
            f"nothing can be rendered here ({e}): install a graphics library (EGL or OSMesa) and set MUJOCO_GL, or "
            "leave out --out"
        ) from None


@contextmanager
def film(path: Path) -> Iterator[Callable[[Frame], Any]]:
    """Takes frames as they come, for a video in real time; what was at `path` stays until the whole of it is there."""
    part = path.with_name(f".{path.stem}.part{path.suffix}")  # by whose ending the kind of video is told
    code = cv2.VideoWriter.fourcc(*("mp4v" if path.suffix.lower() == ".mp4" else "MJPG"))
    writer = cv2.VideoWriter(str(part), code, 50.0 / EVERY_VIDEO, _SIZE)
    try:
        if not writer.isOpened():
            raise InputError(f"{path}: no video can be written there; try .avi, or a picture (.png)")
        yield lambda frame: writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        writer.release()
        part.replace(path)
    finally:
        writer.release()
        part.unlink(missing_ok=True)


def sheet(path: Path, frames: list[Frame]) -> None:
    """Write a dozen moments, evenly spread, from left to right and from top to bottom.

    Args:
      path: of the picture; what was there stays until the whole of it is.
      frames: one or more, each (height, width, 3) RGB.

    Raises:
      InputError: no picture of this kind can be made here.
    """
    rows, columns = _SHEET
    chosen = [frames[round(k)] for k in np.linspace(0, len(frames) - 1, rows * columns)]
    whole = np.concatenate([np.concatenate(chosen[r * columns : (r + 1) * columns], 1) for r in range(rows)], 0)
    made, picture = cv2.imencode(path.suffix.lower(), cv2.cvtColor(whole, cv2.COLOR_RGB2BGR))
    if not made:
        raise InputError(f"{path}: no picture of this kind can be made here; try .png")
    with replacing(path) as part:
        part.write_bytes(picture.tobytes())
