"""Small machines and helpers that the physics tests share."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import FAMILIES, Effect, Scales, build, propose
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments, Trajectory

Array = NDArray[np.float64]

# Something of everything: a rotorcraft (free body, thrust at sites), a rover on wheels (contact), an arm on two hinges
# with a motor and a position servo, a carriage on a slide with a velocity servo, and sensors.
ZOO = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom density="300"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="20 20 .1"/>
    <body name="craft" pos="0 0 2" simple="false">
      <joint name="flight" type="free"/>
      <geom type="box" size=".1 .15 .03" pos=".01 0 0" mass="1"/>
      <site name="front" pos=".1 0 0"/> <site name="rear" pos="-.1 0 0"/> <site name="imu"/>
    </body>
    <body name="rover" pos="5 0 .12" simple="false">
      <joint name="drive" type="free"/>
      <geom type="box" size=".2 .15 .03" mass="8" contype="0" conaffinity="0"/>
      <body name="wheel_l" pos="0 .2 0"><joint name="wheel_l" axis="0 1 0" damping=".01"/>
        <geom name="wheel_l" type="ellipsoid" size=".1 .03 .1" friction=".8"/></body>
      <body name="wheel_r" pos="0 -.2 0"><joint name="wheel_r" axis="0 1 0" damping=".01"/>
        <geom name="wheel_r" type="ellipsoid" size=".1 .03 .1" friction=".8"/></body>
      <body name="caster" pos="-.18 0 -.05"><joint name="caster" type="ball"/>
        <geom name="caster" type="sphere" size=".05" friction=".1"/></body>
    </body>
    <body name="upper" pos="0 5 1.5"><joint name="shoulder" axis="0 1 0" damping=".02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>
      <body name="lower" pos="0 0 -.3"><joint name="elbow" axis="0 1 0" range="-2 2" limited="true" frictionloss=".01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/></body></body>
    <body name="carriage" pos="0 -5 1" simple="false"><joint name="rail" type="slide" axis="1 0 0" stiffness="2"/>
      <geom type="sphere" size=".05"/></body>
  </worldbody>
  <actuator>
    <general name="thrust_f" site="front" gear="0 0 1 0 0 .02" ctrlrange="0 12" dyntype="filterexact" dynprm=".05"/>
    <general name="thrust_r" site="rear" gear="0 0 1 0 0 -.02" ctrlrange="0 12" dyntype="filterexact" dynprm=".05"/>
    <velocity name="spin_l" joint="wheel_l" kv="1" forcerange="-3 3" ctrlrange="-20 20"/>
    <velocity name="spin_r" joint="wheel_r" kv="1" forcerange="-3 3" ctrlrange="-20 20"/>
    <motor name="push" joint="shoulder" ctrlrange="-1 1"/>
    <position name="bend" joint="elbow" kp="4" kv=".1"/>
    <velocity name="slide" joint="rail" kv="3"/>
  </actuator>
  <sensor><accelerometer name="acc" site="imu"/><jointpos name="angle" joint="shoulder"/></sensor>
</mujoco>
"""


def zoo() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ZOO)


def zoo_scales(model: mujoco.MjModel) -> Scales:
    return Scales(
        force=np.full(model.nv, 0.5),
        speed=np.full(model.nv, 1.0),
        command=np.full(model.nu, 0.5),
        actuation=np.full(model.nu, 0.5),
        interval=0.01,
        exogenous={"exo:supply": 11.0, "exo:time": 1.0},
        channels={
            "joint:shoulder:pos": (0.5, 1e-3),
            "joint:elbow:vel": (0.5, 1e-3),
            "body:craft:quat": (0.1, 1e-3),
            "body:craft:linvel": (0.3, 1e-3),
            "sensor:acc": (1.0, 0.1),
        },
        low=model.qpos0 - 1.0,
        high=model.qpos0 + 1.0,
    )


def candidates(model: mujoco.MjModel) -> dict[str, list[Effect]]:
    """Every candidate that the zoo could have, by family."""
    out: dict[str, list[Effect]] = {name: [] for name in FAMILIES}
    for effect in propose(model, zoo_scales(model)):
        out[effect.family].append(effect)
    return out


def zoo_segments(model: mujoco.MjModel, seed: int, size: int = 2, history: int = 15, steps: int = 40) -> Segments:
    """Random states near rest, random commands, a supply that sags, over contact."""
    rng = np.random.default_rng(seed)
    hold = 10
    count = -(-(history + steps) // hold)
    ctrl = np.repeat(rng.normal(size=(size, count, model.nu)), hold, 1)[:, : history + steps]
    ctrl *= np.array([3, 3, 8, 8, 0.7, 1, 1])
    ctrl[..., :2] += 5.0
    qpos = np.tile(model.qpos0, (size, 1))
    hinges = [model.joint(n).qposadr[0] for n in ("shoulder", "elbow", "rail", "wheel_l", "wheel_r")]
    qpos[:, hinges] += rng.normal(size=(size, len(hinges))) * 0.3
    time = np.tile(np.arange(history + steps) * model.opt.timestep, (size, 1))
    volts = 12 - 2 * rng.random((size, 1)) - 5 * time
    return Segments(
        model.opt.timestep,
        history,
        qpos,
        rng.normal(size=(size, model.nv)) * 0.4,
        ctrl,
        {"exo:supply": volts, "exo:time": time},
    )


def plant_of(model: mujoco.MjModel, *effects: Effect) -> Plant:
    return Plant(model, ParameterSpace(model, []), effects, nthread=1)


def make(family: str, where: str | list[str], parameters: dict[str, float]) -> tuple[Effect, Array]:
    """`build`, with every parameter of the family that is not given at null."""
    try:
        return build(family, where, parameters)
    except InputError:
        rest = {p.name: p.null for p in FAMILIES[family].PARAMS if not p.shape}
        return build(family, where, rest | parameters)


def probe(effect: Effect) -> Array:
    """Parameters of a realistic size, all at once."""
    return np.array([p.probes[0] for p in effect.params])


def run(
    xml_or_model: str | mujoco.MjModel,
    effect: Effect | None,
    theta: Array | list[float],
    steps: int,
    qpos: Array | None = None,
    qvel: Array | list[float] | None = None,
    ctrl: Array | list[float] | float = 0.0,
    history: int = 0,
    exogenous: dict[str, Array] | None = None,
) -> Trajectory:
    """One segment of one machine under one effect; `ctrl` is a constant, (nu,), or (history + steps, nu)."""
    model = mujoco.MjModel.from_xml_string(xml_or_model) if isinstance(xml_or_model, str) else xml_or_model
    start = model.qpos0 if qpos is None else np.asarray(qpos, float)
    speed = np.zeros(model.nv) if qvel is None else np.asarray(qvel, float)
    commands = np.broadcast_to(np.asarray(ctrl, float), (history + steps, model.nu))
    signals = {k: np.asarray(s, float)[None] for k, s in (exogenous or {}).items()}
    segments = Segments(model.opt.timestep, history, start[None], speed[None], commands[None], signals)
    plant = plant_of(model) if effect is None else plant_of(model, effect)
    return plant.shoot(np.asarray(theta, float)[None], segments, sensors=True)
