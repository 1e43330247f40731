"""A policy as one safetensors file: actor, critic and the scale of observations, and in the metadata all about it."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torchrl
from numpy.typing import NDArray
from safetensors.torch import save_file
from torchrl.modules import ProbabilisticActor

from nfc_gym import __version__, assets
from nfc_gym.adaptation.network import CLIP, ActorCritic, Sizes
from nfc_gym.adaptation.sight import Sight
from nfc_gym.adaptation.weights import of_weights
from nfc_gym.adaptation.worlds import robot_of
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.inference.state import read, require_format
from nfc_gym.simulate.machine import full_id
from nfc_gym.simulate.policy import Perceptron

FORMAT = "nfc_gym-policy-1"
SUFFIX = ".safetensors"
_MEASURED = ("steps", "seconds", "nominal", "command", "device", "weights")  # that are of some weights and no others


@dataclass
class Policy:
    """A trained policy: call it with what an environment observes.

    Attributes:
      sight: what it looks at, and of which environment it is.
      network: actor and critic.
      about: plain values kept beside it: seed, command, versions, steps, returns, and the digest of the weights that
        they are of; where others are saved, what was said of these stands under `before`.
    """

    sight: Sight
    network: ActorCritic
    about: dict[str, Any] = field(default_factory=dict)

    @torch.no_grad()
    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """The mean action (..., action_size) in [-1, 1].

        Args:
          observation: of the policy's environment, one or many, with any context (see `Sight.flat`).

        Raises:
          InputError: it is of another robot, or lacks what the policy looks at.
        """
        flat = torch.from_numpy(np.ascontiguousarray(self.sight.flat(observation)))
        mean, _ = self.network.gaussian(flat.to(self.network.scale.mean.device))
        return mean.cpu().numpy()

    @property
    def actor(self) -> ProbabilisticActor:
        """The TorchRL actor, `observation` -> `action`; it shares the policy's weights."""
        return self.network.actor

    def perceptron(self) -> Perceptron:
        """The mean action as plain arrays, which other processes can be sent without torch."""
        network = self.network
        layers = [m for m in network.gaussian.body if isinstance(m, torch.nn.Linear)]
        arrays = [tuple(t.detach().cpu().numpy().copy() for t in (m.weight, m.bias)) for m in layers]
        scale = network.scale
        return Perceptron(
            tuple(w for w, _ in arrays), tuple(b for _, b in arrays), scale.mean.cpu().numpy().copy(),
            scale.spread.cpu().numpy().copy(), "elu", CLIP, True, self.sight.cells,
            f"of {self.sight.environment}",
        )  # fmt: skip

    def settings(self, environment: str) -> dict[str, Any]:
        """Of an environment of the policy's robot, by its full id: the task that training was told, where it was."""
        task = self.about.get("training", {}).get("task")
        return {"task": task} if task and robot_of(environment) == robot_of(self.sight.environment) else {}

    def require(self, envs: Any) -> None:
        """Refuse an environment, single or vector, that the policy does not fit.

        Raises:
          InputError: it is of another robot, has another action space, or the policy's cells of elevation need rough
            ground and it has none.
        """
        theirs = Sight.of(envs)
        mine, action = self.sight, self.network.sizes.action
        robot, other = (name.removeprefix("nfc_gym/") for name in (mine.environment, theirs.environment))
        if (mine.proprio, mine.goal) != (theirs.proprio, theirs.goal):
            raise InputError(f"the policy is of {robot} and cannot act in {other}: {mine.says()}")
        size = int(getattr(envs, "single_action_space", envs.action_space).shape[0])
        if size != action:
            raise InputError(f"the policy of {robot} gives actions of {action} entries; {other} takes {size}")
        if mine.cells is not None and theirs.cells is None:
            raise InputError(f"the policy of {robot} looks at elevation, and {other} is flat ground")

    def save(self, path: str | Path) -> None:
        """Write it; the old file stays until the new one is whole.

        Raises:
          InputError: the path does not end in `.safetensors`.
        """
        path = Path(path)
        check_suffix(path)
        versions = {
            "nfc_gym": __version__, "torch": str(torch.__version__), "torchrl": str(torchrl.__version__),
        }  # fmt: skip
        tensors = {k: t.detach().cpu().contiguous().clone() for k, t in unique(self.network.state_dict()).items()}
        about = _said_of(of_weights(self.network), self.about)
        about |= {"sight": self.sight.to_dict(), "sizes": asdict(self.network.sizes), "versions": versions}
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            save_file(tensors, part, {"format": FORMAT, "about": json.dumps(about)})


