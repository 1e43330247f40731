"""A run of TD-MPC2: collect, learn, keep; what a kill interrupts, the same call goes on with."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from gymnasium.vector import VectorEnv
from safetensors.torch import save_file
from torch import Tensor, nn

from nfc_gym.adaptation import resume
from nfc_gym.adaptation.record import Record, in_words
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.inference.random import mixed
from nfc_gym.inference.state import read, require_format

from .collecting import Collector
from .learner import Learner
from .replay import Replay
from .speed import Speed
from .world_model import WorldModel

SAVE_EVERY = 120.0  # s between two states on disk; what was seen goes with them
KEEP_EVERY = 30.0  # s between two calls of `kept`
TELL_EVERY = 2.0  # s
BURST = 64  # updates between two looks at the clock
REPLAY = "nfc_gym-tdmpc2-replay-1"


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How much is collected and learned.

    Attributes:
      seed: of actions, episodes and batches.
      first: control steps before anything is learned; then as many updates as `ratio` wants of them come at once.
      random: whether those are at random; a model that was trained before plans them.
      ratio: updates a control step.
    """

    seed: int = 0
    first: int = 5000
    random: bool = True
    ratio: float = 1.0

    def __post_init__(self) -> None:
        if self.ratio < 0 or self.first < 0:
            raise InputError(f"first {self.first}, ratio {self.ratio:g}: want steps and updates a step, none negative")


class Chance(nn.Module):
    """State of torch's generators, kept like weights so that a run goes on with the very same draws.

    Args:
      device: of the run.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self.device = device

    def get_extra_state(self) -> Tensor:
        """Of the processor's generator, and of the GPU's that the run is on."""
        none = torch.zeros(0, dtype=torch.uint8)
        gpu = torch.cuda.get_rng_state(self.device) if self.device.type == "cuda" else none
        return torch.cat([torch.tensor([len(gpu)], dtype=torch.uint8), gpu, torch.get_rng_state()])

    def set_extra_state(self, state: Tensor) -> None:
        """The inverse; a GPU's is left out where the run goes on without one."""
        size = int(state[0])
        torch.set_rng_state(state[1 + size :].clone())  # whose memory must be aligned
        if size and self.device.type == "cuda":
            torch.cuda.set_rng_state(state[1 : 1 + size].clone(), self.device)


