"""Policies: pretraining on TorchRL, adaptation in the calibrated simulator (the paper's Algorithm 1).

Needs the extra `rl`. Importing this package loads neither torch nor TorchRL; its names do.
"""

from typing import TYPE_CHECKING

from nfc_gym.core.lazy import export

if TYPE_CHECKING:
    from nfc_gym.adaptation.afterwards import LearnConfig, Learned, learn_from_mission
    from nfc_gym.adaptation.agent import Agent, ppo_agent, sac_agent
    from nfc_gym.adaptation.algorithm import AdaptConfig, Adapted, adapt
    from nfc_gym.adaptation.finetuning import FineTuneConfig
    from nfc_gym.adaptation.handover import hand_over
    from nfc_gym.adaptation.logs import write_logs
    from nfc_gym.adaptation.policy import Policy, load_policy
    from nfc_gym.adaptation.pretraining import pretrain
    from nfc_gym.adaptation.sight import Sight
    from nfc_gym.adaptation.transforms import SplitPiH

_HOME = {
    "AdaptConfig": "algorithm",
    "Adapted": "algorithm",
    "Agent": "agent",
    "FineTuneConfig": "finetuning",
    "LearnConfig": "afterwards",
    "Learned": "afterwards",
    "Policy": "policy",
    "Sight": "sight",
    "SplitPiH": "transforms",
    "adapt": "algorithm",
    "hand_over": "handover",
    "learn_from_mission": "afterwards",
    "load_policy": "policy",
    "ppo_agent": "agent",
    "pretrain": "pretraining",
    "sac_agent": "agent",
    "write_logs": "logs",
}
__all__ = [
    "AdaptConfig", "Adapted", "Agent", "FineTuneConfig", "LearnConfig", "Learned", "Policy", "Sight", "SplitPiH",
    "adapt", "hand_over", "learn_from_mission", "load_policy", "ppo_agent", "pretrain", "sac_agent", "write_logs",
]  # fmt: skip

export(__name__, _HOME, "rl")
