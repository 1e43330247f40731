"""A case for the loop: logs and mapping in a folder, effects at a wanted size, and the model that knows all."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench, candidates, make_bench
from nfc_gym.measured.dataset import load
from nfc_gym.measured.demo import write_log
from nfc_gym.measured.hidden import Array, Hidden, Kind
from nfc_gym.measured.metric import metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.standin import Machine
from nfc_gym.measured.verdict import mean_square
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.rollout import Plant

from .outside import parts
from .robots import Robot


def write_case(
    folder: Path,
    kit: Robot,
    machine: Machine,
    seconds: float,
    seeds: Sequence[int],
    only: Sequence[str] = (),
    exclude: Sequence[str] = (),
) -> Path:
    """One log a seed and the mapping file, which is returned; `only` and `exclude` are the mapping's `effects`."""
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    for i, seed in enumerate(seeds):
        write_log(folder / "logs" / f"run_{i:02d}.csv", kit.log(machine, seconds, seed))
    mapping = yaml.safe_load(kit.mapping(machine.psi[kit.weighed]))
    if only or exclude:
        mapping["effects"] = {"only": list(only), "exclude": list(exclude)}
    path = folder / "mapping.yaml"
    path.write_text(yaml.safe_dump(mapping, sort_keys=False))
    return path


def chi2(problem: Problem, plant: Plant, x: Array) -> float:
    """X: mean square of the whitened errors."""
    white = metric(problem, problem.covariance(plant, x)).whiten(problem.residual(plant, x[None]))
    return mean_square(problem, white[0])


def sized(
    kit: Robot, psi: dict[str, float], kind: Kind, place: int, wanted: float, folder: Path, tries: int = 8
) -> tuple[Hidden, float]:
    """The effect at a size that makes X / X_null about `wanted`, and the ratio reached (sizes have a range).

    X is of the model without effects at the true psi, on four short logs of always the same commands.

    Args:
      place: seed of all that is drawn of the effect but its size.
      folder: for those logs.
      tries: sizes that are tried.
    """

    def ratio_of(hidden: Hidden) -> float:
        bench = make_bench(load(write_case(folder, kit, Machine(psi, hidden), 2.1, range(4))), 1)
        return chi2(bench.problem(list(bench.dataset.logs)), bench.plant, bench.plant.space.vector(psi))

    floor = ratio_of(Hidden())
    size, found = float(np.sqrt(kind.low * kind.high)), []
    for _ in range(tries):
        hidden = kind.make(np.random.default_rng(place), size)
        ratio = ratio_of(hidden) / floor
        found.append((size, ratio, hidden))
        if abs(np.log(max(ratio, 1.0) / wanted)) < 0.1:
            break
        size = _next_size([(s, r) for s, r, _ in found], wanted, kind)
    _, ratio, hidden = min(found, key=lambda f: abs(np.log(max(f[1], 1.0) / wanted)))
    return hidden, ratio


def _next_size(tried: Sequence[tuple[float, float]], wanted: float, kind: Kind) -> float:
    """The size to try after (size, X / X_null) pairs.

    The excess grows about as the square of the size: a step goes by that, at most to a tenth or tenfold. It ends midway
    where it would leave what earlier tries have enclosed: a limit on a force does nothing at all down to some value.
    """
    size, ratio = tried[-1]
    step = float(np.clip(np.sqrt((wanted - 1) / max(ratio - 1, 1e-2)), 0.1, 10.0))
    below = max((s for s, r in tried if r < wanted), default=None)
    above = min((s for s, r in tried if r >= wanted), default=None)
    if below is not None and above is not None and below < above and not below < size * step < above:
        return float(np.sqrt(below * above))
    return float(np.clip(size * step, kind.low, kind.high))


def true_effects(bench: Bench, logs: Sequence[Log], hidden: Hidden) -> list[tuple[Effect, Array]] | None:
    """The library's own effects with the hidden ones' parameters; None where the library has no such law."""
    pool = candidates(bench, logs)
    out = []
    for part in parts(hidden):
        same = [e for e in pool if e.family == part.family and set(e.where) == set(part.where)]
        if not same or not part.parameters:
            return None
        out.append((same[0], np.array([part.parameters[p.name] for p in same[0].params])))
    return out


def oracle(bench: Bench, logs: Sequence[Log], machine: Machine) -> tuple[Plant, Array] | None:
    """The package's model with the true psi and the true effects; None where the library has no such law."""
    known = true_effects(bench, logs, machine.hidden)
    if known is None:
        return None
    plant = bench.plant.with_effects([e for e, _ in known])
    return plant, np.concatenate([bench.plant.space.vector(dict(machine.psi)), *(t for _, t in known)])
