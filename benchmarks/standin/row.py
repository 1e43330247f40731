"""What is to be tried, and what came of it; both are plain data that JSON keeps."""

import json
import zlib
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

NAN = float("nan")


@dataclass(frozen=True)
class Size:
    """How long a trial is: logs, seconds of each, which effects compete (empty: all), and tries to size an effect."""

    logs: int = 8
    seconds: float = 5.0
    only: tuple[str, ...] = ()
    tries: int = 8


@dataclass(frozen=True)
class Task:
    """One trial to run.

    Attributes:
      robot: its name.
      group: single, pair, outside or null.
      families: what is hidden.
      seed: of everything that is drawn.
      size: how long its logs are.
      baselines: whether the baselines run too.
    """

    robot: str
    group: str
    families: tuple[str, ...]
    seed: int
    size: Size = Size()
    baselines: bool = False

    @property
    def name(self) -> str:
        """Of its file in the folder of finished trials."""
        size = zlib.crc32(json.dumps(asdict(self.size)).encode()) % 10000
        return f"{self.robot}-{self.group}-{'+'.join(self.families) or 'none'}-{self.seed}-{size}"


@dataclass
class Estimate:
    """A number that was hidden and what the report says of it: truth, value, 95 % interval."""

    name: str
    unit: str
    true: float
    value: float
    low: float
    high: float

    @property
    def covered(self) -> bool:
        """Whether the interval holds the truth."""
        return self.low <= self.true <= self.high

    @property
    def off(self) -> float:
        """Relative error; nan where the truth is 0."""
        return abs(self.value - self.true) / abs(self.true) if self.true else NAN


@dataclass
class Row:
    """Outcome of a trial.

    Attributes:
      ratio: X / X_null of the effect under the true psi without it, of two the smaller; nan for nulls.
      outcome: right, wrong or missed; of pairs also `half`, of effects outside the library also `silent` and
        `elsewhere` (said to be unexplained, at another place).
      false_claims: effects claimed that are not there (an equivalent of a right claim is none).
      class_size: claim and equivalents, of the largest right claim.
      errors: error over the oracle's by stage (nominal, psi only, after, and the baselines'), at the longest horizon,
        geometric mean over the groups of quantities; empty where the library has no such law.
      oracle_x: X of the oracle over X_null on the verification logs, about 1 if both codes mean the same effect.
      foretold: where something hidden is not named (it alone, or of a pair), whether the identifiability table says of
        all that is not that it had to be so.
      effect, psi: parameters of the rightly named effects, and of the model.
      sindy: what sparse regression names, and whether that is right.
      seconds: of the loop alone, wall clock; `cpu` of the whole trial, core-seconds.
    """

    robot: str
    group: str
    families: list[str]
    seed: int
    hidden: str = ""
    ratio: float = NAN
    outcome: str = ""
    false_claims: int = 0
    claims: list[str] = field(default_factory=list)
    class_size: int = 0
    verdict: str = ""
    coordinate: str = ""
    errors: dict[str, float] = field(default_factory=dict)
    oracle_x: float = NAN
    foretold: bool | None = None
    effect: list[Estimate] = field(default_factory=list)
    psi: list[Estimate] = field(default_factory=list)
    sindy: dict[str, Any] = field(default_factory=dict)
    seconds: float = NAN
    cpu: float = NAN
    note: str = ""


def to_json(row: Row) -> dict[str, Any]:
    """Plain data; nan and infinity as null, which JSON has no word for."""
    return clean(asdict(row))


def from_json(data: dict[str, Any]) -> Row:
    """The inverse of `to_json`."""
    data = dict(data)
    for key in ("effect", "psi"):
        data[key] = [Estimate(**{k: NAN if v is None else v for k, v in e.items()}) for e in data[key]]
    for key in ("ratio", "oracle_x", "seconds", "cpu"):
        data[key] = NAN if data[key] is None else data[key]
    data["errors"] = {k: NAN if v is None else v for k, v in data["errors"].items()}
    return Row(**data)


def clean(value: Any) -> Any:
    """The same with nan and infinity as null."""
    if isinstance(value, dict):
        return {k: clean(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [clean(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
