"""`Simulations`: a batch of a robot's simulations, each with its own psi, terrain, generator and task memory."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium.utils import seeding
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.envs import scene
from nfc_gym.envs.batching import Ids, terrain_ids
from nfc_gym.envs.contract import FLAT, UNSTABLE, psi_of, rest_key, seen_psi
from nfc_gym.envs.forking import safe_to_fork
from nfc_gym.envs.rotations import planar
from nfc_gym.envs.settings import Settings
from nfc_gym.envs.view import View
from nfc_gym.physics.fields import ModelFields
from nfc_gym.terrain import Heightfield, surface


class Simulations:
    """n simulations on `mujoco.batch`.

    Args:
      given: the environment's settings.
      n: simulations.
      nthread: threads of the batch; 0 takes every core.
      maps: terrains to choose from; none is a plane.
      perceived: what `elevation` shows on each of them.

    Attributes:
      model, batch, fields, robot, space: the nominal model, the simulations, their model fields, the laws, psi.
      view: what the laws read, (n, ...).
      psi, seen: (n, d) in physical units, and as agents believe it, normalised.
      chosen: (n,) map of each simulation.
      generators, seeds: n of each, what starts, goals and maps are drawn from.
    """

    def __init__(
        self, given: Settings, n: int, nthread: int, maps: Sequence[Heightfield], perceived: Sequence[Heightfield]
    ) -> None:
        self.n, self.maps, self.perceived = n, tuple(maps), tuple(perceived)
        self.model = given.kind.compile(len(maps))
        for k, heightfield in enumerate(maps):
            scene.write(self.model, k, heightfield.heights)
        self.robot, self.space = given.robot(self.model), given.kind.space(self.model)
        self.batch = safe_to_fork(Batch(self.model, n, nthread))
        self.fields = ModelFields(self.batch)
        self.view = View(self.model, self.batch.bind, given.kind.reads, self.ground)
        self.psi = np.tile(self.space.nominal, (n, 1))
        self.seen = np.zeros((n, len(self.space)), np.float32)
        self.chosen = np.zeros(n, np.intp)
        self.generators, self.seeds = map(list, zip(*(seeding.np_random() for _ in range(n)), strict=True))
        self.rest = rest_key(self.model)
        self._stack = np.stack([m.heights for m in maps]) if maps else np.zeros((0, 2, 2), np.float32)
        # Which map a simulation stands on is one entry of `geom_dataid`.
        self._dataid = self.batch.expand("geom_dataid")[:, self.model.geom(scene.GROUND).id] if maps else None

    def ground(self, xy: NDArray, which: Ids | None = None) -> NDArray[np.float64]:
        """Height of the terrain below points (k, ..., 2); `which` (k,): their maps, by default every simulation's."""
        if self._dataid is None:
            return np.zeros(xy.shape[:-1])
        which = self.chosen if which is None else which
        which = which.reshape(which.shape + (1,) * (xy.ndim - 2))
        return surface(self._stack, xy, self.maps[0].resolution, self.maps[0].origin, which)[0]

    def terrains(self, maps: Sequence[Heightfield]) -> list[Heightfield]:
        """Of `maps` or `perceived`, each simulation's own."""
        return [maps[int(k)] for k in self.chosen] if maps else [FLAT] * self.n

    def checked(self, k: int, given: Mapping[str, Any]) -> dict[str, Any]:
        """Reset options of k simulations, those that are given, as arrays of leading shape (k,).

        Raises:
          InputError: another shape, values that are not finite or physically impossible, a map that there is not.
        """
        checked = dict(given)
        for name in ("psi", "psi_belief"):
            if name in given:
                checked[name] = psi_of(self.space, given[name], (k,), name)
        if "psi" in given:
            self.space.require_possible(checked["psi"])
        if "terrain_id" in given:
            checked["terrain_id"] = terrain_ids(given["terrain_id"], k, len(self.maps))
        return checked

    def begin(self, ids: Ids, given: Mapping[str, Any], edits: Sequence[Callable[[ModelFields], Any]] = ()) -> None:
        """Begin an episode in some simulations, (k,) ascending; `view.now` is left to the caller.

        Args:
          ids: which.
          given: reset options, leading shape (k,); what is left out is nominal, or drawn from each one's generator.
          edits: called with their model fields, psi being written.

        Raises:
          InputError: as `checked`; nothing is changed then.
        """
        k = len(ids)
        given = self.checked(k, given)
        u = np.array([self.generators[i].random(1 + self.robot.draws) for i in ids])
        self._write_psi(ids, given, edits)
        if self._dataid is not None:
            drawn = (u[:, 0] * len(self.maps)).astype(np.intp)
            self.chosen[ids] = given.get("terrain_id", drawn)
            self._dataid[ids] = self.chosen[ids]
        self.still(ids, mujoco.mjtStage.mjSTAGE_NONE)
        start = self.robot.begin(u[:, 1:], lambda xy: self.ground(xy, self.chosen[ids]))
        self.view.qpos[ids], self.view.qvel[ids] = start.qpos, start.qvel
        self.batch.forward(ids)
        for name, value in start.task.items():
            old = self.view.task.get(name)
            # A new array: the old one may be in somebody's hands.
            new = np.empty((self.n, *value.shape[1:]), value.dtype) if old is None else old.copy()
            new[ids] = value
            self.view.task[name] = new

    def coming(
        self, generators: Sequence[np.random.Generator], maps: Sequence[Heightfield]
    ) -> tuple[Ids, NDArray[np.float64]]:
        """Where episodes would begin that drew from these generators and maps: (n,) map of each, and (n, 3) poses."""
        u = np.array([generator.random(1 + self.robot.draws) for generator in generators])
        which = (u[:, 0] * len(maps)).astype(np.intp)
        stack, one = np.stack([m.heights for m in maps]), maps[0]

        def ground(xy: NDArray) -> NDArray[np.float64]:
            return surface(stack, xy, one.resolution, one.origin, which.reshape(-1, *[1] * (xy.ndim - 2)))[0]

        return which, planar(self.robot.begin(u[:, 1:], ground).qpos)

    def still(self, ids: Ids, stage: mujoco.mjtStage = mujoco.mjtStage.mjSTAGE_ACC) -> None:
        """Put simulations back to rest, and compute stages of them."""
        self.batch.reset(ids, self.rest, stage=stage.value)
        self.batch.warning[ids[:, None], UNSTABLE, 1] = 1

    def _write_psi(self, ids: Ids, given: Mapping[str, Any], edits: Sequence[Callable[[ModelFields], Any]]) -> None:
        psi = given["psi"] if "psi" in given else np.tile(self.space.nominal, (len(ids), 1))
        belief = given.get("psi_belief", psi)
        fields = self.fields if len(ids) == self.n else self.fields.rows(ids)
        fields.restore()
        self.space.write(fields, psi)
        for edit in edits:
            edit(fields)
        fields.commit()
        self.psi[ids], self.seen[ids] = psi, seen_psi(self.space, belief)
