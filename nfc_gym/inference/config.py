"""What a network is built from: plain values that a checkpoint holds."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.data import Batch

DENSITIES = ("score", "mixture", "flow")


@dataclass(frozen=True)
class NetworkConfig:
    """What is built; the defaults are the paper's "SDE + TCN".

    Attributes:
      encoder: of the motion: tcn, nn, qmc-rff, qmc-fks, or none.
      density: of (psi, delta_s): score, mixture or flow.
      width: of the layers of the encoder `nn`.
      summaries: physics summaries beside the encoder.
      elevation: the elevation map beside the encoder.
      linear: densities start from what a ridge regression tells (`LinearBase`): on the physics summaries where they are
        on, else on the window itself. False starts from the prior.
      delta_s: infer the residual dynamics too.
      delta_e: infer the residual terrain too; needs `elevation` and the score model.
      families: names of the families of effects, the first "none", where a structure head is wanted.
      features: width of the layer that the encoders' features are mapped to; 0 hands them on as they are.
      hidden: width of the heads' layers.
      depth: residual blocks of the score model, transforms of the flow.
      dropout: in the score model's blocks.
      draws: noise draws a window and step, of the score model.
      components: of the mixture.
    """

    encoder: str = "tcn"
    density: str = "score"
    width: int = 1024
    summaries: bool = False
    elevation: bool = False
    linear: bool = False
    delta_s: bool = False
    delta_e: bool = False
    families: tuple[str, ...] = ()
    features: int = 1024
    hidden: int = 256
    depth: int = 4
    dropout: float = 0.0
    draws: int = 4
    components: int = 8

    def __post_init__(self) -> None:
        if isinstance(self.families, str):  # whose letters would be taken for names
            raise InputError(f"structure head: families is a tuple of names, got {self.families!r}")
        object.__setattr__(self, "families", tuple(self.families))
        if self.density not in DENSITIES:
            raise InputError(f"no density named {self.density!r}; there are: {', '.join(DENSITIES)}")
        if self.delta_e and not (self.elevation and self.density == "score"):
            raise InputError(
                "network: delta_e is inferred from an elevation map, by the score model: "
                f"want elevation=True, density='score', got {self.elevation}, {self.density!r}"
            )
        if len(self.families) == 1:
            raise InputError(f"structure head: two families or more, the first 'none', got {self.families}")
        if len(set(self.families)) < len(self.families):
            raise InputError(f"structure head: families named twice: {', '.join(self.families)}")
        for name in ("width", "hidden", "depth", "draws", "components"):
            require_whole(f"network: {name}", getattr(self, name), 1)
        require_whole("network: features", self.features, 0)
        if not 0 <= self.dropout < 1:
            raise InputError(f"network: dropout is a share in [0, 1), got {self.dropout:g}")

    def to_dict(self) -> dict[str, Any]:
        """Plain values that JSON holds."""
        return asdict(self)


@dataclass(frozen=True)
class Sizes:
    """Sizes of a window: `horizon` H steps, `states` s, `actions` a.

    Attributes:
      layout: of joints, for the physics summaries.
      place: which states say where the robot is, which is then left out (`encoders.place.place_of`).
    """

    horizon: int
    states: int
    actions: int
    layout: Mapping[str, Any] | None = None
    place: Mapping[str, Any] | None = None

    @classmethod
    def of(
        cls, batch: Batch, layout: Mapping[str, Any] | None = None, place: Mapping[str, Any] | None = None
    ) -> "Sizes":
        """Those of a batch of windows."""
        actions = batch["actions"]
        return cls(actions.shape[1], batch["states"].shape[2], actions.shape[2], layout, place)
