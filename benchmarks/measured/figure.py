"""One picture a machine: what was measured and what the models say of a log that none of them was fitted to."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from nfc_gym.core.log import Log
from nfc_gym.measured.dataset import load

STAGES = {"calibrated": ("parameters alone", "#c8742a"), "extended": ("with what was found", "#1f6fb2")}
MEASURED = "#222222"


def compared(log: Log, mode: str) -> tuple[np.ndarray, list[str]]:
    """Measured columns (T, C) that predictions of a mode are set beside, and their labels."""
    prefix = {"rollout": "", "inverse": "force:", "forward": "sensor:"}[mode]
    columns, labels = [], []
    for name, channel in log.channels.items():
        if name.startswith(prefix):
            values = channel.values.reshape(len(log), -1)
            columns.append(np.where((True if channel.mask is None else channel.mask[:, None]), values, np.nan))
            labels += [f"{name} [{channel.unit}]"] * values.shape[1]
    return np.concatenate(columns, 1), labels


def draw(mapping: Path, mode: str, predictions: Mapping[str, Path], title: str, out: Path) -> None:
    """Draw the verification log with the middle error of the calibrated model, in the column where that is largest.

    Args:
      mapping: the set's mapping file.
      mode: of the predictions.
      predictions: stage -> npz file with one array a log.
      title: above the picture.
      out: PNG file.
    """
    dataset = load(mapping)
    # A log cut by time is predicted whole; its last part verifies.
    whole = {log.name.partition("@")[0]: log for log in dataset.logs}
    tables = {stage: np.load(file) for stage, file in predictions.items()}
    held_out = sorted({n for fold in dataset.folds for n in fold.names("verify")})
    held_out = [n for n in held_out if n in tables["calibrated"].files] or tables["calibrated"].files
    errors = {n: _error(whole[n], mode, tables["calibrated"][n]) for n in held_out}
    name = sorted(held_out, key=lambda n: errors[n].max())[len(held_out) // 2]
    column, log = int(errors[name].argmax()), whole[name]
    measured, labels = compared(log, mode)
    figure = Figure(figsize=(7.2, 2.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    axes.plot(log.time[: len(measured)], measured[:, column], color=MEASURED, lw=1.6, label="measured")
    for stage, (label, colour) in STAGES.items():
        values = _table(tables[stage][name])[-len(log) :]
        axes.plot(log.time[: len(values)], values[:, column], color=colour, lw=1.1, label=label)
    low, high = np.nanmin(measured[:, column]), np.nanmax(measured[:, column])
    room = 0.35 * (high - low)
    axes.set_ylim(low - room, high + room)
    axes.set(xlabel="s", ylabel=labels[column], title=f"{title}: log {name}")
    axes.legend(loc="upper right", fontsize=8, ncols=3)
    axes.grid(alpha=0.25)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)


def _table(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)


def _error(log: Log, mode: str, predicted: np.ndarray) -> np.ndarray:
    """(C,) root-mean-square error of each column over the spread of that column."""
    measured, _ = compared(log, mode)
    table = _table(predicted)[-len(log) :]
    out = np.zeros(measured.shape[1])
    for c in range(len(out)):
        seen = np.isfinite(measured[: len(table), c])
        if seen.any():
            values = measured[: len(table), c][seen]
            out[c] = np.sqrt(np.mean((table[seen, c] - values) ** 2)) / max(float(values.std()), 1e-9)
    return out
