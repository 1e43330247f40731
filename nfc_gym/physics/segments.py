"""What roll-outs start from and what they are: segments, the firmware servos in them, and trajectories."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.past import Past

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Servo:
    """A firmware position loop: ctrl = supply * clip(gain (target - q) - damping v, -limit, limit)."""

    actuator: int
    qpos: int
    dof: int
    limit: float

    def command(self, goal: Array, qpos: Array, qvel: Array, terms: Mapping[str, Array]) -> Array:
        """(...,) what it makes of goals (...,) at states (..., nq), (..., nv); `gain`, `supply`, `damping` (...,)."""
        wish = terms["gain"] * (goal - qpos[..., self.qpos]) - terms["damping"] * qvel[..., self.dof]
        return terms["supply"] * np.clip(wish, -self.limit, self.limit)


@dataclass(frozen=True)
class Segments:
    """S stretches of logs, laid on a uniform grid of physics steps; H steps of history come before the start.

    Attributes:
      dt: physics step, s.
      history: H.
      qpos, qvel: (S, nq), (S, nv) measured start states.
      qacc: (S, nv) how fast the speeds changed there, as measured; None where nobody knows. What a late sensor has
        missed is told by it.
      ctrl: (S, H + K, nu) commands, or targets where a firmware servo computes the command.
      exogenous: name -> (S, H + K).
      known: (field, object names) -> (S, H + K) model fields that the log itself gives.
      servo: per `Servo`, its gain, supply and damping, (S, H + K) each.
      settle: steps for which the first command is held before the start; velocities and hidden states are then kept,
        the positions go back to the measured ones. 0 starts at the measured velocities.
      condition: (S,) label of the condition that each segment was recorded in.
      past: what was measured before the starts. Without it, or with no history, joints with a memory begin at rest,
        and slow states of the drives settled at the history's first command.
      off: (S, nq), (S, nv) by how much the starts are off what was measured, where noise is added to them. States come
        from several samples and are off alike for a while: effects that ask for it (`Effect.off_before`) take what was
        measured before the starts as off by the same.
      channels: names of all measured channels, which say what each start was read from (`true_state`); None where
        nobody knows.
    """

    dt: float
    history: int
    qpos: Array
    qvel: Array
    ctrl: Array
    exogenous: Mapping[str, Array] = field(default_factory=dict)
    known: Mapping[tuple[str, tuple[str, ...]], Array] = field(default_factory=dict)
    servo: Sequence[tuple[Servo, Mapping[str, Array]]] = ()
    settle: int = 0
    condition: NDArray[np.str_] | None = None
    past: Past | None = None
    channels: frozenset[str] | None = None
    qacc: Array | None = None
    off: tuple[Array, Array] | None = None

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def steps(self) -> int:
        """K, physics steps after the start."""
        return self.ctrl.shape[1] - self.history


@dataclass(frozen=True)
class Trajectory:
    """What was rolled out. P parameter vectors, S segments, times 0, dt, ..., K dt.

    Attributes:
      qpos, qvel: (P, S, K + 1, nq), (P, S, K + 1, nv).
      sensordata: (P, S, K + 1, nsensordata), each at its own time, or None where not asked for.
      stable: (P, S) False where MuJoCo warned or a value is not finite; such rows hold no meaning.
      touched: (P, S) whether bodies touched in any step.
    """

    qpos: Array
    qvel: Array
    sensordata: Array | None
    stable: NDArray[np.bool_]
    touched: NDArray[np.bool_]
