"""Which log fits, which selects and which verifies: log files found, named, grouped and divided."""

import json
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping as Dict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nfc_gym.core import InputError, Log
from nfc_gym.measured.entries import LogEntry, SplitRule
from nfc_gym.measured.mapping import SPLITS, Mapping, Split
from nfc_gym.measured.readers import is_log, log_parts, suffixes
from nfc_gym.measured.yaml_marks import suggest

SELECT_OF_REST = 0.2  # by: rotate: this part of the logs that do not verify selects
SELECT_BY_TIME = 0.25  # no log selects: this last part of every fitting log does


@dataclass(frozen=True)
class Source:
    """A log file and what the mapping says of it.

    Attributes:
      name: unique; the stem, or the path below the mapping's folder where two stems are alike.
      split: fit, select, verify, or auto where the split rule decides.
      group, condition: empty where none was given.
      part: which of the logs in a file that holds several (an episode); empty for a file that is one log.
    """

    name: str
    path: Path
    split: str
    group: str
    part: str = ""
    condition: str = ""


@dataclass(frozen=True)
class Fold:
    """One way to divide the logs: log name -> fit, select or verify. `name` is the group that verifies, or empty."""

    name: str
    splits: Dict[str, Split]

    def names(self, split: Split) -> tuple[str, ...]:
        """Names of the logs of a split, in the data set's order."""
        return tuple(name for name, own in self.splits.items() if own == split)


@dataclass(frozen=True)
class Division:
    """Logs (cut where the rule cuts), the folds over them, and whether no two splits share a log."""

    logs: tuple[Log, ...]
    folds: tuple[Fold, ...]
    independent: bool


def find_logs(mapping: Mapping, folder: Path) -> list[Source]:
    """The mapping's log files, sorted within each entry.

    Raises:
      InputError: nothing matches, a file is listed twice, a group's pattern does not match, `splits` names other files.
    """
    found: dict[Path, tuple[LogEntry, list[tuple[str, ...]]]] = {}
    for entry in mapping.logs:
        paths = _matches(entry, folder)
        inside = {path: {part: _label(path, part) for part in log_parts(path)} for path in paths}
        labels = [label for parts in inside.values() for label in parts.values()]
        assigned = _read_splits(folder / entry.splits, labels) if entry.splits else {}
        for path in paths:
            if any(
                unicodedata.category(c) in ("Cc", "Cs") for c in str(path)
            ):  # control characters, bytes that are no text
                name = str(path).encode(errors="backslashreplace").decode()
                raise InputError(f"logs: {name!r} has characters in its name that cannot be printed; rename it")
            if path in found:
                raise InputError(
                    f"logs: {path.name} is matched by {found[path][0].path!r} and by {entry.path!r}; list it once"
                )
            rules = []
            for part, label in inside[path].items():
                name = assigned.get(label, entry.split)
                split, group = (name, "") if name in (*SPLITS, "auto") else ("auto", name)
                given = _named(entry.group, label, "group") or group
                rules.append((split, given, part, _named(entry.condition, label, "condition")))
            found[path] = entry, rules
    stems = Counter(_label(path) for path in found)

    def name_of(path: Path, part: str) -> str:
        if stems[_label(path)] == 1:
            return _label(path, part)
        inside = path.relative_to(folder) if path.is_relative_to(folder) else path
        return _label(inside, part, inside.parent.as_posix() + "/")

    sources = [Source(name_of(path, rule[2]), path, *rule) for path, (_, rules) in found.items() for rule in rules]
    name, count = Counter(source.name for source in sources).most_common(1)[0]
    if count > 1:
        raise InputError(f"logs: {count} files would all be called {name!r}; rename them")
    return sources


def _label(path: Path, part: str = "", before: str = "") -> str:
    """What a log is called: the file's stem or the folder's name, with the name of its part."""
    return before + (path.name if path.is_dir() else path.stem) + (f"/{part}" if part else "")


def _matches(entry: LogEntry, folder: Path) -> list[Path]:
    pattern = Path(entry.path)
    base = Path(pattern.anchor) if pattern.is_absolute() else folder
    relative = str(pattern.relative_to(pattern.anchor)) if pattern.is_absolute() else entry.path
    try:
        # "." is no glob, but the folder itself may be a log.
        candidates = base.glob(relative) if Path(relative).parts else [base]
        matches = sorted(p for p in candidates if is_log(p))
    except (ValueError, NotImplementedError) as e:
        raise InputError(f"logs: {entry.path!r} is no path or glob: {e}") from None
    if not matches:
        nearest = base / relative
        while not nearest.is_dir():
            nearest = nearest.parent
        there = sorted(
            p.name for p in nearest.iterdir() if p.suffix.lower() in suffixes() or (p.is_dir() and is_log(p))
        )
        raise InputError(
            f"logs: no file matches {entry.path!r} in {base}; {nearest} holds: {', '.join(there[:6]) or 'no log'}"
        )
    return matches


