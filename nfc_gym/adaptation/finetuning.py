"""Fine-tuning of a policy by PPO in an extended model, in blocks: a run that was killed ends with the same bits.

Each block begins new episodes, with random numbers of its own, and ends with a point of the curve: the policy's return
without exploring, over the same whole episodes each time. The weights kept are those of the curve's best point; the
policy that was given is its first.
"""

import copy
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium
import torch
from gymnasium.vector import VectorEnv
from torch import nn

from nfc_gym.adaptation import resume
from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.extension import Extension
from nfc_gym.adaptation.policy import Policy
from nfc_gym.adaptation.ppo import Diverged, OnPolicy, clipped
from nfc_gym.adaptation.pretraining import recipe_of
from nfc_gym.adaptation.record import Record, in_words
from nfc_gym.adaptation.returns import figure
from nfc_gym.adaptation.settings import require_number
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.worlds import VectorStaggered, batches, torchrl_env
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.random import mixed

STATE = "training.safetensors"
_RATE = 1e-4  # first step size: of a policy that can walk already
_TOGETHER = 8192  # steps an iteration
_WORLDS, _CURVE, _BLOCK = 0, 1, 2  # streams of random numbers


@dataclass(frozen=True, kw_only=True)
class FineTuneConfig:
    """Settings of fine-tuning.

    Attributes:
      steps: control steps of all simulations together.
      envs: simulations; so few that each comes to the end of an episode between two points of the curve.
      vary: sizes of effects and psi are uniform over this multiple of their 95 % intervals; 0 is the fitted ones.
      episode: control steps of the episodes that judge; None is the environment's own. Learning takes the shorter ones
        of the robot's `Recipe`, where that has such.
      every: iterations of some 8192 steps between two points of the curve.
      curve: episodes of each point.
      seed: of everything.
    """

    steps: int = 500_000
    envs: int = 64
    vary: float = 1.0
    episode: int | None = None
    every: int = 8
    curve: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("envs", 1), ("episode", 1), ("every", 1), ("curve", 2), ("seed", 0)):
            value = getattr(self, name)
            if (name, value) != ("episode", None):
                object.__setattr__(self, name, require_whole(name, value, least))
        object.__setattr__(self, "vary", require_number("vary", self.vary, 0, 10, "a multiple of the intervals"))


def whole_episode(config: FineTuneConfig, environment: str) -> int:
    """Control steps of the episodes that judge."""
    return config.episode or gymnasium.spec(environment).max_episode_steps or 1000


