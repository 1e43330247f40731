"""`predict`: what the nominal, calibrated or extended model says of every log, one array a log."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing, require_writable
from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench, make_bench
from nfc_gym.measured.checks import require
from nfc_gym.measured.dataset import Dataset
from nfc_gym.measured.export import unpack
from nfc_gym.measured.forward import ForwardProblem
from nfc_gym.measured.inverse import InverseProblem
from nfc_gym.measured.segments import Layout, servos
from nfc_gym.measured.shooting import RolloutProblem, interpolate
from nfc_gym.measured.splits import find_logs
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]


def predict(
    mapping: Path, fit: Path | None, mode: str, stage: str, out: Path, *, restart: float | None = None
) -> dict[str, Array]:
    """Predict every log and write one array a log, in SI units, to an npz file, whole or not at all.

    Rows are those of the log, at `Log.time`; of a log cut by time, those of its parts, one after the other. Columns
    follow the channels of the mapping in their order, all components of each; a single column makes a vector (T,).

    Args:
      mapping: the mapping file.
      fit: folder that `close_loop` wrote; with folds each log is predicted by the fit that did not see its group.
      mode: rollout (T, components of `joint:*:pos|vel`, `body:` and `sensor:` channels, orientations scalar first) from
        the first sample of each log or part; inverse (T, `force:` channels); forward (T, components of `sensor:`
        channels).
      stage: nominal, calibrated or extended.
      out: npz file to write; what is there is replaced.
      restart: rollout only: start anew from the measured state every so many seconds; a single row that would be left
        at the end of a log belongs to the piece before it.

    Returns:
      The arrays by log name, as written.

    Raises:
      InputError: the mapping, the model or the logs cannot be used, the fit does not belong to the mapping, or a model
        is unstable on a log.
    """
    if out.is_dir():
        raise InputError(f"{out} is a folder: name the file to write in it, as --out {out / 'predicted.npz'}")
    if out.suffix not in ("", ".npz"):
        raise InputError(f"--out {out}: predictions are written as .npz; name it {out.with_suffix('.npz').name}")
    if out.exists() and not out.is_file():
        raise InputError(f"--out {out} is a device, not a file: choose another")
    require_writable(out.parent)
    mujoco.set_mju_user_warning(lambda message: None)  # what comes apart is an error here, said once
    dataset = require(mapping)[0]
    bench = make_bench(dataset)
    models = _models(bench, dataset, fit, stage)
    results: dict[str, Array] = {}
    of = "the nominal model" if fit is None or stage == "nominal" else f"the {stage} model of fit.json"
    for fold in dataset.folds:
        logs = [log for log in dataset.logs if len(dataset.folds) == 1 or fold.splits[log.name] == "verify"]
        if logs:
            plant, x = models[fold.name]
            results |= _predict(bench, plant, x, logs, mode, restart, of)
    joined = _join(results, frozenset(s.name for s in find_logs(dataset.mapping, dataset.folder)))
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as part, open(part, "wb") as handle:
        np.savez_compressed(handle, **joined)  # type: ignore[arg-type]
    return joined


def _models(bench: Bench, dataset: Dataset, fit: Path | None, stage: str) -> dict[str, tuple[Plant, Array]]:
    out = {}
    for fold in dataset.folds:
        if fit is None or stage == "nominal":
            out[fold.name] = (bench.plant, bench.plant.null)
            continue
        file = fit / fold.name / "fit.json" if len(dataset.folds) > 1 else fit / "fit.json"
        if not file.is_file():
            raise InputError(f"{file} does not exist: run close-loop on this mapping with --out {fit} first")
        _require_own(file.with_name("report.json"), bench.dataset.mapping.model_file)
        out[fold.name] = _read_fit(file, stage, bench.plant)
    return out


def _require_own(report: Path, model: str) -> None:
    """Refuse a fit whose report says that it is of another model; without a report nobody knows."""
    try:
        given = json.loads(report.read_text(encoding="utf-8"))["model"]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if Path(given).name != Path(model).name:
        raise InputError(
            f"{report.parent} is of the model {given}, the mapping of {model}: give the folder of this mapping"
        )


def _read_fit(file: Path, stage: str, plant: Plant) -> tuple[Plant, Array]:
    again = "run close-loop on this mapping again, with --overwrite"
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as e:
        raise InputError(f"{file}: not the JSON that close-loop writes ({e}); {again}") from None
    if not isinstance(data, dict) or stage not in data:
        raise InputError(f"{file}: has no model {stage!r}; {again}")
    try:
        whole, x = unpack(data[stage], plant)
    except InputError as e:
        raise InputError(f"{file}: {stage}: {e}; {again}") from None
    for p, value in zip(plant.space.parameters, x, strict=False):
        if not p.low <= value <= p.high:
            raise InputError(
                f"{file}: {stage}: {p.name} is {value:g} {p.unit}, outside the mapping's [{p.low:g}, {p.high:g}]; "
                f"{again}"
            )
    return whole, x


def _predict(
    bench: Bench, plant: Plant, x: Array, logs: list[Log], mode: str, restart: float | None, of: str
) -> dict[str, Array]:
    if mode == "rollout":
        return {log.name: _roll(bench, plant, x, log, restart, of) for log in logs}
    kind = InverseProblem if mode == "inverse" else ForwardProblem
    states = [bench.states[log.name] for log in logs]
    problem = kind(bench.plant.model, logs, states, bench.dataset.mapping.segments.length)
    values = problem.along(plant, x[None], problem.tracks)
    return {log.name: v[0][:, 0] if v.shape[-1] == 1 else v[0] for log, v in zip(logs, values, strict=True)}


def _roll(bench: Bench, plant: Plant, x: Array, log: Log, restart: float | None, of: str) -> Array:
    """One open-loop roll-out of a log by the model `of`, or pieces of `restart` seconds, at the log's own samples."""
    mapping = bench.dataset.mapping
    dt = float(plant.model.opt.timestep)
    if restart is not None and not restart >= max(dt, log.interval):
        raise InputError(
            f"--restart {restart:g}: log {log.name!r} has a sample every {log.interval:.3g} s, and the model's step is "
            f"{dt:g} s; give {max(dt, log.interval):.3g} or more"
        )
    length = min(restart, log.duration) if restart else log.duration
    starts = np.searchsorted(log.time, np.arange(0.0, log.duration, length) - 1e-9) if restart else np.array([0])
    starts = np.unique(starts[starts < len(log) - 1])  # a last row alone is the end of the piece before it
    laws = servos(
        plant.model, {k: (c.servo.joint, c.servo.limit) for k, c in mapping.controls.items() if c.servo is not None}
    )
    linear = frozenset(k for k, c in mapping.controls.items() if c.hold == "linear")
    pieces = []
    for i, begin in enumerate(starts):
        end = int(starts[i + 1]) if i + 1 < len(starts) else len(log)
        part = log.part(int(begin), max(end, int(begin) + 2), log.name)
        states = _slice(bench.states[log.name], int(begin), max(end, int(begin) + 2))
        layout = Layout(part.duration, 0.0, (part.duration,), part.duration + 1, dt)
        problem = RolloutProblem(
            plant.model, [part], [states], layout, laws, linear, settle=mapping.segments.start == "settled"
        )
        values, traj = problem.predict(plant, x[None], problem.segments, problem.observers)
        if not traj.stable.all():
            raise InputError(
                f"log {log.name!r}: the simulation is unstable with {of}; shorten segments.timestep or use --restart"
            )
        step = (part.time / dt)[None]
        columns = [interpolate(v, step, o.quaternion)[0, 0] for v, o in zip(values, problem.observers, strict=True)]
        pieces.append(np.concatenate(columns, -1)[: end - begin])
    out = np.concatenate(pieces)
    return out[:, 0] if out.shape[1] == 1 else out


def _slice(states: Any, start: int, stop: int) -> Any:
    from dataclasses import replace

    keys = ("qpos", "qvel", "qacc", "qpos_sd", "qvel_sd")
    return replace(states, **{k: getattr(states, k)[start:stop] for k in keys})


def _join(results: dict[str, Array], files: frozenset[str]) -> dict[str, Array]:
    """Parts of a log that was cut by time (`<log>@fit`, ...), in the order of time, become the log of a file again."""
    out: dict[str, Array] = {}
    for name, values in results.items():
        while name not in files:
            name = name.rpartition("@")[0]
        out[name] = np.concatenate([out[name], values]) if name in out else values
    return out
