"""Contact laws that MuJoCo does not have by name: restitution through a direct `solref`."""

import tomllib
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import ArrayLike, NDArray


@cache
def _table() -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """(omega in rad/s, restitution, damping ratio) as measured by drop tests; see the data file for how."""
    data = tomllib.loads(files("nfc_gym.assets").joinpath("restitution.toml").read_text())
    return float(data["omega"]), np.array(data["restitution"], float), np.array(data["zeta"], float)


def restitution_solref(restitution: ArrayLike) -> NDArray[np.float64]:
    """Direct `solref` (..., 2) = (-omega^2, -2 zeta omega) of a contact that bounces by a coefficient (...,), [0, 1].

    zeta comes from a table measured with one-sided contacts at 5 ms; the textbook zeta(e) of a two-sided oscillator
    creates energy there. Values outside the table take its ends.
    """
    omega, e, zeta = _table()
    order = np.argsort(e)
    ratio = np.interp(np.asarray(restitution, float), e[order], zeta[order])
    return np.stack([np.full_like(ratio, -(omega**2)), -2 * ratio * omega], -1)
