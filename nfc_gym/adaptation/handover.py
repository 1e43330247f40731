"""`nfc-gym adapt`: the policy that the machine is to get, fine-tuned in the model that close-loop extended.

Before and after, both policies run the same episodes in the nominal model, in the extended one, in that without each
effect in turn, and in a true world where one is given. What the real machine will do nobody can measure here: without
a true world every figure is of the extended model, and the report says so.
"""

import copy
import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import torch
from gymnasium.vector import VectorEnv
from rich.console import Console

from nfc_gym.adaptation.evaluate import Score, evaluate
from nfc_gym.adaptation.extended import read_found
from nfc_gym.adaptation.extension import Bound, Extension, require_read
from nfc_gym.adaptation.finetuning import FineTuneConfig, FineTuning, whole_episode
from nfc_gym.adaptation.handover_page import render
from nfc_gym.adaptation.policy import Policy, load_policy
from nfc_gym.adaptation.record import Record
from nfc_gym.adaptation.returns import figure, from_plain, gain, to_plain
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.threads import limit_threads
from nfc_gym.adaptation.weights import of_weights
from nfc_gym.adaptation.worlds import vector_env
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable, write_together, write_whole
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.jobs import device_of
from nfc_gym.inference.random import mixed
from nfc_gym.simulate.machine import full_id

EPISODES = 100  # by which a policy is judged in each world
POLICY, REPORT, PAGE, KEPT = "policy.safetensors", "report.json", "report.html", "judged.json"
NOMINAL, EXTENDED, TRUE, WITHOUT = "nominal", "extended", "world", "without "
_JUDGED = 3  # stream of random numbers
_FUNCTION = "function"  # in place of a world's digest: nothing tells two lambdas apart, so no call recalls another's
World = Callable[[int], VectorEnv]


