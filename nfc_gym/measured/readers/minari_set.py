"""Minari data sets, by `minari`: each episode is a log.

A data set is its folder, the folder `data` in it, or the `.hdf5` file in that. Columns of an episode of T steps:
`observations` (T, k) and `actions` (T, k) with entries `observations[5]`; of Dict and Tuple spaces
`observations.<key>`, `actions.0`; `rewards`, `terminations`, `truncations`, `infos.<key>`. Row i holds the observation
that action i answers to, so the episode's last observation, which no action follows, is left out. Episodes of one step
are left out.

`time` is `infos.time` where that was recorded, else the row times the environment's control interval `dt`, for which
the environment must be registered here; its own program is run, never one that the data set names. Where neither is
known there is no `time`, and the mapping says `time: {interval: S}`, the seconds of a control step.
"""

import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import broken, needed, parsing

_PART = "episode_{}"


def episodes(path: Path) -> tuple[str, ...]:
    """Names of a data set's episodes of two steps or more.

    Raises:
      InputError: `minari` is not installed, or the data set is damaged, foreign or empty.
    """
    data = _open(path)
    with parsing(path):
        lengths = [int(m["total_steps"]) for m in data.storage.get_episode_metadata(data.episode_indices)]
    names = tuple(_PART.format(i) for i, n in zip(data.episode_indices, lengths, strict=True) if n > 1)
    if not names:
        raise InputError(f"{path}: the data set holds no episode of two steps or more")
    return names


def read_episode(path: Path, part: str) -> dict[str, NDArray[Any]]:
    """One episode's columns; `part` is one of `episodes(path)`."""
    data = _open(path)
    there = {_PART.format(i): int(i) for i in data.episode_indices}
    if part not in there:
        raise InputError(f"{path}: no episode {part!r}; there are {len(there)}, from {_PART.format(0)} on")
    with parsing(path):
        episode = next(iter(data.storage.get_episodes([there[part]])))
        steps = len(episode["rewards"])
        keys = ("observations", "actions", "rewards", "terminations", "truncations", "infos")
        leaves = [leaf for key in keys for leaf in _leaves(key, episode[key])]
        table = {name: values[:steps] for name, values in leaves if len(values) in (steps, steps + 1)}
    if "infos.time" in table:
        table["time"] = table["infos.time"]
    elif (interval := _interval(_spec(data))) is not None:
        table["time"] = np.arange(steps) * interval
    return table


def _folder(path: Path) -> Path:
    inside = path / "data"
    return path.parent if path.is_file() else inside if (inside / "metadata.json").is_file() else path


def _open(path: Path) -> Any:
    minari = needed(path, "minari", "minari")
    folder = _folder(path)
    try:
        metadata = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"{path}: no metadata.json beside it, as a Minari data set has; other HDF5 files: save their arrays with "
            "numpy.savez(path, time=..., ...)"
        ) from None
    except ValueError as e:
        raise broken(folder / "metadata.json", e) from None
    wanted = {"data_format", "observation_space", "action_space", "minari_version", "total_episodes"}
    lacking = sorted(wanted - set(metadata)) if isinstance(metadata, dict) else sorted(wanted)
    if lacking:  # without the spaces minari would make the environment that the file describes
        raise InputError(f"{folder / 'metadata.json'}: not of a Minari data set, as it lacks {', '.join(lacking)}")
    if metadata["data_format"] == "hdf5":
        needed(path, "h5py", "minari")
        needed(path, "PIL", "minari")
    with parsing(path):
        return minari.MinariDataset(folder)


def _leaves(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays (T, ...) of a nested episode by name; those of more dimensions are laid out flat, (T, k)."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(f"{name}.{key}", inner)
    elif isinstance(value, tuple):
        for i, inner in enumerate(value):
            yield from _leaves(f"{name}.{i}", inner)
    elif value is not None and np.ndim(value) > 0:
        array = np.asarray(value)
        yield name, array.reshape(len(array), -1) if array.ndim > 2 else array


def _spec(data: Any) -> tuple[str, int | None]:
    """The environment's id and, where it was given, its `frame_skip`."""
    spec = data.env_spec
    skip = None if spec is None else spec.kwargs.get("frame_skip")
    return ("" if spec is None else spec.id), skip if isinstance(skip, int) else None


@functools.lru_cache(maxsize=32)
def _interval(spec: tuple[str, int | None]) -> float | None:
    """Control interval in s of an environment that is registered here; None where it is not or does not say."""
    import gymnasium as gym

    name, skip = spec
    if name not in gym.registry:  # gym.make would import the module that an id names
        return None
    try:
        kwargs: dict[str, Any] = {} if skip is None else {"frame_skip": skip}
        env = gym.make(name, **kwargs)
    except Exception:  # it needs what is not installed, say: then the time stays unknown
        return None
    interval = getattr(env.unwrapped, "dt", None)
    env.close()
    return float(interval) if isinstance(interval, int | float) and interval > 0 else None
