"""`Finding`: one thing that is wrong or looks wrong, where, and what to do; the same in many logs is one finding."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]
_RANK = {"error": 0, "warning": 1, "note": 2}
_ASIDE = re.compile(r"\((?:[^()]|\([^()]*\))*\)")  # in round brackets


@dataclass(frozen=True)
class Finding:
    """One thing that the user should know before fitting.

    Attributes:
      severity: an error stops the loop; a warning makes its answer doubtful; a note is worth knowing.
      where: file and line, or key of the mapping and logs.
      message: what is wrong, with the value.
      advice: what to do about it.
    """

    severity: Severity
    where: str
    message: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.where}: {self.message}" + (f"; {self.advice}" if self.advice else "")


@dataclass(frozen=True)
class Suspicion:
    """One thing that looks wrong in one log; `kind` tells which test found it."""

    severity: Severity
    where: str
    kind: str
    message: str
    advice: str


def parted(text: str) -> tuple[str, str]:
    """An error's `message; advice` as the two, or without advice; what is in round brackets stays whole."""
    outside = _ASIDE.sub(lambda aside: "." * len(aside[0]), text)
    at = outside.find("; ")
    return (text, "") if at < 0 else (text[:at], text[at + 2 :])


def gather(found: Iterable[tuple[str, Suspicion]], whole: Mapping[str, str]) -> list[Finding]:
    """Findings from (log name, suspicion) pairs; alike ones are told once, in the first log's words.

    Args:
      found: the pairs.
      whole: the recording that each log is of, itself or the one that it was cut from: these are counted.
    """
    logs = len(set(whole.values()))
    groups: dict[tuple[Severity, str, str], list[tuple[str, Suspicion]]] = {}
    for log, suspicion in found:
        groups.setdefault((suspicion.severity, suspicion.where, suspicion.kind), []).append((log, suspicion))
    findings = []
    for (severity, where, _), members in groups.items():
        count = len({whole[log] for log, _ in members})
        first, suspicion = members[0]
        text = f"in {count} of {logs} logs, first {first}: {suspicion.message}" if count > 1 else suspicion.message
        place = where if count > 1 else f"{first}: {where}"
        findings.append(Finding(severity, place, text, suspicion.advice))
    return in_order(findings)


def in_order(findings: Iterable[Finding]) -> list[Finding]:
    """Errors first, then warnings, then notes; otherwise as they came."""
    return sorted(findings, key=lambda f: _RANK[f.severity])
