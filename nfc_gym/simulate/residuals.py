"""Effects that windows are given: which a robot could have, of what size, and how they act in rows of a batch."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.envs.simulations import Simulations
from nfc_gym.physics.acting import Acting
from nfc_gym.physics.effects import FAMILIES, Effect, Scales, propose
from nfc_gym.physics.effects.base import TIME, overrides
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.fields import ModelFields
from nfc_gym.simulate import motion
from nfc_gym.simulate.draws import Array, between, geometric
from nfc_gym.simulate.drive import channels, drive_of
from nfc_gym.simulate.ground import count
from nfc_gym.simulate.machine import Machine

SPREAD = (0.5, 3.0)  # sizes are the library's realistic ones times this, uniform in the logarithm
# Effects of sensors change no motion; `generic` ones are never the name of a cause.
_HOOKS = ("model", "action", "friction", "force", "modulate")  # that change the motion
UNMOVED = ("sensor_bias", "sensor_gain", "sensor_delay", "misalignment")
_ROWS, _STEPS = 32, 60  # of the motion that typical magnitudes are taken from


def typical(machine: Machine) -> Scales:
    """Typical magnitudes along the robot's motion: nominal, on a plane, under its own excitation."""
    sims = machine.simulations(_ROWS, 1, [])
    robot, batch, view = sims.robot, sims.batch, sims.view
    rng = np.random.default_rng(0)
    nominal = np.tile(sims.space.nominal, (_ROWS, 1))
    flat = rng.random((_ROWS, count(machine)))
    sims.begin(np.arange(_ROWS), {"psi": nominal})
    start = robot.begin(flat[:, -robot.draws :], sims.ground)
    view.qpos[...], view.qvel[...] = start.qpos, start.qvel
    view.task.update(start.task)
    view.now = robot.derive(view)
    u = rng.random((_ROWS, motion.count(_STEPS, channels(robot))))
    habit, drive = machine.habit, drive_of(robot, sims.model)
    signal = motion.signals(u, _STEPS, channels(robot), machine.dt, habit.swing, habit.offset)
    parts = [batch.bind(n) for n in ("qfrc_passive", "qfrc_actuator", "qfrc_constraint", "actuator_force")]
    kept: list[list[Array]] = [[], [], [], [], [], []]
    for k in range(_STEPS):
        action = np.clip(drive(view, signal[:, k]), -1, 1)
        view.ctrl[...] = robot.actuate(action, view)
        batch.step(nstep=machine.kind.frame_skip)
        passive, driven, held, force = (np.array(p) for p in parts)
        for series, value in zip(
            kept, (passive + driven + held, driven, force, view.qvel, view.ctrl, view.qpos), strict=True
        ):
            series.append(np.array(value))
    sane = np.isfinite(np.stack(kept[3])).all((0, 2))
    needed, driven, force, qvel, ctrl, qpos = (np.stack(s)[:, sane].reshape(-1, s[0].shape[-1]) for s in kept)

    def rms(a: Array) -> Array:
        return np.sqrt((a * a).mean(0))

    length = (sum(habit.warm) / 2 + habit.horizon) * machine.dt
    return Scales(
        np.maximum(rms(needed), rms(driven)), rms(qvel), ctrl.std(0) + 0.1 * np.abs(ctrl).mean(0), rms(force),
        machine.dt, {TIME: length / 2}, {}, qpos.min(0), qpos.max(0),
    )  # fmt: skip


def candidates(machine: Machine) -> list[Effect]:
    """Every effect on the motion that the robot's model could lack, in the library's order."""
    # A patch lies at one place of the world; on rough ground the motion begins anywhere.
    away = ("friction_patch",) if machine.rough else ()
    found = propose(machine.model, typical(machine), exclude=(*UNMOVED, *away), generic=False)
    return [e for e in found if any(overrides(e, hook) for hook in _HOOKS)]


def families(effects: Sequence[Effect]) -> tuple[str, ...]:
    """Their families in the library's order, after `none`."""
    present = {e.family for e in effects}
    return ("none", *(f for f in FAMILIES if f in present))


def sizes(effect: Effect, u: Array) -> Array:
    """Parameters (n, k) of an effect from uniform numbers (n, 2 k), as float32 holds them.

    A size is the null plus one of the realistic sizes times a factor of `SPREAD`, in a sign that the bounds allow; what
    only shapes the effect lies between its probes.
    """
    columns = [_size(p, u[:, 2 * i], u[:, 2 * i + 1]) for i, p in enumerate(effect.params)]
    return np.stack(columns, -1).astype(np.float32).astype(float)


