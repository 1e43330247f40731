"""Air that a stand-in may hide: a gust, and the cushion that rotors find near the ground."""

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array

from .pushes import OnBody


class Gust(OnBody):
    """A force that swells to (3,) N and dies away once, as 1 - cosine does, from `start` for `length` s of each log.

    The clock of the simulation must be at 0 where a log begins.
    """

    family = "gust"

    def __init__(self, body: str, peak: Array, start: float, length: float) -> None:
        values = {f"push_{axis}": float(p) for axis, p in zip("xyz", peak, strict=True)}
        values |= {"start": start, "length": length}
        text = f"a gust pushes {body} by up to {np.linalg.norm(peak):.3g} N from {start:.2f} s on for {length:.2f} s"
        super().__init__((body,), values, text)
        self.peak = peak

    def pull(self, data: mujoco.MjData, velocity: Array, rate: Array) -> Array:
        gone = (data.time - self.parameters["start"]) / self.parameters["length"]
        return self.peak * np.sin(np.pi * gone) ** 2 if 0 < gone < 1 else np.zeros(3)


class GroundEffect(OnBody):
    """Rotors gain thrust over the ground: T (1 / (1 - r^2 / (16 z^2)) - 1) at height z, r their effective radius.

    Cheeseman and Bennett, The effect of the ground on a helicopter rotor in forward flight, ARC R&M 3021 (1955).
    """

    family = "ground_effect"

    def __init__(self, body: str, radius: float) -> None:
        text = f"thrust grows near the ground as of a rotor of {radius:.3g} m"
        super().__init__((body,), {"strength": radius**2}, text)

    def pull(self, data: mujoco.MjData, velocity: Array, rate: Array) -> Array:
        height = data.xipos[self.body, 2]
        if height == 0:
            return np.zeros(3)  # before the first step nothing is known of where it is
        share = min(self.parameters["strength"] / (4 * height) ** 2, 0.5)
        up = data.xmat[self.body].reshape(3, 3)[:, 2]
        return share / (1 - share) * data.actuator_force.sum() * up
