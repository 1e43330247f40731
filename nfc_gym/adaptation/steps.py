"""The noise of single control steps, from a window's own residuals.

delta_s is one bias for a window, and the posterior's covariance says how sure it is, not by how much steps differ. That
is seen by replaying each control step alone, from the state that was estimated at its start, under the psi that is
believed: r_t = s_{t+1} - f_psi(s_t, a_t) - delta_s. Their covariance, less what the sensors put into s_{t+1}, is what
`ResidualDynamics(covariance=)` takes.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.adaptation.replaying import replayed
from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import real_array
from nfc_gym.physics.quiet import no_warnings
from nfc_gym.simulate.machine import Machine
from nfc_gym.terrain import Heightfield

Array = NDArray[np.float64]
LEAST = 10  # control steps; of fewer nothing is said


@no_warnings()  # steps that come apart are left out
def step_covariance(
    environment: str, states: ArrayLike, actions: ArrayLike, estimate: ArrayLike, psi: ArrayLike, *,
    delta_s: ArrayLike | None = None, sensed: ArrayLike = 0.0, ground: Heightfield | None = None, nthread: int = 1,
) -> Array:  # fmt: skip
    """Covariance (s, s) of what control steps do beyond f_psi(s, a) + delta_s.

    Entries of `proprio` that no replay can say (commands, a runner's target) are 0 in it. Errors of the estimate count
    as noise of the steps, so with a noisy one it is an upper bound; so do bumps that `ground` leaves out.

    Args:
      environment: id of the robot's simulator.
      states: (n + 1, s) `proprio` of the window.
      actions: (n, a).
      estimate: (n + 1, nq + nv) positions and velocities, or with the actuators' states behind them, as
        `Trajectory.estimate` has them.
      psi: (d,) in physical units, such as the posterior's mean.
      delta_s: (s,) such as the posterior's mean; default the residuals' own mean.
      sensed: (s,) or () standard deviation of the sensors' noise in `states`.
      ground: underfoot, for a Rough environment.
      nthread: threads; the result does not depend on them.

    Raises:
      InputError: arrays that do not fit the robot or each other, fewer than `LEAST` steps that can be replayed, no
        ground where one is needed.
    """
    machine = Machine(environment)
    if machine.rough != (ground is not None):
        raise InputError(
            f"step_covariance: {machine.environment} {'needs its' if machine.rough else 'is a plane: no'} `ground`"
        )
    model, kind = machine.model, machine.kind
    size, moving = kind.proprio_size, model.nq + model.nv
    n = len(np.atleast_1d(np.asarray(actions, object)))
    s = _array("states", states, (n + 1, size))
    a = np.clip(_array("actions", actions, (n, kind.action_size)), -1, 1)
    starts = _array("estimate", estimate, (n + 1, moving), (n + 1, moving + model.na))[:-1]
    believed = np.tile(_array("psi", psi, (len(machine.space),)), (n, 1))
    noise = np.broadcast_to(_array("sensed", sensed, (), (size,)), size)
    sims = machine.simulations(n, nthread, [] if ground is None else [ground])
    on = {} if ground is None else {"terrain_id": np.zeros(n, int)}
    sims.begin(np.arange(n), {"psi": believed} | on)
    missed = machine.difference(s[1:], replayed(machine, sims, starts, s[:-1], a[:, None]))[:, machine.told]
    missed = missed[np.isfinite(missed).all(1)]
    if len(missed) < LEAST:
        raise InputError(f"step_covariance: {len(missed)} control steps can be replayed; want {LEAST} or more")
    if delta_s is None:
        found = np.atleast_2d(np.cov(missed, rowvar=False))
    else:
        missed = missed - _array("delta_s", delta_s, (size,))[machine.told]
        found = missed.T @ missed / len(missed)
    out = np.zeros((size, size))
    out[np.ix_(machine.told, machine.told)] = _positive(found - np.diag(noise[machine.told] ** 2))
    return out


def _positive(matrix: Array) -> Array:
    """The nearest covariance: less noise than the sensors' own leaves directions in which nothing is left."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def _array(name: str, value: Any, *shapes: tuple[int, ...]) -> Array:
    given = real_array(value)
    if given is None or given.shape not in shapes or not np.isfinite(given).all():
        got = repr(value)[:60] if given is None else f"of shape {given.shape}"
        if given is not None and given.shape in shapes:
            got += " and not finite"
        raise InputError(f"step_covariance: {name} is {got}; want finite numbers {' or '.join(map(str, shapes))}")
    return given
