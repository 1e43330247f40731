"""The paper's Algorithm 1: informative sim-to-real adaptation with NFC.

`adapt` is the loop, line by line; what a line does is a function of its own below, or a module beside this one. The
policy is touched only after an anomaly. A world that never shows one leaves it as it was, to the bit, and says so.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from torch import nn

from nfc_gym.adaptation import resume
from nfc_gym.adaptation.agent import Agent
from nfc_gym.adaptation.beliefs import Inference, inference_of, require_spoken, require_width, width
from nfc_gym.adaptation.choice import Choice, weights_of
from nfc_gym.adaptation.earned import RATE, chance, require_home
from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.gathered import STATE
from nfc_gym.adaptation.gathering import Cluster, RayWorlds, cluster_of, portable, spread
from nfc_gym.adaptation.given import check_fit, episode_of, run_folder, simulator_of, with_task
from nfc_gym.adaptation.hallucination import hallucination
from nfc_gym.adaptation.imagined import imagined, require_parts
from nfc_gym.adaptation.network import Gaussian
from nfc_gym.adaptation.optimise import optimise, pi_h_for
from nfc_gym.adaptation.record import Record, in_words
from nfc_gym.adaptation.settings import require_number
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.trajectory import Dataset, Trajectory, execute, limited
from nfc_gym.adaptation.whose import Whose
from nfc_gym.core.errors import InputError
from nfc_gym.core.posterior import Sampler
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.random import mixed
from nfc_gym.wrappers.anomaly import opened

_POINTS = 3  # how often weights are judged on the way of one mission's learning


@dataclass(frozen=True, kw_only=True)
class AdaptConfig:
    """Settings of adaptation.

    Attributes:
      missions: trajectories that are executed.
      worlds: N, simulations that are drawn from the belief; so many only that each has steps for several episodes.
        Until its first one has ended a simulation shows but the beginning of what there is to learn.
      steps: control steps of all of them together, after each anomaly.
      episode: control steps of an episode in them, and in a world of which no time limit is known; None is the world's
        own, or else the simulator's.
      hallucinate: train pi_h too, which leans the draws in the policy's favour.
      parts: of the belief, those that are used where it speaks of them; ("psi",) is the paper's "w/o delta fidelity".
        On rough ground a neural posterior's delta_e is laid where each simulation starts (`VectorResidualTerrain`);
        pi_h does not move it.
      beta: how far, in standard deviations of the belief, pi_h = 1 leads.
      judged: episodes by which weights are chosen: those from before the first mission, those that each mission left
        and those on the way now compete in worlds of the present belief, and the best are deployed, while learning goes
        on from where it was (see `choice`). 0 deploys the last.
      seed: of everything.
    """

    missions: int = 10
    worlds: int = 64
    steps: int = 500_000
    episode: int | None = None
    hallucinate: bool = True
    parts: Sequence[str] = ("psi", "delta_s", "delta_e", "effects", "noise")
    beta: float = 1.0
    judged: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"missions": 1, "worlds": 1, "steps": 1, "seed": 0} | ({} if self.episode is None else {"episode": 1})
        for name, low in least.items():
            object.__setattr__(self, name, require_whole(f"adapt: {name}", getattr(self, name), low))
        whole = isinstance(self.judged, Integral) and not isinstance(self.judged, bool)
        if not whole or self.judged == 1 or self.judged < 0:
            raise InputError(f"adapt: judged is {self.judged!r}; want 0, or 2 episodes or more")
        object.__setattr__(self, "judged", int(self.judged))
        beta = require_number("adapt: beta", self.beta, 0, what="a number of standard deviations")
        object.__setattr__(self, "beta", beta)
        if isinstance(self.parts, str) or not isinstance(self.parts, Sequence) or not self.parts:
            raise InputError(f"adapt: parts is {self.parts!r}; want parts of the belief, such as ('psi',)")
        require_parts(self.parts)


@dataclass
class Adapted:
    """What adaptation came to; the agent that was given has learned in place.

    Attributes:
      dataset: every trajectory, anomalous or not.
      posterior: what infers now.
      belief: after the last anomaly; None without one.
      anomalies: trajectories that were anomalous.
      history: for each trajectory its return and what was done about it.
    """

    dataset: Dataset
    posterior: Inference
    belief: Sampler | None = None
    anomalies: int = 0
    history: list[dict[str, Any]] = field(default_factory=list)


def adapt(
    agent: Agent, world: Any, posterior: Any, detector: Any, *, config: AdaptConfig | None = None,
    environment: str | None = None, folder: str | Path | None = None, threshold: float | None = None, threads: int = 0,
    settings: Mapping[str, Any] | None = None, home: Sequence[float] | None = None, ray: str | None = None,
    workers: int = 0, console: Console | None = None,
) -> Adapted:  # fmt: skip
    """Adapt an agent to a world.

    Args:
      agent: any TorchRL actor and loss (see `Agent`); it learns in place.
      world: the environment to do well in, single, with whatever around it makes it another than the simulator.
      posterior: what infers (see `beliefs`).
      detector: of anomalies, as for `MonitorAnomaly`, or the path of one.
      config: see `AdaptConfig`.
      environment: id of the simulator; default the world's own, where `gymnasium.make` made it.
      folder: where trajectories, curves and the state are kept; the same call goes on from there. None keeps nothing.
        Another agent than the run began with is refused, and so are another detector of windows and another posterior
        where they can be told from others (see `digests`).
      threshold: of the detector; default its own.
      threads: of the physics; 0 takes every core. On a cluster of each worker, and 0 is one.
      settings: of the simulator; its task is the world's.
      home: returns of episodes of the agent, as it is before, in the nominal world: a trajectory with which it has
        lately earned less than would happen there (`earned.RATE`) is anomalous, whatever the detector says.
      ray, workers: a Ray cluster on which the worlds of the belief are simulated, as of `pretrain`.
      console: is told.

    Raises:
      InputError: the agent does not fit the world, one of the arguments is none, the posterior speaks of none of the
        parts, or the settings have another task than the world.
    """
    config = config or AdaptConfig()
    cluster = cluster_of(ray, workers, threads, config.worlds)
    run = _Run(agent, world, posterior, detector, config, environment, folder, threshold, threads,
               dict(settings or {}), None if home is None else require_home(home), cluster, console)  # fmt: skip
    while run.mission_goes_on():
        tau = run.execute()
        if tau.anomalous:
            belief = run.infer(tau)  # psi, phi ~ q(psi, phi | tau)
            worlds = run.hallucinate(belief)  # N of p(psi, phi | tau, pi_h)
            run.optimise(worlds, belief)  # pi', pi_h' = Policy-Opt(pi, pi_h, psi, phi)
            run.update(tau, belief)  # q <- q({psi}, {phi} | {tau}): sequential NFC
        run.store(tau)  # T = T + tau
    return run.finish()  # fine-tune NFC with T


class _Run:
    """The state of `adapt`, and its lines."""

    def __init__(
        self, agent: Agent, world: Any, posterior: Any, detector: Any, config: AdaptConfig, environment: str | None,
        folder: str | Path | None, threshold: float | None, threads: int, settings: dict[str, Any],
        home: np.ndarray | None, cluster: Cluster | None, console: Console | None,
    ) -> None:  # fmt: skip
        check_fit(agent, world)
        self.agent, self.world, self.config, self.threads, self.cluster = agent, world, config, threads, cluster
        self.environment = simulator_of(world, environment)
        self.episode = config.episode or episode_of(world, self.environment)
        self.longest = None if limited(world) else self.episode
        self.settings, self.home = with_task(settings, world), home
        self.detector, self.threshold = opened(detector, threshold)
        self.inference = inference_of(posterior)
        require_width(posterior, world.unwrapped.psi_space)
        require_spoken(posterior, config.parts)
        self.folder = None if folder is None else run_folder(Path(folder))
        self.record = Record(None if self.folder is None else self.folder / "log", console)
        self.pi_h: Gaussian | None = None
        self.past = [copy.deepcopy(weights_of(agent))]  # what was deployed
        self.learned = copy.deepcopy(weights_of(agent))  # where learning has come to
        self.t = self.steps = 0
        self.belief: Sampler | None = None
        self.history: list[dict[str, Any]] = []
        self.now: dict[str, Any] = {}
        self.whose = Whose(agent, self.detector, self.inference)
        self._go_on()

    # ---- the lines of the algorithm -------------------------------------------------------------------------------

    def mission_goes_on(self) -> bool:
        """Whether there is another trajectory to execute."""
        return self.t < self.config.missions

    def execute(self) -> Trajectory:
        """One episode in the world, watched by the detector."""
        seed = mixed(self.config.seed, self.t) % 2**31
        tau = execute(self.agent, self.world, self.detector, self.threshold, seed, self.longest)
        top = float(tau.scores.max())  # over the threshold, where that is a measure of it
        self.now = {"return": tau.total, "length": len(tau), "reached": tau.reached,
                    "score": top / self.threshold if self.threshold > 0 else top}  # fmt: skip
        if self.home is not None:
            self.now["chance"] = chance(self.home, [*(row["return"] for row in self.history), tau.total])
            if self.now["chance"] < RATE and not tau.anomalous:
                tau = replace(tau, scores=np.append(tau.scores[:-1], self.threshold))
        self.now["anomalous"] = tau.anomalous
        return tau

    def infer(self, tau: Trajectory) -> Sampler:
        """What the trajectory tells about psi and residual fidelity."""
        self.belief = belief = self.inference.infer(tau)
        self.now["width"] = width(belief, self.world.unwrapped.psi_space)
        return belief

    def hallucinate(self, belief: Sampler) -> VectorSight | RayWorlds:
        """N simulations of the belief; with pi_h each episode's psi and phi are mean + beta L pi_h."""
        config = self.config
        make = self._imagined(belief if self.cluster is None else portable(belief), hallucinate=config.hallucinate)
        worlds = spread(make, config.worlds, self.threads, mixed(config.seed, self.t, 4) % 2**31, self.cluster)
        fresh = pi_h_for(self.agent, worlds, mixed(config.seed, self.t, 1))
        if fresh is None or self.pi_h is None or self.pi_h.log_std.shape != fresh.log_std.shape:
            self.pi_h = fresh
        return worlds

    def optimise(self, worlds: VectorSight | RayWorlds, belief: Sampler) -> None:
        """Policy-Opt: pi and pi_h for the return in these worlds. A loss that comes apart changes nothing."""
        own = weights_of(self.agent)
        own.load_state_dict(self.learned.state_dict())
        with closing(worlds), self._choice(belief) as choice:
            if choice is not None:
                self.now["best_so_far"] = choice.best
            self.now |= optimise(
                self.agent, worlds, self.config.steps, pi_h=self.pi_h, seed=mixed(self.config.seed, self.t, 2),
                record=self.record, before=self.steps, choice=choice, points=_POINTS,
            )  # fmt: skip
        if "diverged" in self.now:
            own.load_state_dict(self.past[-1].state_dict())
            self.record.say(f"mission {self.t}: {self.now['diverged']}; the policy is as before")
        else:
            self.learned.load_state_dict(own.state_dict())
            if choice is not None:
                choice.take()
            self.past.append(copy.deepcopy(own))
        self.steps += self.config.steps

    def update(self, tau: Trajectory, belief: Sampler) -> None:
        """Sequential NFC."""
        self.inference = self.inference.updated(tau, belief)

    def store(self, tau: Trajectory) -> None:
        """Every trajectory, anomalous or not; and the state to go on from."""
        self.dataset.add(tau)
        self.history.append(self.now)
        self.record.scalars(self.t, {k: float(v) for k, v in self.now.items() if isinstance(v, int | float)})
        shown = {k: v for k, v in self.now.items() if k in ("return", "length", "score", "chance", "width", "chosen")}
        what = "anomalous: adapted" if tau.anomalous else "no anomaly: the policy is not touched"
        reached = "" if not self.world.unwrapped.robot.place_size else f"  reached {tau.reached}"
        self.record.say(f"mission {self.t}: {in_words(shown)}{reached}  {what}")
        self.t += 1
        self._save()

    def finish(self) -> Adapted:
        """After the mission: what infers learns from all of it, where it can."""
        anomalies = sum(tau.anomalous for tau in self.dataset)
        tune = getattr(self.inference, "fine_tuned", None)
        if anomalies and tune is not None:
            self.record.say("what infers learns from the whole mission")
            self.inference = tune(self.dataset)
        if not anomalies:
            self.record.say(f"no anomaly in {len(self.dataset)} trajectories: nothing was changed")
        return Adapted(self.dataset, self.inference, self.belief, anomalies, self.history)

    # ---- inside ---------------------------------------------------------------------------------------------------

    def _imagined(self, belief: Sampler, **how: Any) -> Callable[..., VectorSight]:
        """Makes simulations of the belief."""
        return partial(
            imagined, self.environment, belief, parts=self.config.parts, beta=self.config.beta,
            episode=self.episode, sight=self.agent.sight, settings=self.settings, **how,
        )  # fmt: skip

    @contextmanager
    def _choice(self, belief: Sampler) -> Iterator[Choice | None]:
        """Between all weights so far and those to come. None where nothing chooses."""
        if not self.config.judged:
            yield None
            return
        seed = mixed(self.config.seed, self.t, 3) % 2**31
        make = self._imagined(belief, hallucinate=False, staggered=False)
        self.record.say(f"judges all weights so far in {self.config.judged} whole episodes of what is believed")
        with closing(make(self.config.judged, threads=self.threads, seed=seed)) as envs:
            yield Choice(
                self.agent, lambda: evaluate(self.agent, envs, seed).returns, [m.state_dict() for m in self.past]
            )

    def _modules(self) -> dict[str, nn.Module]:
        modules: dict[str, nn.Module] = {"agent": weights_of(self.agent), "learned": self.learned}
        modules |= {f"past_{k}": module for k, module in enumerate(self.past)}
        return modules if self.pi_h is None else {**modules, "pi_h": self.pi_h}

    def _described(self) -> dict[str, Any]:
        config = {k: v for k, v in asdict(self.config).items() if k != "missions"}
        home = None if self.home is None else f"{len(self.home)} returns, {self.home.mean():.6g} on average"
        known = {"settings": self.settings, "threshold": self.threshold, "home": home}
        return {"environment": self.environment, **config, **known}

    def _save(self) -> None:
        if self.folder is None:
            return
        size = 0 if self.pi_h is None else len(self.pi_h.log_std)
        plain = {"t": self.t, "steps": self.steps, "pi_h": size, "past": len(self.past), "history": self.history}
        plain["whose"] = self.whose.told
        resume.save(self.folder / STATE, self._modules(), None, plain, self._described())

    def _go_on(self) -> None:
        """From the state in the folder, if there is one; what infers is brought there by the same updates."""
        path = None if self.folder is None else self.folder / STATE
        if path is None or not path.is_file():
            self.dataset = Dataset(self.folder)
            self.whose.remember(self.folder)
            return
        kept = resume.plain(path)
        self.whose.require(path, kept.get("whose", {}))
        self.past += [copy.deepcopy(self.past[0]) for _ in range(kept.get("past", 1) - 1)]
        size = int(kept["pi_h"])
        if size:
            self.pi_h = hallucination(self.agent.sight.size, size).to(self.agent.device)
        plain = resume.load(path, self._modules(), None, self._described())
        self.t, self.steps, self.history = plain["t"], plain["steps"], plain["history"]
        self.dataset = Dataset(self.folder, self.t)
        over = not self.mission_goes_on()
        self.record.say(
            f"{'finished before, at' if over else 'going on from'} mission {self.t} of {self.config.missions}"
        )
        self._infer_again([tau for tau in self.dataset if tau.anomalous])

    def _infer_again(self, anomalous: Sequence[Trajectory]) -> None:
        """What infers is not kept, as it may be anything: it is shown the same trajectories."""
        if anomalous:
            self.record.say(f"what infers is shown the {len(anomalous)} anomalous trajectories so far again")
        for k, tau in enumerate(anomalous, 1):
            if k == len(anomalous) or getattr(self.inference, "reads_belief", True):
                self.belief = self.inference.infer(tau)
            self.inference = self.inference.updated(tau, self.belief)  # type: ignore[arg-type]
