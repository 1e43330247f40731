"""Ways to a policy for a world, by name: those of the paper, its ablations, and references."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nfc_gym.core.errors import NfcError

from .falco import Falco
from .judge import Episodes, Uniform
from .players import control_rate, play
from .world import ERRORS, OTHERS, World

if TYPE_CHECKING:
    from .learning import Budget, Learned


REACH = 0.3  # of the prior's width, by which psi may lie beyond its bounds: as far as `psi_off` leads


class NotThere(NfcError):
    """A method lacks something; the message says what."""


@dataclass(frozen=True)
class Job:
    """One method in one world with one seed.

    Attributes:
      world: the true world.
      seed: of learning and of the episodes that judge it.
      nominal: the pretrained policy: a file, or an id whose policy comes with the package.
      posterior: checkpoint of a posterior of the same environment; None infers by `Assimilation`.
      detector: an anomaly detector or its file; None where there is none.
      budget: what it may use.
      task: of Jackal and Quadcopter; None is the first.
      folder: where states and logs go.
      world_model: file of a pretrained world model of TD-MPC2; None where there is none.
    """

    world: World
    seed: int
    nominal: str
    posterior: str | None
    detector: Any
    budget: "Budget"
    task: str | None
    folder: Path
    world_model: str | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """Of the environment."""
        return {"task": self.task} if self.task else {}

    def returns(self, policy: Any) -> np.ndarray:
        """(judged,) of a few episodes in the true world, always the same."""
        return np.array(self.played(policy, self.budget.judged, self.seed + 10_000).returns)

    def mean_return(self, policy: Any) -> float:
        """Over these, for curves."""
        return float(self.returns(policy).mean())

    def played(self, policy: Any, episodes: int, seed: int) -> Episodes:
        """Episodes in the true world."""
        return play(policy, self.world, episodes, seed, nthread=self.budget.threads, **self.settings)


Make = Callable[[Job], "Learned"]


def _fixed(policy: Any, job: Job) -> "Learned":
    from .learning import Learned

    return Learned(policy, [], {})


def random_policy(job: Job) -> "Learned":
    """Actions uniform in their box."""
    return _fixed(Uniform(job.world.kind.action_size, job.seed), job)


def falco(job: Job) -> "Learned":
    """Motion primitives with PID."""
    if job.world.robot != "jackal":
        raise NotThere("drives a Jackal alone")
    return _fixed(Falco(), job)


def unadapted(job: Job) -> "Learned":
    """The pretrained policy as it is."""
    from .learning import opened

    return _fixed(opened(job.nominal, job.budget.device), job)


def no_nfc(job: Job) -> "Learned":
    """PPO on what was executed in the true world, and on nothing else."""
    from .learning import EPISODE, improve, opened, true_world

    budget, policy = job.budget, opened(job.nominal, job.budget.device)
    envs = true_world(job.world, 1, budget, job.seed, **job.settings)
    return improve(policy, envs, job.mean_return, budget, job.seed, EPISODE * budget.executed)


def oracle(job: Job) -> "Learned":
    """PPO in as many simulations of the true world as there is time for, at its best there: what could be reached."""
    from nfc_gym.adaptation.agent import ppo_agent
    from nfc_gym.adaptation.choice import Choice

    from .learning import improve, levelled, opened, true_world

    budget, policy = job.budget, opened(job.nominal, job.budget.device)
    envs = true_world(job.world, budget.envs, budget, job.seed, **job.settings)
    choice = Choice(ppo_agent(policy), lambda: job.returns(policy))
    found = improve(policy, envs, lambda _: choice.judge(), budget, job.seed, budget.steps, choice.best)
    envs.close()
    choice.take()
    found.notes["levelled"] = levelled(found.curve)
    return found


def randomised(job: Job) -> "Learned":
    """PPO for as many steps in the package's simulator, psi uniform over the whole prior: no posterior is asked.

    As with NFC, the weights on the way that did best in such worlds are kept.
    """
    from nfc_gym.adaptation.agent import ppo_agent
    from nfc_gym.adaptation.algorithm import AdaptConfig
    from nfc_gym.adaptation.choice import Choice
    from nfc_gym.adaptation.evaluate import evaluate
    from nfc_gym.adaptation.worlds import training_env

    from .learning import EPISODE, improve, opened

    budget, policy, seed = job.budget, opened(job.nominal, job.budget.device), job.seed
    shared = {"threads": budget.threads, "spread": 1.0, "episode": EPISODE, "settings": job.settings}
    environment = f"nfc_gym/{job.world.place}-v0"
    envs = training_env(environment, budget.envs, seed=seed, **shared)
    tests = training_env(environment, min(budget.judged, AdaptConfig.judged), seed=seed, staggered=False, **shared)
    choice = Choice(ppo_agent(policy), lambda: evaluate(policy, tests, seed).returns)

    def judge(learning: Any) -> float:
        choice.judge()
        return job.mean_return(learning)

    found = improve(policy, envs, judge, budget, seed, budget.steps)
    choice.take()
    return found


def inference(job: Job) -> Any:
    """The posterior of the job; without one, replays of what was executed."""
    from nfc_gym.adaptation.assimilation import Assimilation
    from nfc_gym.core.posterior import load_source

    if job.posterior is not None:
        return load_source(job.posterior)
    known = {"map_error": ERRORS.get(job.world.robot, OTHERS)} if job.world.ground == "Rough" else {}
    return Assimilation(
        f"nfc_gym/{job.world.place}-v0", reach=REACH, seed=job.seed, nthread=job.budget.threads, **known
    )


def nfc(**config: Any) -> Make:
    """The paper's Algorithm 1; `config` of `AdaptConfig`, by which it is ablated."""

    def make(job: Job) -> "Learned":
        from nfc_gym.adaptation.agent import ppo_agent
        from nfc_gym.adaptation.algorithm import AdaptConfig, adapt

        from .learning import EPISODE, Learned, opened
        from .watching import earned_at_home, watcher

        posterior = inference(job)
        policy, budget = opened(job.nominal, job.budget.device), job.budget
        detector = job.detector or watcher(
            policy, job.world, job.seed, budget.watched, nthread=budget.threads, **job.settings
        )
        home = earned_at_home(
            policy, job.world, job.seed, budget.home, EPISODE, nthread=job.budget.threads, **job.settings
        )
        context = ["psi", "elevation"] if job.world.ground == "Rough" else ["psi"]
        given = AdaptConfig(missions=budget.executed, worlds=budget.envs, steps=budget.steps // budget.executed,
                            episode=EPISODE, judged=min(budget.judged, AdaptConfig.judged), seed=job.seed,
                            **config)  # fmt: skip
        found = adapt(
            ppo_agent(policy), job.world.single(context=context, **job.settings), posterior, detector,
            config=given, environment=f"nfc_gym/{job.world.place}-v0", folder=job.folder, threads=budget.threads,
            settings=job.settings, home=home,
        )  # fmt: skip
        curve = [(EPISODE * k, row["return"]) for k, row in enumerate(found.history)]
        return Learned(policy, curve, {"anomalies": found.anomalies, "history": found.history})

    return make


