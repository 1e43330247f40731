"""The ceiling: what a window can tell of psi at most, by the Fisher information of its noisy states.

With the start state and the actions known, the states y = f(u) + noise of a window tell of u (psi in its box, [0, 1])
the Fisher information I = J' R^-1 J, J = df/du by central differences of the simulator and R the noise's covariance.
Under the uniform prior, and f taken as linear, each parameter is a number in [0, 1] seen through Gaussian noise of
standard deviation sigma = (I_ii - I_io (I_oo + 12)^-1 I_oi)^-1/2: the others, o, of variance 1/12 beforehand, are
marginalised. Its expected posterior variance and the information gained have no closed form, but are integrals in one
dimension (`variance`, `gain`). For the joint gain the same is done along the chain rule, each parameter given those
before it.

It is a ceiling in so far as start, actions and noise are known exactly and f is nearly linear over a posterior's width:
what an estimator gains beyond it is a fault of one of the two. Parameters that leave the states alone have gain 0 and
the prior's variance, 1/12.
"""

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from nfc_gym.core.errors import InputError
from nfc_gym.inference.windows import Batch
from nfc_gym.simulate.ground import made
from nfc_gym.simulate.machine import Machine

Array = NDArray[np.float64]
Simulator = Callable[[NDArray[np.intp], Array], Array]  # (which window (m,), u (m, d)) -> outputs (m, k)
PRIOR = 12.0  # one over the variance of a uniform number in [0, 1]
STEP = 0.02  # of u: large beside the simulator's rounding, small beside the box
_LEAST, _MOST = 1e-4, 1e3  # of sigma: beyond these the limits hold to all digits that matter


class Ceiling(NamedTuple):
    """What n windows can tell of d parameters at most.

    Attributes:
      information: (n, d, d) Fisher information on u; entries of windows that a step of psi makes unstable are nan.
      variance: (n, d) expected posterior variance of u at least, between 0 and 1/12.
      gain: (n, d) information gained of each parameter by itself at most, nats.
      joint: (n,) of all together, nats; it counts correlations that `gain` cannot.
    """

    information: Array
    variance: Array
    gain: Array
    joint: Array


def information(simulator: Simulator, u: Array, noise: Array, step: float = STEP) -> Array:
    """Fisher information (n, d, d) of outputs under Gaussian noise, by central differences.

    Args:
      simulator: outputs (m, k) of windows `which` (m,) at u (m, d); all windows and steps are asked for in one call.
      u: (n, d) in [0, 1], where to linearise; within a step of the box's edge the point is moved inwards.
      noise: (k,) standard deviation of each output; 0 leaves it out, it is known without measuring.
      step: of u.

    Raises:
      InputError: shapes that do not fit, or no output with noise.
    """
    n, d = u.shape
    told = np.asarray(noise) > 0
    if not told.any():
        raise InputError("the ceiling needs outputs with measurement noise; all of these are known exactly")
    middle = np.clip(u, step, 1 - step)
    moves = step * np.concatenate([np.eye(d), -np.eye(d)])
    at = (middle[:, None] + moves).reshape(-1, d)
    out = simulator(np.repeat(np.arange(n), 2 * d), at)
    if out.shape != (2 * d * n, len(told)):
        raise InputError(f"the simulator gives outputs {out.shape}, want {(2 * d * n, len(told))}")
    white = (out[:, told] / np.asarray(noise)[told]).reshape(n, 2, d, -1)
    slope = (white[:, 0] - white[:, 1]) / (2 * step)
    return slope @ slope.swapaxes(1, 2)


def bounds(information: Array) -> Ceiling:
    """Variance, gain and joint gain from Fisher information (n, d, d)."""
    n, d = information.shape[:2]
    own, chain = np.empty((n, d)), np.empty((n, d))
    for i in range(d):
        own[:, i] = _told(information, i, [j for j in range(d) if j != i])
        chain[:, i] = _told(information, i, list(range(i + 1, d)))
    return Ceiling(information, variance(own), gain(own), gain(chain).sum(1))


def _told(information: Array, i: int, others: list[int]) -> Array:
    """(n,) standard deviation of the noise through which parameter i is seen, the others being uncertain."""
    left = information[:, i, i].copy()
    if others:
        cross = information[:, others, i]
        among = information[:, others][:, :, others] + PRIOR * np.eye(len(others))
        ok = np.isfinite(among).all((1, 2))
        left[ok] -= np.einsum("ni,ni->n", cross[ok], np.linalg.solve(among[ok], cross[ok][..., None])[..., 0])
    return 1 / np.sqrt(np.maximum(left, 1 / _MOST**2))


def variance(sigma: Array) -> Array:
    """Expected posterior variance of a uniform number in [0, 1] that is seen through Gaussian noise of sd `sigma`."""
    return _interpolated(sigma)[0]


def gain(sigma: Array) -> Array:
    """Information, nats, that such an observation gives: h(y) - h(y | u)."""
    return _interpolated(sigma)[1]


