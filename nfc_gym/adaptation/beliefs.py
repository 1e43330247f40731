"""What infers psi and residual fidelity from a trajectory, as `adapt` asks for it.

Anything with `sample(n, rng)` will do: what it believes then does not depend on what was seen. With `given(window)` as
well, like the neural posterior, it is given the window that ends at the alarm; a robot that fell before a window was
full has shown too little, and what is believed is the prior. `Sequential` adds the paper's online
rounds to a neural posterior; `Assimilation` (in a module of its own) needs no network.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from nfc_gym.adaptation.imagined import among, spoken
from nfc_gym.adaptation.trajectory import Dataset, Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.posterior import Sampler, without_maps
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.proposals import TRUNCATED, SequentialConfig
from nfc_gym.inference.sequential import sequential
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig
from nfc_gym.physics.parameters import ParameterSpace


@runtime_checkable
class Inference(Protocol):
    """From a trajectory to a belief, and on to the next trajectory.

    One with an attribute `parts` says before the first trajectory what its beliefs speak of. One whose `reads_belief`
    is False makes nothing of the belief in `updated`: a run that goes on need not infer it again.
    """

    def infer(self, trajectory: Trajectory) -> Sampler:
        """What the trajectory tells."""
        ...

    def updated(self, trajectory: Trajectory, belief: Sampler) -> "Inference":
        """What to infer with from now on."""
        ...


@dataclass(frozen=True)
class Unseen:
    """Draws of psi's prior: what is believed where too little was seen."""

    prior: PriorBox

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """`n` draws, uniform in the box; parameters that are not free are nominal."""
        low, high, nominal, free = (np.array(getattr(self.prior, k)) for k in ("low", "high", "nominal", "free"))
        return Fidelity(psi=np.where(free, rng.uniform(low, high, (n, len(low))), nominal))


def asked(posterior: Any, trajectory: Trajectory) -> Window | None:
    """The window that a posterior is asked about: up to the alarm, or else all; None where that is too short for it."""
    least = posterior.network.sizes.horizon if isinstance(posterior, NeuralPosterior) else 0
    parts = (trajectory.until_alarm(), trajectory)
    return next((part.window() for part in parts if len(part) >= least), None)


def believed(posterior: Any, trajectory: Trajectory) -> Sampler:
    """What a posterior with `given` says of a trajectory."""
    window = asked(posterior, trajectory)
    return Unseen(posterior.prior) if window is None else posterior.given(window)


@dataclass(frozen=True)
class Fixed:
    """A posterior that is used as it is.

    Attributes:
      posterior: with `sample`, or with `given(window)` that makes such a one.
    """

    reads_belief: ClassVar[bool] = False
    posterior: Any

    def infer(self, trajectory: Trajectory) -> Sampler:
        """See `Inference`."""
        given = getattr(self.posterior, "given", None)  # of a `Fidelity`, the names of its parts
        return believed(self.posterior, trajectory) if callable(given) else self.posterior

    def updated(self, trajectory: Trajectory, belief: Sampler) -> "Fixed":
        """Itself."""
        return self


@dataclass
class Sequential:
    """A neural posterior that simulates around what it believes, and learns from that, after each anomaly.

    Attributes:
      posterior: pretrained; a copy of its network is trained further, so that earlier beliefs stay what they were.
      simulate: psi -> windows, `nfc_gym.simulate.Simulator` of the environment.
      rounds: see `inference.sequential`; the first draws from the prior, later ones where the posterior has mass.
      training: of each round.

    Raises:
      InputError: rounds of a posterior's own draws: what is corrected for one window misleads about the next.
    """

    reads_belief: ClassVar[bool] = False
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
        return believed(self.posterior, trajectory)

    def updated(self, trajectory: Trajectory, belief: Sampler) -> "Sequential":
        """Sequential NFC: rounds of simulations that close in on the window; without a whole one there are none."""
        window = asked(self.posterior, trajectory)
        if window is None:
            return self
        network = deepcopy(self.posterior.network)
        sequential(network, self.simulate, window, self.rounds, self.training, scales=False)
        return Sequential(NeuralPosterior(network), self.simulate, self.rounds, self.training)

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


def width(belief: Sampler, space: ParameterSpace) -> float:
    """Mean standard deviation of a belief's psi over that of a uniform prior between a space's bounds; nan without psi.

    Raises:
      InputError: its psi is of another width.
    """
    psi = _psi(belief, 256, space)
    return float("nan") if psi is None else float((psi.std(0) / ((space.high - space.low) / 12**0.5)).mean())


def require_width(posterior: Any, space: ParameterSpace) -> None:
    """Refuse what infers other parameters than a space's, where that shows before there is a trajectory.

    Raises:
      InputError: naming both widths.
    """
    posterior = getattr(posterior, "posterior", posterior)
    if isinstance(posterior, NeuralPosterior):
        _require(len(posterior.prior.low), space)
    elif isinstance(posterior, Sampler):
        _psi(posterior, 1, space)


def require_spoken(posterior: Any, wanted: Sequence[str]) -> None:
    """Refuse parts of a belief of which what infers never speaks, where that shows before there is a trajectory.

    Raises:
      InputError: naming what it speaks of.
    """
    posterior = posterior.posterior if isinstance(posterior, Fixed | Sequential) else posterior
    if isinstance(posterior, NeuralPosterior):
        among(posterior.parts, wanted)
    elif isinstance(posterior, Inference):
        among(getattr(posterior, "parts", wanted), wanted)
    elif not callable(getattr(posterior, "given", None)):  # of a `Fidelity`, the names of its parts
        spoken(posterior, wanted)


def _psi(belief: Sampler, n: int, space: ParameterSpace) -> np.ndarray | None:
    """(n, d) draws of its psi; None where it says nothing of it."""
    drawn = without_maps(belief).sample(n, np.random.default_rng(0))
    if not isinstance(drawn, Fidelity):
        raise InputError(
            f"adapt: the posterior's sample(n, rng) must return a Fidelity, such as Fidelity(psi=array), got "
            f"{type(drawn).__name__}"
        )
    if drawn.psi is not None:
        _require(drawn.psi.shape[-1], space)
    return drawn.psi


def _require(size: int, space: ParameterSpace) -> None:
    if size != len(space):
        raise InputError(
            f"adapt: the posterior's psi has {size} entries, the world's {len(space)}: {', '.join(space.names)}"
        )
