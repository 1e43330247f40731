"""What `nfc-gym train` and `nfc-gym infer` do: a posterior from a folder of windows, and draws of it given one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile, is_zipfile

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.core import kinds
from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.files import replacing, require_writable
from nfc_gym.core.posterior import without_maps
from nfc_gym.inference import checkpoint
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.data import StoredWindows
from nfc_gym.inference.encoders.base import SEEN
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.gains import gains
from nfc_gym.inference.network import Network
from nfc_gym.inference.normal import NormalPosterior
from nfc_gym.inference.posterior import NeuralPosterior, Window, load
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.reflection import Reflection
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train
from nfc_gym.inference.windows import Windows

Array = NDArray[np.float64]
HELD_OUT = 0.05  # of the windows, by which epochs are compared
JUDGED = 0.05  # of the windows, by which the posterior is judged at the end: they neither train nor choose
_JUDGED_MOST = 256  # of them: more would be lost to training
_JUDGED_LEAST, _JUDGED_SHARE = 20, 5  # below 400 windows: so many, whose spread tells something, but one in five
_LEVEL = 0.9
AS_WIDE = 0.9  # of the prior's own 90 % interval: told little or nothing
_FARTHEST = 2.0  # in size, of an action: a log may command a little more than [-1, 1], raw commands are far beyond
_FORM = "an .npz (numpy.savez) with `states` (n + 1, s) and `actions` (n, a)"


def device_of(name: str) -> torch.device:
    """`auto` is a GPU where there is one.

    Raises:
      InputError: no device of that name here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as e:
        raise InputError(f"device {name!r}: {str(e).splitlines()[0]}; there is auto, cpu, and cuda on a GPU") from None
    if device.type == "meta":  # whose tensors have shapes and no numbers
        raise InputError(f"device {name!r} computes nothing; there is auto, cpu, and cuda on a GPU")
    return device


def require_prior(stored: Windows, prior: PriorBox) -> None:
    """Refuse windows that were drawn from another box than a posterior's: their u would be read as other psi.

    Raises:
      InputError: other bounds or units; the message says of which parameter.
    """
    about = stored.manifest
    drawn = replace(prior, units=about.psi_units, low=about.psi_low, high=about.psi_high)
    prior.require_same(drawn, " + ".join(map(str, stored.folders)))


def say_unfinished(stored: Windows, report: Report) -> None:
    """A message where some of the windows that were asked for are still to be made."""
    wanted = stored.manifest.windows
    if not stored.manifest.complete:
        report.message(
            f"{stored.folders[0]}: {len(stored)} of {wanted} windows are there, and these are trained on; "
            "`nfc-gym simulate` with the same arguments makes the rest"
        )


