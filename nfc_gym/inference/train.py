"""The one training loop: any network, CPU or GPU, resumable after a kill."""

import math
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from time import monotonic

import torch
from torch import Tensor, nn

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.compiled import Compiled, Losses
from nfc_gym.inference.data import Batch, TensorWindows, WindowSet, resident
from nfc_gym.inference.graphs import Graphs
from nfc_gym.inference.learner import Learner
from nfc_gym.inference.memory import enough_memory
from nfc_gym.inference.optimiser import Optimiser
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.random import mixed, seeded
from nfc_gym.inference.reflection import Reflection
from nfc_gym.inference.state import load_state, save_state

_SCALE_WINDOWS, _SCALE_MAPS = 16384, 1024  # windows from which scales are taken, without maps (64 kB each) and with
_EVALUATION = 2**20  # stands for "held-out" in seeds, where training uses step numbers
_LOOK = {"cuda": 16}  # steps between looks at how they went: for each a GPU is waited for; elsewhere after every step


@dataclass(frozen=True)
class TrainConfig:
    """How a network is trained.

    Attributes:
      epochs: passes over the windows at most; the cosine decay of the step size ends there.
      batch: windows a step.
      rate: the step size after `warmup` steps.
      muon: whether matrices are changed by Muon, see `Optimiser`; else all is changed by AdamW.
      decay: of the weights.
      average: share of the averaged weights that a step keeps (exponential moving average).
      clip: largest norm of a gradient.
      patience: epochs without a better held-out loss after which training ends.
      mixed: bfloat16 in the networks on a GPU.
      save_every: seconds between saved states, beside the one at the end.
      seed: of the order, the noise and nothing else.
      budget: seconds that training takes at most, 0 for any number; where epochs take longer, the decay of the step
        size follows the clock, and what is learned is no function of the seed alone.
      graph: whether a GPU replays steps as CUDA graphs (`Graphs`); without, it is told every kernel of every step.
      compiled: whether whole batches' losses are compiled first (`Compiled`), which takes half a minute and more.
    """

    epochs: int = 100
    batch: int = 256
    rate: float = 5e-4
    warmup: int = 100
    muon: bool = True
    decay: float = 1e-4
    average: float = 0.999
    clip: float = 1.0
    patience: int = 20
    mixed: bool = True
    save_every: float = 60.0
    seed: int = 0
    budget: float = 0.0
    graph: bool = True
    compiled: bool = False

    def __post_init__(self) -> None:
        for name, least in (("epochs", 1), ("batch", 1), ("patience", 1), ("warmup", 0), ("seed", 0)):
            require_whole(f"training: {name}", getattr(self, name), least)
        if not 0 < self.rate < 1 or not 0 <= self.average < 1:
            raise InputError(f"training: rate in (0, 1) and average in [0, 1), got {self.rate:g}, {self.average:g}")
        if not self.clip > 0 or not self.decay >= 0:  # a gradient cut to less than 0 would lead uphill
            raise InputError(f"training: clip above 0 and decay 0 or more, got {self.clip:g}, {self.decay:g}")
        if not 0 <= self.budget < math.inf:
            raise InputError(f"training: budget is {self.budget:g}, want seconds, or 0 for any number")


@dataclass
class Outcome:
    """What training came to.

    Attributes:
      train: mean loss of each epoch; where the budget ends the last one early, of its part.
      start: held-out loss before the first step.
      held_out: held-out loss of each epoch, of the averaged weights.
      best: epoch whose weights were kept, counted from 1; 0 is the start: training found nothing that generalises.
      stopped: why it ended: "epochs", "budget", "patience" or "diverged".
      seconds: that it took, the time before an interruption included.
    """

    train: list[float] = field(default_factory=list)
    held_out: list[float] = field(default_factory=list)
    start: float = math.nan
    best: int = 0
    stopped: str = ""
    seconds: float = 0.0


def train(
    network: Learner, windows: WindowSet, held_out: WindowSet, config: TrainConfig | None = None, *,
    folder: Path | None = None, device: str | torch.device = "cpu", report: Report = quiet, scales: bool = True,
    mirror: Reflection | None = None,
) -> Outcome:  # fmt: skip
    """Train a network in place; it ends with the averaged weights of the best epoch.

    Args:
      network: as built, or trained before.
      windows: to train on.
      held_out: by which epochs are compared; none of `windows` belongs here.
      config: see `TrainConfig`.
      folder: where the state is saved, and from where a run that was killed goes on; the result is the same as if it
        had not been. A state of another configuration is refused.
      device: to train on.
      report: is told of the progress.
      scales: whether those of the inputs are taken from `windows` first; a network that was trained before on other
        windows keeps its own, which its weights are made for.
      mirror: shows half of the windows of each step in each of its mirrors; None shows all as they are.

    Raises:
      InputError: windows that are not the network's, or that have maps where there is a mirror, no memory for the
        batch, or a saved state of something else.
    """
    config = config or TrainConfig()
    device = torch.device(device)
    if scales:
        _fit_scales(network, windows, config.seed)
    run = _Run(network, windows, held_out, config, device, mirror, report)
    file = None if folder is None else folder / "training.safetensors"
    if file is not None and file.is_file():
        load_state(file, run, run.describe())
        report.message(f"goes on from step {run.step} of {run.total}")
    said = f"training: no memory for {config.batch} windows a step on {device}: use batch={max(1, config.batch // 2)}"
    kept = f"; it goes on from what {folder} holds" if folder else ""
    with enough_memory(said + kept), seeded(config.seed):
        run.loop(file, report)
    network.load_state_dict(run.best.state_dict())
    network.eval()
    return run.outcome


