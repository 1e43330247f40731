"""`NormalPosterior`: psi's posterior given one window, normal where the prior is."""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from nfc_gym import __version__
from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.files import replacing
from nfc_gym.core.whole import require_share, require_whole
from nfc_gym.inference.space import PriorBox

Array = NDArray[np.float64]
FORMAT = "nfc_gym-normal-1"
_PARTS = ("mean", "covariance")
_LEAST = 1e-4  # probit, of standard deviations


@dataclass(frozen=True)
class Normal:
    """A normal in p coordinates in which what is known beforehand is N(0, I).

    Attributes:
      mean, covariance: (p,) and (p, p).
    """

    mean: Array
    covariance: Array

    @classmethod
    def prior(cls, size: int) -> "Normal":
        """N(0, I)."""
        return cls(np.zeros(size), np.eye(size))

    @classmethod
    def through(cls, z: Array) -> "Normal":
        """With the mean and the covariance of points z (n, p), which may all be equal."""
        return cls(z.mean(0), np.atleast_2d(np.cov(z.T)) + _LEAST**2 * np.eye(z.shape[1]))

    def beside(self, more: int) -> "Normal":
        """The same beside further entries of which nothing is known."""
        p = len(self.mean)
        covariance = np.eye(p + more)
        covariance[:p, :p] = self.covariance
        return Normal(np.concatenate([self.mean, np.zeros(more)]), covariance)

    def first(self, size: int) -> "Normal":
        """Of the first entries."""
        return Normal(self.mean[:size], self.covariance[:size, :size])

    def told(self, size: int) -> float:
        """Nats over the prior that are told of the first `size` entries, an entry, at the mean's own place."""
        return -0.5 * float(np.linalg.slogdet(self.first(size).covariance)[1]) / size

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """(n, p) draws."""
        return self.mean + rng.standard_normal((n, len(self.mean))) @ np.linalg.cholesky(self.covariance).T

    def gain(self, z: Array) -> Array:
        """(n,) log density over the prior's at z (n, p)."""
        off = z - self.mean
        squares = (off * np.linalg.solve(self.covariance, off.T).T).sum(1)
        return 0.5 * (np.square(z).sum(1) - squares - np.linalg.slogdet(self.covariance)[1])


@dataclass(frozen=True)
class NormalPosterior:
    """A normal in the probit coordinates z of the prior's box, and a little of what was believed before it.

    What the window does not show stays as wide as the prior, which is N(0, I) there, and no draw leaves the box. It is
    a `core.Posterior`.

    Attributes:
      prior: psi's box.
      normal: of z.
      notes: kept in its file.
      doubt: share of what was believed before: how often the normal may be altogether wrong.
      before: that belief; default the prior.
    """

    prior: PriorBox
    normal: Normal
    notes: dict[str, Any] = field(default_factory=dict)
    doubt: float = 0.0
    before: Normal | None = None
    parts: tuple[str, ...] = ("psi",)

    def __post_init__(self) -> None:
        k = self.prior.size
        require_share("a normal posterior's doubt", self.doubt)
        for each in (self.normal, self.otherwise):
            if np.shape(each.mean) != (k,) or np.shape(each.covariance) != (k, k):
                raise InputError(
                    f"a normal posterior of {k} free parameters wants a mean of {(k,)} and a covariance of {(k, k)}, "
                    f"got {np.shape(each.mean)} and {np.shape(each.covariance)}"
                )
            try:
                np.linalg.cholesky(each.covariance)
            except np.linalg.LinAlgError:
                raise InputError("a normal posterior's covariance must be positive definite") from None

    @property
    def otherwise(self) -> Normal:
        """What was believed before."""
        return self.before or Normal.prior(self.prior.size)

    def of(self, *parts: str) -> "NormalPosterior":
        """Itself: it speaks of psi alone.

        Raises:
          InputError: other parts.
        """
        if parts != ("psi",):
            raise InputError(f"posterior: its only part is psi, got {parts}")
        return self

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """`n` draws of psi in physical units.

        Raises:
          InputError: n is no whole number of 1 or more.
        """
        require_whole("sample: n", n, 1)
        z, before = (each.sample(n, rng) for each in (self.normal, self.otherwise))
        return Fidelity(self.prior.from_z(np.where(rng.random((n, 1)) < self.doubt, before, z)))

    def log_prob(self, x: Fidelity) -> Array:
        """(n,) log density of psi in physical units, in nats; minus infinity outside the prior's box.

        Raises:
          InputError: x has no psi, or holds more.
        """
        if x.psi is None or len(x.given) > 1:
            raise InputError("log_prob: this density is of psi and of nothing else")
        psi = np.atleast_2d(x.psi)
        z, free = self.prior.to_z(psi), np.array(self.prior.free)
        u = self.prior.u_of(psi)[:, free]
        told = self.normal.gain(z)
        if self.doubt:
            told = np.logaddexp(np.log1p(-self.doubt) + told, np.log(self.doubt) + self.otherwise.gain(z))
        return np.where(((u < 0) | (u > 1)).any(1), -np.inf, told - self.prior.log_volume)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file that `load_source` opens.

        Raises:
          InputError: another suffix.
        """
        path = Path(path)
        if path.suffix.lower() != ".safetensors":
            raise InputError(f"{path}: a posterior is kept in a file that ends in .safetensors")
        about = {"nfc_gym": __version__, "prior": self.prior.to_dict(), "notes": self.notes, "doubt": self.doubt}
        arrays = {
            f"{name}/{part}": np.ascontiguousarray(getattr(each, part))
            for name, each in (("normal", self.normal), ("before", self.otherwise))
            for part in _PARTS
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            safetensors.numpy.save_file(arrays, part, {"format": FORMAT, "about": json.dumps(about)})

    @classmethod
    def of_file(cls, path: Path, arrays: dict[str, Any], metadata: dict[str, str]) -> "NormalPosterior":
        """From what a file holds, arrays or tensors.

        Raises:
          InputError: it is damaged.
        """
        try:
            about = json.loads(metadata["about"])
            prior, notes, doubt = PriorBox.from_dict(about["prior"]), dict(about["notes"]), float(about["doubt"])
            normal, before = (
                Normal(*(np.asarray(arrays[f"{name}/{part}"], float) for part in _PARTS))
                for name in ("normal", "before")
            )
        except (KeyError, TypeError, ValueError) as e:
            raise InputError(f"{path}: holds no normal posterior that this version knows ({e})") from None
        try:
            return cls(prior, normal, notes, doubt, before)
        except InputError as e:
            raise InputError(f"{path}: {e}") from None