def _named(pattern: str | None, label: str, what: str) -> str:
    """What a pattern's round brackets hold of a log's label."""
    if pattern is None:
        return ""
    match = re.search(pattern, label)
    if match is None or not match[1]:
        raise InputError(f"logs: {what} pattern {pattern!r} does not match the file name {label!r}; widen the pattern")
    return match[1]


def _read_splits(path: Path, stems: list[str]) -> dict[str, str]:
    try:
        splits = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"logs: splits file {path} does not exist") from None
    except ValueError as e:
        raise InputError(f"logs: splits file {path} is not JSON: {e}") from None
    if not isinstance(splits, dict) or not all(isinstance(v, str) and v for v in splits.values()):
        raise InputError(f'logs: splits file {path} must hold {{"log stem": "fit" | "select" | "verify" | group name}}')
    for stem in stems:
        if stem not in splits:
            raise InputError(f"logs: splits file {path} says nothing of {stem!r}; {suggest(stem, list(splits))}")
    for stem in splits:
        if stem not in stems:
            raise InputError(f"logs: splits file {path} names {stem!r}, which is no log; {suggest(stem, stems)}")
    return splits


def divide(rule: SplitRule, sources: Sequence[Source], logs: Sequence[Log]) -> Division:
    """Divide logs by the mapping's rule; `logs` are the sources' contents in the same order.

    Raises:
      InputError: too few logs or groups for the rule, or a split that stays empty; with what to change.
    """
    fixed: dict[str, Split] = {s.name: split for s in sources for split in SPLITS if s.split == split}
    free = [log for log in logs if log.name not in fixed]
    if rule.by == "rotate":
        return Division(tuple(logs), _rotate(rule, fixed, free), True)
    independent = True
    if rule.by == "time" and free:
        parts = {log.name: _by_time(log, rule) for log in free}
        fixed |= {part.name: split for cut in parts.values() for split, part in cut.items()}
        logs = [part for log in logs for part in (parts[log.name].values() if log.name in parts else [log])]
        independent = False
    elif free:
        fixed |= _by_unit(rule, free)
    _require_both(fixed)
    if "select" not in fixed.values():
        independent = False
        cut = {
            log.name: _cut(log, (("fit", 1 - SELECT_BY_TIME), ("select", SELECT_BY_TIME)))
            for log in logs
            if fixed[log.name] == "fit"
        }
        fixed |= {part.name: split for parts in cut.values() for split, part in parts.items()}
        logs = [part for log in logs for part in (cut[log.name].values() if log.name in cut else [log])]
    return Division(tuple(logs), (Fold("", {log.name: fixed[log.name] for log in logs}),), independent)


def _require_both(splits: dict[str, Split]) -> None:
    if "verify" not in splits.values():
        raise InputError(
            "split: no log verifies; give some log `split: verify`, set split.verify above 0, or say `by: time`"
        )
    if "fit" not in splits.values():
        raise InputError("split: no log fits; give some log `split: fit`, or leave logs `split: auto`")


def _by_unit(rule: SplitRule, free: Sequence[Log]) -> dict[str, Split]:
    """Logs, or whole groups of them, shuffled by the seed and dealt out by the rule's fractions."""
    if rule.by == "group" and any(not log.group for log in free):
        raise InputError("split: `by: group` needs a `group` pattern in every entry of `logs` (or use `by: log`)")
    units = sorted({log.group if rule.by == "group" else log.name for log in free})
    wanted = 1 + (rule.select > 0) + (rule.verify > 0)
    if len(units) < wanted:
        raise InputError(
            f"split: {len(units)} {rule.by}{'s' * (len(units) != 1)} cannot be split {wanted} ways; record more, or "
            "use `split: {by: time}`, which cuts every log in consecutive parts (reported as not independent)"
        )
    order = np.random.default_rng(rule.seed).permutation(len(units))
    select = max(round(rule.select * len(units)), 1) if rule.select > 0 else 0
    verify = max(round(rule.verify * len(units)), 1) if rule.verify > 0 else 0
    while select + verify >= len(units):  # rounding up must leave something to fit
        select, verify = (select, verify - 1) if verify > select else (select - 1, verify)
    unit_of = {log.name: log.group if rule.by == "group" else log.name for log in free}
    days = {u: frozenset(log.condition for log in free if unit_of[log.name] == u) for u in units}
    split_of = _dealt([units[i] for i in order], days, {"select": select, "verify": verify})
    return {name: split_of[unit] for name, unit in unit_of.items()}


