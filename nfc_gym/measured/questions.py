"""What a new motion is asked to tell: the claims of a report against their rivals, or every effect against psi."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench, candidates
from nfc_gym.measured.contest import dispersion
from nfc_gym.measured.distances import Ask, Model
from nfc_gym.measured.export import unpack
from nfc_gym.measured.fisher import Lens, flat, realistic, without
from nfc_gym.measured.fit import Fit, fitted
from nfc_gym.measured.metric import loss, metric
from nfc_gym.measured.screen import sized
from nfc_gym.measured.search import Options
from nfc_gym.measured.settle import settle, slack
from nfc_gym.measured.stakes import Stakes
from nfc_gym.measured.story import rivals_of
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.each import split
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
TOLD = 3.92  # sigma between two explanations from which the contest tells them apart (`identify`)
_FEWEST, _LOOK, _WORK = 12, 60, 2400  # segments of the logs that are looked at: between these, and times candidates
_MOST = 24  # effects that a motion is designed for at once; of more, the hardest to see of each family
_SIZES = (0.3, 1.0, 3.0)  # times a realistic size, from the best of which a rival's fit starts
_ROUNDS = 12  # iterations of that fit
_RIVALS = 4  # of one claim, at most


@dataclass(frozen=True)
class Present:
    """The logs at hand, seen from the fitted model.

    Attributes:
      lens: on some of their segments; `repeats`: how many times these they are.
      stakes: what the search charges an effect on all of them.
    """

    lens: Lens
    repeats: float
    stakes: Stakes


def blocks_for(candidates: int) -> int:
    """How many segments of the logs are looked at when so many effects are rolled out on them."""
    return int(np.clip(_WORK // max(candidates, 1), _FEWEST, _LOOK))


def look(bench: Bench, logs: Sequence[Log], plant: Plant, x: Array, most: int = _LOOK) -> Present:
    """See at most so many segments of the logs from a fitted model, as roll-outs whatever the mapping's mode."""
    states = [bench.states[log.name] for log in logs]
    whole = bench.rollouts(logs, states)
    problem = bench.rollouts(logs, states, most=most)
    sigma = problem.covariance(plant, x)
    lens = Lens(problem, metric(problem, sigma, slack(problem, sigma, plant, x)), plant, x)
    repeats = len(whole) / len(problem)
    stakes = Stakes(int(whole.mask.sum()), dispersion(_as_fit(lens)), Options().worth, repeats)
    return Present(lens, repeats, stakes)


def _as_fit(lens: Lens) -> Fit:
    return Fit(lens.plant, lens.x, lens.base, lens.tangent)


def calibrated(bench: Bench, logs: Sequence[Log], seed: int) -> tuple[Plant, Array]:
    """Psi fitted to some of the logs' segments, without any effect."""
    problem = bench.rollouts(logs, [bench.states[log.name] for log in logs], most=_LOOK)
    plant = bench.plant
    found, _, _ = settle(problem, problem.covariance(plant, plant.null), plant, plant.null, seed, rounds=8)
    return plant, found.x


def reported(bench: Bench, logs: Sequence[Log], folder: Path) -> tuple[dict[str, Any], Plant, Array]:
    """Report and extended model that `close-loop` left in a folder.

    Raises:
      InputError: there is none, it is a summary of folds, or it is of another model.
    """
    for name in ("report.json", "fit.json"):
        if not (folder / name).is_file():
            inside = sorted(p.parent.relative_to(folder).as_posix() for p in folder.rglob("*/fit.json"))
            hint = f"it holds folds: give one of {', '.join(inside)}" if inside else "run close-loop with it as --out"
            raise InputError(f"{folder / name} does not exist; {hint}")
    try:
        report = json.loads((folder / "report.json").read_text())
        packed = json.loads((folder / "fit.json").read_text())["extended"]
        given, ours = report["model"], bench.dataset.mapping.model_file
    except (ValueError, KeyError, TypeError) as e:
        raise InputError(f"{folder}: not what close-loop writes ({type(e).__name__}: {e})") from None
    if given != ours:
        raise InputError(f"{folder} is of the model {given}, the mapping of {ours}: give the folder of this mapping")
    plant, x = unpack(packed, bench.plant)
    # Saved effects know their values alone; those of the library come with bounds and sizes that fit the machine.
    pool = [e for e in candidates(bench, logs) if not e.generic]
    return report, plant.with_effects([find(bench, pool, e.id) or e for e in plant.effects]), x


