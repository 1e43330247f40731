"""Elevation maps of windows, rebuilt from their seeds and poses: what the robot perceived, and the ground as it was.

Windows hold no maps: 1e6 of 128 x 128 would take 65 GB. The terrain is made again from its kind, seed and difficulty;
the depth camera then looks along the window's poses with its own seed, and the map is the one at the window's end.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from nfc_gym.envs.contract import FLAT
from nfc_gym.inference.shards import maps_path, save_maps
from nfc_gym.inference.windows import Batch, Manifest, Windows
from nfc_gym.physics.state import yaw
from nfc_gym.simulate.ground import made
from nfc_gym.simulate.pool import unordered
from nfc_gym.simulate.workers import cores
from nfc_gym.terrain import DepthCamera, Heightfield, PerceivedMap, elevation

READ = ("pose", "terrain_kind", "terrain_seed", "terrain_difficulty", "camera_seed", "camera_level")


class Maps(NamedTuple):
    """Elevation maps (n, 128, 128) float32 [m] at the end of each window, relative to the base, turned as it heads.

    `perceived` is what a depth camera made of the ground, `true` the ground itself; `valid` says which cells were seen.
    The residual terrain is `true - perceived`.
    """

    perceived: NDArray[np.float32]
    true: NDArray[np.float32]
    valid: NDArray[np.bool_]

    @property
    def delta_e(self) -> NDArray[np.float32]:
        """(n, 128, 128) truth minus perceived [m]."""
        return self.true - self.perceived


def camera(level: float) -> DepthCamera:
    """The depth camera with all its errors times `level`."""
    usual = DepthCamera()
    return replace(
        usual,
        subpixel=usual.subpixel * level,
        dropout=min(usual.dropout * level, 1.0),
        blotches=usual.blotches * level,
        flying=min(usual.flying * level, 1.0),
        drift=usual.drift * level,
        yaw_drift=usual.yaw_drift * level,
        tilt=usual.tilt * level,
    )


def ground(manifest: Manifest, kind: int, seed: int, difficulty: float) -> Heightfield:
    """The terrain of a window; `kind` -1 is a plane."""
    if kind < 0:
        return FLAT
    return made(manifest.terrain_kinds[kind], int(seed), float(difficulty), manifest.terrain_scale)


def keep_maps(folder: str | Path, jobs: int = 0, console: Console | None = None) -> None:
    """Write the maps of all windows of a folder beside them, 64 KB a window; shards that have theirs are passed over.

    Args:
      folder: what `simulate` wrote.
      jobs: processes; 0 takes all cores.
      console: where progress goes; None is silent.
    """
    folder = Path(folder)
    left = [k for k in Windows(folder).manifest.finished if not maps_path(folder, k).exists()]
    shown = Progress(console=console, disable=console is None)
    with shown as bar:
        kept = unordered(_keep, ((folder, k) for k in left), jobs or cores())
        for _ in bar.track(kept, len(left), description="elevation maps"):
            pass


def _keep(folder: Path, shard: int) -> None:
    whole = Windows(folder)
    first = sum(whole.manifest.size(k) for k in whole.manifest.finished if k < shard)
    rows = np.arange(first, first + whole.manifest.size(shard))
    rebuilt = maps(whole.manifest, whole.take(rows, READ))
    save_maps(folder, shard, {"map": rebuilt.perceived, "delta_e": rebuilt.delta_e})


def maps(manifest: Manifest, windows: Batch) -> Maps:
    """Rebuild the maps of some windows.

    Args:
      manifest: of their set.
      windows: as `Windows` gives them; what `READ` names is read, (n, ...) each.
    """
    pose = np.asarray(windows["pose"], np.float64)
    kinds, seeds, hard = (windows[f"terrain_{k}"] for k in ("kind", "seed", "difficulty"))
    n, size = len(pose), PerceivedMap().valid.shape
    out = Maps(np.empty((n, *size), np.float32), np.empty((n, *size), np.float32), np.empty((n, *size), bool))
    for i in range(n):
        field = ground(manifest, int(kinds[i]), int(seeds[i]), float(hard[i]))
        seen = PerceivedMap(camera(float(windows["camera_level"][i])))
        seen.reset(np.random.default_rng(int(windows["camera_seed"][i])))
        xyz, quat = pose[i, :, :3], pose[i, :, 3:]
        heading = yaw(quat)
        # Between images nothing is seen; the last pose is the one the map is drawn at.
        stride = max(1, round(1 / seen.camera.rate / manifest.dt))
        last = len(pose[i]) - 1
        for k in range(last % stride, last + 1, stride):
            out.perceived[i] = seen.update(field, xyz[k], quat[k], heading[k], k * manifest.dt)
        out.valid[i] = seen.valid
        out.true[i] = elevation(field, xyz[last], heading[last])
    return out
