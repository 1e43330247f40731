"""A world model that acts by planning, as one safetensors file."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from nfc_gym import __version__
from nfc_gym.adaptation.policy import check_suffix
from nfc_gym.adaptation.sight import Sight
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.inference.state import read, require_format

from .planner import Planner
from .settings import Settings
from .speed import Speed
from .world_model import Sizes, WorldModel

FORMAT = "nfc_gym-tdmpc2-1"


@dataclass
class Agent:
    """Plans in a world model; call it with what an environment observes, for one step of n robots after another.

    Attributes:
      model: which.
      gamma: discount a control step.
      sight: what it looks at, and of which environment it is; None takes the vector under `observation`.
      about: plain values kept beside it.
      speed: of its plans.
    """

    model: WorldModel
    gamma: float
    sight: Sight | None = None
    about: dict[str, Any] = field(default_factory=dict)
    speed: Speed = field(default_factory=Speed, repr=False)
    _planners: dict[int, Planner] = field(default_factory=dict, repr=False)  # by n: a GPU's are captured once
    _rows: int = field(default=0, repr=False)

    def begin(self, n: int) -> None:
        """Episodes of n robots begin: what was planned before is forgotten."""
        model, self._rows = self.model, n
        if n not in self._planners:
            self._planners[n] = Planner(
                model, model.settings, self.gamma, model.sizes.action, n, model.device, self.speed
            )
        self._planners[n].begin()

    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """Actions (n, a) in [-1, 1], without exploring.

        Args:
          observation: of n robots.

        Raises:
          InputError: it is of another robot, or lacks what the model looks at.
        """
        flat = self.sight.flat(observation) if self.sight is not None else observation["observation"]
        seen = torch.from_numpy(np.atleast_2d(np.asarray(flat, np.float32)))
        if self._rows != len(seen):
            self.begin(len(seen))
        if self.model.training:
            self.model.eval()
        return self._planners[self._rows].plan(seen.to(self.model.device)).cpu().numpy()

    def require(self, envs: Any) -> None:
        """Refuse an environment, single or vector, that the model does not fit.

        Raises:
          InputError: it is of another robot, has another action space, or flat ground where elevation is looked at.
        """
        if self.sight is None:
            raise InputError("this world model is of no environment of the package")
        theirs, robot = Sight.of(envs), self.sight.environment.removeprefix("nfc_gym/")
        other = theirs.environment.removeprefix("nfc_gym/")
        space = getattr(envs, "single_action_space", envs.action_space)
        if space.shape != (self.model.sizes.action,):
            raise InputError(
                f"the world model of {robot} plans actions of {self.model.sizes.action} entries; {other} takes {space}"
            )
        if (self.sight.proprio, self.sight.goal, self.sight.cells) != (theirs.proprio, theirs.goal, theirs.cells):
            raise InputError(f"the world model is of {robot} and cannot act in {other}: {self.sight.says()}")

    def save(self, path: str | Path) -> None:
        """Write it; the old file stays until the new one is whole.

        Raises:
          InputError: the path does not end in `.safetensors`.
        """
        path = Path(path)
        check_suffix(path)
        about = {
            **self.about, "sizes": asdict(self.model.sizes), "settings": asdict(self.model.settings),
            "gamma": self.gamma, "sight": None if self.sight is None else self.sight.to_dict(),
            "versions": {"nfc_gym": __version__, "torch": str(torch.__version__)},
        }  # fmt: skip
        tensors = {k: t.detach().cpu().contiguous().clone() for k, t in self.model.state_dict().items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            save_file(tensors, part, {"format": FORMAT, "about": json.dumps(about)})


def load_agent(path: str | Path, device: str | torch.device = "cpu", speed: Speed | None = None) -> Agent:
    """Open what `Agent.save` wrote.

    Raises:
      InputError: no such file, a damaged one, or one of another format.
    """
    path = Path(path)
    tensors, metadata = read(path)
    require_format(path, metadata, FORMAT)
    try:
        about = json.loads(metadata["about"])
        sight, gamma = about.pop("sight"), float(about.pop("gamma"))
        model = WorldModel(Sizes(**about.pop("sizes")), Settings(**about.pop("settings")))
        model.load_state_dict(tensors)
        seen = None if sight is None else Sight.from_dict(sight)
    except (KeyError, TypeError, ValueError, RuntimeError) as e:
        raise InputError(f"{path}: its metadata and weights are no world model that is known here ({e})") from None
    return Agent(model.to(device).eval(), gamma, seen, about, speed or Speed())
