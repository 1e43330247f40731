"""Small environments with known numbers that the wrappers' tests share."""

import tempfile
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.utils import EzPickle
from machines import ZOO

from nfc_gym.core import Fidelity

# A free cube far above the ground: no gravity, no contact, 1 kg.
CUBE = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="cube" pos="0 0 3"><freejoint name="free"/>
      <geom name="cube" type="box" size=".1 .1 .1" mass="1"/></body>
    <body name="pole" pos="2 0 1"><joint name="hinge" axis="0 1 0"/>
      <geom name="pole" type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".5"/></body>
  </worldbody>
  <actuator><motor name="twist" joint="hinge" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/><gyro name="gyro" site="middle"/></sensor>
</mujoco>
""".replace('<geom name="cube"', '<site name="middle"/><geom name="cube"')

# A roll-out's actuators begin settled at the first command, an environment's at zero: without a state they agree.
STATELESS = ZOO.replace(' dyntype="filterexact" dynprm=".05"', "")


class FakeEnv(MujocoEnv, EzPickle):
    """A model given as text, stepped as Gymnasium steps its own; observes qpos and qvel."""

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
        "render_fps": 50,
    }

    def __init__(self, xml: str = CUBE, frame_skip: int = 4, **kwargs: Any) -> None:
        EzPickle.__init__(self, xml, frame_skip, **kwargs)
        self._folder = tempfile.TemporaryDirectory()  # goes with the environment, which may read it again
        file = Path(self._folder.name) / "fake.xml"
        file.write_text(xml)
        model = mujoco.MjModel.from_xml_string(xml)
        self.metadata = {**self.metadata, "render_fps": round(1 / (model.opt.timestep * frame_skip))}
        box = spaces.Box(-np.inf, np.inf, (model.nq + model.nv,), np.float64)
        super().__init__(str(file), frame_skip, box, **kwargs)
        self.start = (self.init_qpos, self.init_qvel)

    def _set_action_space(self) -> spaces.Box:
        self.action_space = spaces.Box(-30, 30, (self.model.nu,), np.float64)
        return self.action_space

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.do_simulation(action, self.frame_skip)
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset_model(self) -> np.ndarray:
        self.set_state(*self.start)
        return self._observe()


class ZooEnv(FakeEnv):
    """The physics tests' machines with actuators that have no state of their own."""

    def __init__(self, frame_skip: int = 10, **kwargs: Any) -> None:
        FakeEnv.__init__(self, STATELESS, frame_skip, **kwargs)
        EzPickle.__init__(self, frame_skip, **kwargs)


class NoModel(gym.Env):
    """No MuJoCo beneath."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.zeros(2, np.float32), 0.0, False, False, {}


class Gaussian:
    """A posterior over one part with independent normal entries."""

    def __init__(self, part: str, mean: np.ndarray, sd: float) -> None:
        self.part, self.mean, self.sd = part, np.asarray(mean, float), sd

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        return Fidelity(**{self.part: self.mean + self.sd * rng.standard_normal((n, *self.mean.shape))})

    def log_prob(self, x: Fidelity) -> np.ndarray:
        z = (getattr(x, self.part) - self.mean) / self.sd
        return -0.5 * (z**2).sum(-1)


def roll(env: gym.Env, steps: int, seed: int = 0, actions: np.ndarray | None = None) -> list[Any]:
    """Observation of a reset and of `steps` random steps."""
    rng = np.random.default_rng(99)
    out = [env.reset(seed=seed)[0]]
    for k in range(steps):
        action = rng.uniform(-0.4, 0.4, env.action_space.shape).astype(env.action_space.dtype)
        observation, reward, terminated, truncated, _ = env.step(action if actions is None else actions[k])
        out.append((observation, reward, terminated, truncated))
    return out


def same(a: Any, b: Any) -> None:
    """Nested results, bit for bit."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    else:
        np.testing.assert_array_equal(a, b)


class Own(gym.Env):
    """Steps its model itself, and offers a place between two physics steps."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(CUBE)
        self.data, self.frame_skip, self.substep_hooks = mujoco.MjData(self.model), 4, []
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.model.nq + self.model.nv,), np.float64)
        self.action_space = spaces.Box(-30, 30, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.data.ctrl[:] = action
        for _ in range(self.frame_skip):
            for hook in self.substep_hooks:
                hook(self)
            mujoco.mj_step(self.model, self.data)
        return self._seen(), 0.0, False, False, {}

    def _seen(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])
