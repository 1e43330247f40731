"""Effects that the library has no law of: a right answer leaves them unexplained, at their place."""

from collections.abc import Sequence

import mujoco
import numpy as np

from .effect import Array, Effect, Form, Signals


class Grease(Effect):
    """A rail whose grease is stiff at one end: F = -size (x - start)^2 v, N."""

    def __init__(self, joint: str, size: float, start: float) -> None:
        super().__init__((), (joint,), f"{joint}: drag of {size:.3g} (x - {start:.2f})^2 v")
        self.joint, self.size, self.start = joint, size, start

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        dof, x = int(model.joint(self.joint).dofadr[0]), float(data.joint(self.joint).qpos[0])
        data.qfrc_applied[dof] -= self.size * (x - self.start) ** 2 * data.qvel[dof]


class Capstan(Effect):
    """A tendon that rubs in its sheath: of its tension it loses 1 - exp(-mu bend), bend the sum of two angles, rad."""

    TURNS = 2e-3  # m/s within which the friction changes sides

    def __init__(self, tendon: str, drive: str, bent: Sequence[str], mu: float, near: Sequence[Form] = ()) -> None:
        places = (tendon, drive, *bent)
        super().__init__(near, places, f"{tendon}: rubs in its sheath by 1 - exp(-{mu:.3g} bend) of its tension")
        self.tendon, self.drive, self.bent, self.mu = tendon, drive, tuple(bent), mu

    def begin(self, model: mujoco.MjModel, signals: Signals) -> None:
        self.id, self.actuator = model.tendon(self.tendon).id, model.actuator(self.drive).id

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        bend = sum(abs(float(data.joint(j).qpos[0])) for j in self.bent)
        sign = np.tanh(data.ten_velocity[self.id] / self.TURNS)
        lost = abs(data.actuator_force[self.actuator]) * (1 - np.exp(-self.mu * bend))
        data.qfrc_applied[:] -= sign * lost * _moment_arms(model, data, self.id)


def _moment_arms(model: mujoco.MjModel, data: mujoco.MjData, tendon: int) -> Array:
    """How a tendon's length goes with the joints, (nv,); MuJoCo keeps it sparse or whole."""
    arms = data.ten_J.ravel()
    if arms.size == model.ntendon * model.nv:
        return arms.reshape(model.ntendon, model.nv)[tendon].copy()
    out = np.zeros(model.nv)
    start, count = model.ten_J_rowadr[tendon], model.ten_J_rownnz[tendon]
    out[model.ten_J_colind[start : start + count]] = arms[start : start + count]
    return out


class Loom(Effect):
    """A cable loom over two joints that stiffens as it is bent: torque -size (q1 + q2)^3 on both, N m."""

    def __init__(self, joints: tuple[str, str], size: float) -> None:
        super().__init__((), joints, f"{' and '.join(joints)}: a loom of {size:.3g} (q1 + q2)^3")
        self.joints, self.size = joints, size

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        bend = sum(float(data.joint(j).qpos[0]) for j in self.joints)
        for joint in self.joints:
            data.qfrc_applied[int(model.joint(joint).dofadr[0])] -= self.size * bend**3


class Tether(Effect):
    """An elastic line to a point that is slack up to a length, m, and then pulls by its stiffness, N/m."""

    def __init__(self, body: str, anchor: Sequence[float], slack: float, stiffness: float) -> None:
        super().__init__((), (body,), f"{body}: a tether of {stiffness:.3g} N/m that is slack up to {slack:.2f} m")
        self.body, self.anchor, self.slack, self.stiffness = body, np.asarray(anchor, float), slack, stiffness

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b = model.body(self.body).id
        way = self.anchor - data.xpos[b]
        length = float(np.linalg.norm(way))
        data.xfrc_applied[b, :3] += self.stiffness * max(length - self.slack, 0.0) * way / length