def find(bench: Bench, pool: Sequence[Effect], label: str) -> Effect | None:
    """An effect of a pool by its id, `:each` included; None for pairs and for what is not there."""
    known = {e.id: e for e in pool}
    if label in known:
        return known[label]
    tied = known.get(label.removesuffix(":each"))
    parts = split(tied, bench.plant) if tied is not None and label.endswith(":each") else None
    return parts[0] if parts else None


def rivalries(
    bench: Bench, logs: Sequence[Log], report: dict[str, Any], present: Present
) -> tuple[list[Ask], list[tuple[str, str]], list[str]]:
    """Each claim against what explains the logs as well, or else against its worst mimic.

    Returns:
      The questions; the ids of claim and rival of each; labels that were passed over.
    """
    rows = {r["id"]: r for r in report.get("identifiability") or []}
    asks, pairs, skipped = [], [], []
    pool = candidates(bench, logs)
    for effect in present.lens.plant.effects:
        claim = next((e for e in report.get("effects") or [] if e["id"] == effect.id), {})
        mimic = rows.get(effect.id, {}).get("worst_mimic")
        for label in (rivals_of(claim, report["effects"]) or ([mimic] if mimic else []))[:_RIVALS]:
            rival = find(bench, pool, label)
            if rival is None:
                skipped.append(label)
                continue
            asks.append(challenge(present, effect, rival))
            pairs.append((effect.id, rival.id))
    return asks, pairs, skipped


def challenge(present: Present, effect: Effect, rival: Effect) -> Ask:
    """If an accepted effect is at work, would the rival, fitted in its place, pass for it?

    Not the other way round: a rival that the logs leave next to nothing of is passed for by everything.
    """
    lens = present.lens
    psi, thetas = lens.plant.split(lens.x)
    others = [(e, t) for e, t in zip(lens.plant.effects, thetas, strict=True) if e is not effect]
    plant = lens.plant.with_effects([*(e for e, _ in others), rival])
    sizes = np.concatenate([whole for whole, _ in realistic(rival)])
    tried = [np.clip(sized(rival, t, s), rival.low, rival.high) for t in sizes for s in _SIZES]
    starts = np.array([np.concatenate([psi, *(t for _, t in others), theta]) for theta in tried])
    white = lens.under.whiten(lens.problem.residual(plant, starts))
    x = fitted(lens.problem, lens.under, plant, starts[int(loss(white).sum(-1).argmin())], _ROUNDS)
    return Ask(Model(lens.plant, lens.x), Model(plant, x), TOLD)


@dataclass(frozen=True)
class Visible:
    """An effect at a realistic size (k,), and the question whether it would show."""

    effect: Effect
    theta: Array
    ask: Ask


def visibilities(pool: Sequence[Effect], present: Present) -> list[Visible]:
    """Every effect of a pool against psi and what is accepted; of many, the hardest to see of each family."""
    lens = present.lens
    basis, here, found = lens.fitted(), Model(lens.plant, lens.x), []
    for effect in pool:
        thetas = np.concatenate([whole for whole, _ in realistic(effect)])
        lengths = np.linalg.norm(without(flat(lens.columns(effect, thetas)), basis), axis=0)
        needed = present.stakes.needed(len(effect.params)) * float(np.sqrt(present.repeats))
        i = int(lengths.argmax())
        plant = lens.plant.with_effects([*lens.plant.effects, effect])
        truth = Model(plant, np.concatenate([lens.x, thetas[i]]))
        found.append((lengths[i] / needed, Visible(effect, thetas[i], Ask(truth, here, needed))))
    found.sort(key=lambda pair: pair[0])
    if len(found) > _MOST:
        found = list({v.effect.family: (f, v) for f, v in reversed(found)}.values())
    return [v for _, v in found][:_MOST]
