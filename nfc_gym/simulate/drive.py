"""From signals in [-1, 1] to a robot's actions: what keeps it moving, and upright long enough for a window.

The Jackal and the Quadruped take commands that stand by themselves. The others' joints (or attitude) follow the
signals under feedback, as they would under any policy that does not let them fall at once.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from nfc_gym.envs.ant import Ant
from nfc_gym.envs.humanoid import Humanoid
from nfc_gym.envs.quadcopter import Quadcopter
from nfc_gym.envs.quadruped import Quadruped
from nfc_gym.envs.robot import Array, Robot
from nfc_gym.envs.rotations import axes
from nfc_gym.envs.view import View

Drive = Callable[[View, Array], Array]  # (view, signals (n, channels)) -> actions (n, action_size)


def channels(robot: Robot) -> int:
    """How many signals a robot's drive takes."""
    return robot.action_size


def drive_of(robot: Robot, model: mujoco.MjModel) -> Drive:
    """The drive of a robot."""
    if isinstance(robot, Ant):
        return _joints(robot, stiff=0.5, damped=0.05, reach=0.6)
    if isinstance(robot, Humanoid):
        return _joints(robot, stiff=0.25, damped=0.1, reach=0.35)
    if isinstance(robot, Quadcopter):
        return _attitude(robot, model)
    if isinstance(robot, Quadruped):
        return lambda view, signal: signal
    return lambda view, signal: signal


def _joints(robot: Ant | Humanoid, stiff: float, damped: float, reach: float) -> Drive:
    """Joints follow targets about the pose at home under proportional and derivative torque.

    Args:
      robot: whose motors' torque is gear times action.
      stiff: rad off the target at which the torque is at its largest.
      damped: s, derivative over proportional gain.
      reach: rad that a signal of 1 asks for.
    """
    home = robot.home[7:]

    def drive(view: View, signal: Array) -> Array:
        target = np.clip(home + reach * signal, robot.low, robot.high)
        return (target - view.qpos[..., 7:] - damped * view.qvel[..., 6:]) / stiff

    return drive


_CLIMB, _LEAN, _SPIN = 1.5, 0.5, 1.0  # m/s, rad, rad/s that a signal of 1 asks for
_LIFT, _RIGHT, _CALM = 8.0, 60.0, 12.0  # 1/s, 1/s^2, 1/s: bandwidths of climb, attitude and rates
_LEVEL, _BACK = 1.75, 1.5  # m, middle of the heights that episodes start at; 1/s: it is returned to


def _attitude(robot: Quadcopter, model: mujoco.MjModel) -> Drive:
    """Thrusts by which nominal climb, lean and spin follow the signals (feedback, then the rotors' inverse mixing)."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, int(model.key("home").id))
    mujoco.mj_forward(model, data)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    # Acceleration of climb and the three rates for each newton of each rotor, the mounts being held.
    effect = np.linalg.solve(inertia[:6, :6], moment[:, :6].T)[2:]
    mix = np.linalg.pinv(effect)
    half, gravity = model.actuator_ctrlrange[:, 1] / 2, -float(model.opt.gravity[2])

    def drive(view: View, signal: Array) -> Array:
        frame, v = axes(view.qpos[..., 3:7]), view.qvel
        climb = _CLIMB * signal[..., 0] + _BACK * (_LEVEL - view.qpos[..., 2])
        up = gravity + _LIFT * (climb - v[..., 2])
        lift = up / np.maximum(frame.zz, 0.5)
        roll = _RIGHT * (_LEAN * signal[..., 1] - frame.zy) - _CALM * v[..., 3]
        pitch = _RIGHT * (_LEAN * signal[..., 2] + frame.zx) - _CALM * v[..., 4]
        spin = _CALM / 4 * (_SPIN * signal[..., 3] - v[..., 5])
        return np.stack((lift, roll, pitch, spin), -1) @ mix.T / half - 1

    return drive
