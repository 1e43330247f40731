"""Tables II and III out of finished cells: figures with intervals, the paper's beside them."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from posteriors.report import lines

from nfc_gym.measured.hidden import Array

from . import figures, paper
from .figures import Interval, bootstrap, normalised, running_min_max
from .judge import Episodes
from .methods import METHODS

LEAST = (
    0.05  # of normalised return that an oracle must be above the unadapted policy, for shares of it to mean anything
)
RATE = "control rate, Hz: ours / the paper's"
Key = tuple[str, str, str, int, int]  # table, place, scenario, seed of what is hidden, seed of learning
World = tuple[str, str, int]  # place, scenario, seed of what is hidden


@dataclass
class Cells:
    """Finished cells by what they are of, then by method.

    Attributes:
      found: (table, place, scenario, hidden seed, learning seed) -> method -> what `methods.run` gave.
    """

    found: dict[Key, dict[str, dict[str, Any]]] = field(default_factory=dict)

    def add(self, key: Key, method: str, cell: dict[str, Any]) -> None:
        """One more."""
        self.found.setdefault(key, {})[method] = cell

    def places(self, table: str) -> list[str]:
        """Of a table, in the order in which they came."""
        return list(dict.fromkeys(k[1] for k in self.found if k[0] == table))

    def of(self, table: str, place: str, method: str) -> dict[Key, Episodes]:
        """Episodes of a method at a place."""
        return {k: Episodes.of_json(v[method]["episodes"]) for k, v in self.found.items()
                if k[:2] == (table, place) and "episodes" in v.get(method, {})}  # fmt: skip

    def missing(self, table: str, place: str, method: str) -> str | None:
        """Why there are none."""
        said = [v[method]["missing"] for k, v in self.found.items() if k[:2] == (table, place)
                and "missing" in v.get(method, {})]  # fmt: skip
        return said[0] if said else None

    def hertz(self, table: str, place: str, method: str) -> float:
        """Its mean control rate there; NaN where none was measured."""
        rates = [v[method]["hertz"] for k, v in self.found.items() if k[:2] == (table, place)
                 and "hertz" in v.get(method, {})]  # fmt: skip
        return float(np.mean(rates)) if rates else float("nan")


def references(cells: Cells, place: str) -> dict[World, tuple[float, float]]:
    """Mean return of the random policy and of the oracle, by (place, scenario, hidden seed), over all their seeds."""
    out = {}
    worlds = dict.fromkeys(k[1:4] for k in cells.found if k[:2] == ("II", place))
    for world in worlds:
        means = []
        for method in ("random", "oracle"):
            all_of = [e.returns for k, e in cells.of("II", place, method).items() if k[1:4] == world]
            means.append(float(np.mean(np.concatenate(all_of))) if all_of else float("nan"))
        out[world] = (means[0], means[1])
    return out


def groups(cells: Cells, place: str, method: str) -> dict[Key, Array]:
    """Normalised returns (episodes,) by cell."""
    known = references(cells, place)
    return {k: normalised(np.array(e.returns), *known[k[1:4]]) for k, e in cells.of("II", place, method).items()}


def min_max(cells: Cells, place: str, method: str) -> float:
    """The paper's normalisation: mean over cells, each between the smallest and largest mean return in its world.

    Every point of every method's curve there counts as a return so far, and the method's own last comes last.
    """
    values = []
    for key, episodes in cells.of("II", place, method).items():
        past = [r for k, v in cells.found.items() if k[:4] == key[:4] for cell in v.values()
                for r in _returns(cell)]  # fmt: skip
        values.append(running_min_max([*past, float(np.mean(episodes.returns))])[-1])
    return float(np.mean(values)) if values else float("nan")


def _returns(cell: dict[str, Any]) -> list[float]:
    own = [float(np.mean(cell["episodes"]["returns"]))] if "episodes" in cell else []
    return [r for _, r in cell.get("curve", [])] + own


def paired(cells: Cells, place: str, one: str, other: str, rng: np.random.Generator) -> Interval:
    """Mean difference of normalised return between two methods, episode by episode, as their seeds are the same."""
    first, second = groups(cells, place, one), groups(cells, place, other)
    return bootstrap([first[k] - second[k] for k in first if k in second], rng)


def _gained(cells: Cells, place: str, rng: np.random.Generator) -> Interval:
    """Mean return that NFC adds to the unadapted policy's, episode by episode; it wants no oracle."""
    after, before = (cells.of("II", place, m) for m in ("nfc", "unadapted"))
    return bootstrap([np.subtract(after[k].returns, before[k].returns) for k in after if k in before], rng)


