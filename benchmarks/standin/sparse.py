"""The baseline SINDy: sparse regression by `pysindy` of what psi leaves over, one equation a degree of freedom.

Brunton, Proctor and Kutz, PNAS 113 (2016). The library holds the laws that this benchmark hides, as far as they can be
written at a sample: constant, angle, speed, speed squared, sign of the speed, acceleration, command, its rate. The
threshold is chosen on the selection logs. What it names is the term with the most force in the equation that explains
most there, read as generously as can be: every family that could make such a term at that place.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.hidden import Array, Hidden
from nfc_gym.physics.rollout import Plant

from .outside import parts
from .residual import Leftover, leftover

_LEAST = 0.05  # share of an equation's variance on unseen logs below which it names nothing
_THRESHOLDS = (0.05, 0.1, 0.2, 0.4, 0.8)  # of the target's root mean square
_DRIVE = ("gain", "loss", "supply_sag", "dead_zone", "saturation", "offset")
ON_JOINT = {
    "1": ("external_force", "offset", "sensor_bias"),
    "q": ("spring_offset", "gain", "loss"),
    "v": ("damping_poly",),
    "v|v|": ("damping_poly",),
    "sign v": ("coulomb", "stribeck"),
    "a": ("armature", "payload"),
    "u": _DRIVE,
    "du/dt": ("delay", "lag"),
}
ON_BASE = {
    "1": ("external_force", "wind", "slope", "com_shift", "payload", "offset"),
    "v": ("drag_linear", "wind", "rotor_drag", "slip"),
    "v|v|": ("drag_quadratic",),
    "sign v": ("slip",),
    "a": ("payload",),
    "u": _DRIVE,
    "du/dt": ("delay", "lag"),
}


@dataclass(frozen=True)
class Found:
    """What the regression names: a term at a place, the families that it may mean, and how much it explains."""

    term: str
    place: str
    families: tuple[str, ...]
    share: float

    def judged(self, hidden: Hidden) -> dict[str, Any]:
        """{named, right, share}: right where the hidden family is among its own and a joint's term is at its joint."""
        truths = parts(hidden)
        right = bool(truths) and all(t.family in self.families and self._at(t) for t in truths)
        text = f"{self.term} at {self.place}" if self.families else ""
        return {"named": text, "right": right, "share": self.share}

    def _at(self, truth: Hidden) -> bool:
        joint = self.place.removeprefix("joint:")
        if joint == self.place:
            return True
        return any(joint == w or joint.startswith(f"{w}_") or w.startswith(f"joint:{joint}:") for w in truth.where)


def regress(bench: Bench, fitting: Sequence[Log], selecting: Sequence[Log], plant: Plant, x: Array) -> Found:
    """Fit on the fit logs, choose the threshold on the selection logs; x (size,) is the calibrated model."""
    import pysindy

    model = plant.model
    fit, unseen = leftover(bench, fitting, plant, x), leftover(bench, selecting, plant, x)
    best = Found("", "", (), _LEAST)
    for dof in range(model.nv):
        names, table = _features(model, dof)
        train, test = table(fit), table(unseen)
        scale, size = _rms(train), _rms(fit.force[:, [dof]])
        if size[0] < 1e-9:
            continue
        goal = unseen.force[:, [dof]] / size
        for threshold in _THRESHOLDS:
            law = pysindy.SINDy(
                optimizer=pysindy.STLSQ(threshold=threshold, alpha=1e-3),
                feature_library=pysindy.PolynomialLibrary(degree=1, include_bias=False),
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # it says so where a threshold leaves no term
                law.fit(train / scale, t=1.0, x_dot=fit.force[:, [dof]] / size, feature_names=names)
            weight = law.coefficients()[0]
            share = 1 - float(
                ((goal[:, 0] - (test / scale) @ weight) ** 2).mean() / np.maximum((goal**2).mean(), 1e-12)
            )
            if share > best.share:
                term = names[int(np.abs(weight).argmax())]
                place, families = _meaning(model, dof, term)
                best = Found(term, place, families, share)
    return best


def _rms(a: Array) -> Array:
    return np.maximum(np.sqrt((a**2).mean(0)), 1e-9)


def _features(model: mujoco.MjModel, dof: int) -> tuple[list[str], Any]:
    """Names of one equation's terms, and what makes their table (n, k)."""
    joint = int(model.dof_jntid[dof])
    hinge = int(model.jnt_type[joint]) >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    own = [a for a in range(model.nu) if int(model.actuator_trnid[a, 0]) == joint and hinge]
    drives = own or ([] if hinge else list(range(model.nu)))
    names = ["1", *(["q"] if hinge else []), "v", "v|v|", "sign v", "a", *(["u", "du/dt"] if drives else [])]

    def table(d: Leftover) -> Array:
        v = d.qvel[:, dof]
        columns = [np.ones(len(d)), *([d.qpos[:, model.jnt_qposadr[joint]]] if hinge else [])]
        columns += [v, v * np.abs(v), np.tanh(v / 0.05), d.qacc[:, dof]]
        if drives:
            columns += [d.ctrl[:, drives].sum(1), d.rate[:, drives].sum(1)]
        return np.stack(columns, 1)

    return names, table


def _meaning(model: mujoco.MjModel, dof: int, term: str) -> tuple[str, tuple[str, ...]]:
    joint = int(model.dof_jntid[dof])
    if int(model.jnt_type[joint]) >= int(mujoco.mjtJoint.mjJNT_SLIDE):
        return f"joint:{mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)}", ON_JOINT[term]
    return f"base, axis {dof - int(model.jnt_dofadr[joint])}", ON_BASE.get(term, ())
