"""The state of learning as one safetensors file: networks, an optimiser, and plain values that say how far it is."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import Tensor, nn, optim

from nfc_gym.core.differences import differences
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.inference.state import read, require_format

FORMAT = "nfc_gym-learning-1"


def save(
    path: Path,
    modules: Mapping[str, nn.Module],
    optimiser: optim.Optimizer | None,
    plain: Mapping[str, Any],
    of: Mapping[str, Any],
) -> None:
    """Write a state; the old one stays until the new one is whole.

    Args:
      path: of the file.
      modules: by name.
      optimiser: of them, if it is to go on too.
      plain: what JSON can hold, and the run needs to go on.
      of: what another run must have in common with this one to go on from it.
    """
    tensors: dict[str, Tensor] = {}
    for name, module in modules.items():
        tensors |= {f"{name}/{k}": t for k, t in module.state_dict().items()}
    inner = {"state": {}, "param_groups": []} if optimiser is None else optimiser.state_dict()
    for i, entry in inner["state"].items():
        tensors |= {f"optimiser/{i}/{k}": t for k, t in entry.items()}
    rates = [group["lr"] for group in inner["param_groups"]]
    told = json.dumps({"plain": dict(plain), "of": dict(of), "rates": rates})
    tensors = {k: t.detach().cpu().contiguous().clone() for k, t in tensors.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        save_file(tensors, part, {"format": FORMAT, "state": told})


def plain(path: Path) -> dict[str, Any]:
    """The plain values of a state alone; raises `InputError` where the file is damaged."""
    _, metadata = read(path)
    require_format(path, metadata, FORMAT)
    return json.loads(metadata["state"])["plain"]


def described(path: Path) -> dict[str, Any]:
    """What the run of a state was of; raises `InputError` where the file is damaged."""
    _, metadata = read(path)
    require_format(path, metadata, FORMAT)
    return json.loads(metadata["state"])["of"]


def load(
    path: Path, modules: Mapping[str, nn.Module], optimiser: optim.Optimizer | None, of: Mapping[str, Any]
) -> dict[str, Any]:
    """Bring networks and optimiser to where the file left off; returns its plain values.

    Raises:
      InputError: the file is damaged, or of a run with other arguments.
    """
    tensors, metadata = read(path)
    require_format(path, metadata, FORMAT)
    told = json.loads(metadata["state"])
    wanted = json.loads(json.dumps(dict(of)))
    differ = list(differences(told["of"], wanted))
    if differ:
        raise InputError(
            f"{path} is of another run ({'; '.join(differ)}): remove it to begin anew, or choose another folder"
        )
    for name, module in modules.items():
        prefix = f"{name}/"
        try:
            module.load_state_dict({k.removeprefix(prefix): t for k, t in tensors.items() if k.startswith(prefix)})
        except RuntimeError as e:
            why = " ".join(str(e).split())
            raise InputError(f"{path} is of another run, whose {name} is another network ({why})") from None
    if optimiser is None:
        return told["plain"]
    state = optimiser.state_dict()
    for key, tensor in tensors.items():
        if key.startswith("optimiser/"):
            _, i, name = key.split("/")
            state["state"].setdefault(int(i), {})[name] = tensor
    for group, rate in zip(state["param_groups"], told["rates"], strict=True):
        group["lr"] = rate
    optimiser.load_state_dict(state)
    return told["plain"]
