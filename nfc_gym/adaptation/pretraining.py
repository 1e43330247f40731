"""Pretraining: PPO under random psi and terrain; what a kill interrupts, the same command goes on with.

Teacher and student are one here: the critic is shown the psi that is simulated, the actor is not. A student that is
told a belief which is always nominal learns nothing from it, and a teacher's actions that depend on what the student
cannot see are a poor thing to imitate; the critic is where knowing psi helps, by taking from the advantages what luck
in psi explains.
"""

import math
import shlex
import sys
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from tensordict import TensorDictBase
from torch import Tensor, nn

from nfc_gym.adaptation import resume
from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.gathering import Batches, Cluster, RayWorlds, cluster_of, gathered, spread
from nfc_gym.adaptation.network import ActorCritic, Sizes, hidden_of
from nfc_gym.adaptation.policy import Policy, check_suffix, load_policy, taught
from nfc_gym.adaptation.ppo import ONWARD, Diverged, OnPolicy, PPOConfig, clipped
from nfc_gym.adaptation.record import Episodes, Record, in_words
from nfc_gym.adaptation.settings import require_number
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.threads import limit_threads
from nfc_gym.adaptation.weights import of_weights
from nfc_gym.adaptation.worlds import robot_of, training_env, vector_env
from nfc_gym.core import kinds
from nfc_gym.core.errors import InputError, NfcError
from nfc_gym.core.files import require_writable
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.jobs import device_of
from nfc_gym.inference.random import mixed
from nfc_gym.simulate.machine import full_id

SAVE_EVERY = 20.0  # s between two states on disk
_TOGETHER = 8192  # steps an iteration that few simulations make
EPISODES = 64  # by which the final policy is judged
SPREAD = 0.5  # of the prior: anomalies lie between this range and the prior's bounds, or beyond


@dataclass(frozen=True)
class Recipe:
    """What suits a robot.

    Attributes:
      episode: control steps of a training episode. Goals are 2 to 4 s away, and staying there for the rest of 20 s
        teaches nothing new.
      explore: standard deviation of the first actions, of a range of one either way: a humanoid that moves each joint
        by chance is down before it has learned anything of standing.
      ppo: settings.
    """

    episode: int = 1000
    explore: float = 0.6
    ppo: PPOConfig = field(default_factory=PPOConfig)


RECIPES: Mapping[str, Recipe] = {
    "ant": Recipe(),
    # What it does at random makes it fall: it is to explore no more than it must, and may change its mind faster.
    "humanoid": Recipe(explore=0.3, ppo=PPOConfig(entropy=0.0, divergence=0.04)),
    "quadruped": Recipe(),
    "quadcopter": Recipe(400, ppo=PPOConfig(entropy=0.005, gamma=0.995)),
    "jackal": Recipe(400, ppo=PPOConfig(entropy=0.005)),
}


def recipe_of(environment: str, onward: bool = False, task: str | None = None) -> Recipe:
    """What suits the robot of an environment, by its full id; `onward` where weights are there to begin with."""
    recipe = RECIPES[robot_of(environment)]
    if task == "figure8":  # a lap takes longer than the way to a goal
        recipe = replace(recipe, episode=Recipe.episode)
    if onward:  # no more exploring than from nothing: a humanoid's weight is 0
        return replace(recipe, ppo=replace(ONWARD, entropy=min(ONWARD.entropy, recipe.ppo.entropy)))
    return recipe


