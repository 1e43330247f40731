"""One shard: what its arrays say is what was simulated."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import safetensors.numpy

from nfc_gym.core import InputError
from nfc_gym.simulate.residuals import Given
from nfc_gym.simulate.roll import roll
from nfc_gym.simulate.run import _manifest
from nfc_gym.simulate.shard import Plan, _labels, _task, make_shard, workshop
from nfc_gym.simulate import ground


def plan(environment: str, windows: int, seed: int = 0, effects: float = 0.5, **more) -> Plan:
    return Plan(_manifest(environment, windows, seed, windows, {}), effects=effects, **more)


@cache
def shard(environment: str, windows: int, seed: int = 0, effects: float = 0.5) -> dict[str, np.ndarray]:
    return safetensors.numpy.load(make_shard(plan(environment, windows, seed, effects), 0))


def test_any_number_of_threads_gives_the_same_bits() -> None:
    made = plan("nfc_gym/JackalRough-v0", 24)
    assert make_shard(made, 0, nthread=1) == make_shard(made, 0, nthread=3)


def test_seeds_and_shards_differ() -> None:
    made = plan("nfc_gym/JackalFlat-v0", 8)
    other = replace(made, manifest=replace(made.manifest, seed=1))
    assert len({make_shard(made, 0), make_shard(made, 1), make_shard(other, 0)}) == 3
