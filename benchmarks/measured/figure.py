"""One picture a machine: what was measured and what the models say of a log that none of them was fitted to."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nfc_gym.core.log import Log
from nfc_gym.measured.dataset import load
from nfc_gym.measured.smoothing import moving_average

STAGES = {"calibrated": ("parameters alone", "#c8742a"), "extended": ("with what was found", "#1f6fb2")}
MEASURED = "#222222"
_MANY = 50  # logs from which on a picture of one says little


def compared(log: Log, mode: str) -> tuple[np.ndarray, list[str], int]:
    """Measured columns (T, C) that predictions of a mode are set beside, their labels, and samples averaged over."""
    prefix = {"rollout": "", "inverse": "force:", "forward": "sensor:"}[mode]
    columns, labels, smooth = [], [], 1
    for name, channel in log.channels.items():
        smooth = max(smooth, channel.smooth)
        if name.startswith(prefix):
            values = channel.values.reshape(len(log), -1)
            columns.append(np.where((True if channel.mask is None else channel.mask[:, None]), values, np.nan))
            labels += [f"{name} [{channel.unit}]"] * values.shape[1]
    return np.concatenate(columns, 1), labels, smooth


def draw(mapping: Path, mode: str, predictions: Mapping[str, Path], title: str, out: Path) -> None:
    """Draw what was measured and predicted on verification logs.

    Of few logs that with the middle error of the calibrated model, in the column that moves most; of many short ones
    the errors at their ends, sorted.

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
    figure = Figure(figsize=(7.2, 2.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    if len(held_out) > _MANY:
        _spread(axes, [whole[n] for n in held_out], mode, tables)
        axes.set_title(f"{title}: {len(held_out)} logs that nobody fitted to")
    else:
        errors = {n: float(np.nansum(_error(whole[n], mode, tables["calibrated"][n]))) for n in held_out}
        name = sorted(held_out, key=lambda n: errors[n])[len(held_out) // 2]
        _trace(axes, whole[name], mode, {stage: table[name] for stage, table in tables.items()})
        axes.set_title(f"{title}: log {name}")
    axes.grid(alpha=0.25)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)


def _trace(axes: Axes, log: Log, mode: str, tables: Mapping[str, np.ndarray]) -> None:
    measured, labels, smooth = compared(log, mode)
    column = int(np.nanstd(measured, 0).argmax())
    seen = np.isfinite(measured[:, column])
    axes.plot(log.time, _averaged(measured, smooth)[:, column], color=MEASURED, lw=1.6, label="measured")
    for stage, (label, colour) in STAGES.items():
        values = _averaged(_table(tables[stage])[-len(log) :], smooth)[:, column]
        axes.plot(log.time, np.where(seen, values, np.nan), color=colour, lw=1.1, label=label)
    low, high = np.nanmin(measured[:, column]), np.nanmax(measured[:, column])
    room = 0.35 * (high - low)
    axes.set(xlabel="s", ylabel=labels[column], ylim=(low - room, high + room))
    axes.legend(loc="upper right", fontsize=8, ncols=3)


def _spread(axes: Axes, logs: Sequence[Log], mode: str, tables: Mapping[str, np.ndarray]) -> None:
    """Errors at the ends of many logs, in the column where the calibrated model's median is largest."""
    ends = {s: np.array([_table(tables[s][log.name])[-1] - compared(log, mode)[0][-1] for log in logs]) for s in STAGES}
    column = int(np.nanmedian(np.abs(ends["calibrated"]), 0).argmax())
    for stage, (label, colour) in STAGES.items():
        values = np.sort(np.abs(ends[stage][:, column]))
        axes.plot(np.linspace(0, 100, len(values)), values, color=colour, lw=1.6, label=label)
    name = compared(logs[0], mode)[1][column]
    top = float(np.nanquantile(np.abs(ends["calibrated"][:, column]), 0.97))
    axes.set(xlabel="per cent of the logs", ylabel=f"error of {name}\nat the end", ylim=(0, 1.1 * top))
    axes.legend(loc="upper left", fontsize=8)


def _table(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)


def _averaged(values: np.ndarray, width: int) -> np.ndarray:
    return moving_average(values, width) if width > 1 else values


def _error(log: Log, mode: str, predicted: np.ndarray) -> np.ndarray:
    """(C,) root-mean-square error of each column, in its own unit; nan where nothing is compared."""
    measured, _, _ = compared(log, mode)
    squares = (_table(predicted)[-len(log) :] - measured) ** 2
    seen = np.isfinite(squares)
    return np.sqrt(np.where(seen, squares, 0.0).sum(0) / np.where(seen.any(0), seen.sum(0), np.nan))
