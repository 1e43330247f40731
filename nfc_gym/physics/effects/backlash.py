"""Play between a drive and its joint."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.drive import on_scalar, plain
from nfc_gym.physics.effects.hysteresis import excursion
from nfc_gym.physics.effects.lookup import actuator_names, index, joint_dofs, limited
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import angle_unit, joint_places, sized, with_joint_units, with_units

_STATELESS = int(mujoco.mjtDyn.mjDYN_NONE)
_LIGHT = 0.1  # share of the joint's inertia that a rotor has where the model states no armature


def drives(model: mujoco.MjModel) -> dict[str, int]:
    """Scalar joints that just one actuator moves, whose force is an affine function of command and motion: its id."""
    known, found = actuator_names(model), {}
    fit = {known.index(n) for n in plain(model)}
    for a in range(model.nactuator):
        joint = int(model.actuator_trnid[a, 0])
        if on_scalar(model, a):
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
            found.setdefault(name, []).append(a)
    stateless = lambda a: int(model.actuator_dyntype[a]) == _STATELESS  # noqa: E731
    return {n: a[0] for n, a in found.items() if n and len(a) == 1 and a[0] in fit and stateless(a[0])}


class Drive:
    """The torque of joints' actuators from command and motion, as MuJoCo computes it in the simulation at hand.

    Args:
      model: the nominal model.
      actuators: (n,) ids, each of a scalar joint.
    """

    def __init__(self, model: mujoco.MjModel, actuators: NDArray[np.intp]) -> None:
        joints = model.actuator_trnid[actuators, 0]
        self.rows = index(actuators)
        self.clips = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
        self.q, self.v = (
            index(model.jnt_qposadr[joints].astype(np.intp)),
            index(model.jnt_dofadr[joints].astype(np.intp)),
        )

    def torque(self, ctx: Context) -> Array:
        """(..., n) N m or N at the joints."""
        its = lambda name: ctx.nominal(f"actuator_{name}")[..., self.rows, :]  # noqa: E731
        gain, bias, gear = its("gainprm"), its("biasprm"), its("gear")[..., 0]
        length, speed = gear * ctx.q[..., self.q], gear * ctx.v[..., self.v]
        law = lambda p: p[..., 0] + p[..., 1] * length + p[..., 2] * speed  # noqa: E731
        wish = limited(ctx.ctrl[..., self.rows], *self._ends(ctx, "ctrl"))
        return gear * limited(law(gain) * wish + law(bias), *self._ends(ctx, "force"))

    def _ends(self, ctx: Context, kind: str) -> tuple[Array, Array]:
        """(low, high) of the actuators' `ctrl` or `force` ranges, infinite where there are none."""
        bounded = ctx.nominal(f"actuator_{kind}limited")[..., self.rows] != 0
        bounded = bounded & (kind == "force" or self.clips)
        ends = ctx.nominal(f"actuator_{kind}range")[..., self.rows, :]
        return np.where(bounded, ends[..., 0], -np.inf), np.where(bounded, ends[..., 1], np.inf)


