"""What the tests of simulation share."""

import numpy as np
import pytest
import safetensors.numpy

from nfc_gym.simulate.run import manifest_of
from nfc_gym.simulate.shard import Plan, make_shard


@pytest.fixture(scope="session")
def jackal() -> dict[str, np.ndarray]:
    """Eight windows of a Jackal on a plane, without effects."""
    plan = Plan(manifest_of("nfc_gym/JackalFlat-v0", 8, 0, 8, {}), effects=0.0)
    return safetensors.numpy.load(make_shard(plan, 0))