def tdmpc2(job: Job) -> "Learned":
    """A world model that was pretrained as PPO was, and learns from what was executed in the true world alone."""
    if job.world_model is None:
        raise NotThere(f"needs a world model: --world-models DIR with {job.world.place}.safetensors, which "
                       "`benchmarks/tdmpc2_pretrain.py` makes")  # fmt: skip
    from tdmpc2.speed import Speed

    from . import planned
    from .learning import EPISODE, true_world

    budget = job.budget
    envs = true_world(job.world, 1, budget, job.seed, **job.settings)
    agent = planned.opened(job.world_model, envs, budget.device, Speed(compiled=budget.compiled))
    return planned.improve(agent, envs, job.mean_return, budget, job.seed, EPISODE * budget.executed)


def measured_loop(job: Job) -> "Learned":
    """`nfc-gym close-loop` on what was executed, then `nfc-gym adapt` in the model that it wrote."""
    if job.world.ground == "Rough":
        raise NotThere("needs a model of the ground, which on rough ground nobody has")
    if job.budget.executed < 1:
        raise NotThere("needs an executed episode or more")
    from .looped import looped

    return looped(job)


@dataclass(frozen=True)
class Method:
    """One of them.

    Attributes:
      title: in tables.
      make: how it comes by a policy.
      learns: whether it makes use of a budget, so that several seeds differ in more than their episodes.
    """

    title: str
    make: Make
    learns: bool = True


METHODS: dict[str, Method] = {
    "random": Method("random", random_policy, learns=False),
    "unadapted": Method("PPO, unadapted", unadapted, learns=False),
    "nfc": Method("PPO w/ NFC", nfc()),
    "no_fidelity": Method("PPO w/o delta-fidelity", nfc(parts=("psi",))),
    "no_hallucination": Method("PPO w/o hallucination", nfc(hallucinate=False)),
    "measured_loop": Method("measured loop, then PPO in its model", measured_loop),
    "no_nfc": Method("PPO w/o NFC", no_nfc),
    "randomised": Method("domain randomisation alone", randomised),
    "oracle": Method("oracle", oracle),
    "falco": Method("Falco", falco, learns=False),
    "tdmpc2": Method("TD-MPC2", tdmpc2),
}


def run(name: str, job: Job, episodes: int) -> dict[str, Any]:
    """A method's episodes in its world, with its curve and control rate; or what is `missing`, in words."""
    try:
        learned = METHODS[name].make(job)
    except (NotThere, ImportError) as error:
        return {"missing": str(error)}
    found = job.played(learned.policy, episodes, job.seed)
    hertz = control_rate(learned.policy, job.world, **job.settings)
    return {"episodes": found.to_json(), "curve": learned.curve, "notes": learned.notes,
            "hidden": job.world.truth.text, "hertz": hertz}  # fmt: skip
