"""The test bench: a mapping's model, parameters and logs made ready for fitting; one `Bench` serves the whole loop."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from nfc_gym import assets
from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured import foresight
from nfc_gym.measured.belief import Belief
from nfc_gym.measured.buffers import make_room, set_step
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.dataset import Dataset
from nfc_gym.measured.findings import Finding
from nfc_gym.measured.forward import ForwardProblem
from nfc_gym.measured.inverse import InverseProblem
from nfc_gym.measured.model import bare, compile_model, read_spec, registered
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.ripple import unrippled
from nfc_gym.measured.segments import served, servos
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import States, estimate_states
from nfc_gym.measured.suspects import Witness
from nfc_gym.physics.activations import Activations
from nfc_gym.physics.effects import complete_inertia, propose
from nfc_gym.physics.effects.base import Effect, Scales, overrides
from nfc_gym.physics.effects.conditions import conditioned
from nfc_gym.physics.effects.lookup import actuator_names
from nfc_gym.physics.parameters import ParameterSpace, parameters_from_toml
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Servo

_MOMENTS = 1000  # at which typical magnitudes are taken
_SAMPLES = 12_000  # of all logs together that an instant problem looks at; longer logs are thinned


@dataclass
class Bench:
    """A mapping made ready.

    Attributes:
      spec: the model as written, to save it with corrections.
      plant: the compiled model, without what is only looked at, with psi and no effects.
      states: of every log, by name.
      belief: of a posterior that calibration starts from.
      compare: calibrate from nominal values too, to say what that saved.
      witness: a structure head that is asked about the fit logs, and the name of its file.
      warned: what `check` warned of.
    """

    dataset: Dataset
    spec: mujoco.MjSpec
    plant: Plant
    states: dict[str, States]
    belief: Belief | None = None
    compare: bool = False
    witness: tuple[Witness, str] | None = None
    warned: tuple[Finding, ...] = ()

    @property
    def mode(self) -> str:
        """What is predicted: rollout, inverse or forward."""
        return self.dataset.mapping.segments.mode

    @property
    def firmware(self) -> dict[str, Servo]:
        """The firmware servos that make the commands, by `ctrl:<actuator>`; they act in roll-outs alone."""
        return servos(self.plant.model, self.dataset.mapping.servo_laws) if self.mode == "rollout" else {}

    def problem(self, logs: Sequence[Log], most: int | None = None) -> Problem:
        """The problem of some logs, thinned to about `most` blocks, spread evenly."""
        segments, model = self.dataset.mapping.segments, self.plant.model
        states = [self.states[log.name] for log in logs]
        if self.mode != "rollout":
            kind = InverseProblem if self.mode == "inverse" else ForwardProblem
            stride = max(1, -(-sum(map(len, self.dataset.logs)) // _SAMPLES))
            return kind(model, logs, states, segments.length, stride, self.dataset.mapping.straight)
        return self.rollouts(logs, states, most)

    def searched(self, logs: Sequence[Log], most: int | None = None) -> Problem:
        """The problem that models are fitted and compared on: as `problem`, but only as far ahead as slopes can follow.

        Args:
          most: of the mapping's segments; of shorter ones as many as are as long together.
        """
        segments = self.dataset.mapping.segments
        if not self.short:
            return self.problem(logs, most)
        horizons, states = segments.horizons[: self._followed], [self.states[log.name] for log in logs]
        most = None if most is None else round(most * segments.length / horizons[-1])
        return self.rollouts(logs, states, most, horizons)

    @property
    def short(self) -> bool:
        """Whether slopes cannot follow as far as the mapping predicts."""
        return self.mode == "rollout" and self._followed < len(self.dataset.mapping.segments.horizons)

    @cached_property
    def _followed(self) -> int:
        """How many horizons slopes can follow the nominal model to, in the logs to fit."""
        problem = self.problem(self.dataset.of("fit"), most=foresight.BLOCKS)
        return foresight.followed(problem, self.plant, self.plant.null)

    def rollouts(
        self,
        logs: Sequence[Log],
        states: Sequence[States],
        most: int | None = None,
        horizons: tuple[float, ...] | None = None,
        put_off: bool = True,
        judged: bool = True,
    ) -> RolloutProblem:
        """The same as roll-outs, whatever the mapping's mode; `states` along each of the logs.

        They count as rough where bodies do touch in these logs: a robot that flies over a floor never meets it.

        Args:
          horizons: s, at which segments that end at the last are compared; default as the mapping says.
          put_off: see `Layout`.
          judged: whether they are rough is found out, by roll-outs of all logs; residuals alone want to know nothing
            of it.
        """
        whole = self._rollouts(logs, states, horizons, put_off)
        whole.rough = whole.rough and judged and self._touching
        if most is None or len(whole) <= most:
            return whole
        return whole.take(np.unique(np.linspace(0, len(whole) - 1, most).round().astype(int)))

    @cached_property
    def _touching(self) -> bool:
        """Whether bodies touch in the nominal model's roll-outs of any log."""
        logs = self.dataset.logs
        every = self._rollouts(logs, [self.states[log.name] for log in logs])
        return every.touches(self.plant, self.plant.null)

    def _rollouts(
        self,
        logs: Sequence[Log],
        states: Sequence[States],
        horizons: tuple[float, ...] | None = None,
        put_off: bool = True,
    ) -> RolloutProblem:
        segments, model = self.dataset.mapping.segments, self.plant.model
        length, horizons = (segments.length, segments.horizons) if horizons is None else (horizons[-1], horizons)
        felt = Activations(model, model.opt.timestep).span
        layout = Layout(length, segments.history, horizons, length, model.opt.timestep, put_off, felt)
        laws, straight = self.dataset.mapping.servo_laws, self.dataset.mapping.straight
        return RolloutProblem(
            model, logs, states, layout, servos(model, laws), straight, settle=segments.start == "settled"
        )


