"""After a mission: the posterior network and the detector learn from what was gathered (Algorithm 1, last line).

    learned = learn_from_mission("runs/axle", posterior=posterior, detector=detector)

**The posterior** needs windows whose psi is known, and of the mission's own nobody knows it. Its motion is therefore
simulated again, from where it began and under the actions that were given, with psi drawn from the prior. Psi is never
drawn from the network's own belief: a network that is fed what it believes grows surer of it with each mission, right
or wrong. What the mission adds is the motion and the ground; what it told about one psi is in the beliefs themselves,
and `Sequential` narrows those.

**The detector** takes windows of the mission for normal, by default those of trajectories without an alarm (`normal`).

Both are judged on trajectories that nothing was learned from, and stay as they were where there are too few.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from nfc_gym.adaptation import normal as normality
from nfc_gym.adaptation.digests import of_detector, of_network
from nfc_gym.adaptation.gathered import read_mission
from nfc_gym.adaptation.normal import Normal, quiet_trajectories
from nfc_gym.adaptation.relearning import relearned
from nfc_gym.adaptation.settings import require_number
from nfc_gym.adaptation.trajectory import Dataset, Trajectory
from nfc_gym.adaptation.weights import digest, flat
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable, write_whole
from nfc_gym.core.whole import require_whole
from nfc_gym.inference import detector_file
from nfc_gym.inference.data import WindowSet
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.detector_file import KEPT
from nfc_gym.inference.jobs import device_of
from nfc_gym.inference.posterior import NeuralPosterior, load
from nfc_gym.inference.progress import Spoken, quiet
from nfc_gym.inference.rates import Threshold
from nfc_gym.inference.train import TrainConfig
from nfc_gym.simulate.machine import MOTOR, full_id

Array = NDArray[np.float64]
REPORT = "learned.json"
RATE = 0.05  # false-positive rate of windows, where a detector does not say which it was set for
_OF = {"posterior": ("simulations", "effects", "motor"), "detector": ("rate",)}  # settings of one part alone
_TOLD = 256  # windows by which a set is told from another of its size
_TRAINING = TrainConfig(epochs=20, batch=128, rate=1e-4, warmup=20, average=0.99, patience=5)


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """Settings of learning from a mission.

    Attributes:
      rate: wanted false-positive rate of windows; None is the one that the detector was calibrated for, or `RATE`.
      simulations: windows that the posterior learns from.
      effects: share of them with an effect that the model lacks.
      motor: standard deviation of the motors' noise, a share of the actions' range.
      training: of either; smaller steps than from the start, so that what was learned before is not lost.
      seed: of everything.
    """

    rate: float | None = None
    simulations: int = 4096
    effects: float = 0.5
    motor: float = MOTOR
    training: TrainConfig = field(default_factory=lambda: _TRAINING)
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("simulations", 100), ("seed", 0)):
            require_whole(f"learning: {name}", getattr(self, name), least)
        require_number("learning: effects", self.effects, 0, 1, "a share")
        require_number("learning: motor", self.motor, 0, what="a share of the actions' range")
        if self.rate is not None and not 0 < require_number("learning: rate", self.rate, 0, 1, "a share") < 1:
            raise InputError(f"learning: rate must lie between 0 and 1, got {self.rate:g}")


@dataclass
class Learned:
    """What a mission left behind.

    Attributes:
      posterior, detector: to go on with; those that were given where nothing was changed.
      report: for `posterior` and `detector`, whether it was `changed`, `why` not, and what it was judged by before and
        after, with standard errors: `gain`, nats a parameter on motion and psi that it did not see; `false_alarms`,
        their share on normal windows that it did not see, and `finds_injected`, AUROC. `windows` counts those.
    """

    posterior: NeuralPosterior | None
    detector: WindowDetector | None
    report: dict[str, Any]


def learn_from_mission(
    mission: str | Path | Dataset | Sequence[Trajectory], *, posterior: NeuralPosterior | str | Path | None = None,
    detector: WindowDetector | str | Path | None = None, environment: str | None = None,
    normal: Normal = quiet_trajectories, beside: WindowSet | None = None, config: LearnConfig | None = None,
    folder: str | Path | None = None, jobs: int = 0, device: str = "auto", console: Console | None = None,
) -> Learned:  # fmt: skip
    """Train the posterior network and the detector further on what a mission gathered.

    Args:
      mission: the folder of `adapt`, or its data set.
      posterior: a network's, or its file; None leaves it out. It stays as it is, a copy learns.
      detector: of windows, or its file; likewise.
      environment: id of the simulator; default the mission's own, if its folder says so.
      normal: which control steps of a trajectory are normal motion, as a flag for each.
      beside: windows that both were trained on before; as many of them are learned from again, so that nothing is
        forgotten.
      config: see `LearnConfig`.
      folder: where what was learned is kept, and from where the same call goes on when it was interrupted; default
        `learned` in the mission's folder. A data set without one keeps nothing. What a detector came to whose scorer is
        neither a network's nor a `Replay` is found anew each time.
      jobs: processes of simulation; 0 takes all cores.
      device: of training: auto, cpu or cuda.
      console: is told.

    Raises:
      InputError: no such mission or file, one of another robot, or the folder holds what was learned otherwise.
    """
    config = config or LearnConfig()
    trajectories, environment, folder = _mission(mission, environment, folder)
    old = load(posterior) if isinstance(posterior, str | Path) else posterior
    watch = detector_file.load(detector) if isinstance(detector, str | Path) else detector
    _check(old, watch)
    of = _described(trajectories, old, watch, normal, beside, config) | {"environment": environment}
    done = None if folder is None else _finished(folder, of, old, watch)
    if done is not None:
        return done
    told = quiet if console is None else Spoken(console)
    out = Learned(old, watch, {"of": of})
    shared: dict[str, Any] = {
        "training": config.training, "beside": beside, "report": told, "seed": config.seed, "device": device_of(device),
    }  # fmt: skip
    if watch is not None:
        out.detector, out.report["detector"] = normality.tuned(
            watch, trajectories, normal, _rate(config, watch), folder=_part(folder, "detector", of), **shared
        )
        told.message(_says("detector", out.report["detector"]))
    if old is not None:
        out.posterior, out.report["posterior"] = relearned(
            old, trajectories, environment, simulations=config.simulations, effects=config.effects, motor=config.motor,
            folder=_part(folder, "posterior", of), jobs=jobs, **shared,
        )  # fmt: skip
        told.message(_says("posterior", out.report["posterior"]))
    if folder is not None:
        _keep(folder, out)
    return out


def _rate(config: LearnConfig, detector: WindowDetector) -> float:
    """The wanted share of false alarms: as it is said, or as the detector was calibrated for."""
    if config.rate is not None:
        return config.rate
    return detector.calibration.rate if detector.calibration else RATE


def _check(posterior: Any, detector: Any) -> None:
    if posterior is None and detector is None:
        raise InputError("learn_from_mission: give a posterior, a detector or both")
    if posterior is not None and not isinstance(posterior, NeuralPosterior):
        raise InputError(f"learn_from_mission: the posterior must be a network's, got a {type(posterior).__name__}")
    if detector is not None and not isinstance(detector, WindowDetector):
        raise InputError(f"learn_from_mission: want a WindowDetector, got a {type(detector).__name__}")


def _mission(
    mission: str | Path | Dataset | Sequence[Trajectory], environment: str | None, folder: str | Path | None
) -> tuple[list[Trajectory], str, Path | None]:
    """Trajectories, the simulator's id, and where to keep what is learned."""
    if isinstance(mission, str | Path):
        trajectories, own = read_mission(mission)
        environment = environment or own
        folder = Path(mission) / "learned" if folder is None else folder
    else:
        trajectories = list(mission)
    if not trajectories:
        raise InputError("learn_from_mission: the mission has no trajectory")
    if environment is None:
        raise InputError("learn_from_mission: say which simulator's mission this was: environment='nfc_gym/...'")
    if folder is not None:
        require_writable(Path(folder))
    return trajectories, full_id(environment), None if folder is None else Path(folder)