class FineTuning:
    """A run of fine-tuning, on the task that the policy was trained to do.

    Args:
      policy: to begin with; its network learns in place.
      extension: the worlds.
      config: see `FineTuneConfig`.
      folder: for the state and the curves.
      of: what else another run must have in common to go on from the state.
      threads: of the physics; 0 takes every core.
      record: what is written down.

    Attributes:
      curve: a dict a point: `steps`, `return` {mean, low, high}, perhaps `success`.
      diverged: why the run stopped early, or None.
    """

    def __init__(
        self, policy: Policy, extension: Extension, config: FineTuneConfig, folder: Path, *, of: dict[str, Any],
        threads: int, record: Record,
    ) -> None:  # fmt: skip
        self.policy, self.extension, self.config = policy, extension, config
        self.path, self.of, self.threads, self.record = folder / STATE, of, threads, record
        self.settings = policy.settings(extension.environment)
        recipe = recipe_of(extension.environment, **self.settings)
        self.ppo = replace(recipe.ppo, rate=_RATE, together=_TOGETHER)
        self.whole = whole_episode(config, extension.environment)
        self.episode = min(recipe.episode, self.whole)
        self.network = policy.network
        self.device = self.network.scale.mean.device
        self.learner = OnPolicy(clipped(self.network.actor, self.network.critic, self.ppo), self.ppo)
        self.best = copy.deepcopy(self.network)
        self.steps, self.curve, self.diverged = 0, [], None
        self._envs: dict[str, VectorEnv] = {}

    def run(self) -> Policy:
        """Learn, from the state in the folder if there is one; returns the policy of the curve's best point."""
        if self.path.is_file():
            self._load()
            over = self.steps >= self.config.steps or self.diverged is not None
            said = "finished before, at" if over else "going on from"
            self.record.say(f"{said} step {self.steps:,} of {self.config.steps:,}")
        else:
            self._point({})
        while self.steps < self.config.steps and self.diverged is None:
            try:
                told = self._block()
            except Diverged as e:
                self._load()
                self.diverged = str(e)
                self.record.say(f"{e}; the policy is that of step {self.curve[self.kept]['steps']:,}")
                self._save()
            else:
                self._point(told)
        for envs in self._envs.values():
            envs.close()
        return Policy(self.policy.sight, self.best, dict(self.policy.about))

    @property
    def kept(self) -> int:
        """The curve's best point."""
        return max(range(len(self.curve)), key=lambda k: self.curve[k]["return"]["mean"])

    def _block(self) -> dict[str, float]:
        """Some iterations in new episodes; returns what the last one has to tell."""
        config, at = self.config, (_BLOCK, len(self.curve))
        worlds = self._made("worlds", config.envs, config.vary, _WORLDS, self.episode)
        staggered = VectorStaggered(worlds, self.episode, mixed(config.seed, *at, 0))
        torch.manual_seed(mixed(config.seed, *at, 1))
        env = torchrl_env(VectorSight(staggered, self.policy.sight))
        env.set_seed(mixed(config.seed, *at, 2) % 2**31)
        told: dict[str, float] = {}
        drawn = batches(env, self.network.actor, self.learner.horizon(config.envs), self.device)
        for batch in islice(drawn, config.every):
            told = self.learner.learn(batch)
            self.steps += batch.numel()
            said = f"{self.steps:,}/{config.steps:,} steps in {config.envs} worlds  {in_words(_shown(self.curve[-1]))}"
            self.record.line(said)
            if self.steps >= config.steps:
                break
        return told

    def _point(self, told: dict[str, float]) -> None:
        """How good the policy is now; the state is kept."""
        envs = VectorSight(self._made("curve", self.config.curve, 0.0, _CURVE, self.whole), self.policy.sight)
        score = evaluate(self.policy, envs, seed=mixed(self.config.seed, _CURVE) % 2**31)
        self.curve.append({"steps": self.steps, **figure(score)})
        if self.kept == len(self.curve) - 1:
            self.best.load_state_dict(self.network.state_dict())
        shown = _shown(self.curve[-1])
        self.record.scalars(self.steps, told | {f"curve/{k}": v for k, v in shown.items()})
        self.record.line(
            f"{self.steps:,}/{self.config.steps:,} steps  {in_words(shown | told)}", self.steps >= self.config.steps
        )
        self._save()

    def _made(self, name: str, n: int, vary: float, stream: int, episode: int) -> VectorEnv:
        """Simulations of the extension, made once."""
        if name not in self._envs:
            seed = mixed(self.config.seed, stream)
            shape = {"episode": episode, "threads": self.threads, "settings": self.settings}
            made = self.extension.envs(n, vary=vary, seed=seed, **shape)
            self._envs[name] = made
        return self._envs[name]

    def _save(self) -> None:
        plain = {"steps": self.steps, "curve": self.curve, "diverged": self.diverged}
        resume.save(self.path, self._modules(), self.learner.optimiser, plain, self._described())

    def _load(self) -> None:
        plain = resume.load(self.path, self._modules(), self.learner.optimiser, self._described())
        self.steps, self.curve, self.diverged = plain["steps"], plain["curve"], plain["diverged"]

    def _modules(self) -> dict[str, nn.Module]:
        return {"network": self.network, "best": self.best, "reward": self.learner.power}

    def _described(self) -> dict[str, Any]:
        config = {k: v for k, v in asdict(self.config).items() if k != "steps"}
        return {**self.of, **config, "ppo": asdict(self.ppo), "learning_episode": self.episode}


def _shown(point: dict[str, Any]) -> dict[str, float]:
    """Of a point of the curve what a line has room for."""
    return {k: point[k]["mean"] for k in ("return", "success") if k in point}