@dataclass(frozen=True, kw_only=True)
class Training:
    """Arguments of a run, which its state on disk must agree with.

    Attributes:
      environment: id.
      seed: of weights, actions, psi and terrain.
      envs: simulations.
      horizon: steps of each an iteration; 0 is as many as make 8192 together, from 16 to 64.
      net: of `network.NETS`.
      spread: share of the prior, around nominal, that psi is uniform over; 0 is nominal.
      task: of the robots that have several; None is the environment's own.
    """

    environment: str
    seed: int = 0
    envs: int = 1024
    horizon: int = 0
    net: str = "small"
    spread: float = SPREAD
    task: str | None = None

    def __post_init__(self) -> None:
        for name, least in (("seed", 0), ("envs", 1), ("horizon", 0)):
            object.__setattr__(self, name, require_whole(f"pretrain: {name}", getattr(self, name), least))
        if not isinstance(self.spread, Real) or not 0 <= self.spread < 1:
            raise InputError(f"--spread {self.spread}: psi is drawn strictly inside the prior, want a share in [0, 1)")
        object.__setattr__(self, "spread", float(self.spread))
        hidden_of(self.net)
        if self.horizon == 0:
            object.__setattr__(self, "horizon", min(max(_TOGETHER // self.envs, 16), 64))

    @property
    def settings(self) -> dict[str, Any]:
        """Of the environment."""
        return {} if self.task is None else {"task": self.task}


def pretrain(
    environment: str, out: str | Path, *, steps: int, seed: int = 0, envs: int = 1024, horizon: int = 0,
    net: str = "small", spread: float = SPREAD, task: str | None = None, device: str = "auto", threads: int = 0,
    seconds: float | None = None, start: str | Path | None = None, ray: str | None = None, workers: int = 0,
    console: Console | None = None,
) -> Policy:  # fmt: skip
    """Train a policy, and write it.

    Args:
      environment: id, `nfc_gym/AntFlat-v0` or `AntFlat`.
      out: file that ends in `.safetensors`. Beside it the state of the run, `.training`, and its curves, `.log`.
      steps: control steps of all simulations together.
      seed, envs, horizon, net, spread, task: see `Training`.
      device: of the networks; the simulations run on the processor.
      threads: of the physics; 0 takes every core. On a cluster of each worker, and 0 is one.
      seconds: stop after so long, with what was learned by then; the same command goes on from there.
      start: a policy of the same robot whose weights the first ones are; one of flat ground will do for rough ground.
      ray: address of a Ray cluster on which the simulations run, `auto` or `local`; None is this process.
      workers: of the cluster, which share the simulations equally; 0 takes as many as it has cores for.
      console: who is told.

    Returns:
      The policy, its return over `EPISODES` whole episodes in the nominal world in `about`.

    Raises:
      InputError: arguments that cannot be, something else than a policy at `out`, or the state of another run beside
        it.
      MissingExtra: a cluster is asked for, and Ray is not installed.
      Diverged: the loss came apart; `out` then holds the last good weights.
      NfcError: the cluster failed; the state beside `out` is that of the last batch.
    """
    path = Path(out)
    check_suffix(path)
    kinds.require_kind(path, kinds.POLICY)
    require_writable(path.absolute().parent)
    require_whole("pretrain: steps", steps, 1)
    if seconds is not None:
        require_number("pretrain: seconds", seconds, 0)
    training = Training(
        environment=full_id(environment), seed=seed, envs=envs, horizon=horizon, net=net, spread=spread, task=task
    )
    cluster = cluster_of(ray, workers, threads, envs)
    limit_threads(threads if cluster is None else 0)
    # With its index: a collector takes "cuda" and "cuda:0" for two devices, and would keep a copy of the policy.
    place = torch.empty(0, device=device_of(device)).device
    recipe = recipe_of(training.environment, start is not None, task)
    run = Run(training, place, threads, Record(path.with_name(path.name + ".log"), console), cluster, recipe)
    run.go_on(path, steps, seconds, None if start is None else load_policy(start))
    return run.policy


class Run:
    """A run of pretraining.

    Args:
      training: its arguments.
      device: of the networks.
      threads: of the physics.
      record: what is written down.
      cluster: where the simulations are; None is here.
      recipe: default what suits the robot.

    Attributes:
      policy: as it is now.
      steps: that were taken.
    """

    def __init__(
        self, training: Training, device: torch.device, threads: int, record: Record, cluster: Cluster | None = None,
        recipe: Recipe | None = None,
    ) -> None:  # fmt: skip
        self.recipe = recipe = recipe or recipe_of(training.environment, task=training.task)
        self.training, self.device, self.record = training, device, record
        self.threads = threads if cluster is None else 0  # in this process
        self.steps, self.elapsed = 0, 0.0
        self.started: dict[str, Any] | None = None
        self.start: str | None = None  # what tells the policy to begin with from others
        self.episodes = Episodes()
        torch.manual_seed(training.seed)
        make = partial(
            training_env, training.environment, spread=training.spread, episode=recipe.episode,
            settings=training.settings,
        )  # fmt: skip
        self.worlds = spread(make, training.envs, self.threads, training.seed, cluster)
        # What they are like, and where the first steps are taken.
        self.envs = self.worlds if isinstance(self.worlds, VectorSight) else self.worlds.template
        if isinstance(self.worlds, RayWorlds):
            self.worlds.restarted = self.episodes.forget
        sizes = Sizes(
            self.envs.sight.size, len(self.envs.unwrapped.psi_space), self.envs.unwrapped.robot.action_size,
            hidden_of(training.net),
        )  # fmt: skip
        self.network = ActorCritic(sizes).to(device)
        nn.init.constant_(self.network.gaussian.log_std, math.log(recipe.explore))
        self.policy = Policy(self.envs.sight, self.network)
        self.learner = OnPolicy(clipped(self.network.actor, self.network.critic, recipe.ppo), recipe.ppo)

    def go_on(self, path: Path, steps: int, seconds: float | None, start: Policy | None = None) -> None:
        """Train up to so many steps in all, from the state beside `path` if there is one; then judge and save."""
        state = path.with_name(path.name + ".training")
        if start is not None:
            self.start = f"{start.sight.environment}, weights {of_weights(start.network)}"
        if state.is_file():
            self.load_state(state)
            over = self.steps >= steps
            self.record.say(f"{'finished before, at' if over else 'going on from'} step {self.steps:,} of {steps:,}")
        elif start is not None:
            self.begin_from(start)
        else:
            self.network.scale.see(self.first())
        try:
            self.train(steps, seconds, state)
        except Diverged as e:
            self.load_state(state)
            self.save(path, diverged=str(e))
            raise Diverged(
                f"{self.training.environment}: {e}. {path} holds the weights of step {self.steps:,}; "
                "another --seed or more --envs may do better"
            ) from None
        self.save(path)

    def begin_from(self, start: Policy) -> None:
        """The weights of another policy; what it did not see is brought to scale first."""
        known = taught(self.network, self.policy.sight, start)
        if known < self.policy.sight.size:
            self.network.scale.begin(self.first(), known)
        self.started = {"environment": start.sight.environment, "steps": start.about.get("steps")}

    def first(self) -> Tensor:
        """What is observed in the first steps, to begin a scale with."""
        with closing(self.batches(8, self.envs)) as batches:
            return next(batches)["observation"]

    def batches(self, horizon: int, worlds: VectorSight | None = None) -> Batches:
        """Batches of (envs, horizon) steps, on the networks' device; environments begin anew."""
        seed = mixed(self.training.seed, self.steps)
        torch.manual_seed(seed)
        return gathered(worlds or self.worlds, self.network.actor, horizon, self.device, seed)

    def train(self, steps: int, seconds: float | None, state: Path) -> None:
        """Iterations until one of the two is used up; the state is saved now and then, and at the end."""
        began = saved = time.monotonic()
        spent = self.elapsed
        self.save_state(state)
        if isinstance(self.worlds, RayWorlds):
            self.record.say(f"Ray, {self.worlds.cluster.address}: the workers begin, which takes half a minute")
        with closing(self.batches(self.training.horizon)) as batches:
            while self.steps < steps and (seconds is None or time.monotonic() - began < seconds):
                start, physics = time.monotonic(), self.envs.seconds
                batch = self._next(batches, state)
                middle = time.monotonic()
                values = self.iterate(batch)
                now = time.monotonic()
                self.elapsed = spent + now - began
                spans = {"learn_s": now - middle}
                if self.worlds is self.envs:
                    physics = self.envs.seconds - physics
                    spans |= {"physics_s": physics, "policy_s": middle - start - physics}
                else:
                    spans |= {"gather_s": middle - start}
                self.tell(values | spans, batch.numel() / (now - start), steps)
                if now - saved > SAVE_EVERY:
                    self.save_state(state)
                    saved = time.monotonic()
        self.save_state(state)

    def _next(self, batches: Batches, state: Path) -> TensorDictBase:
        """The next batch; where a cluster fails, what was learned before is saved first."""
        try:
            return next(batches)
        except NfcError:
            self.save_state(state)
            raise

    def iterate(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch; what was seen changes the scale only afterwards, so that densities stay comparable."""
        values = self.learner.learn(batch)
        self.network.scale.see(batch["observation"])
        self.episodes.see(batch)
        self.steps += batch.numel()
        return values | self.episodes.means()

    def tell(self, values: dict[str, float], speed: float, steps: int) -> None:
        """Curves and the progress line."""
        self.record.scalars(self.steps, values | {"steps_per_s": speed, "hours": self.elapsed / 3600})
        shown = {k: values[k] for k in ("return", "success", "length", "divergence") if k in values}
        self.record.line(f"{self.steps:,}/{steps:,}  {speed:,.0f} steps/s  {in_words(shown)}", self.steps >= steps)

    def save(self, path: Path, diverged: str | None = None) -> None:
        """Judge the policy in the nominal world, and write it."""
        judged = VectorSight(
            vector_env(self.training.environment, EPISODES, threads=self.threads, **self.training.settings)
        )
        score = evaluate(self.policy, judged, seed=mixed(self.training.seed, EPISODES) % 2**31).summary()
        judged.close()
        self.policy.about = {
            "training": asdict(self.training), "ppo": asdict(self.recipe.ppo), "episode": self.recipe.episode,
            "started_from": self.started, "steps": self.steps, "seconds": round(self.elapsed, 1), "nominal": score,
            "device": self.device.type,
            "command": shlex.join(["nfc-gym", *sys.argv[1:]]) if sys.argv[0].endswith("nfc-gym") else None,
        } | ({"diverged": diverged} if diverged else {})  # fmt: skip
        self.policy.save(path)
        self.record.say(f"{path}: in the nominal world {in_words(score)}; {self.elapsed:.0f} s of training")

    def save_state(self, path: Path) -> None:
        """All that going on needs; the simulations begin new episodes then."""
        plain = {
            "steps": self.steps, "elapsed": self.elapsed, "episodes": self.episodes.count, "started": self.started,
        }  # fmt: skip
        resume.save(path, self._modules(), self.learner.optimiser, plain, self._described())

    def load_state(self, path: Path) -> None:
        """The inverse."""
        of = self._described()
        if "start" not in resume.described(path):  # a state of before that was written down
            del of["start"]
        plain = resume.load(path, self._modules(), self.learner.optimiser, of)
        self.steps, self.elapsed, self.episodes.count = plain["steps"], plain["elapsed"], plain["episodes"]
        self.started = plain.get("started")

    def _modules(self) -> dict[str, nn.Module]:
        return {"network": self.network, "reward": self.learner.power}

    def _described(self) -> dict[str, Any]:
        how = {"ppo": asdict(self.recipe.ppo), "episode": self.recipe.episode}
        return {"start": self.start, **asdict(self.training), **how}