def make_bench(dataset: Dataset, nthread: int = 0) -> Bench:
    """Compile the model, bind psi, and estimate the states along every log.

    Raises:
      InputError: the model does not compile, or names of the mapping do not exist in it.
    """
    spec = read_spec(dataset.mapping.model_file, dataset.folder)
    if dataset.mapping.segments.timestep is not None:
        set_step(spec, dataset.mapping.segments.timestep)
    complete_inertia(spec)  # centres of mass must be free to move: psi and effects shift them
    declared = list(dataset.mapping.declared)
    robot = registered(dataset.mapping.model_file)
    if robot and not declared:
        declared = parameters_from_toml(assets.path(robot).with_name("psi.toml"))
    compile_model(spec, dataset.mapping.model_file)  # an error speaks of the model as it was given
    named = {name for entry in (*declared, *dataset.mapping.known) for name in entry.of}
    moving = bare(spec, named)
    make_room(moving)
    moving.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)  # a roll-out that starts at any state is awake
    model = compile_model(moving, dataset.mapping.model_file)
    known = actuator_names(model)
    for control in dataset.mapping.controls:
        if control.removeprefix("ctrl:") not in known:
            raise InputError(f"{control}: the model has no such actuator; it has: {', '.join(known) or 'none'}")
    plant = Plant(model, ParameterSpace(model, declared), nthread=nthread)
    states = {log.name: estimate_states(model, log) for log in dataset.logs}
    if dataset.mapping.segments.mode == "rollout":  # which begin at a row; what a moment shows, its neighbours show too
        laws, straight = servos(model, dataset.mapping.servo_laws), dataset.mapping.straight
        states = {log.name: unrippled(model, log, states[log.name], laws, straight) for log in dataset.logs}
    return Bench(dataset, spec, plant, states)


def scales(bench: Bench, logs: Sequence[Log]) -> Scales:
    """Typical magnitudes along the logs: speeds and forces of the motion, and what its actuators push."""
    model = bench.plant.model
    firmware = bench.firmware
    # The commands that a firmware servo makes are known along the measured motion alone.
    rolled = _rolled(bench, logs) if bench.mode == "rollout" and not firmware else None
    measured, goals = _measured(bench, logs)
    motion = rolled or measured
    needed, pushed, acting = _forces(model, motion)
    rms = lambda a: np.sqrt((a**2).mean(0))  # noqa: E731
    need, push = rms(needed), rms(pushed)
    # A driven wheel needs little for its own motion and pushes the vehicle: roll-outs show what it pushes. At measured
    # states one by one a stiff servo would seem to push thousands of newtons: there the need counts first.
    force = np.maximum(need, push) if rolled else np.where(need > 1e-9, need, push)
    first = logs[0]
    exogenous = {k: float(np.median(np.concatenate([log.exogenous[k] for log in logs]))) for k in first.exogenous}
    channels = {
        k: (
            float(np.std(np.concatenate([log.channels[k].values.reshape(len(log), -1) for log in logs]), axis=0).max()),
            first.channels[k].noise or 0.0,
        )
        for k in first.channels
    }
    spread = lambda ctrl: ctrl.std(0) + 0.1 * np.abs(ctrl).mean(0)  # noqa: E731
    ends = [f(np.stack([f(bench.states[log.name].qpos, 0) for log in logs]), 0) for f in (np.min, np.max)]
    push = _known_push(bench, logs, measured) if rolled else None
    return Scales(
        force, rms(motion.qvel), spread(goals if firmware else motion.ctrl), rms(acting), first.interval, exogenous,
        channels, ends[0], ends[1], push, spread(measured.ctrl) if firmware else None,
    )  # fmt: skip


