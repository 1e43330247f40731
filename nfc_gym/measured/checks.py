"""`nfc-gym check`: all that is wrong with a mapping, its model and its logs, in one place. Nothing is repaired."""

import hashlib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from nfc_gym.core import InputError, Log
from nfc_gym.measured.clock_checks import clock_offsets, even_rows, shift_notes
from nfc_gym.measured.dataset import Dataset, assemble, read_log
from nfc_gym.measured.findings import Finding, Suspicion, gather, in_order, parted
from nfc_gym.measured.mapping import SPLITS, Mapping, load_mapping
from nfc_gym.measured.model import compile_told, read_spec
from nfc_gym.measured.model_checks import model_findings
from nfc_gym.measured.sign_checks import turned_round
from nfc_gym.measured.signal_checks import suspicions
from nfc_gym.measured.speed_checks import clock_unit
from nfc_gym.measured.splits import Source, find_logs
from nfc_gym.measured.stream_checks import stream_notes
from nfc_gym.physics.quiet import no_warnings

__all__ = ["Finding", "check", "examine", "require"]

ONE_SAMPLE = 0.9  # sampling intervals, below which no horizon reaches a sample; less than 1, as intervals are rounded


def check(dataset_path: Path | str) -> list[Finding]:
    """Everything that is wrong or looks wrong, errors first; an empty list where nothing does."""
    return examine(dataset_path)[1]


def require(dataset_path: Path | str) -> tuple[Dataset, list[Finding]]:
    """The data set, and the warnings and notes about it.

    Raises:
      InputError: something is wrong that no fit should be built on; all of it, one a line.
    """
    dataset, findings = examine(dataset_path)
    errors = [f for f in findings if f.severity == "error"]
    if dataset is None or errors:
        raise InputError("\n".join(map(str, errors)))
    return dataset, findings


@no_warnings()  # a nominal model that comes apart would say so in each roll-out
def examine(dataset_path: Path | str) -> tuple[Dataset | None, list[Finding]]:
    """Read a data set once, and say all that is wrong with it; None where it cannot be used at all."""
    path = Path(dataset_path)
    try:
        mapping = load_mapping(path)
    except InputError as e:
        return None, [_split_line(line, str(path)) for line in str(e).splitlines()]
    findings: list[Finding] = []
    model: mujoco.MjModel | None = None
    try:
        spec = read_spec(mapping.model_file, path.parent)
        model, remarks = compile_told(spec, mapping.model_file)
        findings += [Finding("note", "model", *parted(remark)) for remark in remarks]
        findings += model_findings(mapping, spec, model)
    except InputError as e:
        findings.append(_finding("model", str(e).removeprefix("model ")))
    dataset, found = _logs(mapping, path, model)
    if dataset is not None:
        found += _whole(dataset)
        if not any(f.severity == "error" for f in findings + found):  # roll-outs need all of it right
            found += turned_round(dataset)
    return dataset, in_order(findings + found)


def _logs(mapping: Mapping, path: Path, model: mujoco.MjModel | None) -> tuple[Dataset | None, list[Finding]]:
    try:
        sources = find_logs(mapping, path.parent)
    except InputError as e:
        return None, [_finding("logs", str(e).removeprefix("logs: "))]
    found: list[tuple[str, Suspicion]] = []
    read: list[tuple[Source, Log]] = []
    whole: dict[str, str] = {}
    spoilt = 0
    for source in sources:
        logs, defects, alignment, even = read_log(mapping, source)
        if even is not None:
            found.append((source.name, even_rows(even)))
        if alignment is not None:
            found += [(source.name, s) for s in stream_notes(alignment)]
        for defect in defects:
            found.append((source.name, Suspicion("error", defect.where, "defect", *parted(defect.text))))
        if any(log.name != source.name for _, log in logs):
            found.append((source.name, _cut(logs)))
        found += [(log.name, s) for _, log in logs for s in suspicions(mapping, model, log)]
        spoilt, read = spoilt + bool(defects), [*read, *logs]
        whole |= dict.fromkeys((source.name, *(log.name for _, log in logs)), source.name)
    shifts = {name: c.shift for name, c in mapping.channels.items()}
    findings = gather(_weighed(found, len(read) + spoilt), whole)
    findings += [*clock_offsets(model, [log for _, log in read], shifts), *shift_notes(shifts)]
    if spoilt:
        return None, findings
    try:
        return assemble(mapping, path, read), findings
    except InputError as e:
        return None, [*findings, _finding("split", str(e).removeprefix("split: "))]


def _cut(stretches: list[tuple[Source, Log]]) -> Suspicion:
    seconds, count = sum(log.duration for _, log in stretches), len(stretches)
    text = f"cut at its gaps: {count} stretch{'es' * (count > 1)}, {seconds:.3g} s in all"
    return Suspicion("note", "time", "cut", text, "what is shorter than a segment is left out")


