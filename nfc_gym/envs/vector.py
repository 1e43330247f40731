"""`RobotVectorEnv`: many simulations of one robot on `mujoco.batch`, a thin shell around the robot's laws.

Environment i with seed s + i goes through the same states, to the bit, as a `RobotEnv` with that seed. Each simulation
has its own psi (`Batch.expand`) and its own terrain, one heightfield of a pool that `geom_dataid` chooses.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from mujoco.batch import SimulationError
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole
from nfc_gym.envs import scene
from nfc_gym.envs.batching import Ids, autoreset_of, final_info, ids_of, masked, rows_of, seeds_of, vector_options
from nfc_gym.envs.contract import (
    Observer,
    as_numbers,
    box,
    broken,
    nothing_yet,
    outcome,
    robot_class,
    wrong_action,
)
from nfc_gym.envs.forking import require_threads
from nfc_gym.envs.look import HeldMaps
from nfc_gym.envs.readable import ReadableVectorEnv
from nfc_gym.envs.registry import EPISODE
from nfc_gym.envs.robot import Robot
from nfc_gym.envs.screen import Screen, warn_without_mode
from nfc_gym.envs.settings import Settings
from nfc_gym.envs.simulations import Simulations
from nfc_gym.physics.fields import ModelFields
from nfc_gym.terrain import Heightfield


# Named though a base has it: learners (skrl) look for Gymnasium's among the direct bases to tell what they are given.
class RobotVectorEnv(ReadableVectorEnv, VectorEnv):  # type: ignore[override]
    """Robots on flat ground or rough terrain, stepped together.

    Args:
      robot, rough: as `RobotEnv`.
      num_envs: n.
      max_episode_steps: control steps after which an episode is truncated; as in `gymnasium.make` None is 1000, and
        -1 never.
      autoreset_mode: `AutoresetMode` or its value.
      nthread: threads of the batch; 0 takes every core.
      render_mode: None or `rgb_array`.
      settings: the attributes of `Settings`.

    Attributes:
      control_hooks: called with this environment before a control step's first physics step, its command being set.
      substep_hooks: called with this environment before every physics step; while empty, a control step is one call.
      after_hooks: called with this environment after the last physics step, before anything is observed.
      reset_hooks: called with the ids (k,) about to be reset, autoresets included; a returned dict of reset options,
        leading shape (k,), holds for those unless `reset` itself was given that option.
      edit_hooks: called at every reset, autoresets included, with the `ModelFields` of the simulations that begin, once
        psi is written and before anything is computed: what they write through them holds for the episode.

    It cannot be pickled or copied: `gymnasium.make_vec` makes another one.

    Raises:
      InputError: a value is none of these; the message says what would be valid.
    """

    def __init__(
        self,
        robot: str | type[Robot],
        rough: bool = False,
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        nthread: int = 0,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        self._kind, self._nthread = robot_class(robot), require_whole("nthread", nthread, 0)
        self._given = Settings.of(self._kind, settings)
        self.screen = Screen(render_mode, (None, "rgb_array"), self._given)
        self.num_envs, self.rough, self.render_mode = require_whole("num_envs", num_envs, 1), bool(rough), render_mode
        self.frame_skip, self.autoreset_mode = self._kind.frame_skip, autoreset_of(autoreset_mode)
        self.control_hooks: list[Callable[[RobotVectorEnv], None]] = []
        self.substep_hooks: list[Callable[[RobotVectorEnv], None]] = []
        self.after_hooks: list[Callable[[RobotVectorEnv], None]] = []
        self.reset_hooks: list[Callable[[Ids], Mapping[str, Any] | None]] = []
        self.edit_hooks: list[Callable[[ModelFields], Any]] = []
        steps = EPISODE if max_episode_steps is None else max_episode_steps
        endless = steps == -1
        self._horizon = np.iinfo(np.int64).max if endless else require_whole("max_episode_steps", steps, 1)

        pool = self._given.pool
        self._build([pool.map(k) for k in range(pool.size)] if rough else [])
        fps = round(1 / self.dt)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": fps, "autoreset_mode": self.autoreset_mode}
        self.screen.require_camera(self.model)
        self._elevation = HeldMaps(self.num_envs, self._given.refresh_period(fps))
        self._observe = Observer(self.robot, len(self.psi_space), self._given.context)
        self.single_observation_space = self._observe.space
        self.single_action_space = box(self._kind.action_size, bound=1.0)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._limit = np.ones((self.num_envs, self._kind.action_size))

    def _build(self, maps: Sequence[Heightfield], perceived: Sequence[Heightfield] | None = None) -> None:
        """Start a batch; every simulation then waits for its first reset."""
        n, before = self.num_envs, self.__dict__.get("_sims")
        self.screen.close()  # pictures are of the model that they were made with
        self._sims = Simulations(self._given, n, self._nthread, maps, maps if perceived is None else perceived)
        if before is not None:
            self._sims.generators, self._sims.seeds = before.generators, before.seeds
        self._view = self._sims.view
        self._steps = np.zeros(n, np.int64)
        self._waiting = np.ones(n, bool)  # for a reset
        self._fresh = True  # nothing was reset yet

    # ---- ground ---------------------------------------------------------------------------------------------------

    def set_terrains(self, maps: Sequence[Any], perceived: Sequence[Any] | None = None) -> None:
        """Other maps for the simulations to choose from; the batch is built anew, and must be reset before a step.

        Args:
          maps: `Heightfield`s or heights (256, 256) m; with n of them, `reset(options={"terrain_id": range(n)})` gives
            each simulation its own.
          perceived: what `elevation` shows on each of them; by default the maps themselves.

        Raises:
          InputError: these are no maps, not one perceived for each, or the ground is a plane.
        """
        if not self.rough:
            raise InputError("set_terrains: the ground of a Flat environment is a plane; use the Rough one")
        for name, given in (("maps", maps), ("perceived", [] if perceived is None else perceived)):
            if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray):
                raise InputError(f"set_terrains: {name} is {given!r}, want a sequence of maps")
        if len(maps) == 0 or (perceived is not None and len(perceived) != len(maps)):
            raise InputError(f"set_terrains: {len(maps)} maps and {len(perceived or [])} perceived ones; want one each")
        simulated = [scene.checked(m, f"maps[{k}]") for k, m in enumerate(maps)]
        shown = None if perceived is None else [scene.checked(m, f"perceived[{k}]") for k, m in enumerate(perceived)]
        self._build(simulated, shown)

    def coming(
        self, *, seed: int | Sequence[int | None] | None = None, maps: Sequence[Heightfield]
    ) -> tuple[Ids, NDArray[np.float64]]:
        """Where a reset of all would begin if these were the maps, for whoever lays ground there; nothing is changed.

        Returns:
          (n,) which of the maps each simulation draws, and (n, 3) x and y [m] and heading [rad] of its start.

        Raises:
          InputError: as `reset`.
        """
        seeds = self.check_reset(seed, None)[2]
        generators = [
            seeding.np_random(seeds[i])[0] if i in seeds else copy.deepcopy(generator)
            for i, generator in enumerate(self._sims.generators)
        ]
        return self._sims.coming(generators, maps)

    # ---- Gymnasium's interface ------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes.

        Args:
          seed: s gives environment i the seed s + i; or one for each.
          options: `reset_mask` (n,) bool, which environments; `psi` and `psi_belief`: (d,), (n, d) or a dict of names
            with values () or (n,), in physical units; on rough ground `terrain_id` () or (n,).

        Raises:
          InputError: as for `RobotEnv.reset`.
        """
        ids, given, seeds = self.check_reset(seed, options)
        self.closed = False  # else Gymnasium's `close` would leave what is made from now on
        for i, own in seeds.items():
            self._sims.generators[i], self._sims.seeds[i] = seeding.np_random(own)
        self._begin(ids, given)
        info = nothing_yet(self.robot, self._view)
        return self._observation(), masked(info, np.isin(np.arange(self.num_envs), ids))

    def check_reset(
        self, seed: int | Sequence[int | None] | None, options: Mapping[str, Any] | None
    ) -> tuple[Ids, dict[str, Any], dict[int, int]]:
        """Refuse what `reset` would refuse; nothing is changed.

        Returns:
          Ids (k,) of the environments to reset, their options of leading shape (k,), and the seeds of those that have
          one.

        Raises:
          InputError: as `reset`.
        """
        require_threads(self.batch)
        n = self.num_envs
        given = vector_options(options, self.rough, ("reset_mask",))
        ids = ids_of(given.pop("reset_mask", None), n)
        if self._fresh and len(ids) < n:
            raise InputError("reset_mask: the first reset must be of all environments")
        given = self._sims.checked(len(ids), {key: rows_of(value, ids, n, key) for key, value in given.items()})
        each = seeds_of(seed, n)
        seeds = {i: own for i in ids.tolist() if (own := each[i]) is not None}
        if seeds and min(seeds.values()) < 0:
            seeding.np_random(min(seeds.values()))  # Gymnasium's own error
        return ids, given, seeds

    def step(self, actions: Any) -> tuple[Any, NDArray, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One control step of every environment.

        Args:
          actions: (n, action_size); values outside [-1, 1] are clipped.

        Returns:
          Fresh arrays: observations, rewards (n,) float64, terminations and truncations (n,) bool, infos.

        Raises:
          InputError: another shape, or an entry that is no finite number, which the message names.
          ResetNeeded: an environment was not reset (after its episode, where autoreset is off).
          ClosedEnvironmentError: it was closed, and not reset since.
        """
        actions = as_numbers(actions)
        if actions.shape != self._limit.shape or not np.isfinite(actions).all():
            raise wrong_action(actions, self._limit.shape)
        resetting = self._waiting.copy() if self._waiting.any() else None
        if resetting is not None and (self._fresh or self.autoreset_mode is not AutoresetMode.NEXT_STEP):
            if self._fresh and self.closed:
                raise gymnasium.error.ClosedEnvironmentError("the environments were closed: reset them, or make others")
            raise gymnasium.error.ResetNeeded(f"environments {np.flatnonzero(resetting).tolist()} must be reset first")
        require_threads(self.batch)
        actions = np.minimum(np.maximum(actions, -self._limit), self._limit)
        view = self._view
        view.ctrl[...] = self.robot.actuate(actions, view)
        unstable = self._advance(None if resetting is None else ~resetting)
        rewards, ended, info = outcome(self.robot, view, actions, unstable)
        self._steps += 1
        if resetting is not None:
            self._begin(np.flatnonzero(resetting), {})
            new = nothing_yet(self.robot, view)
            info = {key: np.where(resetting, new[key], value) for key, value in info.items()}
            rewards, ended = np.where(resetting, 0.0, rewards), ended & ~resetting
        truncated = self._steps >= self._horizon
        done = ended | truncated
        info = masked(info, np.ones(self.num_envs, bool))
        self._waiting = done.copy()
        again = self.autoreset_mode is AutoresetMode.SAME_STEP and done.any()
        obs = self._restart(done, info) if again else self._observation()
        return obs, rewards, ended, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture (height, width, 3) of every environment; without a `render_mode` Gymnasium's logger warns."""
        if self.render_mode is None:
            warn_without_mode()
            return None
        each = range(self.num_envs)
        return tuple(self.screen.render(self.batch.get_model(i), self.batch.get_data(i)) for i in each)  # type: ignore[misc]

    def close_extras(self, **kwargs: Any) -> None:
        """Free what rendering holds; a step then wants a reset."""
        self.screen.close()
        self._waiting, self._fresh = np.ones_like(self._waiting), True

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            f"{type(self).__name__} cannot be pickled or copied, since its simulations are MuJoCo's own: make it anew "
            "with gymnasium.make_vec, and reset it with the same seed"
        )

    # ---- inside ---------------------------------------------------------------------------------------------------

    def _begin(self, ids: Ids, given: Mapping[str, Any]) -> None:
        """Begin episodes with options of leading shape (k,), and what the hooks add to them."""
        for hook in self.reset_hooks:
            given = {**vector_options(hook(ids), self.rough), **given}
        self._sims.begin(ids, given, self.edit_hooks)
        self._view.now = self.robot.derive(self._view)
        self._steps[ids] = 0
        self._waiting[ids] = False
        self._fresh = False

    def _restart(self, done: NDArray[np.bool_], info: dict[str, Any]) -> Any:
        """Same-step autoreset: the last observations and infos of the ended episodes go into `info`."""
        last = self._observation(done)
        self._begin(np.flatnonzero(done), {})
        info.update(final_info(last, info, nothing_yet(self.robot, self._view), done.copy()))
        return self._observation()

    def _advance(self, active: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        """Physics of one control step; returns which simulations came apart (and were put back to rest), None: none."""
        self._run(active)
        for hook in self.after_hooks:
            hook(self)
        unstable = broken(self._view)
        if active is not None:
            unstable &= active
        if not unstable.any():
            return None
        self._sims.still(np.flatnonzero(unstable))
        return unstable

    def _run(self, active: NDArray[np.bool_] | None) -> None:
        for hook in self.control_hooks:
            hook(self)
        if not self.substep_hooks:
            self._physics(active, self.frame_skip)
            return
        for _ in range(self.frame_skip):
            for hook in self.substep_hooks:
                hook(self)
            self._physics(active, 1)

    def _physics(self, active: NDArray[np.bool_] | None, steps: int) -> None:
        try:
            self.batch.step(active, nstep=steps)
        except SimulationError as error:  # the solver ran out of memory in some; the others went on
            self._view.qvel[error.ids] = np.nan

    def _observation(self, rows: NDArray[np.bool_] | None = None) -> Any:
        """Fresh observations of all environments, or of some."""
        obs = self._observe(self._view, self._sims.seen, None)
        if rows is not None:
            obs = obs[rows] if self._observe.plain else {k: v[rows] for k, v in obs.items()}
        if self._observe.elevation:
            perceived = self._sims.perceived or None
            obs["elevation"] = self._elevation.around(self._view.qpos, perceived, self._sims.chosen, self._steps, rows)
        return obs


def make(robot: str | type[Robot], rough: bool = False, **kwargs: Any) -> RobotVectorEnv:
    """A `RobotVectorEnv`, or for `goal_conditioned=True` one with gymnasium-robotics' `compute_reward`."""
    if not kwargs.get("goal_conditioned"):
        return RobotVectorEnv(robot, rough, **kwargs)
    from nfc_gym.envs.goals import GoalRobotVectorEnv

    return GoalRobotVectorEnv(robot, rough, **kwargs)