def recovered(cells: Cells, place: str, method: str) -> dict[World, float]:
    """Share of (oracle - unadapted) that a method brought back, in each world by itself: what was lost differs.

    A world is left out where one of them is missing, or where the oracle is hardly better than the unadapted policy:
    it was trained for too short a time then, or nothing was lost.
    """
    after, before = (_by_world(groups(cells, place, m)) for m in (method, "unadapted"))
    shares = {w: figures.recovered(after[w], before[w], 1.0) for w in after if before.get(w, 1.0) < 1 - LEAST}
    return {w: share for w, share in shares.items() if share == share}


def _by_world(own: dict[Key, Array]) -> dict[World, float]:
    """Mean over a world's seeds of learning."""
    found: dict[World, list[float]] = {}
    for key, values in own.items():
        found.setdefault(key[1:4], []).append(float(values.mean()))
    return {world: float(np.mean(means)) for world, means in found.items()}


def shown(interval: Interval, digits: int = 2) -> str:
    """As text; a dash where there is nothing."""
    if interval.value != interval.value:
        return "-"
    return f"{interval.value:.{digits}f} [{interval.low:.{digits}f}, {interval.high:.{digits}f}]"


def shown_rate(hertz: float, method: str) -> str:
    """A control rate beside the paper's, as text."""
    theirs = paper.RATES.get(method)
    return f"{'-' if hertz != hertz else f'{hertz:.0f}'} / {'-' if theirs is None else f'{theirs:.0f}'}"


def table_two(cells: Cells, methods: Iterable[str], rng: np.random.Generator) -> tuple[str, list[dict[str, Any]]]:
    """Text and figures of Table II."""
    text, found = [], []
    for place in cells.places("II"):
        rows = []
        for name in methods:
            why, own = cells.missing("II", place, name), groups(cells, place, name)
            if why is None and not cells.of("II", place, name):
                continue  # nobody ran it there
            value = bootstrap(list(own.values()), rng)
            returns = bootstrap([np.array(e.returns) for e in cells.of("II", place, name).values()], rng)
            theirs, ours = paper.return_of(name, place), min_max(cells, place, name)
            rows.append([METHODS[name].title, why or shown(value), shown(returns, 0), "-" if ours != ours else
                         f"{ours:.2f}", "-" if theirs is None else f"{theirs:.2f}",
                         shown_rate(cells.hertz("II", place, name), name), _counted(own)])  # fmt: skip
            if why is None:
                title = f"{place}: {METHODS[name].title}"
                found.append(_figure(f"{title}, normalised return", value, "1", None, own))
                if ours == ours:
                    goal = theirs if name == "nfc" and value.value == value.value else None  # not without an oracle
                    found.append(_figure(f"{title}, min-max", _plain(ours), "1", theirs, own, goal))
        head = ["", "normalised return, 95 %", "return, 95 %", "min-max", "the paper's", RATE,
                "cells (worlds, episodes)"]  # fmt: skip
        text.append(f"### {place}\n\n{lines(head, rows)}\n{_contributions(cells, place, rng)}")
    if not text:
        return "", []
    said, summed = _summary(cells, found)
    head = "## Table II: return in the hidden world (random 0, oracle 1)"
    return f"{head}\n\n" + "\n".join([*text, said]), found + summed


def _summary(cells: Cells, found: list[dict[str, Any]]) -> tuple[str, list[dict[str, Any]]]:
    """What PPO w/ NFC comes to over all worlds and places, beside what it is to come to."""
    shares = [s for place in cells.places("II") for s in recovered(cells, place, "nfc").values()]
    judged = [row["holds"] for row in found if row["unit"] == "1" and row["goal"] is not None]
    said, rows = [], []
    if shares:
        middle = Interval(float(np.median(shares)), min(shares), max(shares))
        rows.append(_figure("share of (oracle - unadapted) recovered, median over worlds (lowest, highest)", middle,
                            "1", None, {}, paper.RECOVERED))  # fmt: skip
        said.append(f"- share of (oracle - unadapted) recovered, median of {len(shares)} worlds (lowest, highest): "
                    f"{shown(middle)}; goal {paper.RECOVERED:g}")  # fmt: skip
    if judged:
        rows.append(_figure("places where min-max is at least the paper's", _plain(sum(judged)), "places", None, {},
                            paper.MIN_MAX))  # fmt: skip
        said.append(f"- min-max at least the paper's: {sum(judged)} of {len(judged)} places; goal {paper.MIN_MAX}")
    return ("### PPO w/ NFC, all places\n\n" + "\n".join(said) + "\n" if said else ""), rows


def _counted(own: dict[Key, Array]) -> str:
    """How many cells, of how many worlds and episodes: rows of a place need not be of the same worlds."""
    return f"{len(own)} ({len({k[1:4] for k in own})}, {sum(len(e) for e in own.values())})" if own else "0"


