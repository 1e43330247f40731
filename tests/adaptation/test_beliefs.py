"""What is asked of posteriors for worlds to be made of it."""

import numpy as np
import pytest

from nfc_gym.adaptation.beliefs import Fixed
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior
from nfc_gym.inference.space import PriorBox


@pytest.mark.parametrize("delta_s", [False, True])
def test_the_ground_around_the_robot_is_not_asked_of_a_network(delta_s: bool) -> None:
    """Worlds are whole maps, and a draw of it takes seconds."""
    prior = PriorBox("toy", ("a",), ("1",), (0.0,), (1.0,))
    config = NetworkConfig(features=8, hidden=8, depth=1, elevation=True, delta_s=delta_s, delta_e=True)
    network = Network(config, Sizes(8, 3, 2), prior)
    seen = Trajectory(
        np.zeros((9, 3)), np.zeros((8, 2)), np.zeros(8), np.zeros(8), 1.0, np.zeros((9, 0)), np.zeros((128, 128))
    )
    drawn = Fixed(NeuralPosterior(network)).infer(seen).sample(3, np.random.default_rng(0))
    assert drawn.given == (("psi", "delta_s") if delta_s else ("psi",))
