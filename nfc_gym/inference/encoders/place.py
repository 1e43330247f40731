"""Where a window happens tells nothing of the robot: states as seen from where, and facing as, the window began."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn


def place_of(names: Sequence[str]) -> dict[str, Any] | None:
    """Which entries of the states say where the robot is, by their names (`body:base:pos.x`, `body:base:quat.w`, ...).

    Returns:
      `quat` (4) and `pos` (2) indices of the base, and `turned`, pairs of indices of horizontal components in the
      world's frame; None where the states do not hold both position and attitude.
    """
    at = {name: i for i, name in enumerate(names)}
    body = next((n.rsplit(":", 1)[0] for n in names if n.startswith("body:") and n.endswith(":quat.w")), None)
    if body is None or f"{body}:pos.x" not in at or f"{body}:pos.y" not in at:
        return None
    pairs = [(f"{body}:{what}.x", f"{body}:{what}.y") for what in ("linvel", "angvel")]
    return {
        "quat": [at[f"{body}:quat.{c}"] for c in "wxyz"],
        "pos": [at[f"{body}:pos.{c}"] for c in "xy"],
        "turned": [[at[a], at[b]] for a, b in pairs if a in at and b in at],
    }


class Place(nn.Module):
    """States (B, H+1, s) in the horizontal frame of the first one: it stands at the origin and heads along x.

    Heights, tilts and everything in the robot's own frame stay. Quaternions get a positive scalar part.

    Args:
      entries: see `place_of`.
    """

    def __init__(self, entries: Mapping[str, Any]) -> None:
        super().__init__()
        self.quat, self.pos, self.pairs = list(entries["quat"]), list(entries["pos"]), list(entries["turned"])

    def forward(self, states: Tensor) -> Tensor:
        """The same shape."""
        columns = list(states.unbind(-1))
        w, x, y, z = (columns[i] for i in self.quat)
        heading = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y.square() + z.square()))[:, :1]
        c, s = (heading / 2).cos(), (heading / 2).sin()
        turned = (c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w)
        sign = torch.where(turned[0] < 0, -1.0, 1.0)
        for i, part in zip(self.quat, turned, strict=True):
            columns[i] = sign * part
        a, b = self.pos
        columns[a], columns[b] = columns[a] - columns[a][:, :1], columns[b] - columns[b][:, :1]
        c, s = heading.cos(), heading.sin()
        for a, b in (self.pos, *self.pairs):
            columns[a], columns[b] = c * columns[a] + s * columns[b], c * columns[b] - s * columns[a]
        return torch.stack(columns, -1)