def hand_over(
    environment: str, effects: str | Path, out: str | Path, *, policy: str | Path | None = None,
    world: str | Path | World | None = None, config: FineTuneConfig | None = None, episodes: int = EPISODES,
    ablate: bool = False, condition: str | None = None, signals: Mapping[str, float] | None = None,
    device: str = "auto", threads: int = 0, console: Console | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Fine-tune a policy in the extended model on the task that it was trained to do, and say what it was worth.

    Args:
      environment: id, of the robot that the logs were of.
      effects: what `nfc-gym close-loop` wrote: its folder, or a file of it (see `extended.read_found`).
      out: folder for `policy.safetensors`, `report.json`, `report.html`; the same call goes on where it was stopped.
      policy: to begin with: a file, or the id of one that comes with the package; default the environment's.
      world: what plays the real machine: of the same kinds as `effects`, or n -> a vector environment of n simulations
        without autoreset and of the policy's task, which each call measures anew. It is judged in, never learned from.
      config: of learning.
      episodes: by which each policy is judged in each world.
      ablate: fine-tune once more without each effect, and judge that where all effects are.
      condition: of the logs, whose values effects have that differ between conditions.
      signals: exogenous signals that effects read, as constant values: {"exo:supply": 24.0}.
      device: of the networks.
      threads: of the physics; 0 takes every core.
      console: is told.

    Returns:
      The report, as in `report.json`.

    Raises:
      InputError: a policy of another robot; effects of another robot, or none at all; values that are not finite; a
        condition or a signal that no effect asks for; a `world` of another task; a folder that holds something else, or
        another run.
    """
    require_whole("episodes", episodes, 2)  # each return is given an interval
    began, name, folder = time.monotonic(), full_id(environment), Path(out)
    config = config or FineTuneConfig()
    extension = Extension(read_found(effects), name, condition=condition, signals=signals)
    extension.require_something()
    start = load_policy(name if policy is None else policy, device_of(device))
    shape = {"threads": threads, "episode": config.episode, "settings": start.settings(name)}
    truth = _truth(world, name, condition, signals, shape)
    models = [extension] if truth is None or truth.extension is None else [extension, truth.extension]
    require_read(models, condition, signals)
    _require_fit(start, name)
    _require_own(folder)
    limit_threads(threads)
    run = _Run(start, extension, truth, config, folder, episodes, threads,
               Record(folder / "log", console))  # fmt: skip
    run.of |= _constant(condition, signals)
    adapted = run.trained(extension, folder)
    report = run.report(adapted, run.ablated() if ablate else {})
    report["seconds"] = round(time.monotonic() - began, 1)
    _write(folder, Policy(adapted.policy.sight, adapted.best, dict(start.about)), report)
    run.say(report)
    return report


def _constant(condition: str | None, signals: Mapping[str, float] | None) -> dict[str, Any]:
    """What was given of these: the same finding is another model under another condition or signal."""
    values = {name: float(value) for name, value in (signals or {}).items()}
    return {k: v for k, v in (("condition", condition), ("signals", values)) if v}


def _write(folder: Path, best: Policy, report: Mapping[str, Any]) -> None:
    """The policy, which says how it was adapted, and the report."""
    best.about |= {"adapted": {k: report[k] for k in ("from", "policy", "config", "returns")}}
    best.save(folder / POLICY)
    write_together(folder, {PAGE: render(report), REPORT: json.dumps(report, indent=1, allow_nan=False)})


@dataclass
class _Truth:
    """What plays the real machine, what it is called, what tells it from another, and what was found if it is that."""

    name: str
    envs: World
    key: str
    extension: Extension | None = None


def _truth(
    world: str | Path | World | None,
    name: str,
    condition: str | None,
    signals: Mapping[str, float] | None,
    shape: Mapping[str, Any],
) -> _Truth | None:
    if world is None:
        return None
    if callable(world):
        called = getattr(world, "__qualname__", type(world).__qualname__)
        return _Truth(called, world, _FUNCTION)
    extension = Extension(read_found(world), name, condition=condition, signals=signals)
    return _Truth(str(world), partial(extension.envs, **shape), extension.found.digest, extension)


def _require_fit(policy: Policy, environment: str) -> None:
    rough = {"terrain_pool": 1} if "Rough" in environment else {}
    envs = vector_env(environment, 1, threads=1, **rough, **policy.settings(environment))
    policy.require(envs)
    envs.close()


def _require_own(folder: Path) -> None:
    """Refuse a folder with another command's report, above all that of the run that is adapted to."""
    require_writable(folder)
    file = folder / REPORT
    if file.is_file():
        try:
            told = json.loads(file.read_text(encoding="utf-8"))
        except ValueError:
            told = None
        if not isinstance(told, dict) or "returns" not in told:
            raise InputError(f"{folder} holds the report of another command: choose another --out")
    folder.mkdir(parents=True, exist_ok=True)


def _safe(effect: str) -> str:
    """An id as the name of a folder."""
    kept = "".join(c if c.isalnum() or c in "_-+" else "_" for c in effect)[:60]
    return f"{kept}_{hashlib.sha256(effect.encode()).hexdigest()[:6]}"


class _Run:
    """Training and judging, with what both share."""

    def __init__(
        self, start: Policy, extension: Extension, truth: _Truth | None, config: FineTuneConfig, folder: Path,
        episodes: int, threads: int, record: Record,
    ) -> None:  # fmt: skip
        self.start, self.extension, self.truth, self.config = start, extension, truth, config
        self.folder, self.episodes, self.threads, self.record = folder, episodes, threads, record
        self.settings = start.settings(extension.environment)
        self.of = {
            "environment": extension.environment,
            "policy": of_weights(start.network),
            "found": extension.found.digest,
        }
        self.of |= self.settings
        self.scores: dict[str, Score] = {}

    def trained(self, extension: Extension, folder: Path) -> FineTuning:
        """A copy of the policy that has learned in the extension."""
        folder.mkdir(parents=True, exist_ok=True)
        policy = Policy(self.start.sight, copy.deepcopy(self.start.network), dict(self.start.about))
        of = {**self.of, "effects": [e.id for e in extension.effects], "psi": extension.psi.tolist()}
        left_out = [e.id for e in self.extension.effects if e.id not in of["effects"]]
        if left_out:
            self.record.say(f"once more without {left_out[0]}")
        record = self.record if folder == self.folder else Record(folder / "log", self.record.console)
        tuning = FineTuning(policy, extension, self.config, folder, of=of, threads=self.threads, record=record)
        tuning.run()
        return tuning

    def ablated(self) -> dict[str, FineTuning]:
        """Of each effect that acts, by its id, the policy that has learned without it."""
        ids = [e.id for e in self.extension.effects if e.acts]
        return {e: self.trained(self.extension.without(e), self.folder / "without" / _safe(e)) for e in ids}

    # ---- judging ---------------------------------------------------------------------------------------------------

    def report(self, adapted: FineTuning, ablated: Mapping[str, FineTuning]) -> dict[str, Any]:
        """Judge, and put everything together."""
        self._recall(adapted)
        both = {"before": self.start, "after": Policy(self.start.sight, adapted.best)}
        length = {"threads": self.threads, "episode": self.config.episode}
        shape = {**length, "settings": self.settings}
        worlds: dict[str, World] = {
            NOMINAL: partial(vector_env, self.extension.environment, **length, **self.settings),
            EXTENDED: partial(self.extension.envs, **shape),
        }
        if self.truth is not None:
            worlds[TRUE] = self.truth.envs
        for e in self.extension.effects:
            if e.acts:
                worlds[WITHOUT + e.id] = partial(self.extension.without(e.id).envs, **shape)
        judged = {w: {k: self._judged(k, p, w, make) for k, p in both.items()} for w, make in worlds.items()}
        blind = {
            e: {
                w: self._judged(f"without {e}", Policy(self.start.sight, tuning.best), w, worlds[w])
                for w in (EXTENDED, TRUE) if w in worlds
            }
            for e, tuning in ablated.items()
        }  # fmt: skip
        returns = {w: _compared(judged[w]) for w in (NOMINAL, EXTENDED, TRUE) if w in judged}
        where = TRUE if self.truth is not None else EXTENDED
        return {
            "schema": 1, "environment": self.extension.environment, "from": str(self.extension.found.source),
            "verdict": self.extension.found.verdict,
            "policy": {"environment": self.start.sight.environment, "digest": self.of["policy"]} | self.settings,
            "world": None if self.truth is None else self.truth.name, "measured_in": where,
            "returns": returns, "parameters": self.extension.told(),
            "effects": [self._effect(e, judged, blind) for e in self.extension.effects],
            "curve": adapted.curve, "kept": adapted.kept, "diverged": adapted.diverged,
            "config": asdict(self.config), "episodes": self.episodes, "seed": self.config.seed,
            "versions": {"nfc_gym": version("nfc_gym"), "mujoco": mujoco.__version__, "torch": str(torch.__version__)},
        }  # fmt: skip

    def _effect(
        self, e: Bound, judged: Mapping[str, Mapping[str, Score]], blind: Mapping[str, Mapping[str, Score]]
    ) -> dict[str, Any]:
        """An effect, what it costs either policy, and what knowing of it was worth."""
        parameters = {
            p.name: {"value": float(v), "low": float(a), "high": float(b), "unit": p.unit}
            for p, v, a, b in zip(e.effect.params, e.theta, e.low, e.high, strict=True)
        }
        row: dict[str, Any] = {"id": e.id, "sentence": e.sentence, "parameters": parameters, "acts": e.acts}
        if not e.acts:
            return row
        there, gone = judged[EXTENDED], judged[WITHOUT + e.id]
        row["returns"] = {
            k: {"with": figure(there[k]), "without": figure(gone[k]), "cost": gain(gone[k], there[k])} for k in there
        }
        if e.id in blind:
            row["ablation"] = {
                w: {"unaware": figure(score), "worth": gain(judged[w]["after"], score)}
                for w, score in blind[e.id].items()
            }
        return row

    def _judged(self, label: str, policy: Policy, world: str, make: World) -> Score:
        """The episodes of a policy in a world, the same for all policies; kept, as they take time."""
        of = f" {self.truth.key}" if self.truth is not None and world == TRUE else ""
        key = f"{label} | {world}{of}"
        if key not in self.scores:
            self.record.line(f"judging over {self.episodes} episodes: {label}, {world}")
            envs = VectorSight(make(self.episodes), self.start.sight)
            self._require_task(world, envs)
            # A function's world may have no time limit.
            longest = whole_episode(self.config, self.extension.environment)
            self.scores[key] = evaluate(policy, envs, mixed(self.config.seed, _JUDGED) % 2**31, longest)
            envs.close()
            kept = {"of": self._key, "scores": {k: to_plain(s) for k, s in self.scores.items()}}
            write_whole(self.folder / KEPT, json.dumps(kept))
        return self.scores[key]

    def _require_task(self, world: str, envs: VectorEnv) -> None:
        """Refuse a function's world in which another task is judged than the policy learned."""
        robot = envs.unwrapped.robot  # type: ignore[attr-defined]
        wanted = self.settings.get("task", robot.tasks[0])
        if robot.task != wanted:
            envs.close()
            raise InputError(f"{world}: its task is {robot.task!r}, the policy's {wanted!r}: say task={wanted!r} there")

    def _recall(self, adapted: FineTuning) -> None:
        """What was judged before an interruption; a world that is a function is judged in anew.

        Raises:
          InputError: the file of it is damaged.
        """
        told = [self.of, asdict(self.config), self.episodes, adapted.curve]
        self._key = hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]
        file = self.folder / KEPT
        if file.is_file():
            try:
                kept = json.loads(file.read_text(encoding="utf-8"))
                of, scores = kept["of"], {k: from_plain(s) for k, s in kept["scores"].items()}
            except (ValueError, KeyError, TypeError, AttributeError) as e:
                raise InputError(f"{file}: damaged, or none of this command's ({e}): remove it to judge anew") from None
            if of == self._key:
                self.scores = {k: s for k, s in scores.items() if not k.endswith(f"| {TRUE} {_FUNCTION}")}

    def say(self, report: Mapping[str, Any]) -> None:
        """The outcome, in a few lines."""
        for world, row in report["returns"].items():
            before, after, more = (row[k] for k in ("before", "after", "gain"))
            self.record.say(
                f"{world}: return {before['return']['mean']:.4g} before, {after['return']['mean']:.4g} after; "
                f"gain {more['mean']:.3g} ({more['low']:.3g} to {more['high']:.3g})"
            )
        for e in report["effects"]:
            if e["acts"]:
                costs = [e["returns"][k]["cost"]["mean"] for k in ("before", "after")]
                self.record.say(f"{e['id']}: costs {costs[0]:.3g} before, {costs[1]:.3g} after")
        if not report["kept"]:
            self.record.say("no weights on the way did better than those that were given: the policy is unchanged")
        if report["world"] is None:
            self.record.say("these are returns of the extended model, not of the machine; --world measures in a third")
        self.record.say(f"{self.folder / POLICY}, {self.folder / PAGE}")


def _compared(scores: Mapping[str, Score]) -> dict[str, Any]:
    before, after = scores["before"], scores["after"]
    return {"before": figure(before), "after": figure(after), "gain": gain(after, before)}
