"""Training sets of simulated windows, made on the vector engine: `simulate` and what reads its sets back as terrain."""

from nfc_gym.simulate.run import simulate

__all__ = ["simulate"]