class Run:
    """A run.

    Args:
      envs: see `collecting.sizes_of`.
      model: learns in place.
      gamma: discount a control step.
      schedule: see `Schedule`.
      most: control steps that there will ever be, so that no more room is taken than they need.
      record: what is written down; None writes nothing.
      speed: see `Speed`.

    Attributes:
      steps: control steps of all simulations together.
      elapsed: s of all parts of the run.
    """

    def __init__(
        self, envs: VectorEnv, model: WorldModel, gamma: float, schedule: Schedule, *, most: int | None = None,
        record: Record | None = None, speed: Speed | None = None,
    ) -> None:  # fmt: skip
        self.speed = speed or Speed()
        self.envs, self.model, self.gamma, self.schedule = envs, model, gamma, schedule
        self.learner = Learner(model, gamma, self.speed)
        self.replay = Replay(model.settings, model.device, most)
        self.record = record or Record(None, None)
        self.chance, self.steps, self.elapsed = Chance(model.device), 0, 0.0
        self._owed = 0.0
        self._collector: Collector | None = None
        torch.manual_seed(mixed(schedule.seed, 0))

    def train(
        self, steps: int, seconds: float | None = None, state: Path | None = None,
        mark: Callable[[int], Any] | None = None, kept: Callable[[], Any] | None = None,
    ) -> None:  # fmt: skip
        """Go on up to so many control steps in all, or for so long.

        Args:
          steps: in all.
          seconds: None is without limit.
          state: file that is written now and then and at the end; None writes none.
          mark: called with the steps after each control step and all updates that are due by it.
          kept: called now and then, to keep what is there.

        Raises:
          Diverged: a loss is not finite; the weights are those from before, and the last state stays as it was.
        """
        began = saved = told = asked = time.monotonic()
        spent, before = self.elapsed, self.steps
        values: dict[str, Tensor] = {}
        while (self.steps < steps or self.due()) and (seconds is None or time.monotonic() - began < seconds):
            if not self.due():
                self.act()
            values = self.learn() or values
            now = time.monotonic()
            self.elapsed = spent + now - began
            if mark is not None and not self.due():
                mark(self.steps)
            if now - told > TELL_EVERY:
                told = now
                self.tell(values, steps, (self.steps - before) / (now - began))
            if state is not None and now - saved > SAVE_EVERY:
                self.save(state)
                saved = time.monotonic()
            if kept is not None and now - asked > KEEP_EVERY:
                kept()
                asked = time.monotonic()
        if values:
            self.tell(values, steps, (self.steps - before) / max(self.elapsed - spent, 1e-9), last=True)
        if state is not None:
            self.save(state)

    def act(self) -> None:
        """One control step of all simulations; after an interruption their episodes begin anew, with other seeds."""
        if self._collector is None:
            seed = mixed(self.schedule.seed, 1, self.steps) % 2**31
            self._collector = Collector(self.envs, self.model, self.gamma, self.replay, seed, self.speed)
        self._collector.step(self.schedule.random and self.steps < self.schedule.first)
        self.steps += self.envs.num_envs
        self._owed += self.schedule.ratio * self.envs.num_envs

    def due(self) -> bool:
        """Whether updates are due."""
        return self._owed >= 1 and self.steps >= self.schedule.first and len(self.replay) > 0

    def learn(self) -> dict[str, Tensor]:
        """Updates that are due, up to `BURST`; values of the last."""
        values: dict[str, Tensor] = {}
        for _ in range(BURST):
            if not self.due():
                break
            values = self.learner.update(self.replay.sample())
            self._owed -= 1
        if values:
            self.learner.check()
        return values

    def tell(self, values: dict[str, Tensor], steps: int, speed: float, last: bool = False) -> None:
        """Curves and the progress line."""
        means = {} if self._collector is None else self._collector.means()
        told = {k: float(v) for k, v in values.items()} | means
        self.record.scalars(self.steps, told | {"steps_per_s": speed, "hours": self.elapsed / 3600})
        shown = {k: told[k] for k in ("return", "length", "loss") if k in told}
        said = f"{self.steps:,}/{steps:,}  {self.learner.updates:,} updates  {speed:,.0f} steps/s  {in_words(shown)}"
        self.record.line(said, last)

    def returns(self) -> list[float]:
        """Of the last episodes that ended."""
        return [] if self._collector is None else [total for total, _ in self._collector.recent]

    # ---- on disk --------------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """All that going on needs, in `path` and beside it; the simulations begin new episodes then."""
        seen = {k: t.cpu().contiguous().clone() for k, t in self.replay.contents().items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(replay_of(path)) as part:
            save_file(seen, part, {"format": REPLAY})
        plain = {"steps": self.steps, "elapsed": self.elapsed, "updates": self.learner.updates, "owed": self._owed}
        resume.save(path, self._modules(), self.learner.optimiser, plain, self.described())

    def load(self, path: Path) -> None:
        """The inverse.

        Raises:
          InputError: the file is damaged, or of a run with other arguments.
        """
        seen, metadata = read(replay_of(path))
        require_format(replay_of(path), metadata, REPLAY)
        if seen:
            self.replay.add(seen)
        plain = resume.load(path, self._modules(), self.learner.optimiser, self.described())
        self.steps, self.elapsed, self._owed = plain["steps"], plain["elapsed"], plain["owed"]
        self.learner.go_on(plain["updates"])
        self._collector = None

    def described(self) -> dict[str, Any]:
        """What a run that goes on from this one's state must have in common with it."""
        return {
            "sizes": asdict(self.model.sizes), "settings": asdict(self.model.settings), "gamma": self.gamma,
            "schedule": asdict(self.schedule), "envs": self.envs.num_envs,
        }  # fmt: skip

    def _modules(self) -> dict[str, nn.Module]:
        return {"model": self.model, "chance": self.chance}


def replay_of(state: Path) -> Path:
    """Where the sequences of a state lie."""
    return state.with_name(state.name + ".replay")
