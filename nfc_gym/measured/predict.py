"""`predict`: what the nominal, calibrated or extended model says of every log, one array a log."""

import itertools
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing, require_writable
from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench, make_bench
from nfc_gym.measured.checks import require
from nfc_gym.measured.cuts import Cut, Layout
from nfc_gym.measured.dataset import Dataset
from nfc_gym.measured.export import unpack
from nfc_gym.measured.forward import ForwardProblem
from nfc_gym.measured.inverse import InverseProblem
from nfc_gym.measured.segments import servos
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.steps import interpolate
from nfc_gym.physics.quiet import no_warnings
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_HISTORY = 5.0  # s, at least, of the past that hidden states are led through: ten times the longest lag of a drive
_ABREAST = 256  # pieces, at most: their histories must fit in memory


@no_warnings()  # what comes apart is an error here, said once
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
    joined = _join(results, frozenset(dataset.whole))
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
    mapping = bench.dataset.mapping
    problem = kind(bench.plant.model, logs, states, mapping.segments.length, linear=mapping.straight)
    values = problem.along(plant, x[None], problem.tracks)
    return {log.name: v[0][:, 0] if v.shape[-1] == 1 else v[0] for log, v in zip(logs, values, strict=True)}


def _roll(bench: Bench, plant: Plant, x: Array, log: Log, restart: float | None, of: str) -> Array:
    """One open-loop roll-out of a log by the model `of`, or pieces of `restart` seconds, at the log's own samples."""
    dt = float(plant.model.opt.timestep)
    if restart is not None and not restart >= max(dt, log.interval):
        raise InputError(
            f"--restart {restart:g}: log {log.name!r} has a sample every {log.interval:.3g} s, and the model's step is "
            f"{dt:g} s; give {max(dt, log.interval):.3g} or more"
        )
    length = min(restart, log.duration) if restart else log.duration
    starts = np.searchsorted(log.time, np.arange(0.0, log.duration, length) - 1e-9) if restart else np.array([0])
    starts = np.unique(starts[starts < len(log) - 1])  # a last row alone is the end of the piece before it
    ends = np.append(starts[1:], len(log))
    pieces: list[Array] = []
    for some in _alike(log, starts):
        problem = _begun(bench, plant, log, starts[some], np.maximum(ends[some] - 1, starts[some] + 1))
        values, traj = problem.predict(plant, x[None], problem.segments, problem.observers)
        if not traj.stable.all():
            raise InputError(
                f"log {log.name!r}: the simulation is unstable with {of}; shorten segments.timestep or use --restart"
            )
        for i, (begin, end) in enumerate(zip(starts[some], ends[some], strict=True)):
            step = ((log.time[begin:end] - log.time[begin]) / dt)[None]
            pairs = zip(values, problem.observers, strict=True)
            columns = [interpolate(v[:, i : i + 1], step, o.quaternion)[0, 0] for v, o in pairs]
            pieces.append(np.concatenate(columns, -1))
    out = np.concatenate(pieces)
    return out[:, 0] if out.shape[1] == 1 else out


def _alike(log: Log, starts: NDArray[np.intp]) -> list[slice]:
    """Pieces that are rolled out side by side: all but a first one that nothing came before, and the last one.

    Of these the one needs no history, and the other may end far sooner: under commands held beyond the log's end it
    might come apart.
    """
    last = len(starts) - 1
    edges = {0, *range(0 if log.before else 1, last, _ABREAST), last, last + 1}
    return [slice(a, b) for a, b in itertools.pairwise(sorted(edges))]


def _begun(bench: Bench, plant: Plant, log: Log, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> RolloutProblem:
    """Roll-outs of a log from rows to rows (S,); what remembers is led along what the log shows before them."""
    mapping, dt = bench.dataset.mapping, float(plant.model.opt.timestep)
    known = log.time[starts[0]] - log.inputs.time[0]  # s before the first of them
    history = max(mapping.segments.history, _HISTORY) if known > 0 else 0.0
    length = float(np.max(log.time[ends] - log.time[starts]))
    layout = Layout(length, history, (length,), length, dt)
    where = Cut(
        np.zeros(len(starts), np.intp), starts, ends[:, None], ((log.time[ends] - log.time[starts]) / dt)[:, None]
    )
    return RolloutProblem(
        plant.model, [log], [bench.states[log.name]], layout, servos(plant.model, mapping.servo_laws), mapping.straight,
        settle=mapping.segments.start == "settled", where=where,
    )  # fmt: skip


def _join(results: dict[str, Array], files: frozenset[str]) -> dict[str, Array]:
    """Parts of a log that was cut by time (`<log>@fit`, ...), in the order of time, become the log of a file again."""
    out: dict[str, Array] = {}
    for name, values in results.items():
        while name not in files:
            name = name.rpartition("@")[0]
        out[name] = np.concatenate([out[name], values]) if name in out else values
    return out
