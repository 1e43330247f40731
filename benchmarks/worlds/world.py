"""A world to adapt to: an ordinary Gymnasium environment, single or vector, that does not say what is true in it."""

import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.envs.robot import Robot
from nfc_gym.envs.vector import RobotVectorEnv
from nfc_gym.measured.hidden import Array
from nfc_gym.wrappers import VectorPerceiveTerrain, VectorPerturbSignals

from .acting import Acting
from .estimate import Estimate, estimated
from .machines import ROBOTS, machine, nominal_space, sensor_noise
from .perception import perceived
from .scenarios import draw
from .truth import Truth

MOTORS = 0.02  # of the action's range, standard deviation of what motors make of a command
ERRORS = {"jackal": 0.01}  # m, of the perceived map: a third of the steps that it climbs
OTHERS = 0.02  # m
POOL = 8  # maps of a Rough world
ENGINES = ("mujoco", "bullet")


@dataclass(frozen=True)
class World:
    """One world.

    Attributes:
      place: robot and ground as in the package's ids: `JackalFlat`, `AntRough`, ...
      scenario: what is hidden there, by parts joined with +: see `scenarios`.
      seed: of all that is drawn: sizes, places, maps.
      noisy: whether sensors, motors and the perceived map are noisy.
      engine: `mujoco`, or `bullet` (slow; Jackal, Quadcopter and Quadruped alone).

    Raises:
      InputError: no such place or scenario.
    """

    place: str
    scenario: str
    seed: int
    noisy: bool = True
    engine: str = "mujoco"

    def __post_init__(self) -> None:
        if self.robot not in ROBOTS or self.ground not in ("Flat", "Rough"):
            raise InputError(f"place {self.place!r}: want a robot and its ground, as in JackalFlat or AntRough")
        if self.engine not in ENGINES:
            raise InputError(f"engine {self.engine!r}: want one of: {', '.join(ENGINES)}")
        if self.engine == "bullet" and find_spec("pybullet") is None:
            raise MissingExtra("engine 'bullet' needs PyBullet: pip install 'nfc_gym[bench]'")
        self.truth  # noqa: B018 (raises where there is no such scenario)

    @property
    def name(self) -> str:
        """For tables and files."""
        return f"{self.place}_{self.scenario}_{self.seed}" + ("" if self.engine == "mujoco" else f"_{self.engine}")

    @property
    def ground(self) -> str:
        """`Flat` or `Rough`."""
        return self.place[-5:] if self.place.endswith("Rough") else self.place[-4:]

    @property
    def robot(self) -> str:
        """`jackal`, ..."""
        return self.place.removesuffix("Flat").removesuffix("Rough").lower()

    @property
    def kind(self) -> type[Robot]:
        """The robot's class in the package: nothing hidden."""
        return ROBOTS[self.robot]

    @property
    def context(self) -> list[str]:
        """What must be observed for policies of the package: the second engine cannot look up single cells of a map."""
        return ["psi", "elevation"] if self.engine != "mujoco" and self.ground == "Rough" else ["psi"]

    def rng(self, what: str) -> np.random.Generator:
        """Draws of one matter, that no other matter's draws change."""
        return np.random.default_rng([self.seed, zlib.crc32(f"{self.place} {self.scenario} {what}".encode())])

    @cached_property
    def truth(self) -> Truth:
        """What is hidden. For judges, never for agents."""
        return draw(self.robot, self.scenario, nominal_space(self.kind), self.rng("truth"))

    @property
    def refused(self) -> str | None:
        """Why the engine cannot have what is hidden; None where it can."""
        if self.engine == "mujoco":
            return None
        from bullet.worlds import refusal

        return refusal(self.truth.hidden)

    @cached_property
    def machine(self) -> type[Robot]:
        """The robot as it truly is."""
        return machine(self.kind, self.truth)

    def make(
        self,
        num_envs: int = 1,
        *,
        camera: bool = False,
        max_episode_steps: int = 1000,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        nthread: int = 1,
        render_mode: str | None = None,
        **settings: Any,
    ) -> VectorEnv:
        """Many simulations of this one world.

        Args:
          num_envs: n; simulation i with seed s draws its start, goal and map from s + i.
          camera: the map comes of a depth camera on the robot (slow) rather than with errors drawn once for each map.
          nthread: threads of the physics, 0 for all cores; processes in the second engine.
          max_episode_steps, autoreset_mode, render_mode, settings: as the package's vector environments take
            them (`task`, `context`, ...); the terrain is the world's own unless it is set here.
        """
        rough = self.ground == "Rough"
        given = {**self.terrain, **settings} if rough else settings
        common: dict[str, Any] = {
            "num_envs": num_envs, "max_episode_steps": max_episode_steps, "autoreset_mode": autoreset_mode,
        }  # fmt: skip
        if self.engine == "bullet":
            from bullet.worlds import BulletVectorEnv

            common |= {"hidden": self.truth.hidden, "workers": nthread or os.cpu_count() or 1}
            env: VectorEnv = BulletVectorEnv(self.machine, rough, **common, **given)
        else:
            env = RobotVectorEnv(
                self.machine, rough, nthread=nthread, render_mode=render_mode, **common, **given
            )  # fmt: skip
            Acting(env, self.truth.hidden)
        if not self.noisy:
            return env
        if rough and not camera:
            env.set_terrains(env.maps, self._seen(env))
        if camera:
            env = VectorPerceiveTerrain(env)
        return VectorPerturbSignals(env, self.noise(env))

    def _seen(self, env: Any) -> list[Any]:
        rngs = self.rng("perception").spawn(len(env.maps))
        return [perceived(m, ERRORS.get(self.robot, OTHERS), rng) for m, rng in zip(env.maps, rngs, strict=True)]

    @property
    def terrain(self) -> dict[str, Any]:
        """Settings of the maps: a pool of this world's own, of its scenario's kind."""
        own = int(self.rng("terrain").integers(1 << 31))
        return {"terrain_pool": POOL, "terrain_seed": own, **self.truth.settings}

    def noise(self, env: Any) -> Mapping[str, Any]:
        """Gaussian noise on motors and on what the robot senses of itself, as `PerturbSignals` takes it."""
        sd = sensor_noise(env.unwrapped.proprio_components)
        space = env.single_observation_space
        if isinstance(space, gymnasium.spaces.Dict):
            key = "proprio" if "proprio" in space.spaces else "observation"
        else:  # the goal, which is known, comes after what is sensed
            key, sd = "observation", np.append(sd, np.zeros(space.shape[0] - len(sd)))
        return {"action": {"sd": MOTORS}, key: {"sd": sd.tolist()}}

    def single(self, **arguments: Any) -> "SingleWorld":
        """One simulation as an ordinary `gymnasium.Env`; arguments as for `make`."""
        return SingleWorld(self, **arguments)


