"""Wrappers around any Gymnasium MuJoCo environment."""

from nfc_gym.wrappers.dynamics import ResidualDynamics
from nfc_gym.wrappers.effects import ApplyEffects
from nfc_gym.wrappers.psi import RandomizePsi

__all__ = ["ApplyEffects", "RandomizePsi", "ResidualDynamics"]
