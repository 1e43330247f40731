"""`RobotEnv`: one robot in one simulation, a thin shell around the robot's laws."""

import copy
from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from nfc_gym.envs import scene
from nfc_gym.envs.batching import whole
from nfc_gym.envs.contract import (
    FLAT,
    UNSTABLE,
    Observer,
    as_numbers,
    box,
    broken,
    checked_options,
    nothing_yet,
    outcome,
    psi_of,
    rest_key,
    robot_class,
    seen_psi,
    wrong_action,
)
from nfc_gym.envs.look import look
from nfc_gym.envs.robot import Robot
from nfc_gym.envs.rotations import planar
from nfc_gym.envs.screen import Screen
from nfc_gym.envs.settings import Settings
from nfc_gym.envs.view import View
from nfc_gym.physics.fields import ModelFields
from nfc_gym.terrain import Heightfield, surface

_FLAGS = (bool, np.bool_)


class RobotEnv(gymnasium.Env):
    """A robot on flat ground or rough terrain.

    Args:
      robot: class of the robot, or `module:Class`.
      rough: heightfields in place of a plane.
      render_mode: None, `rgb_array` or `human`.
      settings: the attributes of `Settings`.

    Attributes:
      model, data: the simulation. Edits of the model last until the next reset where psi or `fields` touched them.
      fields: `ModelFields` of `model`; what is written through it goes back to nominal at every reset.
      psi_space: names, units, bounds and nominal values of psi.
      height_limits: between which the ground must lie [m].
      control_hooks: called with this environment before a control step's first physics step, its command being set.
      substep_hooks: called with this environment before every physics step; while empty, a control step is one call.
      after_hooks: called with this environment after the last physics step, before anything is observed.
      edit_hooks: called with `fields` at every reset, once psi is written and before anything is computed: what they
        write through them holds for the episode.
      screen: what renders; its `camera` may be changed between pictures.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 50}  # noqa: RUF012
    height_limits = (scene.LOWEST, scene.HIGHEST)  # m

    def __init__(
        self,
        robot: str | type[Robot],
        rough: bool = False,
        *,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        self._arguments = {"robot": robot, "rough": rough, "render_mode": render_mode, **settings}
        kind = robot_class(robot)
        given = Settings.of(kind, settings)
        self.screen = Screen(render_mode, (None, *self.metadata["render_modes"]), given)
        self.rough, self.render_mode = bool(rough), render_mode
        self.model = kind.compile(maps=1 if rough else 0)
        self.screen.require_camera(self.model)
        self.data = mujoco.MjData(self.model)
        self.robot = given.robot(self.model)
        self.psi_space = kind.space(self.model)
        self.fields = ModelFields(self.model)
        self.frame_skip = kind.frame_skip
        self.metadata = self.metadata | {"render_fps": round(1 / self.dt)}
        self.control_hooks: list[Callable[[RobotEnv], None]] = []
        self.substep_hooks: list[Callable[[RobotEnv], None]] = []
        self.after_hooks: list[Callable[[RobotEnv], None]] = []
        self.edit_hooks: list[Callable[[ModelFields], Any]] = []

        self._pool = given.pool
        self._terrain = self._perceived = FLAT
        self._observe = Observer(self.robot, len(self.psi_space), given.context)
        self._period = given.refresh_period(self.metadata["render_fps"])
        self._map: NDArray[np.float32] | None = None
        self._age, self._closed = 0, False
        self.observation_space = self._observe.space
        self.action_space = box(kind.action_size, bound=1.0)

        self._shape = (kind.action_size,)
        self._home = rest_key(self.model)
        self._psi = self.psi_space.nominal.copy()
        self._seen = seen_psi(self.psi_space, self._psi)
        self._view = View(self.model, lambda name: getattr(self.data, name), kind.reads, self._ground)

    # ---- what may be read back ------------------------------------------------------------------------------------

    @property
    def dt(self) -> float:
        """Control step, s."""
        return self.model.opt.timestep * self.frame_skip

    @property
    def psi(self) -> NDArray[np.float64]:
        """(d,) psi of the simulation in physical units."""
        return self._psi.copy()

    def note_psi(self, psi: NDArray[np.float64]) -> None:
        """Say what `psi` is: for whoever has written another one, (d,), through `fields` into the running episode.

        What the observation shows stays.
        """
        self._psi = np.array(psi, float)

    @property
    def proprio_components(self) -> list[str]:
        """What each entry of `proprio` is, in the names of logs: how a residual of it reaches the state."""
        return self.robot.components(self.model)

    @property
    def mjcf(self) -> str:
        """The nominal model with the ground of the running episode, as MJCF that plain MuJoCo loads."""
        return self.robot.mjcf(self._terrain if self.rough else None)

    @property
    def heightfield(self) -> Heightfield:
        """The terrain that is simulated; zeros on flat ground."""
        return self._terrain

    @property
    def perceived(self) -> Heightfield:
        """The terrain that `elevation` is taken from: the simulated one, unless a reset was told another."""
        return self._perceived

    def coming(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Heightfield, NDArray[np.float64]]:
        """Where a reset with these arguments would begin, for whoever lays ground around it; nothing is changed.

        Returns:
          The terrain without a residual, and (3,) x and y [m] and heading [rad] of the start on it.

        Raises:
          InputError: as `reset`.
        """
        own = whole(seed)
        given, u = self._checked(options, own), self._next_draws(own)
        ground = given["heightfield"] if "heightfield" in given else self._next_map(u[0]) if self.rough else FLAT
        return ground, planar(self.robot.begin(u[1:], ground.height).qpos)

    # ---- Gymnasium's interface ------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
          seed: of the environment's own generator, from which start, goal and terrain are drawn.
          options: `psi` and `psi_belief`: (d,) in physical units or a dict of names, the rest nominal (what the agent
            believes is by default the truth). On rough ground `heightfield`: (256, 256) m, or `terrain_id`: a map of
            the pool; `perceived`: (256, 256) m, what `elevation` shows, by default that terrain; `terrain_residual`:
            (256, 256) m, added to the simulated terrain alone.

        Raises:
          InputError: an unknown option or name, another shape, values that are not finite or physically impossible.
        """
        own = whole(seed)
        seed = seed if own is None else own  # what is none is Gymnasium's to refuse
        given = self._checked(options, seed)
        super().reset(seed=seed)
        u = self.np_random.random(1 + self.robot.draws)
        if self.rough:
            self._set_terrain(given, u[0])
        self._set_psi(given)
        self._still()
        start = self.robot.begin(u[1:], self._ground)
        self.data.qpos[:], self.data.qvel[:] = start.qpos, start.qvel
        mujoco.mj_forward(self.model, self.data)
        view = self._view
        view.task = dict(start.task)
        view.now = self.robot.derive(view)
        self._age = 0
        if self.render_mode == "human":
            self.render()
        return self._observation(), _leaves(nothing_yet(self.robot, view))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One control step of `frame_skip` physics steps.

        Args:
          action: (action_size,); values outside [-1, 1] are clipped.

        Raises:
          InputError: another shape, or an entry that is no finite number, which the message names.
          ResetNeeded: no episode was begun yet.
          ClosedEnvironmentError: it was closed, and not reset since.
        """
        action = as_numbers(action)
        values = action.tolist()  # a handful of numbers: looked at faster one by one than by numpy
        if action.shape != self._shape or not all(map(isfinite, values)):
            raise wrong_action(action, self._shape)
        if max(values) > 1 or min(values) < -1:
            action = np.clip(action, -1, 1)
        view = self._view
        if view.now is None:
            if self._closed:
                raise gymnasium.error.ClosedEnvironmentError("the environment was closed: reset it, or make another")
            raise gymnasium.error.ResetNeeded("the environment must be reset before its first step")
        view.ctrl[...] = self.robot.actuate(action, view)
        self._advance()
        unstable = broken(view)
        if unstable:
            self._rest()
        reward, terminated, info = outcome(self.robot, view, action, unstable if unstable else None)
        self._age += 1
        if self.render_mode == "human":
            self.render()
        return self._observation(), float(reward), bool(terminated), False, _leaves(info)

    def render(self) -> NDArray[np.uint8] | None:
        """(height, width, 3) picture for `rgb_array`; brings the window up to date for `human`.

        Without a `render_mode` Gymnasium's logger warns, and there is no picture.
        """
        return self.screen.render(self.model, self.data)

    def close(self) -> None:
        """Free what rendering holds; a step then wants a reset."""
        self.screen.close()
        self._view.now, self._closed = None, True

    # ---- inside ---------------------------------------------------------------------------------------------------

    def _ground(self, xy: NDArray) -> NDArray[np.float64] | float:
        if xy.ndim == 1:
            return self._terrain.height_at(*xy.tolist()) if self.rough else 0.0
        if not self.rough:
            return np.zeros(xy.shape[:-1])
        return surface(self._terrain.heights, xy, self._terrain.resolution, self._terrain.origin)[0]

    def _checked(self, options: Mapping[str, Any] | None, seed: int | None) -> dict[str, Any]:
        """Reset options as they are used: refused, if at all, before anything has changed."""
        given, space = checked_options(options, self.rough), self.psi_space
        for name in ("psi", "psi_belief"):
            if name in given:
                given[name] = psi_of(space, given[name], (), name)
        if "psi" in given:
            space.require_possible(given["psi"])
        for name in ("heightfield", "perceived"):
            if name in given:
                given[name] = scene.checked(given[name], name)
        if "terrain_id" in given:
            given["heightfield"] = self._pool.map(given["terrain_id"])
        if "terrain_residual" in given:  # which may lift a map too high, also one that is yet to be drawn
            ground = given["heightfield"] if "heightfield" in given else self._next_map(self._next_draws(seed)[0])
            given["risen"] = scene.risen(ground, given["terrain_residual"])
        return given

    def _next_draws(self, seed: int | None) -> NDArray[np.float64]:
        """What a reset with this seed is about to draw: for the map, then for the start."""
        generator = copy.deepcopy(self.np_random) if seed is None else seeding.np_random(seed)[0]
        return generator.random(1 + self.robot.draws)

    def _next_map(self, u: float) -> Heightfield:
        return self._pool.map(self._pool.draw(u))

    def _set_psi(self, given: Mapping[str, Any]) -> None:
        space = self.psi_space
        psi = given["psi"] if "psi" in given else space.nominal.copy()
        belief = given.get("psi_belief", psi)
        self.fields.restore()
        space.write(self.fields, psi)
        for hook in self.edit_hooks:
            hook(self.fields)
        self.fields.commit()
        self._psi, self._seen = psi, seen_psi(space, belief)

    def _set_terrain(self, given: Mapping[str, Any], u: float) -> None:
        terrain = given["heightfield"] if "heightfield" in given else self._next_map(u)
        self._terrain, self._perceived = given.get("risen", terrain), given.get("perceived", terrain)
        scene.write(self.model, 0, self._terrain.heights)

    def _advance(self) -> None:
        try:
            for hook in self.control_hooks:
                hook(self)
            if self.substep_hooks:
                for _ in range(self.frame_skip):
                    for hook in self.substep_hooks:
                        hook(self)
                    mujoco.mj_step(self.model, self.data)
            else:
                mujoco.mj_step(self.model, self.data, nstep=self.frame_skip)
            for hook in self.after_hooks:
                hook(self)
        except mujoco.FatalError:  # the solver ran out of memory, as happens where bodies are driven into one another
            self.data.qvel[:] = np.nan

    def _rest(self) -> None:
        """A simulation that came apart goes back to its keyframe, so that nothing that is returned holds NaN."""
        self._still()
        mujoco.mj_forward(self.model, self.data)

    def _still(self) -> None:
        if self._home < 0:
            mujoco.mj_resetData(self.model, self.data)
        else:
            mujoco.mj_resetDataKeyframe(self.model, self.data, self._home)
        self.data.warning.number[UNSTABLE] = 1

    def _observation(self) -> Any:
        return self._observe(self._view, self._seen, self._elevation() if self._observe.elevation else None)

    def _elevation(self) -> NDArray[np.float32]:
        """A fresh elevation map, or a copy of the last one between two refreshes."""
        if self._age % self._period == 0 or self._map is None:
            out = look(self.data.qpos, self._perceived if self.rough else None)
            if self._period > 1:
                self._map = out.copy()
            return out
        return self._map.copy()

    def __getstate__(self) -> dict[str, Any]:
        view = self._view
        state = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION.value))
        mujoco.mj_getState(self.model, self.data, state, mujoco.mjtState.mjSTATE_INTEGRATION.value)
        kept = ("_np_random", "_np_random_seed", "_psi", "_seen", "_terrain", "_perceived", "_map", "_age", "spec")
        return {
            "arguments": self._arguments,
            "kept": {k: self.__dict__[k] for k in kept if k in self.__dict__},
            "state": state,
            "view": (view.task, view.now, view.before),
        }

    def __setstate__(self, saved: dict[str, Any]) -> None:
        """Goes on where the pickled environment stopped, to the bit; edits of the model other than psi are not kept."""
        self.__init__(**saved["arguments"])
        self.__dict__.update(saved["kept"])
        self.psi_space.write(self.fields, self._psi)
        self.fields.commit()
        if self.rough:
            scene.write(self.model, 0, self._terrain.heights)
        self.data.warning.number[UNSTABLE] = 1
        mujoco.mj_setState(self.model, self.data, saved["state"], mujoco.mjtState.mjSTATE_INTEGRATION.value)
        mujoco.mj_forward(self.model, self.data)
        self._view.task, self._view.now, self._view.before = saved["view"]


def _leaves(info: dict[str, Any]) -> dict[str, NDArray | np.float64]:
    """Numpy leaves: float64 scalars, and flags as arrays of shape (), as Gymnasium's vectors want them."""
    return {k: np.asarray(v) if v.__class__ in _FLAGS else np.float64(v) for k, v in info.items()}


def make(robot: str | type[Robot], rough: bool = False, **kwargs: Any) -> RobotEnv:
    """A `RobotEnv`, or for `goal_conditioned=True` one with gymnasium-robotics' `GoalEnv` interface."""
    if not kwargs.get("goal_conditioned"):
        return RobotEnv(robot, rough, **kwargs)
    from nfc_gym.envs.goals import GoalRobotEnv

    return GoalRobotEnv(robot, rough, **kwargs)


make.metadata = RobotEnv.metadata  # type: ignore[attr-defined]  # where Gymnasium looks for what can be rendered
