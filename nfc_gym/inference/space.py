"""`PriorBox`: psi as plain data, and its probit coordinates in which the uniform prior is N(0, I)."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from nfc_gym.core.errors import InputError

Array = NDArray[np.float64]
EDGE = 1e-6  # u is kept this far from 0 and 1, where its probit is infinite; float32 still resolves it


@dataclass(frozen=True)
class PriorBox:
    """The prior's box: what a posterior and its checkpoint need to know of psi, bound to no model.

    A position in the box is u = (psi - low) / (high - low) in [0, 1]; z = probit(u) of the free parameters is what
    networks see. The uniform prior is N(0, I) in z, and nothing that is drawn in z lies outside the box.

    Attributes:
      robot: whose parameters these are.
      names: in the order of the psi vector.
      units: of the values.
      low: the prior's lower bounds.
      high: the prior's upper bounds.
      nominal: values of the parameters that are not free; default the middle of the box.
      free: which parameters are inferred; default all. The others are known and stay nominal.

    Raises:
      InputError: lengths differ, a name comes twice, a bound is not finite, a free parameter's prior has no width, or
        none is free.
    """

    robot: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    nominal: tuple[float, ...] = ()
    free: tuple[bool, ...] = ()

    def __post_init__(self) -> None:
        for name in ("low", "high", "nominal"):
            object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
        for name in ("names", "units"):
            object.__setattr__(self, name, tuple(str(v) for v in getattr(self, name)))
        middle = tuple((a + b) / 2 for a, b in zip(self.low, self.high, strict=False))
        object.__setattr__(self, "nominal", self.nominal or middle)
        object.__setattr__(self, "free", tuple(bool(v) for v in self.free) or (True,) * len(self.names))
        sizes = {k: len(getattr(self, k)) for k in ("names", "units", "low", "high", "nominal", "free")}
        if len(set(sizes.values())) > 1:
            raise InputError(f"prior of {self.robot}: entries of different length: {sizes}")
        twice = sorted({n for n in self.names if self.names.count(n) > 1})
        if twice:
            raise InputError(f"prior of {self.robot}: parameters named twice: {', '.join(twice)}")
        if not any(self.free):
            raise InputError(f"prior of {self.robot}: no parameter is free, so there is nothing to infer")
        for name, low, high, free in zip(self.names, self.low, self.high, self.free, strict=True):
            if not (math.isfinite(low) and math.isfinite(high)) or low > high or (free and low == high):
                raise InputError(
                    f"prior of {self.robot}: {name!r} needs finite bounds with low < high, got [{low:g}, {high:g}]; "
                    "mark a parameter that is known as not free (`anchored`) instead of giving it a prior of zero width"
                )

    @classmethod
    def of(cls, space: Any, robot: str) -> "PriorBox":
        """The box of a `ParameterSpace`, or of anything with its `names`, `units`, `low`, `high`, `nominal`, `free`."""
        parts: dict[str, Any] = {k: getattr(space, k) for k in cls.__match_args__ if k != "robot"}
        return cls.from_dict({"robot": robot} | parts)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "PriorBox":
        """Inverse of `to_dict`.

        Raises:
          InputError: an entry is missing or unknown.
        """
        values: dict[str, Any] = {k: v if k == "robot" else tuple(v) for k, v in data.items()}
        try:
            return cls(**values)
        except TypeError as e:
            raise InputError(
                f"this is no description of a prior ({e}); it has {', '.join(cls.__match_args__)}"
            ) from None

    def to_dict(self) -> dict[str, Any]:
        """Plain values that JSON holds."""
        return asdict(self)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def size(self) -> int:
        """How many parameters are free: the size of z."""
        return sum(self.free)

    @property
    def _bounds(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        return np.array(self.low), np.array(self.high), np.array(self.free)

    @property
    def log_volume(self) -> float:
        """log of the free box's volume: the prior's log density in physical units is its negative."""
        low, high, free = self._bounds
        return float(np.log((high - low)[free]).sum())

    def u_of(self, psi: ArrayLike) -> Array:
        """Physical psi (..., d) to positions u (..., d) in the box; a parameter that is not free sits at 1/2.

        Raises:
          InputError: psi has another width.
        """
        psi = np.asarray(psi, float)
        if psi.shape[-1:] != (len(self),):
            raise InputError(f"psi must end in {len(self)} values ({', '.join(self.names)}), got shape {psi.shape}")
        low, high, free = self._bounds
        return np.where(free, (psi - low) / np.where(free, high - low, 1.0), 0.5)

    def psi_of(self, u: ArrayLike) -> Array:
        """Inverse of `u_of`; a parameter that is not free is nominal."""
        low, high, free = self._bounds
        return np.where(free, low + np.asarray(u, float) * (high - low), np.array(self.nominal))

    def to_z(self, psi: ArrayLike) -> Array:
        """Physical psi (..., d) to probit coordinates (..., size); positions are kept 1e-6 from the edges."""
        return ndtri(np.clip(self.u_of(psi)[..., np.array(self.free)], EDGE, 1 - EDGE))

    def from_z(self, z: ArrayLike) -> Array:
        """Probit coordinates (..., size) to physical psi (..., d)."""
        z = np.asarray(z, float)
        u = np.full((*z.shape[:-1], len(self)), 0.5)
        u[..., np.array(self.free)] = ndtr(z)
        return self.psi_of(u)

    def require_same(self, other: "PriorBox", what: str) -> None:
        """Refuse to go on where two boxes differ, saying where.

        Raises:
          InputError: another robot, other names in another order, other units or bounds.
        """
        if self == other:
            return
        if self.robot != other.robot:
            raise InputError(f"{what} is of the robot {other.robot!r}, not of {self.robot!r}")
        if self.names != other.names:
            only = [n for n in other.names if n not in self.names] or list(other.names)
            raise InputError(
                f"{what} has other parameters than {self.robot!r} has here ({', '.join(only[:5])}, ...); "
                f"here: {', '.join(self.names)}"
            )
        for part in ("units", "low", "high", "nominal", "free"):
            for name, mine, its in zip(self.names, getattr(self, part), getattr(other, part), strict=True):
                if mine != its:
                    raise InputError(f"{what} has {part} of {name!r} = {its}, here it is {mine}")
