"""Which families of effects to look at first: what a structure head says of the fit logs, before anything is fitted."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.states import channel_noise, estimate_states
from nfc_gym.physics.effects.base import Effect

if TYPE_CHECKING:
    from nfc_gym.measured.bench import Bench

Array = NDArray[np.float64]
NONE = "none"
_MASS = 0.95  # of the probability of having an effect at all: what the families that are looked at first make up
_MOST = 8  # of these families
_OFF = 0.25  # of a control step: how far a sample may lie from its place
_FAINT = 1e-6  # printed as this at least, so that no probability reads as zero


class Witness(Protocol):
    """A structure head (`nfc_gym.simulate.witness`), whose windows are `horizon` control steps of `dt` s long."""

    horizon: int
    dt: float

    def __call__(
        self,
        motion: tuple[Array, Array],
        expected: tuple[Array, Array],
        sent: Mapping[str, Array],
        noise: Mapping[str, float],
        seed: int = 0,
    ) -> dict[str, float]:
        """Probability of each family, "none" for no effect, given W windows of motion together.

        Args:
          motion: measured positions (W, H+1, nq) and velocities (W, H+1, nv) at control steps.
          expected: the same of the calibrated model.
          sent: `ctrl:<actuator>` -> (W, H) commands.
          noise: channel name -> standard deviation.
          seed: of what it draws.
        """
        ...


@dataclass(frozen=True)
class Suspects:
    """What the head said, and what follows for the search.

    Attributes:
      file: of the head.
      probabilities: of each family that it knows, "none" included.
      windows: of the fit logs, that it was asked about.
      seconds: that asking took.
    """

    file: str
    probabilities: dict[str, float]
    windows: int = 0
    seconds: float = 0.0

    @property
    def likely(self) -> tuple[str, ...]:
        """Families that together make up nearly all of the probability of having an effect, likeliest first."""
        ranked = sorted((f for f in self.probabilities if f != NONE), key=lambda f: -self.probabilities[f])
        whole, out, sum_ = sum(self.probabilities[f] for f in ranked), [], 0.0
        for family in ranked[:_MOST]:
            if sum_ > _MASS * whole:
                break
            out.append(family)
            sum_ += self.probabilities[family]
        return tuple(out)

    def told(self, close: Sequence[Effect], pool: Sequence[Effect], seconds: float) -> dict[str, Any]:
        """For `report.json`; the identifiability table has rows for `close`, some of a pool, and took so long."""
        rows, of = (sum(not e.generic for e in effects) for effects in (close, pool))
        ranked = sorted(self.probabilities.items(), key=lambda pair: -pair[1])
        return {
            "file": self.file, "windows": self.windows, "seconds": self.seconds,
            "families": {f: max(p, _FAINT) for f, p in ranked}, "looked_at_first": list(self.likely),
            "left_out": of - rows, "seconds_spared": round(seconds / max(rows, 1) * (of - rows), 2),
        }  # fmt: skip


def ask(witness: Witness, file: str, bench: "Bench", logs: Sequence[Log], x: Array, seed: int) -> Suspects:
    """Ask a head about the fit logs, cut into windows as long as those that it was trained on.

    Args:
      witness: the head.
      file: where it is kept.
      bench: the mapping made ready.
      logs: that effects are fitted to; those that select and verify stay unseen.
      x: (d,) calibrated psi.
      seed: of the noise that quiet logs are given.

    Raises:
      InputError: logs of another robot, slower than the head's control steps, or shorter than a window.
    """
    began = time.monotonic()
    h, dt = witness.horizon, witness.dt
    problem = bench.rollouts(logs, [bench.states[log.name] for log in logs], horizons=(h * dt,))
    rolled = bench.plant.shoot(x[None], problem.segments)
    fine = rolled.stable[0]
    if not fine.any():
        return Suspects(file, {}, 0, round(time.monotonic() - began, 2))
    at = np.round(dt * np.arange(h + 1) / problem.segments.dt).astype(int)
    raw = [estimate_states(bench.plant.model, log, raw=True) for log in logs]
    of = list(zip(problem.log_of[fine], problem.time_of[fine], strict=True))
    pairs = [(i, _rows(logs[i], float(t), dt, h)) for i, t in of]
    motion = np.stack([raw[i].qpos[r] for i, r in pairs]), np.stack([raw[i].qvel[r] for i, r in pairs])
    expected = rolled.qpos[0, fine][:, at], rolled.qvel[0, fine][:, at]
    sent = {k: np.stack([_means(logs[i].controls[k], r) for i, r in pairs]) for k in logs[0].controls}
    noise = {k: channel_noise(logs[0], k) for k in logs[0].channels}
    told = witness(motion, expected, sent, noise, seed)
    return Suspects(file, told, len(pairs), round(time.monotonic() - began, 2))


def _rows(log: Log, start: float, dt: float, steps: int) -> NDArray[np.intp]:
    """(steps + 1,) rows of a log nearest to control steps from a time on.

    Raises:
      InputError: the log has no sample near one of them.
    """
    wanted = start + dt * np.arange(steps + 1)
    rows = np.clip(np.searchsorted(log.time, wanted - _OFF * dt), 0, len(log) - 1)
    off = np.abs(log.time[rows] - wanted)
    if off.max() > _OFF * dt:
        raise InputError(
            f"log {log.name!r}: no sample within {1e3 * _OFF * dt:.0f} ms of {wanted[off.argmax()]:.3f} s; the head's "
            f"windows have one every {1e3 * dt:.0f} ms: record at {1 / dt:.0f} Hz or a multiple of it"
        )
    return rows


def _means(values: Array, rows: NDArray[np.intp]) -> Array:
    """(steps,) mean over each control step of a signal (T,) that may be commanded faster than that."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    return (total[rows[1:]] - total[rows[:-1]]) / np.diff(rows)


def looked_at(pool: Sequence[Effect], suspects: Suspects, rounds: Sequence[Any]) -> list[Effect]:
    """The candidates of a pool whose families a search looked at closely: suspected, or ranked in any of its rounds.

    They alone get a row in the identifiability table, which takes a roll-out and more for each.
    """
    ranked = {i for r in rounds for row in r.ranking for i in row["id"].split(" + ")}
    named = {i for r in rounds for i in (*r.accepted, *r.equivalents, *chain(*r.alike.values()))}
    families = {i.partition(":")[0] for i in ranked | named} | set(suspects.likely)
    return [e for e in pool if e.family in families]


def kept(suspects: Suspects) -> dict[str, Any]:
    """Plain data from which `restored` makes the same."""
    return dict(suspects.__dict__)


def restored(data: dict[str, Any] | None) -> Suspects | None:
    """Inverse of `kept`."""
    return None if data is None else Suspects(**data)
