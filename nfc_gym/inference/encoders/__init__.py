"""From a window to features: one interface, (states, actions, map) -> (B, features), for every method compared."""

from nfc_gym.inference.encoders.base import Encoder, Signals
from nfc_gym.inference.encoders.joined import ENCODERS, Joined
from nfc_gym.inference.encoders.summaries import Regressions, Summaries

__all__ = ["ENCODERS", "Encoder", "Joined", "Regressions", "Signals", "Summaries"]