def _forces(model: mujoco.MjModel, motion: "_Motion") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the model needs for a motion (n, nv), and what its actuators push (n, nv) and exert (n, nu) along it."""
    data = mujoco.MjData(model)
    count = len(motion.qpos)
    needed, pushed, acting = np.zeros((count, model.nv)), np.zeros((count, model.nv)), np.zeros((count, model.nu))
    driven, activations = np.zeros(model.nv), Activations(model, model.opt.timestep)
    for k in range(count):
        data.qpos[:], data.qvel[:], data.ctrl[:] = motion.qpos[k], motion.qvel[k], motion.ctrl[k]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_mulM(model, data, driven, motion.qacc[k])
        needed[k] = driven + data.qfrc_bias
        activations.advance(data.ctrl, data.act, settle=True)  # what came before a moment is not at hand
        activations.hold(data, needed[k] - data.qfrc_passive, model.actuator_gainprm, model.actuator_biasprm)
        mujoco.mj_fwdActuation(model, data)
        pushed[k], acting[k] = data.qfrc_actuator, data.actuator_force
    return needed, pushed, acting


def _known_push(bench: Bench, logs: Sequence[Log], motion: "_Motion") -> np.ndarray:
    """(nv,) what the actuators pushed at most as their laws tell from the measured motion, less what its noise adds.

    The largest is the 99th percentile, which noise alone would bring to 2.33 standard deviations. Degrees of freedom
    that no channel shows get 0.
    """
    model, states = bench.plant.model, [bench.states[log.name] for log in logs]
    spread = [np.median([np.median(getattr(s, f"{k}_sd"), 0) for s in states], 0) for k in ("qpos", "qvel")]
    pushed = _forces(model, motion)[1]
    turned = motion.qpos.copy()
    for q in turned:
        mujoco.mj_integratePos(model, q, spread[0], 1.0)
    moved = replace(motion, qpos=turned), replace(motion, qvel=motion.qvel + spread[1])
    noise = sum(((_forces(model, m)[1] - pushed) ** 2).mean(0) for m in moved)
    known = np.maximum(np.quantile(np.abs(pushed), 0.99, axis=0) - 2.33 * np.sqrt(noise), 0.0)
    return np.where(spread[1] > 0, known, 0.0)


@dataclass(frozen=True)
class _Motion:
    """States, accelerations and commands at n moments: (n, nq), (n, nv), (n, nv), (n, nu)."""

    qpos: np.ndarray
    qvel: np.ndarray
    qacc: np.ndarray
    ctrl: np.ndarray


def _measured(bench: Bench, logs: Sequence[Log]) -> tuple[_Motion, np.ndarray]:
    """The motion as estimated from the logs; joints that no channel shows stand still. And the logs' commands (n, nu).

    The motion's commands are those that reach the actuators: in roll-outs what firmware servos make of their goals.
    """
    model = bench.plant.model
    parts = []
    for log in logs:
        s = bench.states[log.name]
        rows = np.linspace(0, len(log) - 1, min(len(log), max(20, _MOMENTS // len(logs)))).astype(int)
        asked, reached = np.zeros((2, len(rows), model.nu))
        for commands, into in ((log.controls, asked), ({**log.controls, **served(log, s, bench.firmware)}, reached)):
            for key, values in commands.items():
                into[:, actuator_names(model).index(key.removeprefix("ctrl:"))] = values[rows]
        parts.append((s.qpos[rows], s.qvel[rows], s.qacc[rows], reached, asked))
    *motion, goals = (np.concatenate(a) for a in zip(*parts, strict=True))
    return _Motion(*motion), goals


def _rolled(bench: Bench, logs: Sequence[Log]) -> _Motion | None:
    """The nominal model's own motion from the logs' starts, under their commands: every joint moves as it would.

    None where every start diverges.
    """
    problem = bench.problem(logs, most=40)
    assert isinstance(problem, RolloutProblem)
    plant, seg = bench.plant, problem.segments
    traj = plant.shoot(plant.null[None], seg)
    stable = traj.stable[0]
    if not stable.any():
        return None
    each = max(1, int(stable.sum()) * seg.steps // _MOMENTS)
    at = np.arange(1, seg.steps, each)
    qpos, qvel = traj.qpos[0, stable], traj.qvel[0, stable]
    qacc = (qvel[:, at + 1] - qvel[:, at - 1]) / (2 * seg.dt)
    flat = lambda a: a.reshape(a.shape[0] * a.shape[1], a.shape[2])  # noqa: E731  (nothing may be commanded)
    return _Motion(flat(qpos[:, at]), flat(qvel[:, at]), flat(qacc), flat(seg.ctrl[stable][:, seg.history + at]))


def candidates(bench: Bench, logs: Sequence[Log]) -> list[Effect]:
    """Every effect that the model can have and that this kind of problem can show."""
    choice = bench.dataset.mapping.effects
    found = propose(bench.plant.model, scales(bench, logs), only=choice.only, exclude=choice.exclude)
    if bench.mode == "inverse":
        # Forces are predicted from motion: an effect on commands shows only if it can say what it would ask for.
        hidden = lambda e: overrides(e, "action") and not overrides(e, "demand")  # noqa: E731
        found = [e for e in found if not (e.driven or hidden(e) or overrides(e, "sense"))]
    if bench.mode != "rollout":  # these change how the next step is made, not what a moment shows
        found = [e for e in found if not overrides(e, "modulate")]
    available = set(logs[0].exogenous)
    found = [e for e in found if set(e.signals) <= available]
    return found + conditioned(found, sorted({log.condition for log in logs}))