class SingleWorld(gymnasium.Env):
    """A world's only simulation.

    Args:
      world: which.
      arguments: as `World.make` takes them.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(self, world: World, **arguments: Any) -> None:
        self.many = world.make(1, autoreset_mode=AutoresetMode.DISABLED, **arguments)
        base, self._world = self.many.unwrapped, world
        self._nominal, self._noise = world.kind.compile(0), world.rng("estimate")
        self.robot, self.rough, self.psi_space = base.robot, base.rough, base.psi_space
        self.observation_space, self.action_space = self.many.single_observation_space, self.many.single_action_space
        self.render_mode = self.many.render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See `gymnasium.Env`."""
        super().reset(seed=seed)
        if seed is not None:  # its estimates too are then the same, whatever was run before: a mission may be resumed
            self._noise = self._world.rng(f"estimate {seed}")
        observation, info = self.many.reset(seed=seed, options=options)
        return first(observation), first(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See `gymnasium.Env`."""
        observation, reward, ended, truncated, info = self.many.step(np.asarray(action)[None])
        return first(observation), float(reward[0]), bool(ended[0]), bool(truncated[0]), first(info)

    @property
    def psi(self) -> Array:
        """(d,) what is believed: nominal, or what `reset(options={"psi": ...})` says."""
        return self.many.unwrapped.psi[0].copy()

    @property
    def data(self) -> Estimate:
        """Positions and speeds as the robot estimates them, with fresh noise each time that it is asked."""
        return estimated(self.many, self._nominal, self._world.noisy, self._noise)

    def render(self) -> Any:
        """A picture."""
        pictures = self.many.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Free what rendering holds."""
        self.many.close()


def first(values: Any) -> Any:
    """The first row of an array, or of each in a dict; masks of vector infos are left out."""
    if isinstance(values, dict):
        return {k: first(v) for k, v in values.items() if not k.startswith("_")}
    return values[0]
