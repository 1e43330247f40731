"""A training run's state as one safetensors file: tensors by name, the rest as JSON in its metadata."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nfc_gym import __version__
from nfc_gym.core.differences import differences
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.core.whole import is_number, require_whole

FORMAT = "nfc_gym-training-1"


def save_state(path: Path, run: Any, description: dict[str, Any]) -> None:
    """Write what `run` would need to go on; the old file stays until the new one is whole."""
    tensors: dict[str, Tensor] = {}
    for name in ("network", "average", "best"):
        tensors |= {f"{name}/{k}": t for k, t in getattr(run, name).state_dict().items()}
    tensors |= {f"optimiser/{k}": t for k, t in run.optimiser.tensors().items()}
    plain = {"step": run.step, "loss_sum": run.loss_sum, "outcome": asdict(run.outcome), "of": description}
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {k: t.detach().cpu().contiguous().clone() for k, t in tensors.items()}
    with replacing(path) as part:
        save_file(tensors, part, {"format": FORMAT, "state": json.dumps(plain)})


def load_state(path: Path, run: Any, description: dict[str, Any]) -> None:
    """Set `run` to where the file left off.

    Raises:
      InputError: the file is damaged, or of a run with another network, prior, data or configuration.
    """
    tensors, metadata = read(path)
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path}: format {metadata.get('format')!r}, want {FORMAT!r}: remove it to train anew")
    plain = _described(path, metadata)
    differ = list(differences(plain["of"], json.loads(json.dumps(description))))
    if differ:
        raise InputError(
            f"{path} is of another run ({'; '.join(differ)}): remove it to train anew, or train to another place"
        )
    for name in ("network", "average", "best"):
        try:
            getattr(run, name).load_state_dict(_part(tensors, name))
        except RuntimeError:  # the configuration is the same, so that the shapes follow from the windows' own
            raise InputError(f"{path} is of windows of other sizes: remove it to train anew") from None
    run.optimiser.load(_part(tensors, "optimiser"))
    run.step, run.loss_sum = plain["step"], plain["loss_sum"]
    try:
        run.outcome = type(run.outcome)(**plain["outcome"])
    except TypeError as e:
        raise InputError(f"{path}: damaged ({e}): remove it to train anew") from None


def _part(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Those whose names begin with a name and a slash, without them."""
    return {k.removeprefix(f"{name}/"): t for k, t in tensors.items() if k.startswith(f"{name}/")}


def _described(path: Path, metadata: dict[str, str]) -> dict[str, Any]:
    """What `save_state` kept as JSON: `step`, `loss_sum`, `outcome`, and `of` what run."""
    try:
        plain = json.loads(metadata["state"])
        require_whole("step", plain["step"], 0)
        whole = isinstance(plain["of"], dict) and isinstance(plain["outcome"], dict) and is_number(plain["loss_sum"])
    except (KeyError, TypeError, ValueError) as e:
        raise InputError(f"{path}: damaged ({e!r}): remove it to train anew") from None
    if not whole:
        raise InputError(f"{path}: damaged, what it says of its run is incomplete: remove it to train anew")
    return plain


def read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file.

    Raises:
      InputError: it is truncated, or no such file.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; want a file that ends in .safetensors")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with safe_open(path, "pt") as file:
            return {k: file.get_tensor(k) for k in file.keys()}, file.metadata() or {}  # noqa: SIM118 (no dict)
    except (SafetensorError, OSError, ValueError) as e:
        raise InputError(f"{path}: truncated, or no safetensors file ({e})") from None


def require_format(path: Path, metadata: dict[str, str], known: str) -> None:
    """Raises `InputError` where a file's metadata name another format than the known one."""
    if metadata.get("format") != known:
        raise InputError(
            f"{path}: format {metadata.get('format')!r}; this version of nfc_gym ({__version__}) reads {known!r}"
        )