def _size(p: Param, u: Array, v: Array) -> Array:
    probes = np.array(p.probes, float)
    if p.shape:
        low, high = probes.min(), probes.max()
        if low > 0:
            low, high = max(low / 1.5, p.low), min(high * 1.5, p.high)
            return np.clip(geometric(u, low, high), p.low, p.high)
        return np.clip(between(u, low, high), p.low, p.high)
    probe = probes[(u * len(probes)).astype(np.intp)] - p.null
    factor = geometric(v, *SPREAD)
    if len(probes) == 1 and p.low < p.null < p.high:
        # One probe stands for both directions; which is what is left of u.
        probe = np.where(u < 0.5, -probe, probe)
    return np.clip(p.null + factor * probe, p.low, p.high)


@dataclass
class Given:
    """An effect that some rows of a shard are given.

    Attributes:
      effect: bound to the model.
      rows: of the batch, contiguous.
      theta: (k, parameters) of each row.
    """

    effect: Effect
    rows: slice
    theta: Array


class Part:
    """Contiguous rows of a batch, as `Acting` sees an engine and its model fields."""

    def __init__(self, sims: Simulations, rows: slice) -> None:
        self.batch: Batch = sims.batch
        self.fields, self.rows = sims.fields, rows
        self.qpos, self.qvel, self.ctrl = (self.batch.bind(n)[rows] for n in ("qpos", "qvel", "ctrl"))
        self.qfrc_applied, self.xfrc_applied = (self.batch.bind(n)[rows] for n in ("qfrc_applied", "xfrc_applied"))

    def bind(self, name: str) -> Any:
        """A live field of these rows."""
        return self.batch.bind(name)[self.rows]

    def forward(self, ids: Any = None) -> None:
        """Derived fields for the state as it is."""
        own = np.arange(self.rows.start, self.rows.stop)
        self.batch.forward(own if ids is None else own[ids])

    def __getitem__(self, name: str) -> NDArray:
        return self.fields[name][self.rows]


class Residuals:
    """Effects at work in the rows of a batch, a control step at a time.

    Args:
      sims: whose psi is written already.
      given: effects; their model edits are made here. Those of the same rows act one after another.
    """

    def __init__(self, sims: Simulations, given: Sequence[Given]) -> None:
        self.parts: list[tuple[Part, Acting, bool]] = []
        self.between = np.zeros(sims.n, bool)
        dt, model = float(sims.model.opt.timestep), sims.model
        for each in given:
            if overrides(each.effect, "model"):
                fields = sims.fields.rows(np.arange(each.rows.start, each.rows.stop))
                each.effect.model(fields, each.theta)
                fields.commit()
        self.time = sims.batch.bind("time")
        together: dict[tuple[int, int], list[Given]] = {}
        for each in given:
            together.setdefault((each.rows.start, each.rows.stop), []).append(each)
        for alike in together.values():
            part = Part(sims, alike[0].rows)
            acting = Acting(model, [e.effect for e in alike], [e.theta for e in alike], _as_fields(part), part, dt)
            if acting.commanding or acting.acts:
                acting.restart()
                self.parts.append((part, acting, bool(acting.pushing)))
                self.between[alike[0].rows] = True
        self.wanted: list[Array] = []

    def command(self, ctrl: Array) -> None:
        """What the robot commands in the coming control step, (n, nu)."""
        self.wanted = [ctrl[part.rows].copy() for part, _, _ in self.parts]

    def recall(self, ctrl: Array, steps: int) -> None:
        """Commands (n, nu) that were given before the simulation begins, for so many physics steps."""
        self.command(ctrl)
        for (part, acting, _), wanted in zip(self.parts, self.wanted, strict=True):
            signals = {TIME: self.time[part.rows].reshape(-1)}
            for _ in range(steps if acting.commanding else 0):
                acting.command(wanted, signals)

    def act(self) -> None:
        """Before each physics step."""
        for (part, acting, pushing), wanted in zip(self.parts, self.wanted, strict=True):
            signals = {TIME: self.time[part.rows].reshape(-1)}
            if acting.commanding:
                part.ctrl[...] = acting.command(wanted, signals)
            if pushing:
                part.qfrc_applied[...] = 0
                part.xfrc_applied[...] = 0
            acting.push(part.ctrl, signals)

    def rest(self) -> None:
        """After a control step: no force is left applied."""
        for part, _, pushing in self.parts:
            if pushing:
                part.qfrc_applied[...] = 0
                part.xfrc_applied[...] = 0


def _as_fields(part: Part) -> ModelFields:
    """What `Acting` reads of model fields is items alone."""
    return part  # type: ignore[return-value]
