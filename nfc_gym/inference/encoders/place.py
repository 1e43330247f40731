"""Where a window happens tells nothing of the robot: states as seen from where, and facing as, the window began."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn


def place_of(names: Sequence[str]) -> dict[str, Any] | None:
    """Which entries of the states say where the robot is, by their names (`body:base:pos.x`, `body:base:quat.w`, ...).

    Returns:
      `quat` (4) and `pos` (2) indices of the base, and `turned`, pairs of indices of horizontal components in the
      world's frame; `pos` is empty where the states hold velocities in the world's frame and no position (the
      Quadcopter's), and None is returned where they do not hold an attitude beside either.
    """
    at = {name: i for i, name in enumerate(names)}
    body = next((n.rsplit(":", 1)[0] for n in names if n.startswith("body:") and n.endswith(":quat.w")), None)
    if body is None:
        return None
    pairs = [[f"{body}:{what}.x", f"{body}:{what}.y"] for what in ("pos", "linvel", "angvel")]
    pos, *turned = [[at[a], at[b]] if a in at and b in at else [] for a, b in pairs]
    if not pos and not any(turned):
        return None
    return {"quat": [at[f"{body}:quat.{c}"] for c in "wxyz"], "pos": pos, "turned": [p for p in turned if p]}


class Place(nn.Module):
    """States (B, H+1, s) in the horizontal frame of the first one: it stands at the origin and heads along x.

    Heights, tilts and everything in the robot's own frame stay. Quaternions get a positive scalar part.

    Args:
      entries: see `place_of`.
    """

    def __init__(self, entries: Mapping[str, Any]) -> None:
        super().__init__()
        self.quat, self.pos, self.pairs = list(entries["quat"]), list(entries["pos"]), list(entries["turned"])

    def _heading(self, states: Tensor) -> Tensor:
        """(B,) rad, of the first states."""
        w, x, y, z = (states[:, 0, i] for i in self.quat)
        return torch.atan2(2 * (w * z + x * y), 1 - 2 * (y.square() + z.square()))

    def facing(self, states: Tensor) -> Tensor:
        """(B, 3) how windows as logged face: cosine and sine of half the heading, and the quaternion's sign."""
        half = self._heading(states) / 2
        c, s = half.cos(), half.sin()
        scalar = c * states[:, 0, self.quat[0]] + s * states[:, 0, self.quat[3]]
        return torch.stack([c, s, torch.where(scalar < 0, -1.0, 1.0)], -1)

    def turned(self, change: Tensor, facing: Tensor, back: bool = False) -> Tensor:
        """Changes of states (..., s) from the world's frame into that of the window, or back.

        Args:
          facing: (..., 3), see `facing`.
        """
        c, s, sign = facing.unbind(-1)
        s = -s if back else s
        columns = list(change.unbind(-1))
        w, x, y, z = (sign * columns[i] for i in self.quat)
        for i, part in zip(self.quat, (c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w), strict=True):
            columns[i] = part
        c, s = c.square() - s.square(), 2 * c * s
        for a, b in self._horizontal:
            columns[a], columns[b] = c * columns[a] + s * columns[b], c * columns[b] - s * columns[a]
        return torch.stack(columns, -1)

    @property
    def _horizontal(self) -> list[list[int]]:
        return [*([self.pos] if self.pos else []), *self.pairs]

    def forward(self, states: Tensor) -> Tensor:
        """The same shape."""
        columns = list(states.unbind(-1))
        w, x, y, z = (columns[i] for i in self.quat)
        heading = self._heading(states)[:, None]
        c, s = (heading / 2).cos(), (heading / 2).sin()
        turned = (c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w)
        sign = torch.where(turned[0] < 0, -1.0, 1.0)
        for i, part in zip(self.quat, turned, strict=True):
            columns[i] = sign * part
        for a in self.pos:
            columns[a] = columns[a] - columns[a][:, :1]
        c, s = heading.cos(), heading.sin()
        for a, b in self._horizontal:
            columns[a], columns[b] = c * columns[a] + s * columns[b], c * columns[b] - s * columns[a]
        return torch.stack(columns, -1)
