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
from torch.optim.swa_utils import get_ema_multi_avg_fn

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.data import Batch, TensorWindows, WindowSet
from nfc_gym.inference.learner import Learner
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.random import mixed, seeded
from nfc_gym.inference.state import load_state, save_state

_SCALE_WINDOWS, _SCALE_MAPS = 16384, 1024  # windows from which scales are taken, without maps (64 kB each) and with
_EVALUATION = 2**20  # stands for "held-out" in seeds, where training uses step numbers


@dataclass(frozen=True)
class TrainConfig:
    """How a network is trained.

    Attributes:
      epochs: passes over the windows at most; the cosine decay of the step size ends there.
      batch: windows a step.
      rate: the step size after `warmup` steps; AdamW.
      decay: of the weights.
      average: share of the averaged weights that a step keeps (exponential moving average).
      clip: largest norm of a gradient.
      patience: epochs without a better held-out loss after which training ends.
      mixed: bfloat16 in the networks on a GPU.
      save_every: seconds between saved states, beside the one at the end.
      seed: of the order, the noise and nothing else.
    """

    epochs: int = 100
    batch: int = 256
    rate: float = 5e-4
    warmup: int = 100
    decay: float = 1e-4
    average: float = 0.999
    clip: float = 1.0
    patience: int = 20
    mixed: bool = True
    save_every: float = 60.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("epochs", 1), ("batch", 1), ("patience", 1), ("warmup", 0), ("seed", 0)):
            require_whole(f"training: {name}", getattr(self, name), least)
        if not 0 < self.rate < 1 or not 0 <= self.average < 1:
            raise InputError(f"training: rate in (0, 1) and average in [0, 1), got {self.rate:g}, {self.average:g}")
        if not self.clip > 0 or not self.decay >= 0:  # a gradient cut to less than 0 would lead uphill
            raise InputError(f"training: clip above 0 and decay 0 or more, got {self.clip:g}, {self.decay:g}")