class Backlash(Effect):
    """The drive turns freely through `gap` before its force reaches the joint.

    Where the force between rotor and joint (the drive's, less what the rotor's own inertia takes) changes sign, the
    rotor leaves one flank and crosses the play; meanwhile the joint coasts, without the rotor's inertia as far as it is
    in the joint's `armature`. Where they meet again they go on together (a plastic impact): the momentum that the drive
    gave its rotor arrives late but whole, and the drive pushes for the rest of that step. What is lost is the energy of
    the impact. Two-mass models of this kind: Nordin and Gutman, Automatica 38 (2002) 1633-1649. The actuator's law (a
    servo's position) is read at the joint, whose acceleration is that of the last step.

    `rotor` is not fitted: it is the joint's `armature`, or a tenth of the joint's inertia where the model has none.
    The gap is known to the same factor as the rotor is, since the time to cross it goes with their product. Where the
    joint has more armature than that, as parameters or an effect of its own have it, all of it is the rotor's: a drive
    with play whose rotor the model forgot is this law and `armature` together.
    """

    family = "backlash"
    # A rotor in the gap is led by the last moments before the start, whose states come from the start's own samples.
    off_before = True
    summary = "Backlash: dead travel between drive and joint"
    # The engine takes the inertia of a lone body that moves along or about its own axes from dof_M0, not from armature.
    MODULATES = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "dof_armature", "dof_M0")
    PARAMS = (
        Param("gap", "rad", 0.0, 1.0, probes=(0.01, 0.05)),
        Param("rotor", "kg m^2", 1e-12, 1e6, probes=(0.01,), shape=True),
    )

    def bind(self, model: mujoco.MjModel) -> None:
        known = drives(model)
        dofs = joint_dofs(model, self.where)
        for name in self.where:
            if name not in known:
                raise InputError(
                    f"backlash: no single motor or servo moves {name!r}; joints with one: {', '.join(known)}"
                )
        actuators = np.array([known[n] for n in self.where], np.intp)
        self.drive, self.rows = Drive(model, actuators), index(actuators)
        self.params = with_joint_units(self.params, model, dofs)

    def rest(self, ctx: Context, theta: Array) -> Any:
        """The rotor lies against the flank that the drive pushes."""
        v, half = ctx.v[..., self.drive.v], theta[..., 0:1] / 2
        return np.sign(self.drive.torque(ctx)) * half, np.array(v), np.ones_like(v), np.zeros_like(v), np.array(v)

    def follow(self, ctx: Context, theta: Array, memory: Any) -> Any:
        """(place of the rotor in the play, its speed, share of the step for which it pushes, impulse with which it
        hits, the joint's speed), (..., n) each."""
        place, speed, share, hit, before = memory
        v, half, rotor, dt = ctx.v[..., self.drive.v], theta[..., 0:1] / 2, self._rotor(ctx, theta), ctx.dt
        own = self.drive.torque(ctx) / rotor
        pull = own - np.where(hit == 0, (v - before) / dt, 0.0)  # the rotor's acceleration as the joint sees it
        side, pull = np.sign(pull), np.abs(pull)
        # Its speed as the joint sees it: none where it pushed; where it hit, both went on with a speed that only the
        # simulation knows, and the rotor's is told from what the joint's was.
        apart = np.where(share > 0, 0.0, speed - np.where(hit == 0, v, before))
        ahead, way = side * apart, np.maximum(half - side * place, 0.0)  # towards the flank that the drive pushes
        beyond = ahead**2 - 2 * pull * (2 * half - way)
        behind = np.sqrt(np.maximum(beyond, 0.0))  # speed with which it comes to the other flank
        until = 2 * (2 * half - way) / np.maximum(behind - ahead, 1e-300)
        back = (ahead < 0) & (beyond > 0) & (until < dt)  # it hits the other flank first
        kick = np.where(back, -behind, 0.0)
        ahead, way = np.where(back, 0.0, ahead), np.where(back, 2 * half, way)
        root = np.sqrt(ahead**2 + 2 * pull * way)  # speed with which it arrives
        sooner = 2 * way / np.where(ahead + root > 0, ahead + root, 1.0)
        later = (root - ahead) / np.maximum(pull, 1e-300)
        arrival = np.where(ahead < 0, later, sooner)
        arrival = np.where((way > 0) & (root == 0), np.inf, arrival)  # nothing moves it
        pushing = np.where(arrival < dt, 1 - arrival / dt, 0.0)
        kick = side * np.where(pushing > 0, kick + root, kick)
        # on its way through the step, or adrift where no force acts
        drift = np.where(side == 0, apart, side * ahead)
        moved = np.where(back, -side * half, place) + dt * (drift + dt / 2 * side * pull)
        inside = np.minimum(np.maximum(moved, -half), half)
        stopped = (side == 0) & (moved != inside)
        kick = np.where(stopped, drift, kick)
        free = np.where(stopped, v, v + drift + dt * own)
        met = pushing > 0
        return np.where(met, side * half, inside), np.where(met, v, free), pushing, rotor * kick, np.array(v)

    def modulate(self, ctx: Context, theta: Array, fields: Mapping[str, Array]) -> None:
        _, _, share, hit, _ = ctx.memory
        for name in self.MODULATES[:3]:
            fields[name][..., self.rows, :] *= share[..., None]
        together = (share > 0) | (hit != 0)  # what is hit moves the rotor on, too
        armature = fields["dof_armature"]
        whole = armature[..., self.drive.v]
        gone = np.where(together, 0.0, np.minimum(whole, self._rotor(ctx, theta)))
        armature[..., self.drive.v] = whole - gone
        fields["dof_M0"][..., self.drive.v] -= gone

    def _rotor(self, ctx: Context, theta: Array) -> Array:
        """(..., n) kg m^2 or kg: inertia of the rotors as it shows at the joints."""
        return np.maximum(theta[..., 1:2], ctx.nominal("dof_armature")[..., self.drive.v])

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        out.qfrc[..., self.drive.v] += ctx.memory[3] / ctx.dt

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        known = drives(model)
        for where in joint_places(model):
            if not set(where) <= set(known):
                continue
            dofs = joint_dofs(model, where)
            inertia = float(np.median(1 / np.maximum(model.dof_invweight0[dofs], 1e-9)))
            rotor = float(np.median(model.dof_armature[dofs])) or _LIGHT * inertia
            fixed = {"probes": (rotor,), "low": rotor * (1 - 1e-3), "high": rotor * (1 + 1e-3)}
            reach, unit = excursion(model, scales, where[0]), angle_unit(model, where[0])
            gap = {"probes": (0.02 * reach, 0.1 * reach), "high": reach, "resolution": 5e-4 * reach}
            units = {"gap": unit, "rotor": "kg m^2" if unit == "rad" else "kg"}
            out.append(cls(where, with_units(sized(cls.PARAMS, gap=gap, rotor=fixed), units)))
        return out
