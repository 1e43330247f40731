"""Play between drive and joint, simulated as what it is: a rotor of its own that meets the joint at two stops."""

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Hidden

STEP = 2.5e-4  # s: stops are hard, and a rotor crosses a small gap within a few milliseconds
_LIGHT = 1e-6  # kg: what turns in a rotor is its armature
# Damping of the stops, of the critical one. A stop that is damped critically throws back 0.14 of the speed (exp(-2)),
# and at two steps to its time constant 0.02 to 0.23 of it, by where in a step it is met: no law foretells that. With
# three times as much damping it is 0.003 to 0.025.
_DULL = 3.0


class Backlash(Hidden):
    """The drive turns a rotor, which has the joint's armature; a tendon with limits lets them differ by the gap.

    Stops take all of the speed with which they are met, as far as steps of this length let them. The servo reads the
    joint. Behind a gear of high ratio a rotor that turns freely hardly pushes back on what carries it, so here it does
    not at all.
    """

    family = "backlash"

    def __init__(self, joint: str, gap: float) -> None:
        # The rotor is the joint's armature where that is larger than what is said here.
        super().__init__((joint,), {"gap": gap, "rotor": 1e-9}, f"{joint} has {1e3 * gap:.3g} mrad of play")

    def shape(self, spec: mujoco.MjSpec) -> None:
        name, half = self.where[0], self.parameters["gap"] / 2
        still = spec.copy().compile()
        starts = still.key_qpos[:, still.joint(name).qposadr[0]]
        joint, drive = spec.joint(name), next(a for a in spec.actuators if a.target == name)
        rotor = spec.worldbody.add_body(name="rotor")
        rotor.explicitinertial, rotor.ipos, rotor.mass, rotor.inertia = True, [0.0] * 3, _LIGHT, np.full(3, 1e-9)
        rotor.add_joint(name="rotor", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=joint.armature)
        joint.armature = 0.0
        for key, start in zip(spec.keys, starts, strict=True):  # the rotor's angle comes last
            key.qpos = [*key.qpos, start]
        stops = spec.add_tendon(
            name="play", limited=mujoco.mjtLimited.mjLIMITED_TRUE, range=[-half, half],
            solref_limit=[2 * STEP, _DULL], solimp_limit=[0.99, 0.99, 0.001, 0.5, 2.0],
        )  # fmt: skip
        stops.wrap_joint(name, 1.0)
        stops.wrap_joint("rotor", -1.0)
        self.drive = drive.name
        self.gain, self.bias = drive.gainprm[0], np.array(drive.biasprm[:3])
        self.commands, self.forces = np.array(drive.ctrlrange), np.array(drive.forcerange)
        drive.gainprm, drive.biasprm = np.zeros(10), np.zeros(10)
        spec.option.timestep = STEP

    def begin(self, model: mujoco.MjModel) -> None:
        joint = model.joint(self.where[0])
        self.actuator, self.rotor = model.actuator(self.drive).id, int(model.joint("rotor").dofadr[0])
        self.q, self.v = int(joint.qposadr[0]), int(joint.dofadr[0])

    def push(self, data: mujoco.MjData) -> None:
        wish = np.clip(data.ctrl[self.actuator], *self.commands)
        force = self.gain * wish + self.bias @ (1.0, data.qpos[self.q], data.qvel[self.v])
        data.qfrc_applied[self.rotor] += np.clip(force, *self.forces)
