"""The posterior-predictive replay: does the simulator, as it is believed to be, explain this window?

A window's actions are replayed from its start under draws of psi, each with a start-state noise and motor noise of
its own, which are thereby carried through. After each control step the error, observation less replay, in units of
the sensor noise, is whitened: if the simulator is right the mean error e is, to first order, Gaussian with the
covariance

    Sigma = I + C: the sensors' noise, and what psi, start and motors leave open, by the spread of the replays.

The replays then move towards what was observed (`ensemble`) and go on: the next error is conditioned on all that was
seen so far, so a start that was off, or contacts that scatter, do not hide what comes after. The score is the mean
over the window, its first steps left out, of X = e' Sigma^-1 e / k (cut at `MOST`): about 1 where the simulator
explains the motion down to the noise. Rolled out freely for the whole window instead, the start's noise hides most
faults of a robot on wheels.

Conditioned on the actions like this a lost motor shows, where the motion alone may look like any other. How high scores
go without a fault is found from nominal windows (`inference.rates`), not from tables: contacts are not Gaussian.
"""

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import mujoco
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.posterior import Sampler, without_maps
from nfc_gym.core.whole import require_share, require_whole
from nfc_gym.envs.quadcopter import Quadcopter
from nfc_gym.envs.simulations import Simulations
from nfc_gym.inference.detector import checked
from nfc_gym.physics.effects import Effect
from nfc_gym.physics.quiet import no_warnings
from nfc_gym.simulate.ensemble import innovation
from nfc_gym.simulate.machine import MOTOR, Machine
from nfc_gym.simulate.residuals import Given, Residuals
from nfc_gym.simulate.roll import acted_on
from nfc_gym.simulate.start import disturbed, observed
from nfc_gym.terrain import Heightfield

Array = NDArray[np.float64]
DRAWS = 32  # replays a window
# Of the replays' spread before each analysis: few replays, taken as Gaussian, grow too sure of themselves.
INFLATION = 1.1
SETTLE = 5  # control steps in which replays find the start's contacts and speeds; they do not count
MOST = 4.0  # of X in one step: beyond it is a blow of contact, and more of it tells nothing more of the model
_TURN = 2048  # replays at once


