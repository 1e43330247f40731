"""What the steps of one run of the loop share."""

from collections.abc import Callable
from dataclasses import dataclass

from nfc_gym.measured.bench import Bench
from nfc_gym.measured.stages import Stages


@dataclass
class Run:
    """What the steps of one run share."""

    bench: Bench
    stages: Stages
    seed: int
    say: Callable[[str], None]
