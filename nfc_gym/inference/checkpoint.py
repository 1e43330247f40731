"""A trained network as one safetensors file: weights and scales, and in the metadata all that rebuilds it."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from nfc_gym import __version__
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.network import Encoded, Network
from nfc_gym.inference.normal import FORMAT as OF_ONE_WINDOW
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.state import read, require_format

FORMAT = "nfc_gym-posterior-1"
FRAME = "window"  # in which the network has delta_s; files that say none have it in the world's
GIVEN = "given/"  # before the names of the encoded window's tensors, in the file of a posterior that was given one


def save(path: Path, network: Network, *, given: Encoded | None = None, notes: dict[str, Any] | None = None) -> None:
    """Write a network; with `given`, also what is kept of the window that its posterior was given.

    Args:
      path: ends in `.safetensors`.
      network: trained.
      given: see above.
      notes: plain values kept beside it: how it was trained, on what.
    """
    if path.suffix.lower() != ".safetensors":
        raise InputError(f"{path}: a posterior is kept in a file that ends in .safetensors")
    about = {
        "nfc_gym": __version__, "torch": str(torch.__version__), "network": network.config.to_dict(),
        "sizes": asdict(network.sizes), "prior": network.prior.to_dict(), "notes": notes or {}, "frame": FRAME,
    }  # fmt: skip
    tensors = {k: t.detach().cpu().contiguous().clone() for k, t in network.state_dict().items()}
    if given is not None:
        tensors |= {GIVEN + k: t.detach().cpu().contiguous() for k, t in given._asdict().items() if t is not None}
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        save_file(tensors, part, {"format": FORMAT, "about": json.dumps(about)})


def load(path: Path, prior: PriorBox | None = None) -> tuple[Network, Encoded | None, dict[str, Any]]:
    """A network, what is kept of the window it was given (or None), and the notes kept beside it.

    Args:
      path: of the file.
      prior: what its prior must be; default any.

    Raises:
      InputError: the file is damaged, of another format, or of another robot or prior than asked for.
    """
    tensors, metadata = read(path)
    if metadata.get("format") == OF_ONE_WINDOW:
        raise InputError(
            f"{path}: the posterior of one window, as `nfc-gym infer --refine` writes it, and no network that could be "
            "given another; give a network that `nfc-gym train` made, or refine for that window too"
        )
    require_format(path, metadata, FORMAT)
    try:
        about = json.loads(metadata["about"])
        own, frame = PriorBox.from_dict(about["prior"]), about.get("frame")
        config, sizes, notes = NetworkConfig(**_known(about["network"])), Sizes(**about["sizes"]), dict(about["notes"])
        network = Network(config, sizes, own)
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError, IndexError) as e:
        raise InputError(f"{path}: its metadata describe no network that this version knows ({e})") from None
    if config.delta_s and sizes.place and frame != FRAME:
        raise InputError(
            f"{path}: of an earlier version: its delta_s is in the world's frame, of which windows do not tell; "
            "train it again"
        )
    if prior is not None:
        prior.require_same(own, str(path))
    kept = {"facing": torch.tensor([[1.0, 0.0, 1.0]])} if any(k.startswith(GIVEN) for k in tensors) else {}
    kept |= {k.removeprefix(GIVEN): tensors.pop(k) for k in list(tensors) if k.startswith(GIVEN)}
    try:
        network.load_state_dict(tensors)
        given = Encoded(**kept) if kept else None
    except (RuntimeError, TypeError) as e:
        raise InputError(f"{path}: its weights are not those of the network that it describes ({e})") from None
    return network.eval(), given, notes


def _known(network: dict[str, Any]) -> dict[str, Any]:
    """A network's description without what earlier versions said of every one and this one has no more.

    `aligned`: it was made for windows of the same commands. One that was is not known here.
    """
    return {key: value for key, value in network.items() if key != "aligned" or value is not False}
