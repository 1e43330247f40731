"""One robot in PyBullet: its state in MuJoCo's terms, its drives, springs and friction by formulas written here."""

import copy
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pybullet

from nfc_gym.measured.hidden import Array
from nfc_gym.terrain import Heightfield

from .urdf import TINY, colliding, to_urdf, with_rotors

STEP = 0.001  # s: a servo as stiff as the Jackal's is stable where its torque is worked out once a step
DEAD = 0.05  # rad/s within which dry friction passes through zero
FLOOR = 1.0  # friction of the ground: Bullet multiplies it with that of what touches it


def _limits(limited: Array, ranges: Array) -> tuple[Array, Array]:
    """(nu,) lower and (nu,) upper, infinite where there is none."""
    low, high = np.where(limited.astype(bool), ranges.T, [[-np.inf], [np.inf]])
    return low, high


class Simulation:
    """A robot with everything that moves it.

    Args:
      model: the MuJoCo model that it is made of: sizes, inertias, drives, springs. Nothing of it is simulated.
      ground: the terrain; None is a plane.
      wheels: geom -> radius [m] of the sphere that takes its place: one contact a wheel as in MuJoCo, of what a loaded
        tyre rolls on. Bullet has no ellipsoids, and a cylinder's edges all but stop it from turning on the spot.

    Positions (nq,), speeds (nv,) and controls (nu,) are MuJoCo's, joint by joint.
    """

    def __init__(
        self, model: mujoco.MjModel, ground: Heightfield | None, wheels: dict[str, float] | None = None
    ) -> None:
        self.model, self.client = model, pybullet.connect(pybullet.DIRECT)
        self._call("setTimeStep", STEP)
        self._call("setGravity", *model.opt.gravity.tolist())
        # The cone would be the better law, but as Bullet solves it, friction is not opposed to the slip, and wheels
        # that slide sideways hold a rover back by half of its yaw rate.
        self._call("setPhysicsEngineParameter", numSolverIterations=50, enableFileCaching=0, enableConeFriction=0)
        self._ground(ground)
        self._load(model, wheels or {})
        self.joints = [j for j in range(model.njnt) if int(model.jnt_type[j]) != int(mujoco.mjtJoint.mjJNT_FREE)]
        self.index = [self.links[model.joint(j).name] for j in self.joints]
        dofs = [int(model.jnt_dofadr[j]) for j in self.joints]
        self.damping = model.dof_damping.reshape(model.nv, -1)[dofs, 0]
        self.dry = model.dof_frictionloss[dofs]
        self.stiffness = model.jnt_stiffness.reshape(model.njnt, -1)[self.joints, 0]
        self.rest = model.qpos_spring[[int(model.jnt_qposadr[j]) for j in self.joints]]
        self._drives(model)
        self._call("setJointMotorControlArray", self.robot, self.index, pybullet.VELOCITY_CONTROL,
                   forces=[0.0] * len(self.index))  # fmt: skip

    def _call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        return getattr(pybullet, name)(*args, **kwargs, physicsClientId=self.client)

    def _ground(self, ground: Heightfield | None) -> None:
        if ground is None:
            shape = self._call("createCollisionShape", pybullet.GEOM_PLANE)
            self.floor = self._call("createMultiBody", 0, shape)
        else:
            heights, middle = ground.heights, (ground.heights.min() + ground.heights.max()) / 2
            rows, columns = heights.shape
            shape = self._call(
                "createCollisionShape", pybullet.GEOM_HEIGHTFIELD, meshScale=[ground.resolution] * 2 + [1.0],
                heightfieldData=heights.ravel().astype(float).tolist(), numHeightfieldRows=columns,
                numHeightfieldColumns=rows,
            )  # fmt: skip
            self.floor = self._call("createMultiBody", 0, shape, basePosition=[*ground.centre, float(middle)])
        self._call("changeDynamics", self.floor, -1, lateralFriction=FLOOR, rollingFriction=0, spinningFriction=0,
                   restitution=0)  # fmt: skip

    def _load(self, model: mujoco.MjModel, wheels: dict[str, float]) -> None:
        rolling = copy.copy(model)
        for name, radius in wheels.items():
            geom = rolling.geom(name).id
            rolling.geom_type[geom], rolling.geom_size[geom] = int(mujoco.mjtGeom.mjGEOM_SPHERE), (radius, 0, 0)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(to_urdf(rolling))
            self.robot = self._call("loadURDF", str(path), flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
        infos = [self._call("getJointInfo", self.robot, i) for i in range(self._call("getNumJoints", self.robot))]
        self.links = {i[1].decode(): i[0] for i in infos}
        bodies = {i[12].decode(): i[0] for i in infos} | {model.body(1).name: -1}
        self.bodies = bodies
        for body in range(1, model.nbody):
            geoms = colliding(model, body)
            friction = model.geom_friction[geoms[0], 0] if geoms else 0.0
            inertia = np.maximum(with_rotors(model, body), TINY).tolist()
            self._call("changeDynamics", self.robot, bodies[model.body(body).name], lateralFriction=float(friction),
                       rollingFriction=0, spinningFriction=0, restitution=0, localInertiaDiagonal=inertia)  # fmt: skip
        for link in range(-1, len(infos)):
            self._call("changeDynamics", self.robot, link, linearDamping=0, angularDamping=0, jointDamping=0,
                       maxJointVelocity=1e3)  # fmt: skip
        # Bullet puts a base where its mass is, MuJoCo where its frame is.
        dynamics = self._call("getDynamicsInfo", self.robot, -1)
        self.centre, self.turn = dynamics[3], dynamics[4]
        self.back = pybullet.invertTransform(self.centre, self.turn)

    def _drives(self, model: mujoco.MjModel) -> None:
        """Where each actuator acts: at a joint, or at a place of a body that it pushes and twists."""
        self.at_joint: list[tuple[int, int]] = []
        self.at_site: list[tuple[int, int, Array, Array]] = []
        for a in range(model.nu):
            target = int(model.actuator_trnid[a, 0])
            if int(model.actuator_trntype[a]) == int(mujoco.mjtTrn.mjTRN_JOINT):
                self.at_joint.append((a, self.joints.index(target)))
            else:
                link = self.bodies[model.body(model.site_bodyid[target]).name]
                # Bullet takes place and direction in the frame of the body's inertia.
                centre, turn = self._call("getDynamicsInfo", self.robot, link)[3:5]
                axes = np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
                gear = model.actuator_gear[a].reshape(2, 3) @ axes
                self.at_site.append((a, link, (model.site_pos[target] - centre) @ axes, gear.ravel()))
        # What `forces` asks for in every step; without a limit it is infinite.
        self.moved, self.rows = [a for a, _ in self.at_joint], [k for _, k in self.at_joint]
        self.gear, self.gain = model.actuator_gear[self.moved, 0], model.actuator_gainprm[:, 0].copy()
        self.bias = model.actuator_biasprm[:, :3].T.copy()
        self.commands = _limits(model.actuator_ctrllimited, model.actuator_ctrlrange)
        self.strength = _limits(model.actuator_forcelimited, model.actuator_forcerange)
        slow = model.actuator_dyntype != int(mujoco.mjtDyn.mjDYN_NONE)
        self.follows = np.where(slow, 1 - np.exp(-STEP / np.where(slow, model.actuator_dynprm[:, 0], 1.0)), 1.0)
        self.thrust = np.zeros(model.nu)

    # ---- state ----------------------------------------------------------------------------------------------------

    def place(self, qpos: Array, qvel: Array) -> None:
        """Put the robot into a state."""
        w, *xyz = qpos[3:7]
        pos, quat = pybullet.multiplyTransforms(qpos[:3], [*xyz, w], self.centre, self.turn)
        self._call("resetBasePositionAndOrientation", self.robot, pos, quat)
        turn = np.array(pybullet.getMatrixFromQuaternion([*xyz, w])).reshape(3, 3)
        rate = turn @ qvel[3:6]
        linear = qvel[:3] + np.cross(rate, turn @ np.array(self.centre))
        self._call("resetBaseVelocity", self.robot, linear.tolist(), rate.tolist())
        for k, joint in enumerate(self.joints):
            at, dof = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
            self._call("resetJointState", self.robot, self.index[k], float(qpos[at]), float(qvel[dof]))
        self.thrust[:] = self.model.key_act[0] if self.model.na and self.model.nkey else 0.0

    def hinges(self) -> tuple[Array, Array]:
        """Angles and speeds (k,) of the joints."""
        states = self._call("getJointStates", self.robot, self.index) if self.index else ()
        return np.array([s[0] for s in states]), np.array([s[1] for s in states])

    def read(self, qpos: Array, qvel: Array) -> None:
        """The robot's state into (nq,), (nv,)."""
        pos, quat = self._call("getBasePositionAndOrientation", self.robot)
        linear, rate = (np.array(v) for v in self._call("getBaseVelocity", self.robot))
        place, (x, y, z, w) = pybullet.multiplyTransforms(pos, quat, *self.back)
        turn = np.array(pybullet.getMatrixFromQuaternion([x, y, z, w])).reshape(3, 3)
        qpos[:3], qpos[3:7] = place, (w, x, y, z)
        qvel[:3] = linear - np.cross(rate, turn @ np.array(self.centre))
        qvel[3:6] = turn.T @ rate
        q, v = self.hinges()
        for k, joint in enumerate(self.joints):
            qpos[self.model.jnt_qposadr[joint]], qvel[self.model.jnt_dofadr[joint]] = q[k], v[k]

    def touching(self, bodies: Sequence[str]) -> Array:
        """Force with which each body is pressed against the ground [N]."""
        points = self._call("getContactPoints", self.robot, self.floor)
        force: dict[int, float] = {}
        for p in points:
            force[p[3]] = force.get(p[3], 0.0) + p[9]
        return np.array([force.get(self.bodies[b], 0.0) for b in bodies])

    def velocity(self, body: str) -> Array:
        """(3,) linear velocity of a body's centre of mass in the world [m/s]."""
        link = self.bodies[body]
        if link < 0:
            return np.array(self._call("getBaseVelocity", self.robot)[0])
        return np.array(self._call("getLinkState", self.robot, link, computeLinkVelocity=1)[6])

    # ---- motion ---------------------------------------------------------------------------------------------------

    def forces(self, ctrl: Array, q: Array, v: Array) -> Array:
        """What the actuators make of a command (nu,) while the joints are at q (k,) and v (k,): N or N m."""
        low, high = self.commands
        self.thrust += self.follows * (np.minimum(np.maximum(ctrl, low), high) - self.thrust)
        force = self.gain * self.thrust + self.bias[0]
        force[self.moved] += self.bias[1, self.moved] * q[self.rows] + self.bias[2, self.moved] * v[self.rows]
        low, high = self.strength
        return np.minimum(np.maximum(force, low), high)

    def step(self, ctrl: Array) -> Array:
        """One step of `STEP`; returns the actuators' forces (nu,)."""
        q, v = self.hinges()
        force = self.forces(ctrl, q, v)
        torque = -self.damping * v - self.dry * np.tanh(v / DEAD) - self.stiffness * (q - self.rest)
        np.add.at(torque, self.rows, self.gear * force[self.moved])
        if self.index:
            self._call("setJointMotorControlArray", self.robot, self.index, pybullet.TORQUE_CONTROL,
                       forces=torque.tolist())  # fmt: skip
        for a, link, at, gear in self.at_site:
            push, twist = (force[a] * gear[:3]).tolist(), (force[a] * gear[3:]).tolist()
            self._call("applyExternalForce", self.robot, link, push, at.tolist(), pybullet.LINK_FRAME)
            self._call("applyExternalTorque", self.robot, link, twist, pybullet.LINK_FRAME)
        self._call("stepSimulation")
        return force

    def close(self) -> None:
        """Free it."""
        if self.client >= 0:
            pybullet.disconnect(self.client)
            self.client = -1