def _interpolated(sigma: Array) -> tuple[Array, Array]:
    x, log_variance, gained = _table()
    at = np.log(np.clip(sigma, _LEAST, _MOST))
    return np.exp(np.interp(at, x, log_variance)), np.interp(at, x, gained)


@cache
def _table() -> tuple[Array, Array, Array]:
    """log sigma -> log of the expected variance, and the gain, by quadrature over what is observed."""
    x = np.linspace(np.log(_LEAST), np.log(_MOST), 1201)
    rows = [_exact(float(np.exp(s))) for s in x]
    return x, np.log([v for v, _ in rows]), np.array([g for _, g in rows])


def _exact(sigma: float) -> tuple[float, float]:
    """For y = u + sigma e: y has the density ndtr(y / sigma) - ndtr((y - 1) / sigma), u given y is a cut-off normal."""
    # Panels: the two edges, where the density bends within a few sigma, and the middle, where nothing changes.
    reach = 8 * sigma
    cuts = [-reach, 0.0, min(reach, 0.5), max(1 - reach, 0.5), 1.0, 1 + reach]
    node, weight = np.polynomial.legendre.leggauss(80)
    y = np.concatenate([(a + b) / 2 + (b - a) / 2 * node for a, b in pairwise(cuts)])
    w = np.concatenate([(b - a) / 2 * weight for a, b in pairwise(cuts)])
    # Seen from the nearer half, both edges are to the left in the tail that ndtr resolves.
    low, high = -y / sigma, (1 - y) / sigma
    mass = np.where(low > 0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))
    keep = mass > 1e-300
    low, high, mass, w = low[keep], high[keep], mass[keep], w[keep]
    bell = lambda z: np.exp(-z * z / 2) / np.sqrt(2 * np.pi)  # noqa: E731
    mean = (bell(low) - bell(high)) / mass
    spread = 1 + (low * bell(low) - high * bell(high)) / mass - mean * mean
    entropy = -(w * mass * np.log(mass)).sum()
    gained = entropy - np.log(sigma) - 0.5 * np.log(2 * np.pi * np.e)
    return float(min((w * mass * spread).sum() * sigma**2, 1 / PRIOR)), float(max(gained, 0.0))


def ceiling(
    environment: str, windows: Batch, noise: Array | None = None, step: float = STEP, nthread: int = 1
) -> Ceiling:
    """What windows can tell of psi at most.

    Args:
      environment: id.
      windows: as `Windows` gives them: `psi`, `start`, `actions` and the terrain are read. The effect, if one was
        injected, is left out: the ceiling is that of psi in the simulator as it is.
      noise: (s,) standard deviation of each entry of the states; None is the robot's own (`Machine.noise`).
      step: of u.
      nthread: threads of the simulation; 0 takes every core.
    """
    machine = Machine(environment)
    sd = machine.noise if noise is None else np.asarray(noise, float)
    if sd.shape != (machine.kind.proprio_size,):
        raise InputError(f"noise has shape {sd.shape}, want ({machine.kind.proprio_size},): one of each state entry")
    horizon = windows["actions"].shape[1]

    def simulator(which: NDArray[np.intp], u: Array) -> Array:
        return replayed(machine, windows, which, u, nthread)

    return bounds(information(simulator, np.asarray(windows["psi"], float), np.tile(sd, horizon), step))


def replayed(machine: Machine, windows: Batch, which: NDArray[np.intp], u: Array, nthread: int) -> Array:
    """States (m, H s) after each control step of windows `which` (m,) from their starts, under other psi, u (m, d).

    A simulation that comes apart gives nan.
    """
    rough, kind = machine.rough, machine.kind
    grounds = list(zip(*(windows[f"terrain_{k}"].tolist() for k in ("kind", "seed", "difficulty")), strict=True))
    keys = sorted(set(grounds)) if rough else []
    fields = [made(machine.terrain_kinds[k], s, d, kind.terrain_scale) for k, s, d in keys]
    sims = machine.simulations(len(which), nthread, fields)
    robot, view, batch = sims.robot, sims.view, sims.batch
    psi = machine.space.low + u * (machine.space.high - machine.space.low)
    given = {"psi": psi}
    if rough:
        given["terrain_id"] = np.array([keys.index(g) for g in grounds])[which]
    sims.begin(np.arange(len(which)), given)
    # Whatever of the task is in the states (a target, a goal) is the same for all psi.
    view.task.update({name: np.zeros_like(value) for name, value in view.task.items()})
    batch.state[...] = windows["start"][which]
    view.now = robot.derive(view)
    out = []
    for action in np.moveaxis(windows["actions"][which].astype(np.float64), 1, 0):
        view.ctrl[...] = robot.actuate(action, view)
        batch.step(nstep=kind.frame_skip)
        view.task.update(robot.advance(view, action))
        view.before, view.now = view.now, robot.derive(view)
        out.append(np.concatenate(robot.proprio(view), -1))
    states = np.stack(out, 1).reshape(len(which), -1)
    return np.where(np.isfinite(states).all(1, keepdims=True), states, np.nan)