def _described(
    trajectories: Sequence[Trajectory], posterior: NeuralPosterior | None, detector: WindowDetector | None,
    normal: Normal, beside: WindowSet | None, config: LearnConfig,
) -> dict[str, Any]:  # fmt: skip
    """What another call must have in common with this one to go on from it; None is a detector that nobody can tell."""
    told = {"posterior": "none", "detector": "none", "normal": "none", "beside": "none"}
    told |= {"trajectories": digest(*(np.asarray(getattr(t, f.name)) for t in trajectories for f in fields(t)))}
    if posterior is not None:
        told["posterior"] = digest(*of_network(posterior.network), posterior.parts)
    if detector is not None:
        # The flags themselves: two functions may share a name.
        told |= {"detector": of_detector(detector), "normal": digest(*(np.asarray(normal(t)) for t in trajectories))}
    if beside is not None:
        first = next(iter(beside.batches(min(len(beside), _TOLD), None)), {})
        told["beside"] = digest(len(beside), *flat(first))
    # What is said of a part that is left out changes nothing.
    unused = [name for part, names in _OF.items() if told[part] == "none" for name in names]
    return json.loads(json.dumps({k: v for k, v in asdict(config).items() if k not in unused} | told))


def _part(folder: Path | None, name: str, of: dict[str, Any]) -> Path | None:
    """Where training keeps its state: what was interrupted goes on under the same arguments alone."""
    if folder is None:
        return None
    part = folder / name / digest(of)
    part.mkdir(parents=True, exist_ok=True)
    return part


