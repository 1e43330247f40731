"""Windows of machines each with a fault, of a kind and a size that are drawn: what a `Judge` learns from."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.windows import Batch
from nfc_gym.simulate.draws import geometric
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.residuals import candidates, sizes
from nfc_gym.simulate.trials import trials

Array = NDArray[np.float64]
_TOGETHER = 10  # windows with the same effect, whose edits of the model take longer than the windows
_MASS, _FRICTION, _GAIN = (1.2, 2.5), (0.2, 0.8), (0.0, 0.5)  # a mass is more or less by that factor


def faulty(machine: Machine, psi: Array, seed: int, *, nthread: int = 1) -> Batch:
    """One window on a plane for each row of psi, with sensor noise and one fault.

    Kinds are drawn alike: the main body heavier or lighter (x 1.2 to 2.5, or one by that), less friction (x 0.2 to 0.8)
    and a servo that is lost or weak (x 0 to 0.5) where psi has them, and an effect of the library, of a realistic size.

    Args:
      machine: the robot, on a plane.
      psi: (n, d) physical units, of the machines before their fault.
      seed: of faults, motion and noise.
      nthread: threads.

    Returns:
      As of `trials`: fewer windows than rows where faults throw the robot at once.

    Raises:
      InputError: the machine stands on rough ground, or psi has another shape.
    """
    psi, rng = np.array(psi, float), np.random.default_rng(seed)
    if psi.ndim != 2 or psi.shape[1] != len(machine.space) or not len(psi):
        raise InputError(f"faulty: psi has shape {psi.shape}, want (n, {len(machine.space)}) with n of 1 or more")
    scales = _scales(machine)
    kind = rng.integers(len(scales) + 1, size=len(psi))
    for row, k in enumerate(kind):
        if k < len(scales):
            psi[row] *= scales[k](rng)
    scaled, first = np.flatnonzero(kind < len(scales)), int(rng.integers(2**31))
    parts = [trials(machine, psi[scaled], first, nthread=nthread)] if len(scaled) else []
    library, rest = candidates(machine), np.flatnonzero(kind == len(scales))
    for i in range(0, len(rest), _TOGETHER):
        rows, effect = rest[i : i + _TOGETHER], library[rng.integers(len(library))]
        theta = np.tile(sizes(effect, rng.random((1, 2 * len(effect.params)))), (len(rows), 1))
        effect.bind(machine.model)
        given = {"effect": effect, "theta": theta}
        parts.append(trials(machine, psi[rows], int(rng.integers(2**31)), nthread=nthread, **given))
    return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}


def _scales(machine: Machine) -> list[Callable[[np.random.Generator], Array]]:
    """Kinds of faults of psi: functions that draw (d,) factors."""
    names = machine.space.names
    bodies = [n for n in names if n.endswith("_mass")][:1]
    rubbing = [n for n in names if n.endswith("_friction")]
    servos = [n for n in names if n.endswith("_damping")]  # the gain of a wheel's servo

    def scaled(which: list[str], by: float) -> Array:
        return np.where([n in which for n in names], by, 1.0)

    def mass(rng: np.random.Generator) -> Array:
        return scaled(bodies, float(geometric(rng.random(1), *_MASS)[0]) ** rng.choice([-1, 1]))

    def friction(rng: np.random.Generator) -> Array:
        return scaled(rubbing, float(geometric(rng.random(1), *_FRICTION)[0]))

    def gain(rng: np.random.Generator) -> Array:
        return scaled([servos[rng.integers(len(servos))]], rng.uniform(*_GAIN))

    return [draw for draw, of in ((mass, bodies), (friction, rubbing), (gain, servos)) if of]
