"""What a posterior over `Fidelity` must offer, whoever computes it, and how one kept in a file is opened."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import PARTS, Fidelity

Array = NDArray[np.float64]


@runtime_checkable
class Sampler(Protocol):
    """Something to draw fidelities from."""

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """A batch of `n` fidelities; the same generator state gives the same samples."""
        ...


@runtime_checkable
class Posterior(Sampler, Protocol):
    """A distribution over `Fidelity` given a window of a log."""

    def log_prob(self, x: Fidelity) -> Array:
        """(n,) log density of a batch of fidelities, in nats."""
        ...


def without_maps(source: Any) -> Any:
    """The same saying nothing of delta_e, where it can be asked for some of its parts: a map takes as long to draw as a
    thousand psi, and many look at psi and delta_s alone."""
    parts = getattr(source, "parts", ())
    return source.of(*(p for p in parts if p != "delta_e")) if "delta_e" in parts and hasattr(source, "of") else source


Loader = Callable[[Path], Sampler]
_LOADERS: dict[str, Loader] = {}


def register_loader(suffix: str, loader: Loader) -> None:
    """Have sources that end in `suffix` (`".safetensors"`) opened by `loader`: path -> something to draw from."""
    _LOADERS[suffix.lower()] = loader


def load_source(path: str | os.PathLike[str]) -> Sampler:
    """Open a file of fidelities or a posterior by the loader that its suffix names.

    Raises:
      InputError: the file does not exist, no loader is registered for it, or it cannot be read.
    """
    path = Path(path)
    loader = _LOADERS.get(path.suffix.lower())
    if loader is None:
        raise InputError(
            f"{path}: no loader for {path.suffix or 'a file without suffix'}; there are: {', '.join(_LOADERS)}"
        )
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    return loader(path)


def _load_npz(path: Path) -> Fidelity:
    """Samples from an `.npz` with the keys psi, delta_s, delta_e, or some of them; nothing in it is unpickled."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            parts = {name: archive[name] for name in archive.files}
    except (ValueError, EOFError, OSError, BadZipFile) as e:
        raise InputError(f"{path}: truncated, or not an npz of plain arrays ({e})") from None
    unknown = sorted(set(parts) - set(PARTS))
    if unknown or not parts:
        raise InputError(
            f"{path}: holds {', '.join(unknown) or 'nothing'}; an npz of fidelities has {', '.join(PARTS)}"
        )
    return Fidelity(**parts)


register_loader(".npz", _load_npz)