def _contributions(cells: Cells, place: str, rng: np.random.Generator) -> str:
    out = []
    for other in ("no_fidelity", "no_hallucination", "no_nfc", "randomised"):
        value = paired(cells, place, "nfc", other, rng)
        if value.value == value.value:
            out.append(f"- w/ NFC minus {METHODS[other].title}: {shown(value)}")
    gain = _gained(cells, place, rng)
    if gain.value == gain.value:
        out.append(f"- w/ NFC minus {METHODS['unadapted'].title}, return: {shown(gain, 1)}")
    out += _alarms(cells, "II", place)
    rose = [v["oracle"]["notes"].get("levelled") for k, v in cells.found.items()
            if k[:2] == ("II", place) and "notes" in v.get("oracle", {})]  # fmt: skip
    if rose:
        out.append(f"- the oracle's curve has levelled in {sum(map(bool, rose))} of {len(rose)} cells")
    for (_, scenario, seed), share in recovered(cells, place, "nfc").items():
        out.append(f"- share of (oracle - unadapted) recovered, {scenario} {seed}: {share:.2f}")
    return "\n".join(out) + ("\n" if out else "")


def _alarms(cells: Cells, table: str, place: str) -> list[str]:
    """How often something was anomalous, and in how many cells it never was: there the policy was not touched."""
    found = [v["nfc"]["notes"] for k, v in cells.found.items()
             if k[:2] == (table, place) and "anomalies" in v.get("nfc", {}).get("notes", {})]  # fmt: skip
    if not found:
        return []
    alarmed, executed = (sum(n) for n in zip(*((n["anomalies"], len(n["history"])) for n in found), strict=True))
    untouched = sum(n["anomalies"] == 0 for n in found)
    return [f"- w/ NFC {alarmed} of {executed} trajectories were anomalous; in {untouched} of {len(found)} cells none, "
            "and the policy was not touched"]  # fmt: skip


def table_three(cells: Cells, methods: Iterable[str], rng: np.random.Generator) -> tuple[str, list[dict[str, Any]]]:
    """Text and figures of Table III; a ground's scenarios are taken together, as the paper does."""
    rows, found = [], []
    for name in methods:
        for place in cells.places("III"):
            ground, own = place.removeprefix("Jackal"), cells.of("III", place, name)
            why = cells.missing("III", place, name)
            if why is None and not own:
                continue  # nobody ran it there
            row = [METHODS[name].title, ground, _by_scenario(own)]
            for key, words in paper.FIGURES.items():
                value = bootstrap([np.array(getattr(e, key), float) for e in own.values()], rng)
                theirs = paper.drive_of(name, ground, key)
                row.append(why or f"{shown(value)} / {'-' if theirs is None else f'{theirs:g}'}")
                if own:
                    goal = paper.GOALS.get((key, ground)) if name == "nfc" else None
                    found.append(_figure(f"{place}: {METHODS[name].title}, {words}", value, words, theirs, own, goal,
                                           at_least=key == "success"))  # fmt: skip
            hertz = cells.hertz("III", place, name)
            row.append(shown_rate(hertz, name))
            if own and hertz == hertz:
                found.append(_figure(f"{place}: {METHODS[name].title}, control rate", _plain(hertz), "Hz",
                                       paper.RATES.get(name), own))  # fmt: skip
            rows.append(row)
    if not rows:
        return "", []
    said = [f"{line} ({place})" for place in cells.places("III") for line in _alarms(cells, "III", place)]
    head = ["", "ground", "success by scenario (episodes)", *(f"{words}: ours / the paper's" for words in
            paper.FIGURES.values()), RATE]  # fmt: skip
    return f"## Table III: the Jackal's broken axle, figure of eight\n\n{lines(head, rows)}\n" + "\n".join(
        [*said, ""]
    ), found


def _by_scenario(own: dict[Key, Episodes]) -> str:
    """Success and episodes in each scenario, over its seeds: rows of a ground need not be of the same scenarios."""
    found: dict[str, list[float]] = {}
    for key, episodes in own.items():
        found.setdefault(key[2], []).extend(episodes.success)
    return ", ".join(f"{scenario} {np.mean(each):.2f} ({len(each)})" for scenario, each in found.items()) or "-"


def _plain(value: float) -> Interval:
    """A figure without an interval."""
    return Interval(float(value), float("nan"), float("nan"))


def _figure(
    name: str, value: Interval, unit: str, baseline: float | None, own: dict[Key, Any], goal: float | None = None,
    at_least: bool = True,
) -> dict[str, Any]:  # fmt: skip
    seeds = sorted({k[4] for k in own})
    plain = [None if v != v else v for v in value]
    holds = None if goal is None else bool(value.value >= goal if at_least else value.value <= goal)
    said = None if goal is None else f"{'>=' if at_least else '<='} {goal:g}"
    return {"name": name, "value": plain[0], "unit": unit, "baseline": baseline, "goal": said, "holds": holds,
            "seeds": seeds, "low": plain[1], "high": plain[2]}  # fmt: skip
