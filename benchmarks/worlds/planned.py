"""TD-MPC2 as the tables want it: a pretrained world model that goes on learning from what is executed alone."""

import time
from collections.abc import Callable
from dataclasses import replace

import torch
from gymnasium.vector import VectorEnv
from tdmpc2.agent import Agent, load_agent
from tdmpc2.run import Run, Schedule
from tdmpc2.speed import Speed

from nfc_gym.adaptation.ppo import Diverged

from .learning import EPISODE, Budget, Learned


def opened(file: str, envs: VectorEnv, device: str, speed: Speed | None = None) -> Agent:
    """A copy of the pretrained world model, which must fit the world.

    Raises:
      InputError: no such file, or it is of another robot or of other actions.
    """
    agent = load_agent(file, device, speed)
    agent.require(envs)
    return agent


def improve(
    agent: Agent, envs: VectorEnv, judge: Callable[[Agent], float], budget: Budget, seed: int, steps: int,
) -> Learned:  # fmt: skip
    """TD-MPC2 in an environment, from where a world model is, with all its losses as in pretraining.

    Nothing of what was seen in pretraining is used again. The first episode is acted by the model as it was; learning
    begins with as many updates at once, as the authors begin after their first episodes.

    Args:
      agent: learns in place.
      envs: in which it acts; a `VectorSight`.
      judge: agent -> mean return in the true world.
      budget: see `Budget`.
      seed: of actions, episodes and batches.
      steps: control steps of all simulations together.
    """
    torch.manual_seed(seed)
    curve, began, notes = [(0, judge(agent))], time.monotonic(), {}
    schedule = Schedule(seed=seed, first=min(EPISODE, steps), random=False, ratio=budget.ratio)
    # Its updates are too few for it to pay that they are compiled; the plans by which it is judged are not.
    plain = replace(agent.speed, compiled=False)
    run = Run(envs, agent.model, agent.gamma, schedule, most=steps, speed=plain)
    marks = [steps * (k + 1) // budget.points for k in range(budget.points)]

    def mark(done: int) -> None:
        if marks and done >= marks[0]:
            marks[:] = [m for m in marks if m > done]
            curve.append((done, judge(agent)))

    try:
        run.train(steps, budget.seconds, mark=mark)
    except Diverged as error:  # what was learned until then holds
        notes["diverged"] = str(error)
    if budget.points and curve[-1][0] < run.steps:
        curve.append((run.steps, judge(agent)))
    notes |= {"steps": run.steps, "updates": run.learner.updates, "seconds": round(time.monotonic() - began, 1),
              "executed": run.returns()}  # fmt: skip
    return Learned(agent, curve, notes)
