"""Lets the tests here import `problems`, their helper; one thread and one seed, so that they agree to the bit."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _own_seed() -> None:
    torch.manual_seed(0)