class Replay:
    """Scores windows by replaying them; a `WindowScore` of `inference.detector`.

    Equal windows get equal scores: psi, start noise and motor noise are drawn once.

    Args:
      environment: id, `nfc_gym/JackalFlat-v0`.
      belief: what psi is drawn from: a posterior given a window of this machine, a `Fidelity`, or None for nominal.
      draws: replays a window.
      motor: standard deviation of the motors' noise, a share of the actions' range.
      ground: the map underfoot, for a Rough environment: one for all windows, or several to choose from.
      standing: the vector environment (one of this package's) whose rows are replayed, each on the map that it is on.
        Else () -> (n,), which map the last transition of each row was driven on; it is asked once the step is over,
        and of same-step autoreset `terrain_id` then is the next episode's.
      seed: of all draws.
      nthread: threads; the scores do not depend on them.

    Raises:
      InputError: no such environment, a belief of other parameters, no ground where one is needed, fewer than 2 draws,
        or a noise of motors that is no share.
    """

    def __init__(
        self, environment: str, belief: Sampler | None = None, *, draws: int = DRAWS, motor: float = MOTOR,
        ground: Heightfield | Sequence[Heightfield] | None = None,
        standing: VectorEnv | Callable[[], Any] | None = None, seed: int = 0, nthread: int = 1,
    ) -> None:  # fmt: skip
        self.machine = machine = Machine(environment)
        require_whole("replay: draws", draws, 2)
        require_share("replay: motor", motor)
        maps = [] if ground is None else [ground] if isinstance(ground, Heightfield) else list(ground)
        if machine.rough != bool(maps):
            raise InputError(
                f"replay: {machine.environment} {'needs a' if machine.rough else 'is a plane: no'} `ground`"
            )
        self.horizon = machine.habit.horizon
        self.states, self.actions = machine.kind.proprio_size, machine.kind.action_size
        self.draws, self.nthread = draws, nthread
        self.maps, self.standing = maps, Driven(standing) if isinstance(standing, VectorEnv) else standing
        rng = np.random.default_rng(seed)
        self.psi = _psi(machine, belief, draws, rng)
        self.jitter = motor * rng.standard_normal((draws, self.horizon, self.actions))
        self.start = rng.standard_normal((draws, 2 * machine.model.nv))
        self.told = np.flatnonzero(machine.told)
        self.eps = rng.standard_normal((draws, self.horizon, len(self.told)))
        self.lacks: tuple[Effect, Array] | None = None  # what every replay has beyond the model, see `under`
        self._residuals: Residuals
        self._sims: Simulations | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without its simulations, which no pickle holds: they are made anew for the next windows."""
        return {k: v for k, v in self.__dict__.items() if k != "_residuals"} | {"_sims": None}

    def require_observed(self) -> None:
        """Raises `InputError` for a robot whose `proprio` does not tell its state: windows then need a `start`."""
        observed(self.machine, np.zeros((0, self.states)))

    def under(self, scale: Array, lacks: tuple[Effect, Array] | None = None) -> "Replay":
        """The same draws for a machine with a fault.

        Args:
          scale: (d,) that psi is multiplied by.
          lacks: an effect of the machine, and its parameters (k,).

        Raises:
          InputError: scale of another size.
        """
        if np.shape(scale) != (len(self.machine.space),):
            raise InputError(f"replay: scale has shape {np.shape(scale)}, want ({len(self.machine.space)},)")
        out = copy(self)
        out.psi, out.lacks, out._sims = self.psi * scale, lacks, None
        return out

    def score(
        self, states: Array, actions: Array, start: Array | None = None, which: NDArray[np.intp] | None = None
    ) -> Array:
        """(n,) mean of min(X, `MOST`) after the first `SETTLE` steps; arguments and errors as of `told_of`."""
        return self.summed(self.steps(states, actions, start, which))

    def score_rows(self, states: Array, actions: Array, rows: NDArray[np.intp]) -> Array:
        """The same for windows of some rows of a vector environment, each on the map that it was driven on."""
        which = None if self.standing is None else np.asarray(self.standing())[rows]
        return self.score(states, actions, which=which)

    @staticmethod
    def summed(steps: Array) -> Array:
        """(n,) scores from X of each control step (n, H)."""
        return np.minimum(steps[:, SETTLE:], MOST).mean(1)

    def steps(
        self, states: Array, actions: Array, start: Array | None = None, which: NDArray[np.intp] | None = None
    ) -> Array:
        """(n, H) X of each control step; infinite from where replays come apart. Arguments as of `told_of`."""
        return self.told_of(states, actions, start, which)[..., 0] / len(self.told)

    @no_warnings()  # replays that come apart are nan
    def told_of(
        self, states: Array, actions: Array, start: Array | None = None, which: NDArray[np.intp] | None = None
    ) -> Array:
        """(n, H, 2) e' Sigma^-1 e and log det Sigma of each control step of windows.

        Their sum, halved, is minus the log likelihood of what was observed in the step given all before it, but for a
        constant. From where replays come apart the first is infinite and the second 0.

        Args:
          states: (n, H+1, s) as observed, with noise.
          actions: (n, H, a) as commanded.
          start: (n, nq + nv) measured positions and velocities of the model at the window's first state. None takes
            them from that state, for robots whose `proprio` has them: Jackal and Quadcopter.
          which: (n,) map of each window, where there are several.

        Raises:
          InputError: windows of another robot, shorter than H or not finite, or a start or a map that is needed and not
            given.
        """
        states, actions = checked(self, states, actions)
        hidden = start is None
        starts = observed(self.machine, states[:, 0]) if start is None else self._given(len(states), start)
        which, per = self._which(len(states), which), max(1, _TURN // self.draws)
        parts = [
            self._scored(states[i : i + per], actions[i : i + per], starts[i : i + per], which[i : i + per], hidden)
            for i in range(0, len(states), per)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, self.horizon, 2))

    def _which(self, n: int, which: NDArray[np.intp] | None) -> NDArray[np.intp]:
        count = max(len(self.maps), 1)
        if which is None and count > 1:
            raise InputError(
                f"replay: {count} maps: say `which` each window is on, or `standing` of a vector environment"
            )
        chosen = np.zeros(n, np.intp) if which is None else np.asarray(which)
        if chosen.shape != (n,) or chosen.dtype.kind not in "iu" or ((chosen < 0) | (chosen >= count)).any():
            raise InputError(f"replay: `which` must be ({n},) numbers of maps, 0 to {count - 1}, got {which!r}")
        return chosen

    def _given(self, n: int, start: Array) -> Array:
        start, width = np.asarray(start, float), self.machine.model.nq + self.machine.model.nv
        if start.shape != (n, width) or not np.isfinite(start).all():
            raise InputError(f"replay: start must be finite, of shape {(n, width)}, got {start.shape}")
        return start

    def _scored(
        self, states: Array, actions: Array, starts: Array, which: NDArray[np.intp], hidden: bool
    ) -> Array:  # fmt: skip
        """(n, H, 2), see `told_of`."""
        sims, held = self._begin(states, starts, which, hidden), np.ones(len(states), bool)
        out = np.empty((len(states), self.horizon, 2))
        with np.errstate(over="ignore", invalid="ignore"):
            for t in range(self.horizon):
                errors = self._step(sims, states, actions, t)
                held &= np.isfinite(errors).all((1, 2))
                found = innovation(np.where(held[:, None, None], errors, 0.0), self.eps[:, t])
                out[:, t, 0] = np.where(held, found.squared, np.inf)
                out[:, t, 1] = np.where(held, found.log_det, 0.0)
                self._move(sims, np.where(held[:, None, None], found.gain, 0.0))
        return out

    def _step(self, sims: Simulations, states: Array, actions: Array, t: int) -> Array:
        """(n, draws, k) one control step on: window less replay in units of the sensor noise."""
        machine, n, m = self.machine, len(states), self.draws
        robot, view = sims.robot, sims.view
        commanded = np.repeat(actions[:, t], m, 0)
        view.ctrl[...] = robot.actuate(np.clip(commanded + np.tile(self.jitter[:, t], (n, 1)), -1, 1), view)
        acted_on(sims, self._residuals, np.ones(n * m, bool), machine.kind.frame_skip)
        view.task.update(robot.advance(view, commanded))
        view.before, view.now = view.now, robot.derive(view)
        shown = np.concatenate(robot.proprio(view), -1).reshape(n, m, -1)
        errors = machine.difference(states[:, None, t + 1], shown)[..., self.told] / machine.noise[self.told]
        mean = errors.mean(1, keepdims=True)
        return mean + INFLATION * (errors - mean)

    def _move(self, sims: Simulations, gain: Array) -> None:
        """Draw the replays towards what was observed."""
        n, m, nv, model, view = len(gain), self.draws, sims.model.nv, sims.model, sims.view
        away = np.empty((n * m, nv))
        for k in range(n * m):
            mujoco.mj_differentiatePos(model, away[k], 1.0, view.qpos[k - k % m], view.qpos[k])
        deviation = np.concatenate([away, view.qvel], 1).reshape(n, m, -1)
        deviation -= deviation.mean(1, keepdims=True)
        moved = (INFLATION - 1) * deviation + gain @ (INFLATION / np.sqrt(m - 1) * deviation)
        moved = moved.reshape(n * m, -1)
        for k in range(n * m):
            mujoco.mj_integratePos(model, view.qpos[k], moved[k, :nv], 1.0)
        view.qvel[...] += moved[:, nv:]
        view.now = sims.robot.derive(view)

    def _begin(self, states: Array, starts: Array, which: NDArray[np.intp], hidden: bool) -> Simulations:
        """n windows times draws simulations at their starts."""
        machine, n, nq = self.machine, len(states), self.machine.model.nq
        sims = self._sims
        # An effect's edits of the model are made once: on other ground than before it gets new simulations.
        anew = self.lacks is not None and len(self.maps) > 1
        fresh = sims is None or sims.n != n * self.draws or anew
        if sims is None or fresh:
            sims = self._sims = machine.simulations(n * self.draws, self.nthread, self.maps)
        if fresh or len(self.maps) > 1:
            on = {"terrain_id": np.repeat(which, self.draws)} if machine.rough else {}
            sims.begin(np.arange(sims.n), {"psi": np.tile(self.psi, (n, 1))} | on)
            self._residuals = Residuals(sims, self._given_effects(sims))
        sims.batch.reset(np.arange(sims.n), sims.rest)
        view = sims.view
        rows = disturbed(machine, np.repeat(starts, self.draws, 0), np.tile(self.start, (n, 1)), hidden)
        view.qpos[...], view.qvel[...] = rows[:, :nq], rows[:, nq:]
        view.task.update({name: np.zeros_like(value) for name, value in view.task.items()})
        if isinstance(sims.robot, Quadcopter):
            view.task["goal"] = np.repeat(starts[:, :3] + states[:, 0, :3], self.draws, 0)
        view.now = sims.robot.derive(view)
        for _, acting, _ in self._residuals.parts:
            acting.restart()
        return sims

    def _given_effects(self, sims: Simulations) -> list[Given]:
        if self.lacks is None:
            return []
        effect, theta = self.lacks
        effect.bind(sims.model)
        return [Given(effect, slice(0, sims.n), np.tile(theta, (sims.n, 1)))]


class Driven:
    """() -> (n,) which map each row of a vector environment was on in its last transition.

    It is noted at the physics: with same-step autoreset a row may stand on another map once its step is over.

    Raises:
      InputError: a vector environment that has no such maps.
    """

    def __init__(self, env: VectorEnv) -> None:
        base: Any = env.unwrapped
        if not (hasattr(base, "terrain_id") and hasattr(base, "after_hooks")):
            raise InputError(
                f"replay: standing is {type(base).__name__}, want a vector environment that gymnasium.make_vec makes "
                "of this package's ids, or a callable"
            )
        self._ids = base.terrain_id
        base.after_hooks.append(self._note)

    def __call__(self) -> NDArray[np.intp]:
        """Before the first step it is where the rows stand."""
        return self._ids

    def _note(self, env: Any) -> None:
        self._ids = env.terrain_id


def _psi(machine: Machine, belief: Sampler | None, draws: int, rng: np.random.Generator) -> Array:
    """(draws, d)."""
    space = machine.space
    if belief is None:
        return np.tile(space.nominal, (draws, 1))
    psi = without_maps(belief).sample(draws, rng).psi
    if psi is None or psi.shape != (draws, len(space)):
        have = "says nothing of psi" if psi is None else f"has psi of shape {psi.shape}"
        raise InputError(f"replay: the belief {have}; want {(draws, len(space))}: {', '.join(space.names)}")
    return psi