def _said_of(digest: str, about: dict[str, Any]) -> dict[str, Any]:
    """What may be said of the weights with this digest: steps and returns of others were theirs."""
    if about.get("weights", digest) == digest:
        return {**about, "weights": digest}
    kept = {k: v for k, v in about.items() if k not in _MEASURED}
    return {**kept, "weights": digest, "before": {k: about[k] for k in _MEASURED if k in about}}


def taught(network: ActorCritic, sight: Sight, by: Policy) -> int:
    """Give a network the weights of a policy of the same robot, which may see less.

    What both see keeps its weights; those of cells of elevation that the policy does not know start at zero, so that
    the network acts as the policy does whatever they show.

    Args:
      network: to be given them.
      sight: what it sees.
      by: whose weights.

    Returns:
      How many leading entries of the observation the policy knows.

    Raises:
      InputError: another robot, other layers or another action; or it sees cells that the network does not.
    """
    mine, theirs = network.sizes, by.network.sizes
    if (sight.proprio, sight.goal) != (by.sight.proprio, by.sight.goal) or mine.action != theirs.action:
        raise InputError(f"start: {by.sight.says()}, actions {theirs.action}; wanted one of {sight.environment}")
    if mine.hidden != theirs.hidden:
        raise InputError(f"start: the policy has layers {theirs.hidden}, wanted {mine.hidden}: use the same --net")
    known = theirs.observation
    if by.sight.cells not in (None, sight.cells):
        raise InputError(f"start: the policy of {by.sight.environment} sees cells that this one does not")
    state = {k: v.clone() for k, v in network.state_dict().items()}
    for key, given in by.network.state_dict().items():
        own = state[key]
        if own.shape == given.shape:
            own.copy_(given)
        elif own.ndim == 1:  # of the scale: what was not known before starts as it is
            own[:known] = given
        else:  # a first layer: (hidden, observation) or, of the critic, (hidden, observation and psi)
            own.zero_()
            own[:, :known] = given[:, :known]
            psi = given.shape[1] - known
            own[:, own.shape[1] - psi :] = given[:, known:]
    network.load_state_dict(state)
    return known


def check_suffix(path: Path) -> None:
    """Raises `InputError` where a policy cannot be kept at `path`."""
    if path.suffix.lower() != SUFFIX:
        raise InputError(f"{path}: a policy is kept in a file that ends in {SUFFIX}")


def unique(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A state without the names under which actor and critic hold the scale that they share."""
    return {k: t for k, t in state.items() if not k.startswith(("gaussian.scale.", "value.scale."))}


def restore(network: ActorCritic, tensors: Mapping[str, torch.Tensor]) -> None:
    """The inverse of `unique`, into a network."""
    missing, unexpected = network.load_state_dict(dict(tensors), strict=False)
    absent = [k for k in missing if not k.startswith(("gaussian.scale.", "value.scale."))]
    if absent or unexpected:
        raise RuntimeError(f"weights: missing {absent}, unexpected {unexpected}")


def load_policy(source: str | Path, device: str | torch.device = "cpu") -> Policy:
    """Open a policy.

    Args:
      source: a file, or the id of an environment, whose pretrained policy comes with the package.
      device: where its network is to be.

    Raises:
      InputError: no such file, no pretrained policy of that id, a damaged file or one of another format.
    """
    path = Path(source)
    if path.suffix.lower() != SUFFIX:
        if path.exists():
            raise InputError(f"policy {path}: want a {SUFFIX} file that `nfc-gym pretrain` or `adapt` wrote")
        path = _pretrained(str(source))
    if not path.is_file():
        raise InputError(f"policy {path}: no such file; want one that `nfc-gym pretrain` wrote, or an environment's id")
    tensors, metadata = read(path)
    require_format(path, metadata, FORMAT)
    try:
        about = json.loads(metadata["about"])
        sizes = about.pop("sizes")
        network = ActorCritic(Sizes(**{**sizes, "hidden": tuple(sizes["hidden"])}))
        sight = Sight.from_dict(about.pop("sight"))
        restore(network, tensors)
        about.setdefault("weights", of_weights(network))
    except (KeyError, TypeError, ValueError, RuntimeError) as e:
        raise InputError(f"{path}: its metadata and weights are no policy that this version knows ({e})") from None
    return Policy(sight, network.to(device).eval(), about)


def _pretrained(name: str) -> Path:
    full = full_id(name)
    path = assets.policy(full.removeprefix("nfc_gym/"))
    if not path.is_file():
        have = ", ".join(sorted(p.stem for p in path.parent.glob(f"*{SUFFIX}"))) or "none yet"
        raise InputError(f"no pretrained policy of {full} comes with this package (there are: {have}); make one with "
                         f"`nfc-gym pretrain {full} --out policy.safetensors`")  # fmt: skip
    return path