def _dealt(units: Sequence[str], days: Dict[str, frozenset[str]], counts: Dict[Split, int]) -> dict[str, Split]:
    """What each unit is for: so many of each split in the order given, the rest fits.

    Where conditions differ each split gets its share of every one of them, and one unit at least of each fits where
    that can be: what belongs to a day that is not fitted to nobody would know.

    Args:
      units: in a random order.
      days: the conditions of each unit's logs.
      counts: units that a split other than fit takes.
    """
    left: dict[frozenset[str], list[str]] = {}
    for unit in units:
        left.setdefault(days[unit], []).append(unit)
    shares = {day: len(own) / len(units) for day, own in left.items()}
    given: Counter[tuple[Split, frozenset[str]]] = Counter()
    out: dict[str, Split] = {}
    turns: list[tuple[Split, float]] = [(s, (k + 0.5) / count) for s, count in counts.items() for k in range(count)]
    if len(left) > 1:  # one after the other in turn, that none takes all that a condition can spare
        turns.sort(key=lambda turn: turn[1])
    for split, _ in turns:
        spare = {day for day, own in left.items() if len(own) > 1} or {day for day, own in left.items() if own}
        wants = {day: shares[day] * counts[split] - given[split, day] for day in left if day in spare}
        day = max(wants, key=lambda d: (round(wants[d], 9), len(left[d])))
        given[split, day] += 1
        out[left[day].pop(0)] = split
    fitted: dict[str, Split] = {unit: "fit" for own in left.values() for unit in own}
    return out | fitted


def _by_time(log: Log, rule: SplitRule) -> dict[Split, Log]:
    fractions: list[tuple[Split, float]] = [("fit", rule.fit), ("select", rule.select), ("verify", rule.verify)]
    return _cut(log, fractions)


def _cut(log: Log, fractions: Sequence[tuple[Split, float]]) -> dict[Split, Log]:
    """Consecutive parts of a log, by rows; empty fractions are left out."""
    edges = np.floor(np.cumsum([0.0] + [f for _, f in fractions]) * len(log) + 1e-6).astype(int)
    parts: dict[Split, Log] = {}
    for (split, fraction), start, stop in zip(fractions, edges[:-1], edges[1:], strict=True):
        if fraction <= 0:
            continue
        if stop - start < 2:
            raise InputError(
                f"split: log {log.name!r} has {len(log)} rows, too few to cut by time; record a longer one"
            )
        parts[split] = log.part(int(start), int(stop), f"{log.name}@{split}")
    return parts


def _rotate(rule: SplitRule, fixed: dict[str, Split], free: Sequence[Log]) -> tuple[Fold, ...]:
    """Every group verifies in turn; a fifth of the remaining logs selects, chosen by the seed."""
    group_of = {log.name: log.group or log.name for log in free}
    day_of = {log.name: frozenset([log.condition]) for log in free}
    groups = sorted(set(group_of.values()))
    fits, selects = (list(fixed.values()).count(s) for s in ("fit", "select"))
    folds = []
    for i, group in enumerate(groups):
        rest = [name for name, own in group_of.items() if own != group]
        count = max(round(SELECT_OF_REST * len(rest)), 1) if not selects else 0
        if len(groups) < 2 or len(rest) + fits <= count:
            raise InputError(
                f"split: {len(free)} logs in {len(groups)} groups are too few to rotate: besides the group that "
                "verifies one log must fit and one select; record more, or say `by: time` (reported as not independent)"
            )
        shuffled = [rest[k] for k in np.random.default_rng([rule.seed, i]).permutation(len(rest))]
        dealt = _dealt(shuffled, day_of, {"select": count})
        own: dict[str, Split] = {name: dealt.get(name, "verify") for name in group_of}
        folds.append(Fold(group, fixed | own))
    if not folds:
        raise InputError("split: `by: rotate` needs logs with `split: auto`")
    return tuple(folds)