def _weighed(found: list[tuple[str, Suspicion]], logs: int) -> list[tuple[str, Suspicion]]:
    """What moves in no log is worse than what rests in some: a channel is then an error, a command no mere note."""
    still = Counter(s.where for _, s in found if s.kind == "constant")

    def weigh(s: Suspicion) -> Suspicion:
        everywhere, measured = still[s.where] == logs, s.where.startswith("channels.")
        if s.kind != "constant" or everywhere != measured:
            return s
        return replace(s, severity="error" if measured else "note")

    return [(log, weigh(s)) for log, s in found]


def _whole(dataset: Dataset) -> list[Finding]:
    """What can only be judged over all logs: lengths, splits, what will be estimated."""
    findings = []
    segments = dataset.mapping.segments
    if segments.mode == "rollout":
        findings += _reached(dataset)
    if not dataset.independent_splits:
        message = "some logs are cut by time, so fitting and verification are not independent"
        findings.append(Finding("note", "split", message, "the report will say so; separate logs prove more"))
    findings += [*_copies(dataset), *_unfitted(dataset)]
    quiet = [name for name, c in dataset.mapping.channels.items() if c.noise is None]
    if quiet:
        advice = "give `noise` (standard deviation of one sample) where you know it"
        findings.append(Finding("note", "channels", f"noise will be estimated for {', '.join(quiet)}", advice))
    return findings


def _copies(dataset: Dataset) -> list[Finding]:
    """Logs that are the same one twice: what was fitted to would then verify itself."""
    first: dict[bytes, str] = {}
    for log in dataset.logs:
        content = hashlib.sha256()
        for values in (log.time, *log.controls.values(), *(c.values for c in log.channels.values())):
            content.update(np.ascontiguousarray(values).data)
        other = first.setdefault(content.digest(), log.name)
        if other != log.name:
            message = f"log {log.name!r} holds the same as {other!r}: one that fits may verify itself"
            return [Finding("warning", "logs", message, "leave one of them out")]
    return []


def _unfitted(dataset: Dataset) -> list[Finding]:
    """Conditions of which no log is fitted to, in some fold: what belongs to such a day alone cannot be known."""
    fitted = [{log.condition for log in dataset.of("fit", fold)} for fold in dataset.folds]
    lone = sorted({log.condition for log in dataset.logs if any(log.condition not in own for own in fitted)})
    if not lone:
        return []
    message = f"no log of the condition {lone[0]!r} is fitted to: what belongs to that day alone nobody will know"
    return [Finding("warning", "logs", message, "record more logs of it, or give one of them `split: fit`")]


_DOES = {"fit": "is fitted to", "select": "selects", "verify": "verifies"}


def _reached(dataset: Dataset) -> list[Finding]:
    """Whether the logs of every split hold segments with samples to compare."""
    findings: list[Finding] = []
    segments, fold = dataset.mapping.segments, dataset.folds[0]
    first, last = segments.horizons[0], segments.horizons[-1]
    told = next((text for log in dataset.logs if (text := clock_unit(log, dataset.mapping.time))), "")
    key = "unit" if dataset.mapping.time.interval is None else "interval"
    cause = f"check `time.{key}`: {told}" if told else ""

    def too_slow(log: Log) -> bool:
        return last < ONE_SAMPLE * log.interval

    for split in SPLITS:
        longest = max((log.duration for log in dataset.of(split, fold)), default=0.0)
        if longest < last:
            message = f"no log that {_DOES[split]} is as long as the longest horizon, "
            message += f"{last:g} s; the longest lasts {longest:.3g} s"
            advice = "shorten segments.length and segments.horizons, record longer logs, or change `split`"
            findings.append(Finding("error", "segments", message, cause or advice))
    short = [log.name for log in dataset.logs if log.duration < last]
    if short and len(short) < len(dataset.logs):
        message = f"{len(short)} of {len(dataset.logs)} logs are shorter than the longest horizon, first {short[0]}"
        findings.append(Finding("warning", "segments", message, "they are left out; shorten the horizons to use them"))
    blind = next((own for s in SPLITS if (own := dataset.of(s, fold)) and all(map(too_slow, own))), None)
    slow = max(log.interval for log in dataset.logs)
    if blind is not None:
        interval = min(log.interval for log in blind)
        span = f"every horizon, {first:g} to {last:g} s," if first < last else f"the horizon, {last:g} s,"
        message = f"{span} lies below one sampling interval, {interval:.3g} s: there is no sample to compare"
        advice = "check `time.unit` (s, ms, us or ns), or lengthen segments.length and segments.horizons"
        findings.append(Finding("error", "segments", message, cause or advice))
    elif first < 0.5 * slow:
        message = f"the shortest horizon, {first:g} s, is below half a sampling interval ({slow:.3g} s)"
        findings.append(Finding("warning", "segments", message, "begin with a horizon of one interval or more"))
    return findings


def _finding(where: str, text: str) -> Finding:
    return Finding("error", where, *parted(text))


def _split_line(line: str, path: str) -> Finding:
    """`file:12: key: message; advice` as a finding."""
    place, _, rest = line.removeprefix(path).partition(": ")
    return _finding(path + place, rest or line)