def judges(windows: int) -> int:
    """How many of so many windows are kept to judge a posterior by: none of fewer than five."""
    return min(_JUDGED_MOST, max(round(JUDGED * windows), _JUDGED_LEAST), windows // _JUDGED_SHARE)


def train_posterior(
    folder: Path, prior: PriorBox, out: Path, config: NetworkConfig, training: TrainConfig, *, device: str = "auto",
    report: Report = quiet, noise: float = 1.0, mirror: Reflection | None = None,
) -> Outcome:  # fmt: skip
    """Train a network on a folder of windows into a checkpoint; a run that was stopped goes on.

    Its notes say as `told` what windows tell of psi that neither trained it nor chose the epoch that is kept, in nats a
    parameter over the prior (`gains`): mean, standard error, and the number of these windows (`judges`), which
    `training.seed` draws from all. With fewer than two there is no standard error, with none no mean: they are None.

    Args:
      folder: what `nfc-gym simulate` wrote.
      prior: psi's box of the windows' environment.
      out: the checkpoint, `.safetensors`; the state of training lies in a folder of that name and `.training`.
      config: of the network. `families` that are not empty are replaced by those of the windows.
      training: see `TrainConfig`.
      device: `auto`, `cpu`, `cuda`.
      report: is told of the progress.
      noise: what multiplies the sensor noise that the windows' manifest assumes, for sensors that are better or worse.
      mirror: in whose mirrors half of the windows of each step are shown, each; None shows all as they are. So
        are windows with maps, and those of a proposal, whose mirror images nobody proposed.

    Raises:
      InputError: no such windows, windows of another prior or without maps where the network needs them, a name of
        another ending, something else than a posterior is there, or nothing can be written there.
    """
    if out.suffix != ".safetensors":
        raise InputError(f"{out}: a posterior is kept in a file that ends in .safetensors")
    kinds.require_kind(out, kinds.POSTERIOR)
    require_writable(out.absolute().parent)
    stored = Windows(folder, robot=prior.robot, psi_names=prior.names)
    require_prior(stored, prior)
    say_unfinished(stored, report)
    for name, what, wanted in (("map", "elevation maps", config.elevation), ("delta_e", "delta_e", config.delta_e)):
        if wanted and name not in stored.names:
            raise InputError(f"{folder}: the windows have no {what}; make them with `nfc-gym simulate ... --maps`")
    if config.families:
        config = replace(config, families=tuple(stored.manifest.families))
    about = stored.manifest
    place = place_of(about.state_names)
    sizes = Sizes(about.horizon, len(about.state_names), len(about.action_names), place=place)
    network = Network(config, sizes, prior, training.seed)
    wanted = StoredWindows(stored, maps=config.elevation, noise=noise)
    rest, judged = wanted.apart(judges(len(stored)), training.seed)
    first, held_out = rest.split(HELD_OUT)
    state = out.with_name(out.name + ".training")
    state.mkdir(parents=True, exist_ok=True)
    proposed = any(part.settings.get("proposal") is not None for part in stored.manifests)
    if config.elevation or proposed:
        mirror = None
    outcome = train(
        network, first, held_out, training, folder=state, device=device_of(device), report=report, mirror=mirror
    )
    notes = {
        "environment": about.environment, "states": list(about.state_names), "windows": len(stored),
        "best": outcome.best, "stopped": outcome.stopped,
        "seconds": outcome.seconds, "held_out": outcome.held_out, "start": outcome.start,
        "noise": [noise * sd for sd in about.state_noise],
        "told": _told_by(network, judged),
    }  # fmt: skip
    checkpoint.save(out, network.cpu(), notes=notes)
    return outcome


def _told_by(network: Network, judged: StoredWindows) -> dict[str, float | int | None]:
    """What some windows tell of psi; see `train_posterior`."""
    n = len(judged)
    if not n:
        return {"mean": None, "error": None, "windows": 0}
    found = gains(network, next(judged.batches(n, 0)))
    error = float(found.std(ddof=1) / np.sqrt(n)) if n > 1 else None
    return {"mean": float(found.mean()), "error": error, "windows": n}


def read_window(path: Path) -> Window:
    """A window of motion from an .npz of `states` (n + 1, s), `actions` (n, a), perhaps `elevation` (128, 128).

    Raises:
      InputError: no such file, or not of this form.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    arrays: dict[str, Any] | None = None
    try:
        with path.open("rb") as file:
            if is_zipfile(file):  # NumPy would take anything else for a pickle, and advise to load it as such
                with np.load(path, allow_pickle=False) as archive:
                    arrays = {k: archive[k] for k in archive.files}
    except (OSError, ValueError, EOFError, AttributeError, TypeError, BadZipFile) as e:
        raise InputError(f"{path} is no .npz file ({e}); want {_FORM}") from None
    if arrays is None:
        raise InputError(f"{path} is no .npz file: a window of motion is {_FORM}")
    missing = [k for k in ("states", "actions") if k not in arrays]
    if missing:
        raise InputError(f"{path}: no array {missing[0]!r}; there are: {', '.join(arrays) or 'none'}")
    for name in ("states", "actions", "elevation"):
        if name in arrays and arrays[name].dtype.kind not in "fiub":
            like = arrays[name].ravel()[:1]
            raise InputError(f"{path}: {name} holds no numbers, but values like {like}; want {_FORM}")
    return Window(arrays["states"], arrays["actions"], arrays.get("elevation"))


class Told(NamedTuple):
    """What draws say of one parameter: median, the 90 % interval, and its width over the prior's own."""

    name: str
    unit: str
    median: float
    low: float
    high: float
    width: float


Refined = Callable[[NeuralPosterior | None, Window], NormalPosterior]


def infer(
    posterior: Path | None, window: Path | Window, *, samples: int = 1000, seed: int = 0, out: Path | None = None,
    refined: Refined | None = None, report: Report = quiet, maps: bool = False,
) -> tuple[Fidelity, list[Told]]:  # fmt: skip
    """Draw from a posterior given a window.

    Args:
      posterior: what `train_posterior` wrote; None where `refined` needs none.
      window: see `read_window`; or the window itself.
      samples: how many.
      seed: of the draws.
      out: `.npz` for the draws (`psi`, and `delta_s` where it is inferred, with `maps` also `delta_e`), or
        `.safetensors` for the posterior given this window; wrappers and `nfc-gym simulate --proposal` take either.
      refined: makes a posterior given the window, `simulate.refined`; None gives the window to the one there is.
      report: is told where the window is unlike all that the posterior was trained on, that there is delta_e to draw,
        and of a network with such a head how likely each family of effects is.
      maps: draw delta_e too, jointly with the rest: a second a draw without a GPU.

    Raises:
      InputError: maps of a posterior that infers none, a damaged file, a structure head, a window that is not the
        network's or whose actions are far outside [-1, 1], another ending, something else than that is at `out`, or
        nothing can be written there.
    """
    if out is not None and out.suffix not in (".npz", ".safetensors"):
        raise InputError(f"{out}: draws are kept in .npz, the posterior given the window in .safetensors")
    if out is not None:
        kinds.require_kind(out, kinds.DRAWS if out.suffix == ".npz" else kinds.POSTERIOR)
        require_writable(out.absolute().parent)
    if posterior is not None and posterior.is_file() and kinds.kind_of(posterior) == kinds.STRUCTURE:
        raise InputError(
            f"{posterior} is a structure head, which knows families of effects and no psi: give it to `nfc-gym "
            "close-loop --posterior`, and a posterior here"
        )
    if posterior is not None and not posterior.suffix and not posterior.exists():
        raise InputError(f"{posterior}: no such file; an environment goes with --refine N, which needs no posterior")
    found = None if posterior is None else load(posterior)
    seen, name = (window, "window") if isinstance(window, Window) else (read_window(window), str(window))
    if found is not None:
        seen = _as_trained(found, seen, name)
        _say_unlike(found, seen, report)
    given = _given(found, seen, refined)
    if maps and "delta_e" not in given.parts:
        raise InputError(
            f"{posterior}: infers {' and '.join(given.parts)}, no delta_e; `nfc-gym train ... --maps --delta-e` trains "
            "one that does"
        )
    _say_more(given, maps, report)
    asked = given if maps else without_maps(given)
    drawn = asked.sample(samples, np.random.default_rng(seed))
    if out is not None and out.suffix == ".safetensors":
        given.save(out)
    elif out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        with replacing(out) as part, part.open("wb") as file:
            np.savez(file, **{p: getattr(drawn, p) for p in drawn.given})
    return drawn, told(given.prior, np.asarray(drawn.psi))


def _given(found: NeuralPosterior | None, seen: Window, refined: Refined | None) -> NeuralPosterior | NormalPosterior:
    if refined is not None:
        return refined(found, seen)
    if found is None:
        raise InputError("infer: want a posterior, or to refine from none")
    return found.given(seen)


def _say_more(given: NeuralPosterior | NormalPosterior, maps: bool, report: Report) -> None:
    """What else a posterior has to say than psi."""
    if isinstance(given, NeuralPosterior) and given.network.structure is not None:
        likely = sorted(given.families().items(), key=lambda each: -each[1])
        report.message(f"family of effects: {', '.join(f'{name} {share:.2f}' for name, share in likely)}")
    if "delta_e" in given.parts and not maps:
        report.message("it infers delta_e too, a second a draw without a GPU: --delta-e draws it")


def _as_trained(posterior: NeuralPosterior, window: Window, name: str) -> Window:
    """A window as the posterior's training set would have it: commands cut to [-1, 1], as the machine took them.

    A network answers motion that it has never seen with as much certainty as any other, so actions far outside [-1, 1]
    are refused here: in those rows that count.

    Raises:
      InputError: such actions, or a window that is not the network's; under the window's name.
    """
    try:
        posterior.given(window)
    except InputError as e:
        raise InputError(f"{name}: {str(e).removeprefix('window: ')}") from None
    actions = np.asarray(window.actions, float)
    require_commands(actions, posterior.network.sizes.horizon, name)
    return replace(window, actions=np.clip(actions, -1, 1))


def require_commands(actions: Array, horizon: int, name: str) -> None:
    """Refuse actions (n, a) of which one of the last `horizon` is far outside [-1, 1].

    Raises:
      InputError: naming the first of them.
    """
    first = max(0, len(actions) - horizon)
    far = np.argwhere(np.abs(actions[first:]) > _FARTHEST)
    if len(far):
        k, i = far[0]
        raise InputError(
            f"{name}: actions are what env.step takes, in [-1, 1]; actions[{first + k}, {i}] is "
            f"{actions[first + k, i]:g}: raw commands, or other units?"
        )


def _say_unlike(posterior: NeuralPosterior, window: Window, report: Report) -> None:
    """A message where a state is beyond all that the network can see for half of the window or longer.

    It is not refused: a policy drives robots where excitation does not, and what a network makes of it may be right.
    """
    states = np.asarray(window.states, float).copy()[-posterior.network.sizes.horizon - 1 :]
    off = posterior.network.unlike(torch.as_tensor(states, dtype=torch.float32)).cpu().numpy()
    if off.max() > SEEN:
        i = int(off.argmax())
        name = dict(enumerate(posterior.notes.get("states", ()))).get(i, "")
        report.message(
            f"states[:, {i}]{f' ({name})' if name else ''} has the median {np.median(states[:, i]):.4g}, {off[i]:.0f} "
            "standard deviations from the training set's mean: if it is in the right unit and place, this is motion "
            "that the posterior has seen little of; before you rely on the answer train on motion like it"
        )


def told(prior: PriorBox, psi: Array) -> list[Told]:
    """By parameter, in the prior's order, of those that are free: from draws (n, d)."""
    levels = [0.5, (1 - _LEVEL) / 2, (1 + _LEVEL) / 2]
    # The k-th of n draws stands for k / (n + 1): else few draws of the prior itself would look narrower than the prior.
    middle, low, high = np.quantile(psi, levels, axis=0, method="weibull").tolist()
    widths = [_LEVEL * (b - a) for a, b in zip(prior.low, prior.high, strict=True)]  # of the prior's own interval
    return [
        Told(prior.names[i], prior.units[i], middle[i], low[i], high[i], (high[i] - low[i]) / widths[i])
        for i in range(len(prior))
        if prior.free[i]
    ]