def _says(what: str, found: dict[str, Any]) -> str:
    if not found["changed"]:
        return f"{what}: not changed. {found['why']}"
    parts = [
        f"{name.replace('_', ' ')} {found[name]['before'][0]:.3g} -> {found[name]['after'][0]:.3g}"
        for name in ("false_alarms", "finds_injected", "gain") if name in found
    ]  # fmt: skip
    return f"{what}: {', '.join(parts)}"


def _keep(folder: Path, out: Learned) -> None:
    """Write what was changed, then the report, which says that all is there."""
    if out.detector is not None and isinstance(out.detector.scorer, KEPT) and out.report["detector"]["changed"]:
        detector_file.save(folder / "detector.safetensors", out.detector)
    if out.posterior is not None and out.report["posterior"]["changed"]:
        out.posterior.save(folder / "posterior.safetensors")
    write_whole(folder / REPORT, json.dumps(out.report, indent=1))


def _finished(
    folder: Path, of: dict[str, Any], posterior: NeuralPosterior | None, detector: WindowDetector | None
) -> Learned | None:
    """What an earlier call came to, if it ended and nothing that it depends on is unknown.

    Raises:
      InputError: it was about something else.
    """
    path = folder / REPORT
    if not path.is_file():
        return None
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        differ = [name for name, value in of.items() if report["of"].get(name) != value]
    except (ValueError, KeyError, AttributeError) as e:
        raise InputError(f"{path}: no report of what was learned ({e}): remove it to learn anew") from None
    if differ:
        raise InputError(
            f"{path} is of another mission or other settings ({', '.join(differ)}): remove the folder, or use another"
        )
    if of["detector"] is None:
        return None
    out = Learned(posterior, detector, report)
    if posterior is not None and report["posterior"]["changed"]:
        out.posterior = load(folder / "posterior.safetensors", posterior.prior)
    if detector is not None and report["detector"]["changed"]:
        if isinstance(detector.scorer, KEPT):
            out.detector = detector_file.load(folder / "detector.safetensors", detector.scorer.prior)
        else:
            threshold = Threshold(**report["detector"]["threshold"])
            out.detector = WindowDetector(detector.scorer, threshold, detector.every)
    return out