@dataclass
class Outcome:
    """What training came to.

    Attributes:
      train: mean loss of each epoch.
      start: held-out loss before the first step.
      held_out: held-out loss of each epoch, of the averaged weights.
      best: epoch whose weights were kept, counted from 1; 0 is the start: training found nothing that generalises.
      stopped: why it ended: "epochs", "patience" or "diverged".
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

    Raises:
      InputError: windows that are not the network's, no memory for the batch, or a saved state of something else.
    """
    config = config or TrainConfig()
    device = torch.device(device)
    if scales:
        _fit_scales(network, windows, config.seed)
    run = _Run(network, windows, held_out, config, device)
    file = None if folder is None else folder / "training.safetensors"
    if file is not None and file.is_file():
        load_state(file, run, run.describe())
        report.message(f"goes on from step {run.step} of {run.total}")
    try:
        with seeded(config.seed):
            run.loop(file, report)
    except torch.OutOfMemoryError as e:
        raise InputError(
            f"training: no memory for {config.batch} windows a step on {device}: use batch={max(1, config.batch // 2)}"
            + (f"; it goes on from what {folder} holds" if folder else "")
        ) from e
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
    """A training run's whole state. All randomness is a function of (seed, step), so nothing else need be saved."""

    def __init__(
        self, network: Learner, windows: WindowSet, held_out: WindowSet, config: TrainConfig, device: torch.device
    ) -> None:  # fmt: skip
        if not len(windows) or not len(held_out):
            raise InputError(f"training: {len(windows)} windows to train on and {len(held_out)} held out; want both")
        self.windows, self.held_out, self.config, self.device = windows, held_out, config, device
        self.epoch_steps = math.ceil(len(windows) / config.batch)
        self.total = self.epoch_steps * config.epochs
        self.network = network.to(device)
        self.average = deepcopy(self.network).eval().requires_grad_(False)
        self.best = deepcopy(self.average)
        self.optimiser = torch.optim.AdamW(
            network.parameters(), lr=config.rate, weight_decay=config.decay, fused=device.type == "cuda"
        )
        self.step, self.loss_sum = 0, 0.0
        self.outcome = Outcome()

    def describe(self) -> dict[str, object]:
        """What a saved state must agree in."""
        config, told = asdict(replace(self.config, save_every=0.0)), getattr(self.windows, "told", {})
        if not told and isinstance(self.windows, TensorWindows):
            told = {"contents of the windows": self.windows.contents}
        return {
            "config": config, "network": self.network.config.to_dict(), "prior": self.network.prior.to_dict(),
            "windows": len(self.windows), "held_out": len(self.held_out), "of": told,
        }  # fmt: skip

    def loop(self, file: Path | None, report: Report) -> None:
        """Steps, evaluations and saved states until an end is reached."""
        began, saved = monotonic() - self.outcome.seconds, monotonic()
        if math.isnan(self.outcome.start):
            self.outcome.start = self.evaluate()
        while not self.outcome.stopped:
            for batch in self.rest_of_epoch():
                if not self.learn(batch):
                    self.outcome.stopped = "diverged"
                    report.message(
                        f"the loss diverged at step {self.step} of {self.total}: the weights of epoch "
                        f"{self.outcome.best} are kept; a smaller rate than {self.config.rate:g} may help"
                    )
                    break
                if self.step % self.epoch_steps:
                    saved = self.save(file, began, saved)
                    report.step(self.step, self.total, monotonic() - began)
            else:
                self.end_epoch(report)
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

    def learn(self, batch: Batch) -> bool:
        """One step; False and nothing changed where the loss is not finite."""
        self.network.train()
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate()
        torch.manual_seed(mixed(self.config.seed, 0, self.step))
        loss = self.loss(self.network, batch)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        size, value = torch.stack([norm, loss.detach().to(norm.dtype)]).tolist()  # waits for the device, once a step
        if not math.isfinite(size) or not math.isfinite(value):
            return False
        self.optimiser.step()
        self.step += 1
        self.loss_sum += value
        self.follow()
        return True

    def rate(self) -> float:
        """Step size: a linear rise, then half a cosine to 0."""
        rise = min(1.0, (self.step + 1) / max(1, self.config.warmup))
        return self.config.rate * rise * (1 + math.cos(math.pi * self.step / self.total)) / 2

    def loss(self, network: Learner, batch: Batch) -> Tensor:
        """Sum of the heads' losses."""
        batch = {k: t.to(self.device, non_blocking=True) for k, t in batch.items()}
        with torch.autocast(self.device.type, torch.bfloat16, self.config.mixed and self.device.type == "cuda"):
            return torch.stack(list(network.losses(batch).values())).sum()

    @torch.no_grad()
    def follow(self) -> None:
        """Draw the averaged weights towards the present ones; early averages forget faster."""
        keep = min(self.config.average, (1 + self.step) / (10 + self.step))
        mean, now = tuple(self.average.parameters()), tuple(self.network.parameters())
        get_ema_multi_avg_fn(keep)(mean, now, self.step)  # all at once: one by one they take a GPU as long as a step

    @torch.no_grad()
    def evaluate(self) -> float:
        """Held-out loss of the averaged weights; the same noise each time, so that epochs are comparable."""
        total = 0.0
        for i, batch in enumerate(self.held_out.batches(self.config.batch, None)):
            torch.manual_seed(mixed(self.config.seed, _EVALUATION, i))
            total += float(self.loss(self.average, batch)) * len(batch["psi"])
        return total / len(self.held_out)

    def end_epoch(self, report: Report) -> None:
        """Compare, keep the best, and see whether it is over."""
        out = self.outcome
        out.train.append(self.loss_sum / self.epoch_steps)
        out.held_out.append(self.evaluate())
        self.loss_sum, epoch = 0.0, len(out.train)
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
        elif epoch - out.best >= self.config.patience:
            out.stopped = "patience"
