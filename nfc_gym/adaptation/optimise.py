"""Policy-Opt: an agent, with pi_h beside it or without, learns in some worlds."""

import copy
from contextlib import closing
from typing import Any

import torch
from gymnasium.vector import VectorEnv

from nfc_gym.adaptation.agent import Agent
from nfc_gym.adaptation.choice import Choice
from nfc_gym.adaptation.gathering import RayWorlds, gathered
from nfc_gym.adaptation.hallucination import hallucination, widened
from nfc_gym.adaptation.network import Gaussian
from nfc_gym.adaptation.ppo import Diverged
from nfc_gym.adaptation.record import Episodes, Record, in_words
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.core.errors import InputError
from nfc_gym.inference.random import mixed


def pi_h_for(agent: Agent, worlds: VectorSight | RayWorlds, seed: int) -> Gaussian | None:
    """An untrained pi_h for the entries that the worlds' action has beyond the agent's; None where there are none.

    Raises:
      InputError: the worlds' action is shorter than the agent's.
    """
    more = int(worlds.single_action_space.shape[0]) - agent.action_size()  # type: ignore[index]
    if more < 0:
        raise InputError(f"optimise: the agent's actions have {-more} entries more than the worlds take")
    torch.manual_seed(seed)
    return hallucination(agent.sight.size, more).to(agent.device) if more else None


def optimise(
    agent: Agent, worlds: VectorEnv | RayWorlds, steps: int, *, pi_h: Gaussian | None = None, seed: int = 0,
    record: Record | None = None, before: int = 0, choice: Choice | None = None, points: int = 1,
) -> dict[str, Any]:  # fmt: skip
    """Train an agent for the return in some worlds; it learns in place.

    Where the worlds hallucinate, `pi_h` learns with it. A loss that comes apart leaves both as they were.

    Args:
      agent: which.
      worlds: vector environment of this package, with `context=["psi"]` and `autoreset_mode="Disabled"`; made by
        `imagined`, or any other: the true world itself for an oracle; or on a cluster (`RayWorlds`).
      steps: control steps of all simulations together.
      pi_h: see `pi_h_for`.
      seed: of actions, of the worlds' draws and of what the agent's loss makes anew, such as critics.
      record: what is written down.
      before: steps that were taken in earlier calls, by which curves are drawn.
      choice: judges the agent's weights on the way; the agent has the last ones until it takes the best.
      points: how often they are judged, at equal distances, the last time at the end.

    Returns:
      `imagined_before`, the mean return of each world's first episode, during which learning has begun already, and
      `imagined_after`, of the last episodes that ended, both None where not each world has ended one; of a choice
      `chosen`, the mean return of the best; where the loss came apart `diverged`, why.
    """
    if not isinstance(worlds, VectorSight | RayWorlds):
        worlds = VectorSight(worlds, agent.sight)
    size = int(worlds.single_action_space.shape[0])  # type: ignore[index]
    actor = agent.actor if pi_h is None else widened(agent.actor, pi_h)
    torch.manual_seed(mixed(seed, 0))  # of critics that a loss makes anew, too
    learner = agent.learner(actor, size)
    kept = [(m, copy.deepcopy(m.state_dict())) for m in (learner.loss, actor)]
    record, episodes, done, judged = record or Record(None, None), Episodes(), 0, 0
    if isinstance(worlds, RayWorlds):
        worlds.restarted = episodes.forget
    try:
        with closing(gathered(worlds, actor, learner.horizon(worlds.num_envs), agent.device, mixed(seed, 1))) as drawn:
            while done < steps:
                batch = next(drawn)
                if pi_h is not None and pi_h.scale.count == 0:
                    pi_h.scale.see(batch["observation"])
                values = learner.learn(batch)
                episodes.see(batch)
                done += batch.numel()
                said = f"{done:,}/{steps:,} steps in {worlds.num_envs} worlds"
                _tell(record, before + done, values, episodes, said, done >= steps)
                if choice is not None and done * points >= (judged + 1) * steps:
                    record.scalars(before + done, {"worlds/judged": choice.judge()})
                    judged = done * points // steps
    except Diverged as e:
        for module, state in kept:
            module.load_state_dict(state)
        return {"diverged": str(e)}
    first = episodes.first
    after = None if first is None else episodes.means().get("return")
    told = {"imagined_before": first, "imagined_after": after}
    return told if choice is None else told | {"chosen": choice.best}


def _tell(
    record: Record, at: int, values: dict[str, float], episodes: Episodes, said: str, last: bool
) -> None:  # fmt: skip
    """What an iteration came to, written down and said; no means before each world has ended an episode."""
    found = {} if episodes.first is None else episodes.means()
    record.scalars(at, {f"worlds/{k}": v for k, v in (values | found).items()})
    record.line(f"{said}  {in_words(found) or 'their first episodes have not all ended'}", last)
