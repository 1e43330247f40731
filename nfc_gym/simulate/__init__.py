"""Training sets of simulated windows, made on the vector engine: into a folder, or in memory for sequential rounds."""

from nfc_gym.simulate.repeated import Repeated
from nfc_gym.simulate.rounds import Simulator
from nfc_gym.simulate.run import simulate

__all__ = ["Repeated", "Simulator", "simulate"]
