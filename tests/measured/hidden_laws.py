"""Small machines with a law that no model of theirs has, stepped by plain MuJoCo, and their logs."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from nfc_gym.core.log import Channel, Log

DT, SAMPLE = 0.001, 0.01  # s: of the machines, and between samples; the models step by STEP
STEP = 0.005

WHEEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="rim"><joint name="wheel" axis="0 1 0" damping="{known}"/>
    <geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="wheel"/></actuator>
</mujoco>
"""

BLOCK = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="block"><joint name="rail" type="slide" axis="1 0 0" damping="{known}"/>
    <geom type="box" size="0.1 0.1 0.1" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="rail"/></actuator>
</mujoco>
"""

CRAFT = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="craft" pos="0 0 1" simple="false"><joint name="flight" type="free"/>
    <geom type="box" size="0.1 0.15 0.03" mass="{known}"/><site name="hub"/></body></worldbody>
  <actuator>
    <motor name="motor" site="hub" gear="0 0 1 0 0 0"/><motor name="roll" site="hub" gear="0 0 0 1 0 0"/>
  </actuator>
</mujoco>
"""

Push = Callable[[mujoco.MjModel, mujoco.MjData], None]
Command = Callable[[float, mujoco.MjData, np.ndarray], list[float]]


@dataclass(frozen=True)
class Machine:
    """What is recorded.

    Attributes:
      text: the model's MJCF with a place for `known`, whose true value differs from the given one.
      given, true: values of `known`.
      command: (time, state, phases) -> the commands of the next sample.
      push: the hidden law, called before every step of DT.
    """

    text: str
    given: float
    true: float
    command: Command
    push: Push

    def model(self) -> mujoco.MjModel:
        """As its maker believes it."""
        return mujoco.MjModel.from_xml_string(self.text.format(known=self.given))


def swing(size: float) -> Command:
    """A rich command that keeps a joint turning to and fro."""
    return lambda t, d, p: [size * (np.sin(2.1 * t + p[0]) + 0.6 * np.sin(5.3 * t + p[1])) - 0.3 * size * d.qpos[0] / 6]


def slide(t: float, d: mujoco.MjData, p: np.ndarray) -> list[float]:
    return [4 * np.sin(2.2 * t + p[0]) + 2 * np.sin(5.1 * t + p[1]) - 2 * d.qpos[0]]


def hover(t: float, d: mujoco.MjData, p: np.ndarray) -> list[float]:
    goal = 0.65 + 0.5 * np.sin(1.7 * t + p[0])
    lift = 9.81 + 6 * (goal - d.qpos[2]) - 3 * d.qvel[2] + 1.5 * np.sin(6 * t + p[1])
    return [lift, 0.02 * np.sin(2.3 * t + p[2]) - 0.3 * d.qpos[4] - 0.05 * d.qvel[3]]


def nothing(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """A machine whose model lacks nothing."""


def record(machine: Machine, seed: int, seconds: float = 2.5) -> Log:
    """One noisy log of a machine."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(machine.text.format(known=machine.true))
    model.opt.timestep = DT
    data, phases = mujoco.MjData(model), rng.uniform(0, 2 * np.pi, 4)
    count = round(seconds / SAMPLE)
    q, v, u = np.zeros((count, model.nq)), np.zeros((count, model.nv)), np.zeros((count, model.nu))
    for k in range(count):
        q[k], v[k] = data.qpos, data.qvel
        data.ctrl[:] = u[k] = machine.command(k * SAMPLE, data, phases)
        for _ in range(round(SAMPLE / DT)):
            machine.push(model, data)
            mujoco.mj_step(model, data)
    controls = {f"ctrl:{model.actuator(i).name}": u[:, i] for i in range(model.nu)}
    noisy = lambda a, sd: Channel(a + sd * rng.normal(size=a.shape), noise=sd)  # noqa: E731
    if model.nq == 7:
        turned = q[:, 3:7].copy()
        for row in turned:
            mujoco.mju_quatIntegrate(row, 0.002 * rng.normal(size=3), 1.0)
        channels = {
            "body:craft:pos": noisy(q[:, :3], 0.002),
            "body:craft:quat": Channel(turned, noise=0.002),
            "body:craft:linvel": noisy(v[:, :3], 0.02),
            "body:craft:angvel@body": noisy(v[:, 3:], 0.02),
        }
    else:
        joint = model.joint(0).name
        channels = {f"joint:{joint}:pos": noisy(q[:, 0], 0.002), f"joint:{joint}:vel": noisy(v[:, 0], 0.02)}
    return Log(f"run_{seed}", np.arange(count) * SAMPLE, controls, channels)
