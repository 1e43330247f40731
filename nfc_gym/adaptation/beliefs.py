"""What infers psi and residual fidelity from a trajectory, as `adapt` asks for it.

Anything with `sample(n, rng)` will do: what it believes then does not depend on what was seen. With `given(window)` as
well, like the neural posterior, it is given the window that ends at the alarm. `Sequential` adds the paper's online
rounds to a neural posterior; `Assimilation` (in a module of its own) needs no network.
"""

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from nfc_gym.adaptation.trajectory import Dataset, Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.core.posterior import Sampler
from nfc_gym.inference.posterior import NeuralPosterior
from nfc_gym.inference.proposals import TRUNCATED, SequentialConfig
from nfc_gym.inference.sequential import sequential
from nfc_gym.inference.train import TrainConfig


@runtime_checkable
class Inference(Protocol):
    """From a trajectory to a belief, and on to the next trajectory."""

    def infer(self, trajectory: Trajectory) -> Sampler:
        """What the trajectory tells."""
        ...

    def updated(self, trajectory: Trajectory, belief: Sampler) -> "Inference":
        """What to infer with from now on."""
        ...


@dataclass(frozen=True)
class Fixed:
    """A posterior that is used as it is.

    Attributes:
      posterior: with `sample`, or with `given(window)` that makes such a one.
    """

    posterior: Any

    def infer(self, trajectory: Trajectory) -> Sampler:
        """See `Inference`."""
        given = getattr(self.posterior, "given", None)  # of a `Fidelity`, the names of its parts
        if callable(given):
            return self.posterior.given(trajectory.until_alarm().window())
        return self.posterior

    def updated(self, trajectory: Trajectory, belief: Sampler) -> "Fixed":
        """Itself."""
        return self


@dataclass
class Sequential:
    """A neural posterior that simulates around what it believes, and learns from that, after each anomaly.

    Attributes:
      posterior: pretrained; its network is trained further, in place.
      simulate: psi -> windows, `nfc_gym.simulate.Simulator` of the environment.
      rounds: see `inference.sequential`; the first draws from the prior, later ones where the posterior has mass.
      training: of each round.

    Raises:
      InputError: rounds of a posterior's own draws: what is corrected for one window misleads about the next.
    """

    posterior: NeuralPosterior
    simulate: Any
    rounds: SequentialConfig = field(default_factory=lambda: SequentialConfig(rounds=2))
    training: TrainConfig = field(default_factory=lambda: TrainConfig(epochs=20))

    def __post_init__(self) -> None:
        if self.rounds.proposal != TRUNCATED:
            raise InputError(
                f"Sequential: rounds want proposal={TRUNCATED!r}, got {self.rounds.proposal!r}: what a network learns "
                "from a posterior's own draws is right for one window alone, and the next trajectory is another"
            )

    def infer(self, trajectory: Trajectory) -> Sampler:
        """See `Inference`."""
        return self.posterior.given(trajectory.until_alarm().window())

    def updated(self, trajectory: Trajectory, belief: Sampler) -> "Sequential":
        """Sequential NFC: rounds of simulations that close in on the window."""
        window = trajectory.until_alarm().window()
        sequential(self.posterior.network, self.simulate, window, self.rounds, self.training, scales=False)
        return Sequential(NeuralPosterior(self.posterior.network), self.simulate, self.rounds, self.training)

    def fine_tuned(self, dataset: Dataset) -> "Sequential":
        """After the mission: rounds for every anomalous trajectory that was gathered."""
        now = self
        for trajectory in dataset:
            if trajectory.anomalous:
                now = now.updated(trajectory, now.posterior)
        return now


def inference_of(posterior: Any) -> Inference:
    """What `adapt` was given, as an `Inference`.

    Raises:
      InputError: it neither infers nor can be drawn from.
    """
    if isinstance(posterior, Inference):
        return posterior
    if isinstance(posterior, Sampler):
        return Fixed(posterior)
    raise InputError(
        f"adapt: a posterior has sample(n, rng), or given(window), or infer(trajectory); got {posterior!r}"
    )


def width(belief: Sampler, low: np.ndarray, high: np.ndarray) -> float:
    """Mean standard deviation of a belief's psi over that of a uniform prior between bounds; nan without psi."""
    psi = belief.sample(256, np.random.default_rng(0)).psi
    return float("nan") if psi is None else float((psi.std(0) / ((high - low) / 12**0.5)).mean())
