"""`Fidelity`: what a simulator should be, one sample of it or many: psi, residual dynamics, residual terrain."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import real_array

Array = NDArray[np.float64]
PARTS = ("psi", "delta_s", "delta_e")
_TRAILING = {"psi": 1, "delta_s": 1, "delta_e": 2}


def _numbers(part: str, value: Any) -> Array:
    """A part as an array; text, flags and complex numbers raise `InputError`."""
    given = real_array(value)
    if given is not None:
        return given
    text = repr(value)
    raise InputError(f"fidelity: {part} is {text if len(text) <= 80 else text[:77] + '...'}, want an array of numbers")


@dataclass(frozen=True)
class Fidelity:
    """One sample (psi, delta_s, delta_e), or a batch of them with one leading axis; None is "says nothing of it".

    Attributes:
      psi: (d,) or (n, d) physical coefficients in physical units, in the order of the environment's `psi_space`.
      delta_s: (s,) or (n, s) residual of one control step: s' = f_psi(s, a) + delta_s.
      delta_e: (rows, cols) or (n, rows, cols) residual terrain in m, truth minus perceived.

    Raises:
      InputError: a part is no array of numbers, has another number of axes, is not finite, or the parts' leading axes
        differ.
    """

    psi: Array | None = None
    delta_s: Array | None = None
    delta_e: Array | None = None

    def __post_init__(self) -> None:
        lead = {}
        for part in PARTS:
            value = getattr(self, part)
            if value is None:
                continue
            value = _numbers(part, value)
            object.__setattr__(self, part, value)
            extra = value.ndim - _TRAILING[part]
            if extra not in (0, 1):
                want = _TRAILING[part]
                raise InputError(f"fidelity: {part} must have {want} or {want + 1} axes, got shape {value.shape}")
            if not np.isfinite(value).all():
                bad = value[~np.isfinite(value)][0]
                raise InputError(f"fidelity: {part} holds {bad:g}; every entry must be finite")
            lead[part] = value.shape[:extra]
        if len(set(lead.values())) > 1:
            raise InputError(f"fidelity: the parts hold different numbers of samples: {lead}")

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the parts that it speaks of."""
        return tuple(p for p in PARTS if getattr(self, p) is not None)

    @property
    def batched(self) -> bool:
        """Whether it holds a leading axis of samples."""
        return any(getattr(self, p).ndim > _TRAILING[p] for p in self.given)

    def __len__(self) -> int:
        if not self.batched:
            raise TypeError("a single fidelity has no length")
        return len(getattr(self, self.given[0]))

    def __getitem__(self, rows: Any) -> "Fidelity":
        """Rows of a batch: an index gives a single sample, a slice or an array of indices a batch."""
        return Fidelity(**{p: getattr(self, p)[rows] for p in self.given})

    def sample(self, n: int, rng: np.random.Generator) -> "Fidelity":
        """`n` of its own samples, each equally likely and drawn with replacement; a single sample is repeated."""
        if self.batched:
            return self[rng.integers(len(self), size=n)]
        return Fidelity(**{p: np.repeat(getattr(self, p)[None], n, 0) for p in self.given})

    def save(self, path: str | Path) -> None:
        """Write an `.npz` that `load_source` opens again."""
        np.savez(path, **{p: getattr(self, p) for p in self.given})  # type: ignore[arg-type]
