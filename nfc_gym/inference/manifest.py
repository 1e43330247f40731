"""What a set of windows says of itself: the `manifest.json` beside its shards."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import is_number

FORMAT = 1
MANIFEST = "manifest.json"


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What the windows of a folder are.

    Attributes:
      environment, robot, rough: id, name of the robot, and whether it moves on rough ground.
      psi_names, psi_units, psi_low, psi_high: the box that u in [0, 1] stands for, d each.
      horizon: H, control steps a window.
      dt: control step, s.
      state_names, action_names: s and a of them; `obs` is what no part of the physical state stands behind alone.
      state_noise: (s,) standard deviation of the measurement noise that readers add, 0 for what is known exactly.
      families: names; the first is `none`.
      effects: of each pair of family and place: `family`, `where`, `parameters` (names), `units`.
      terrain_kinds, terrain_scale: names, and what multiplies all heights.
      seed, windows, per_shard: the run's seed, and how many windows were asked for, in all and per shard.
      settings: what else the windows depend on.
      versions: of the packages that made them.
      finished: shard -> counts (`windows`, `unstable`, `ended`, `relabelled`).
      format: of these files.
    """

    environment: str
    robot: str
    rough: bool
    psi_names: tuple[str, ...]
    psi_units: tuple[str, ...]
    psi_low: tuple[float, ...]
    psi_high: tuple[float, ...]
    horizon: int
    dt: float
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    state_noise: tuple[float, ...]
    families: tuple[str, ...]
    effects: tuple[dict[str, Any], ...]
    terrain_kinds: tuple[str, ...]
    terrain_scale: float
    seed: int
    windows: int
    per_shard: int
    settings: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    finished: dict[int, dict[str, int]] = field(default_factory=dict)
    format: int = FORMAT

    @property
    def shards(self) -> int:
        """How many shards the whole set has."""
        return -(-self.windows // self.per_shard)

    @property
    def complete(self) -> bool:
        """Whether every shard is there."""
        return len(self.finished) == self.shards

    def size(self, shard: int) -> int:
        """Windows of a shard: the last one holds what is left."""
        return min(self.per_shard, self.windows - shard * self.per_shard)

    def shapes(self) -> dict[str, tuple[int | None, ...]]:
        """Trailing shape of each array; None is any."""
        s, a, d, h = len(self.state_names), len(self.action_names), len(self.psi_names), self.horizon
        scalars = ("family", "effect", "terrain_kind", "terrain_seed", "terrain_difficulty", "camera_seed")
        return {
            "states": (h + 1, s), "actions": (h, a), "psi": (d,), "delta_s": (s,), "theta": (None,),
            "pose": (h + 1, 7), "start": (None,), **dict.fromkeys(scalars, ()), "camera_level": (),
        }  # fmt: skip

    def text(self) -> str:
        """As JSON."""
        return json.dumps(asdict(self), indent=1)

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """The manifest of a folder.

        Raises:
          InputError: there is none, it is not JSON, of another format, lacks a key, or has a value that is none.
        """
        path = folder / MANIFEST
        try:
            raw = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InputError(f"{folder}: no {MANIFEST}; want a folder that `nfc-gym simulate` wrote") from None
        except (OSError, ValueError) as e:
            raise InputError(f"{path}: cannot be read ({e})") from None
        found = raw.get("format") if isinstance(raw, dict) else None
        if found != FORMAT:
            raise InputError(f"{path}: format {found!r}, and this version of nfc_gym reads format {FORMAT}")
        names = {f.name for f in fields(cls)}
        odd = sorted(names ^ set(raw))
        if odd:
            raise InputError(f"{path}: the keys {', '.join(odd)} are missing or unknown")
        for name, value in raw.items():
            if not _KINDS[name](value):
                raise InputError(f"{path}: {name} is {str(value)[:80]}, which no manifest has: simulate again")
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in raw.items()}
        values["finished"] = {int(k): v for k, v in values["finished"].items()}
        for name, like in _ALIKE.items():
            if len(values[name]) != len(values[like]):
                raise InputError(f"{path}: {len(values[name])} {name} and {len(values[like])} {like}: simulate again")
        return cls(**values)


def _whole(least: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, int) and not isinstance(value, bool) and value >= least


def _list_of(one: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and all(one(v) for v in value)


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _named(value: Any) -> bool:
    return isinstance(value, dict)


def _counted(value: Any) -> bool:
    """Shard -> counts, the shards by their numbers."""
    return _named(value) and all(
        k.isdecimal() and _named(v) and all(_whole(0)(n) for n in v.values()) for k, v in value.items()
    )


# Whether a value, as JSON has it, may be that of a key; and keys whose lists are as long as another's.
_KINDS: dict[str, Callable[[Any], bool]] = {
    "environment": _text, "robot": _text, "rough": lambda value: isinstance(value, bool),
    "psi_names": _list_of(_text), "psi_units": _list_of(_text), "psi_low": _list_of(is_number),
    "psi_high": _list_of(is_number), "horizon": _whole(1), "dt": is_number, "state_names": _list_of(_text),
    "action_names": _list_of(_text), "state_noise": _list_of(is_number), "families": _list_of(_text),
    "effects": _list_of(_named), "terrain_kinds": _list_of(_text), "terrain_scale": is_number, "seed": _whole(0),
    "windows": _whole(1), "per_shard": _whole(1), "settings": _named, "versions": _named, "finished": _counted,
    "format": _whole(FORMAT),
}  # fmt: skip
_ALIKE = {"psi_units": "psi_names", "psi_low": "psi_names", "psi_high": "psi_names", "state_noise": "state_names"}
