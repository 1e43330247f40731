"""What may be read back of a batch of simulations."""

import mujoco
import numpy as np
from gymnasium.vector import VectorEnv
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.envs import scene
from nfc_gym.envs.batching import Ids
from nfc_gym.envs.robot import Robot
from nfc_gym.envs.simulations import Simulations
from nfc_gym.envs.view import View
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.terrain import Heightfield


class ReadableVectorEnv(VectorEnv):
    """What `RobotVectorEnv` says of its n simulations, apart from how it steps them.

    Attributes:
      frame_skip: physics steps a control step.
      rough: heightfields in place of a plane.
      height_limits: between which the ground must lie [m].
    """

    frame_skip: int
    rough: bool
    height_limits = (scene.LOWEST, scene.HIGHEST)
    _sims: Simulations
    _view: View

    @property
    def dt(self) -> float:
        """Control step, s."""
        return self.model.opt.timestep * self.frame_skip

    @property
    def model(self) -> mujoco.MjModel:
        """The nominal model; `set_terrains` replaces it, and the next three."""
        return self._sims.model

    @property
    def batch(self) -> Batch:
        """The simulations."""
        return self._sims.batch

    @property
    def fields(self) -> ModelFields:
        """Model fields of the batch; what is written through it goes back to nominal at every reset."""
        return self._sims.fields

    @property
    def robot(self) -> Robot:
        """The laws."""
        return self._sims.robot

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Every simulation's generator, as Gymnasium's own vector environments have them."""
        return tuple(self._sims.generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds that they began from."""
        return tuple(self._sims.seeds)

    @property
    def psi_space(self) -> ParameterSpace:
        """Names, units, bounds and nominal values of psi."""
        return self._sims.space

    @property
    def psi(self) -> NDArray[np.float64]:
        """(n, d) psi of every simulation in physical units."""
        return self._sims.psi.copy()

    def note_psi(self, psi: NDArray[np.float64], ids: Ids) -> None:
        """Say what `psi` of some simulations (k,) is: for whoever has written another one, (k, d), through `fields`.

        What the observation shows stays.
        """
        self._sims.psi[ids] = psi

    @property
    def terrain_id(self) -> Ids:
        """(n,) which of `maps` every simulation stands on."""
        return self._sims.chosen.copy()

    @property
    def maps(self) -> tuple[Heightfield, ...]:
        """The maps to choose from; none on flat ground."""
        return self._sims.maps

    @property
    def heightfield(self) -> list[Heightfield]:
        """n terrains that are simulated; zeros on flat ground."""
        return self._sims.terrains(self._sims.maps)

    @property
    def perceived(self) -> list[Heightfield]:
        """n terrains that `elevation` is taken from: the simulated ones, unless `set_terrains` was told others."""
        return self._sims.terrains(self._sims.perceived)

    @property
    def places(self) -> NDArray[np.float64]:
        """(n, place_size) world places of the goals [m], of robots that have some."""
        return self.robot.desired(self._view).copy()

    @property
    def proprio_components(self) -> list[str]:
        """What each entry of `proprio` is, in the names of logs: how a residual of it reaches the state."""
        return self.robot.components(self.model)

    @property
    def mjcf(self) -> str:
        """The nominal model on the first map, as MJCF that plain MuJoCo loads."""
        return self.robot.mjcf(self.maps[0] if self.rough else None)