def _fit_scales(network: Learner, windows: WindowSet, seed: int) -> None:
    """Take the inputs' scales from some windows."""
    if not len(windows):
        return  # which is said when they are trained on
    with torch.random.fork_rng():
        most = _SCALE_MAPS if network.config.elevation else _SCALE_WINDOWS
        first = next(iter(windows.batches(min(len(windows), most), mixed(seed, _EVALUATION))))
    now = next(network.parameters()).device
    network.fit_scales({k: t.to(now) for k, t in first.items()})


class _Run:
    """A training run's whole state. All randomness is a function of (seed, step), so nothing else need be saved.

    What a step changes lies on the device and is changed in place: `update` and `judge` are what a graph holds.
    """

    def __init__(
        self, network: Learner, windows: WindowSet, held_out: WindowSet, config: TrainConfig, device: torch.device,
        mirror: Reflection | None = None, report: Report = quiet,
    ) -> None:  # fmt: skip
        if not len(windows) or not len(held_out):
            raise InputError(f"training: {len(windows)} windows to train on and {len(held_out)} held out; want both")
        self.given, self.config, self.device = windows, config, device
        self.mirror = None if mirror is None else mirror.to(device)
        self.windows, self.held_out = (resident(w, device) for w in (windows, held_out))
        self.epoch_steps = math.ceil(len(windows) / config.batch)
        self.total = self.epoch_steps * config.epochs
        self.network = network.to(device).train()
        self.average = deepcopy(self.network).eval().requires_grad_(False)
        self.best = deepcopy(self.average)
        number = torch.zeros((), device=device)
        self.lost = number.clone()  # 1 from the first loss or gradient on that is not finite: nothing is changed then
        self.optimiser = Optimiser(self.network, config.rate, config.decay, self.lost, config.muon)
        self.pull = number.clone()  # of a step on the averaged weights
        self.tally = number.new_zeros(2, dtype=torch.float64)  # steps that were taken, and the epoch's losses
        self.judged = self.tally.new_zeros(())  # sum of the held-out losses
        self.graphs = Graphs(device, config.graph)
        self.losses = Compiled(self.network.losses, config.batch, report) if config.compiled else self.network.losses
        self.step, self.loss_sum = 0, 0.0
        self.outcome = Outcome()

    def describe(self) -> dict[str, object]:
        """What a saved state must agree in."""
        config, told = asdict(replace(self.config, save_every=0.0)), getattr(self.given, "told", {})
        del config["graph"]  # which leads to the same weights
        for name in ("budget", "compiled"):
            if not config[name]:
                del config[name]
        if not told and isinstance(self.given, TensorWindows):
            told = {"contents of the windows": self.given.contents}
        if self.mirror is not None:
            config["mirror"] = len(self.mirror)
        return {
            "config": config, "network": self.network.config.to_dict(), "prior": self.network.prior.to_dict(),
            "windows": len(self.given), "held_out": len(self.held_out), "of": told,
        }  # fmt: skip

    def loop(self, file: Path | None, report: Report) -> None:
        """Steps, evaluations and saved states until an end is reached."""
        began, saved = monotonic() - self.outcome.seconds, monotonic()
        self.tally.copy_(self.tally.new_tensor([self.step, self.loss_sum]))
        if math.isnan(self.outcome.start):
            self.outcome.start = self.evaluate()
        look = _LOOK.get(self.device.type, 1)
        while not self.outcome.stopped:
            for batch in self.rest_of_epoch():
                self.learn(batch)
                ends = self.step % self.epoch_steps == 0
                if self.step % look and not ends:
                    continue
                self.outcome.seconds = monotonic() - began
                if not self.sound():
                    self.outcome.stopped = "diverged"
                    report.message(
                        f"the loss diverged at step {self.step} of {self.total}: the weights of epoch "
                        f"{self.outcome.best} are kept; a smaller rate than {self.config.rate:g} may help"
                    )
                    break
                if ends or self.share() >= 1:
                    self.end_epoch(report)
                    break
                saved = self.save(file, began, saved)
                report.step(self.step, self.total, self.outcome.seconds)
            saved = self.save(file, began, saved)

    def save(self, file: Path | None, began: float, saved: float) -> float:
        """The state, where it is over or time for it; gives when it was saved last."""
        self.outcome.seconds = monotonic() - began
        if file is None or (not self.outcome.stopped and monotonic() - saved <= self.config.save_every):
            return saved
        save_state(file, self, self.describe())
        return monotonic()

    def rest_of_epoch(self) -> Iterator[Batch]:
        """The batches of the running epoch that have not been seen."""
        epoch, done = divmod(self.step, self.epoch_steps)
        return islice(self.windows.batches(self.config.batch, mixed(self.config.seed, epoch)), done, None)

    def learn(self, batch: Batch) -> None:
        """One step: the device is told what is another in each, and does the rest by itself."""
        self.optimiser.rate.fill_(self.rate())
        self.seed(0, self.step)
        self.step += 1
        self.pull.fill_(1 - min(self.config.average, (1 + self.step) / (10 + self.step)))
        self.graphs(self.update, self.moved(batch))

    def update(self, batch: Batch) -> None:
        """The law of a step; after a loss or a gradient that was not finite it changes nothing."""
        loss = self.loss(self.losses, batch if self.mirror is None else self.mirror(batch))
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        value = loss.detach()
        self.lost.copy_(torch.where(norm.isfinite() & value.isfinite(), self.lost, 1.0))
        self.optimiser.step()
        self.tally.add_(torch.where(self.lost == 0, torch.stack([torch.ones_like(value), value]), 0.0))
        self.follow()

    @torch.no_grad()
    def follow(self) -> None:
        """Draw the averaged weights towards the present ones; early averages forget faster."""
        mean, now = tuple(self.average.parameters()), tuple(self.network.parameters())
        # All at once: one by one they take a GPU as long as a step.
        away = torch._foreach_sub(now, mean)  # type: ignore[attr-defined]
        torch._foreach_mul_(away, self.pull * (1 - self.lost))  # type: ignore[attr-defined]
        torch._foreach_add_(mean, away)  # type: ignore[attr-defined]

    def sound(self) -> bool:
        """Whether all steps were taken, else `step` is the last that was; waits for the device."""
        done, self.loss_sum = self.tally.tolist()
        told, self.step = self.step, int(done)
        return told == self.step

    def share(self) -> float:
        """Of the training that is done: of its steps, or of its seconds where these are used up sooner."""
        return max(self.step / self.total, self.outcome.seconds / (self.config.budget or math.inf))

    def rate(self) -> float:
        """Step size: a linear rise, then half a cosine to 0."""
        rise = min(1.0, (self.step + 1) / max(1, self.config.warmup))
        return self.config.rate * rise * (1 + math.cos(math.pi * min(1.0, self.share()))) / 2

    def seed(self, *at: int) -> None:
        """Have the device's generator draw what belongs to a step."""
        seed = mixed(self.config.seed, *at)
        if self.device.type == "cuda":
            torch.cuda.default_generators[self.tally.get_device()].manual_seed(seed)
        else:
            torch.manual_seed(seed)

    def moved(self, batch: Batch) -> Batch:
        """On the device."""
        return {k: t.to(self.device, non_blocking=True) for k, t in batch.items()}

    def loss(self, losses: Losses, batch: Batch) -> Tensor:
        """Sum of the heads' losses."""
        with torch.autocast(self.device.type, torch.bfloat16, self.config.mixed and self.device.type == "cuda"):
            return torch.stack(list(losses(batch).values())).sum()

    def evaluate(self) -> float:
        """Held-out loss of the averaged weights; the same noise each time, so that epochs are comparable."""
        self.judged.zero_()
        for i, batch in enumerate(self.held_out.batches(self.config.batch, None)):
            self.seed(_EVALUATION, i)
            self.graphs(self.judge, self.moved(batch))
        return float(self.judged) / len(self.held_out)

    @torch.no_grad()
    def judge(self, batch: Batch) -> None:
        """Add a held-out batch's loss."""
        self.judged.add_(self.loss(self.average.losses, batch).double() * len(batch["psi"]))

    def end_epoch(self, report: Report) -> None:
        """Compare, keep the best, and see whether it is over."""
        out = self.outcome
        out.train.append(self.loss_sum / (self.step - self.epoch_steps * len(out.train)))
        out.held_out.append(self.evaluate())
        self.loss_sum, epoch = 0.0, len(out.train)
        self.tally[1].zero_()
        if not math.isfinite(out.held_out[-1]):
            out.stopped = "diverged"
            report.message(
                f"the held-out loss of epoch {epoch} is not finite: the weights of epoch {out.best} are kept"
            )
            return
        if out.held_out[-1] < (out.held_out[out.best - 1] if out.best else out.start):
            out.best = epoch
            self.best.load_state_dict(self.average.state_dict())
        report.epoch(epoch, self.config.epochs, out.train[-1], out.held_out[-1])
        if self.step >= self.total:
            out.stopped = "epochs"
        elif self.share() >= 1:
            out.stopped = "budget"
        elif epoch - out.best >= self.config.patience:
            out.stopped = "patience"
