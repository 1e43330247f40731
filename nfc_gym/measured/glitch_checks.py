"""Readings that no motion explains: single rows far off, and sensors that stand still while the rest moves."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.findings import Suspicion

Array = NDArray[np.float64]

USUAL = 0.95  # share of the steps from row to row; glitches are the rest, or a part of it
FAR = 10.0  # times the largest of these
BACK = 0.25  # of the way there, that may lack of the way back
JUMP = 2.0  # times the largest usual step, with which a reading goes on that was frozen
FROZEN = 20  # rows of one value, of a sensor that hardly ever repeats one
SELDOM = 0.02  # share of its other rows that repeat the one before
_MASK = "name a `mask` column that is false there, or cut the log"


def glitches(log: Log) -> Iterator[Suspicion]:
    """What nothing can have moved like; channels that are masked, or slower than the log, are left out."""
    whole = {name: c for name, c in log.channels.items() if c.mask is None and c.rate is None}
    rows = {name: c.values.reshape(len(log), -1) for name, c in whole.items()}
    moving = {name: (np.diff(v, axis=0) != 0).any(1) for name, v in rows.items()}
    for name, channel in whole.items():
        if parse_channel(name).quantity in ("pos", "quat"):  # a blow does this to a speed, or to a force
            yield from _spikes(name, channel, rows[name])
        others = [m for other, m in moving.items() if other != name]
        if others:
            yield from _frozen(name, rows[name], np.any(others, axis=0), log)


def _spikes(name: str, channel: Channel, values: Array) -> Iterator[Suspicion]:
    """Single rows (T, k) that lie far from both beside them, which lie near each other."""
    if len(values) < FROZEN:
        return
    step = np.linalg.norm(np.diff(values, axis=0), axis=1)
    there = np.minimum(step[:-1], step[1:])
    across = np.linalg.norm(values[2:] - values[:-2], axis=1)
    usual = float(np.quantile(step, USUAL))
    found = np.flatnonzero((usual > 0) & (there > FAR * usual) & (across < BACK * there))
    if found.size:
        far = float(there[found].max())
        message = f"{found.size} single row{'s' * (found.size > 1)} off by up to {far:.3g} {channel.unit}"
        message += f", the first row {int(found[0]) + 1}: there and back within two rows"
        yield Suspicion("warning", f"channels.{name}", "spikes", message, _MASK)


def _frozen(name: str, values: Array, others: NDArray[np.bool_], log: Log) -> Iterator[Suspicion]:
    """The longest run of one value (T, k), which ends with a jump, in a channel that otherwise hardly repeats one.

    What merely rests sets out from where it stands.
    """
    step = np.linalg.norm(np.diff(values, axis=0), axis=1)
    still = step == 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    runs = edges.reshape(-1, 2)
    if not runs.size:
        return
    first, last = runs[int(np.diff(runs, axis=1).argmax())]
    count = int(last - first)
    if last == len(step) or step[last] <= JUMP * np.quantile(step, USUAL):
        return
    rest = len(still) - count
    if count < FROZEN or still.sum() - count > SELDOM * rest or rest < FROZEN or not others[first:last].mean() > 0.5:
        return
    seconds = float(log.time[last] - log.time[first])
    message = f"the same value in rows {first} to {last}, for {seconds:.3g} s, while other channels move: frozen?"
    yield Suspicion("warning", f"channels.{name}", "frozen", message, _MASK)
