"""A vector environment in the second engine: the package's observations and rewards over PyBullet's motion."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from worlds.acting import overrides

from nfc_gym.core.errors import InputError
from nfc_gym.envs.batching import Ids, ids_of, masked, seeds_of
from nfc_gym.envs.contract import Observer, box, broken, nothing_yet, outcome, seen_psi
from nfc_gym.envs.look import look
from nfc_gym.envs.robot import Robot
from nfc_gym.envs.settings import Settings
from nfc_gym.envs.view import View
from nfc_gym.measured.hidden import Array, Hidden
from nfc_gym.terrain import Heightfield, surface

from .herd import Far, Herd, Near, Task

RADIUS = 0.098  # m that the Jackal's loaded tyres roll on
WHEELS = {"jackal": {f"{end}_{side}_wheel": RADIUS for end in ("front", "rear") for side in ("left", "right")}}
ROBOTS = ("jackal", "quadcopter", "quadruped")


def refusal(hidden: Hidden) -> str | None:
    """Why an effect cannot be carried over; None where it can."""
    return f"{hidden.text}: a force that asks MuJoCo for velocities is not in the second engine" \
        if overrides(hidden, "push") else None  # fmt: skip


class BulletVectorEnv(VectorEnv):
    """Robots of one kind, one simulation after another.

    Args:
      robot: class of the robot, whose compiled model says what it is made of.
      rough: heightfields in place of a plane.
      hidden: what changes its commands; what it does to the model must be in the robot's class already.
      num_envs, max_episode_steps, autoreset_mode, settings: as `RobotVectorEnv`.
      workers: processes that share the simulations; 1 is this one alone.

    Raises:
      InputError: a robot that is not carried over; an effect that pushes, whose formulas ask MuJoCo for velocities.
    """

    def __init__(
        self,
        robot: type[Robot],
        rough: bool,
        *,
        hidden: Hidden,
        num_envs: int,
        max_episode_steps: int = 1000,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        workers: int = 1,
        **settings: Any,
    ) -> None:
        if robot.name not in ROBOTS:
            raise InputError(f"the {robot.name} is not in the second engine; there are: {', '.join(ROBOTS)}")
        if why := refusal(hidden):
            raise InputError(why)
        given = Settings.of(robot, settings)
        self.num_envs, self.rough, self.render_mode = num_envs, rough, None
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "render_fps": 50, "autoreset_mode": self.autoreset_mode}
        self.model = robot.compile(0)
        self.robot, self.psi_space = given.robot(self.model), robot.space(self.model)
        self.maps = [given.pool.map(k) for k in range(given.pool.size)] if rough else []
        self.shown: Sequence[Heightfield] = self.maps
        self._stack = np.stack([m.heights for m in self.maps]) if rough else np.zeros((0, 2, 2), np.float32)
        self._observe = Observer(self.robot, len(self.psi_space), given.context)
        self.single_observation_space, self.single_action_space = self._observe.space, box(robot.action_size, bound=1.0)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._horizon = np.iinfo(np.int64).max if max_episode_steps == -1 else max_episode_steps
        self._start(robot, hidden, min(workers, num_envs))

    def _start(self, robot: type[Robot], hidden: Hidden, workers: int) -> None:
        n, model = self.num_envs, self.model
        sizes = {"qpos": model.nq, "qvel": model.nv, "ctrl": model.nu, "sensordata": model.nsensordata,
                 "actuator_force": model.nu}  # fmt: skip
        self._fields = {name: np.zeros((n, size)) for name, size in sizes.items()}
        self._view = View(model, self._fields.__getitem__, robot.reads, self._ground)
        self._shares = np.array_split(np.arange(n), workers)
        tasks = [Task(model, hidden, len(share), WHEELS.get(robot.name)) for share in self._shares]
        self._herds: list[Herd] = [Near(tasks[0])] if workers == 1 else [Far(task) for task in tasks]
        self._chosen = np.zeros(n, np.intp)
        self._generators = [seeding.np_random()[0] for _ in range(n)]
        self._waiting, self._steps = np.zeros(n, bool), np.zeros(n, np.int64)
        self._seen = np.tile(seen_psi(self.psi_space, self.psi_space.nominal), (n, 1))

    # ---- what may be read back ------------------------------------------------------------------------------------

    @property
    def places(self) -> Array:
        """(n, place_size) world places of the goals [m]."""
        return self.robot.desired(self._view).copy()

    @property
    def proprio_components(self) -> list[str]:
        """What each entry of `proprio` is."""
        return self.robot.components(self.model)

    @property
    def commands(self) -> Array:
        """(n, nu) what the actuators were last sent."""
        return self._view.ctrl.copy()

    def state(self) -> tuple[Array, Array]:
        """True positions (n, nq) and speeds (n, nv), in MuJoCo's terms."""
        return self._view.qpos.copy(), self._view.qvel.copy()

    def set_terrains(self, maps: Sequence[Heightfield], perceived: Sequence[Heightfield]) -> None:
        """What `elevation` shows of the maps that there are."""
        self.shown = perceived

    def _ground(self, xy: NDArray, which: Ids | None = None) -> Array:
        if not self.rough:
            return np.zeros(xy.shape[:-1])
        which = self._chosen if which is None else which
        which = which.reshape(which.shape + (1,) * (xy.ndim - 2))
        return surface(self._stack, xy, self.maps[0].resolution, self.maps[0].origin, which)[0]

    # ---- Gymnasium's interface ------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes; `options`: `reset_mask` (n,) alone."""
        given = dict(options or {})
        ids = ids_of(given.pop("reset_mask", None), self.num_envs)
        if given:
            raise InputError(f"reset has no option {next(iter(given))!r} in the second engine; it has: reset_mask")
        for i, own in enumerate(seeds_of(seed, self.num_envs)):
            if own is not None and i in ids:
                self._generators[i] = seeding.np_random(own)[0]
        self._begin(ids)
        return self._observation(), masked(nothing_yet(self.robot, self._view), np.isin(np.arange(self.num_envs), ids))

    def step(self, actions: Any) -> tuple[Any, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One control step of every environment; those that wait for a reset are reset."""
        actions, view, resetting = np.clip(np.asarray(actions, float), -1, 1), self._view, self._waiting.copy()
        view.ctrl[...] = self.robot.actuate(actions, view)
        self._advance(~resetting)
        unstable = broken(view) & ~resetting
        rewards, ended, info = outcome(self.robot, view, actions, unstable if unstable.any() else None)
        self._steps += 1
        if resetting.any():
            self._begin(np.flatnonzero(resetting))
            new = nothing_yet(self.robot, view)
            info = {key: np.where(resetting, new[key], value) for key, value in info.items()}
            rewards, ended = np.where(resetting, 0.0, rewards), ended & ~resetting
        truncated = self._steps >= self._horizon
        again = self.autoreset_mode is AutoresetMode.NEXT_STEP
        self._waiting = (ended | truncated) if again else np.zeros(self.num_envs, bool)
        return self._observation(), rewards, ended, truncated, masked(info, np.ones(self.num_envs, bool))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations."""
        for herd in self._herds:
            herd.close()

    # ---- inside ---------------------------------------------------------------------------------------------------

    def _begin(self, ids: Ids) -> None:
        view, robot = self._view, self.robot
        u = np.array([self._generators[i].random(1 + robot.draws) for i in ids])
        if self.rough:
            self._chosen[ids] = (u[:, 0] * len(self.maps)).astype(np.intp)
        start = robot.begin(u[:, 1:], lambda xy: self._ground(xy, self._chosen[ids]))
        view.qpos[ids], view.qvel[ids] = start.qpos, start.qvel
        for share, herd in zip(self._shares, self._herds, strict=True):
            for i in ids[np.isin(ids, share)]:
                ground = self.maps[self._chosen[i]] if self.rough else None
                herd.put(int(i - share[0]), ground, view.qpos[i], view.qvel[i])
        for name, value in start.task.items():
            old = view.task.get(name)
            new = np.empty((self.num_envs, *value.shape[1:]), value.dtype) if old is None else old.copy()
            new[ids] = value
            view.task[name] = new
        view.now = robot.derive(view)
        self._steps[ids] = 0

    def _advance(self, moving: NDArray[np.bool_]) -> None:
        """A control step of some simulations (n,), all workers at the same time."""
        view, busy = self._view, []
        for share, herd in zip(self._shares, self._herds, strict=True):
            rows = share[moving[share]]
            if len(rows):
                herd.begin((rows - share[0]).tolist(), view.ctrl[rows])
                busy.append((rows, herd))
        for rows, herd in busy:
            state = herd.end()
            view.qpos[rows], view.qvel[rows] = state.qpos, state.qvel
            self._fields["actuator_force"][rows], self._fields["sensordata"][rows] = state.force, state.sensors

    def _observation(self) -> Any:
        obs = self._observe(self._view, self._seen, None)
        if self._observe.elevation:
            obs["elevation"] = look(self._view.qpos, [self.shown[k] for k in self._chosen] if self.rough else None)
        return obs
