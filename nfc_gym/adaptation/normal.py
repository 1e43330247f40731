"""What a mission says of normal motion, and a detector of anomalies that is tuned to it.

Windows do not overlap and are shared out by trajectory: those that a threshold is set from, those that false alarms are
counted on, and, of a detector that can learn, those that it learns from. Where the first two are too few for the
false-positive rate that is wanted, the detector stays as it was.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.inference.contrast import Contrast
from nfc_gym.inference.data import TensorWindows, WindowSet
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.injections import KINDS, injected
from nfc_gym.inference.progress import Report
from nfc_gym.inference.random import mixed, seeded
from nfc_gym.inference.rates import auroc, rate_above, threshold_at, wanted
from nfc_gym.inference.train import TrainConfig, train

Array = NDArray[np.float64]
Normal = Callable[[Trajectory], NDArray[np.bool_]]  # -> (T,): control steps that are taken to be normal
LEAST = 64  # windows that a detector learns from, or it does not
_LIMIT, _JUDGE = 0.3, 0.2  # shares of the windows that the threshold is set from, and that alarms are counted on
_HELD_OUT = 0.2  # of those: by which epochs are compared
_WORSE = 2.0  # standard errors by which a detector may find less of what is injected


def quiet_trajectories(trajectory: Trajectory) -> NDArray[np.bool_]:
    """Trajectories without any alarm: a fault that goes on is part of no normal motion, between two alarms either."""
    return np.full(len(trajectory), not trajectory.anomalous)


def quiet_windows(trajectory: Trajectory) -> NDArray[np.bool_]:
    """All but the transitions that alarmed: for anomalies that come and go."""
    return trajectory.scores < trajectory.threshold


def stretches(trajectory: Trajectory, horizon: int, normal: NDArray[np.bool_], every: int | None = None) -> list[int]:
    """First steps of windows that are normal throughout, `every` steps apart; by default they do not overlap.

    Raises:
      InputError: `normal` is not a flag for each control step.
    """
    flags = np.asarray(normal)
    if flags.shape != (len(trajectory),) or flags.dtype != bool:
        raise InputError(f"normal: want {len(trajectory)} flags, one a control step, got {flags.dtype} {flags.shape}")
    return [k for k in range(0, len(trajectory) - horizon + 1, every or horizon) if flags[k : k + horizon].all()]


def windows_of(trajectories: Sequence[Trajectory], horizon: int, normal: Normal) -> list[tuple[Array, Array]]:
    """Of each trajectory its normal windows: states (n, H+1, s) and actions (n, H, a)."""
    out = []
    for t in trajectories:
        at = stretches(t, horizon, normal(t))
        states = np.array([t.states[k : k + horizon + 1] for k in at]).reshape(len(at), horizon + 1, t.states.shape[1])
        actions = np.array([t.actions[k : k + horizon] for k in at]).reshape(len(at), horizon, t.actions.shape[1])
        out.append((states, actions))
    return out


def tuned(
    detector: WindowDetector, trajectories: Sequence[Trajectory], normal: Normal, rate: float, *, training: TrainConfig,
    beside: WindowSet | None, folder: Path | None, report: Report, seed: int, device: torch.device,
) -> tuple[WindowDetector, dict[str, Any]]:  # fmt: skip
    """A detector with its threshold set from a mission, and trained further on it where it can be.

    Args:
      detector: as it was; it stays so.
      trajectories: of the mission.
      normal: which of their control steps are normal.
      rate: wanted false-positive rate, of windows.
      training: of a `Contrast`.
      beside: windows that it was trained on before; as many of them as of the mission's are learned from.
      folder: where training's state is kept.
      report: is told.
      seed: of the shares.
      device: of training.

    Returns:
      The detector, and what was done: see `afterwards.Learned`.
    """
    scorer = detector.scorer
    each = windows_of(trajectories, scorer.horizon, normal)
    learn, judge, limit = _shares([len(s) for s, _ in each], wanted(rate), seed)
    parts = {name: _joined([each[k] for k in of]) for name, of in (("fit", learn), ("judge", judge), ("limit", limit))}
    counts = {name: 0 if p is None else len(p[0]) for name, p in parts.items()}
    of = sum(len(t) // scorer.horizon for t in trajectories)
    found: dict[str, Any] = {
        "changed": False,
        "rate": rate,
        "windows": counts | {"not_normal": of - sum(counts.values())},
    }
    if min(counts["judge"], counts["limit"]) < wanted(rate):
        found["why"] = (
            f"{sum(counts.values())} normal windows: a false-positive rate of {rate:g} takes {wanted(rate)} to set a "
            f"threshold from and {wanted(rate)} of other trajectories to count false alarms on; it is as before"
        )
        return detector, found
    assert parts["judge"] is not None  # counted above
    assert parts["limit"] is not None
    before = float(trajectories[0].threshold if detector.threshold is None else detector.threshold)
    alarms = {"before": rate_above(scorer.score(*parts["judge"]), before)}
    if isinstance(scorer, Contrast) and parts["fit"] is not None and counts["fit"] >= LEAST:
        scorer = _trained(scorer, parts["fit"], parts["judge"], found, training, beside, folder, report, seed, device)
    threshold = threshold_at(scorer.score(*parts["limit"]), rate)
    alarms["after"] = rate_above(scorer.score(*parts["judge"]), threshold.value)
    found |= {"changed": True, "threshold": asdict(threshold), "threshold_before": before, "false_alarms": alarms}
    return WindowDetector(scorer, threshold, detector.every), found


def _shares(counts: Sequence[int], least: int, seed: int) -> tuple[list[int], list[int], list[int]]:
    """Trajectories to learn from, to count false alarms on and to set a threshold from; the last two come first."""
    order = [int(k) for k in np.random.default_rng(mixed(seed, 0)).permutation(len(counts)) if counts[k]]
    parts: list[list[int]] = []
    for share in (_LIMIT, _JUDGE):
        part: list[int] = []
        while order and sum(counts[k] for k in part) < max(least, share * sum(counts)):
            part.append(order.pop())
        parts.append(part)
    return order, parts[1], parts[0]


def _joined(parts: Sequence[tuple[Array, Array]]) -> tuple[Array, Array] | None:
    return None if not parts else (np.concatenate([s for s, _ in parts]), np.concatenate([a for _, a in parts]))


def _trained(
    old: Contrast, fit: tuple[Array, Array], judge: tuple[Array, Array], found: dict[str, Any], training: TrainConfig,
    beside: WindowSet | None, folder: Path | None, report: Report, seed: int, device: torch.device,
) -> Contrast:  # fmt: skip
    """The network trained further, unless it then finds less of what is injected into windows that it did not see."""
    new = copy.deepcopy(old)
    first, last = with_beside(_tensors(old, fit), beside, seed).split(_HELD_OUT)
    outcome = train(new, first, last, training, folder=folder, report=report, scales=False, device=device)
    finds = {"before": _finds(old, judge, seed), "after": _finds(new, judge, seed)}
    kept = outcome.best > 0 and finds["after"][0] >= finds["before"][0] - _WORSE * finds["before"][1]
    found |= {"finds_injected": finds, "weights": "trained further" if kept else "as before", "best": outcome.best}
    return new if kept else old


def _tensors(net: Contrast, windows: tuple[Array, Array]) -> TensorWindows:
    states, actions = (torch.as_tensor(x, dtype=torch.float32) for x in windows)
    psi = torch.full((len(states), len(net.prior)), 0.5)  # which plays no part in a detector
    return TensorWindows({"states": states, "actions": actions, "psi": psi})


def with_beside(windows: TensorWindows, beside: WindowSet | None, seed: int) -> TensorWindows:
    """As many other windows among them, shuffled.

    Raises:
      InputError: the others lack what these have.
    """
    if beside is not None:
        others = next(iter(beside.batches(min(len(windows), len(beside)), mixed(seed, 1))))
        lacking = [name for name in windows.tensors if name not in others]
        if lacking:
            raise InputError(f"beside: the windows have no {lacking[0]!r}; they have: {', '.join(others)}")
        for name, t in windows.tensors.items():
            if others[name].shape[1:] != t.shape[1:]:
                theirs, ours = tuple(others[name].shape[1:]), tuple(t.shape[1:])
                raise InputError(f"beside: {name!r} of a window has shape {theirs}, where the mission's have {ours}")
        windows = windows.append(TensorWindows({name: others[name] for name in windows.tensors}))
    order = torch.randperm(len(windows), generator=torch.Generator().manual_seed(mixed(seed, 2)))
    return TensorWindows({name: t[order] for name, t in windows.tensors.items()})


def _finds(net: Contrast, windows: tuple[Array, Array], seed: int) -> tuple[float, float]:
    """AUROC, and its standard error, of windows with an injected disturbance against the same without."""
    states, actions = windows
    with seeded(mixed(seed, 3)), torch.no_grad():
        target = torch.as_tensor(states[:, -net.span :], dtype=torch.float32)
        struck = injected(target, net.spread.cpu(), torch.randint(len(KINDS), (len(target),))).numpy()
    disturbed = np.concatenate([states[:, : -net.span], struck], 1)
    return auroc(net.score(states, actions), net.score(disturbed, actions))
