"""One shard: labels drawn from the prior, motion rolled out until each window holds, everything packed into bytes."""

from dataclasses import dataclass, field
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.windows import Manifest, packed
from nfc_gym.physics.effects import Effect
from nfc_gym.physics.quiet import no_warnings
from nfc_gym.simulate import draws, ground, motion
from nfc_gym.simulate.draws import LABELS, MOTION, PLACES, Array, between, generator, geometric, picked, uniforms
from nfc_gym.simulate.drive import channels
from nfc_gym.simulate.machine import MOTOR, Machine
from nfc_gym.simulate.policy import Act, Policy
from nfc_gym.simulate.recorded import Recorded
from nfc_gym.simulate.residuals import Given, candidates, sizes
from nfc_gym.simulate.roll import Rolled, Task, roll

PLACES_EACH = 2  # of every family in a shard; other shards draw others
PATIENCE = 4  # attempts at a window's motion before its labels are drawn anew
LEVELS = (0.5, 2.0)  # of the depth camera's noise
_FRUITLESS = 40  # attempts after which it is said that this robot cannot be simulated so
_ANOTHER = 7919  # windows on: the start of which one that comes apart is tried with


@dataclass(frozen=True)
class Plan:
    """What a shard depends on beside its number; plain data, so that any process can be sent it.

    Attributes:
      manifest: of the whole set.
      policy: callable or path of what moves a share of the windows.
      effects, policy_share: shares of the windows.
      motor: standard deviation of what the motors make of an action, see `machine.MOTOR`.
      recorded: motion that windows repeat, each some stretch of it, on its own ground; None excites and invents ground.
    """

    manifest: Manifest
    policy: Act | str | None = None
    effects: float = 0.5
    policy_share: float = 0.5
    motor: float = MOTOR
    recorded: Recorded | None = None


@dataclass
class Labels:
    """What windows are to be inferred to have: psi as u (n, d), effect and its parameters; `effect` -1 is none."""

    u: Array
    effect: NDArray[np.intp]
    theta: Array


@dataclass
class Workshop:
    """A machine with what all its shards share, made once a process."""

    machine: Machine
    effects: list[Effect]
    by_family: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for i, effect in enumerate(self.effects):
            self.by_family.setdefault(effect.family, []).append(i)

    @property
    def most(self) -> int:
        """Parameters of the effect that has most."""
        return max((len(e.params) for e in self.effects), default=1)


@cache
def workshop(environment: str) -> Workshop:
    """The workshop of an environment."""
    machine = Machine(environment)
    return Workshop(machine, candidates(machine))


@lru_cache(maxsize=4)
def _policy(source: Act | str, environment: str) -> Policy:
    return Policy(source, workshop(environment).machine)


@no_warnings()  # windows that come apart are counted
def make_shard(plan: Plan, shard: int, proposed: Array | None = None, nthread: int = 1) -> bytes:
    """The file of a shard; the same bits for the same plan and shard, at any number of threads, in any process.

    Args:
      plan: of the set.
      shard: its number.
      proposed: (n, d) u in place of draws from the prior.
      nthread: threads of the simulation.

    Raises:
      InputError: the robot cannot be kept going for the length of a window.
    """
    manifest = plan.manifest
    shop = workshop(manifest.environment)
    policy = None if plan.policy is None else _policy(plan.policy, manifest.environment)
    machine, n = shop.machine, manifest.size(shard)
    again = plan.recorded
    soil = ground.Ground.of(machine, manifest.seed, shard) if again is None else ground.Ground.given(again.maps)
    labels = _labels(plan, shop, shard, np.arange(n), 0, proposed)
    longest, horizon = 0 if again else machine.habit.warm[1], machine.habit.horizon
    counts = {"windows": n, "unstable": 0, "ended": 0, "relabelled": 0}
    out: dict[str, NDArray] = {}
    pending = np.arange(n)
    for attempt in range(_FRUITLESS):
        if attempt and attempt % PATIENCE == 0:
            new = _labels(plan, shop, shard, pending, attempt, proposed)
            labels.u[pending], labels.effect[pending], labels.theta[pending] = new.u, new.effect, new.theta
            counts["relabelled"] += len(pending)
        # Rows of one effect lie side by side.
        order = pending[np.argsort(labels.effect[pending], kind="stable")]
        task, kept = _task(plan, shop, shard, order, attempt, labels, soil, longest + horizon)
        done = roll(machine, task, soil.maps, policy, nthread)
        good = ~(done.unstable | done.ended)
        counts["unstable"] += int(done.unstable.sum())
        counts["ended"] += int(done.ended.sum())
        _keep(out, n, order, good, done, kept)
        pending = np.sort(order[~good])
        if not len(pending):
            break
    else:
        raise InputError(
            f"{manifest.environment}: {len(pending)} of {n} windows came apart or ended early {_FRUITLESS} times over; "
            "the proposal or the policy lets the robot fall at once"
        )
    family = np.array([0, *(manifest.families.index(e.family) for e in shop.effects)])
    out |= {
        "psi": labels.u.astype(np.float32),
        "family": family[labels.effect + 1].astype(np.int16),
        "effect": labels.effect.astype(np.int16),
        "theta": labels.theta.astype(np.float32),
    }
    return packed(manifest, out, counts)


def _labels(
    plan: Plan, shop: Workshop, shard: int, rows: NDArray[np.intp], attempt: int, proposed: Array | None
) -> Labels:
    """psi, effect and sizes of some windows; u is what float32 holds."""
    seed, d, most = plan.manifest.seed, len(shop.machine.space), shop.most
    drawn = uniforms(seed, shard, LABELS, rows, attempt, d + 2 + 2 * most)
    u = drawn[:, :d]
    if proposed is not None:
        u = proposed[rows]
    u = np.clip(u.astype(np.float32).astype(float), 0, 1)
    effect = np.full(len(rows), -1)
    theta = np.zeros((len(rows), most))
    chosen = _places(shop, seed, shard)
    struck = np.flatnonzero(drawn[:, d] < plan.effects) if len(chosen) else np.zeros(0, np.intp)
    effect[struck] = chosen[picked(drawn[struck, d + 1], len(chosen))]
    for e in np.unique(effect[struck]):
        at, one = np.flatnonzero(effect == e), shop.effects[e]
        theta[at, : len(one.params)] = sizes(one, drawn[at, d + 2 :])
    return Labels(u, effect, theta)


def _places(shop: Workshop, seed: int, shard: int) -> NDArray[np.intp]:
    """Effects that a shard's windows are given: of every family some places, each as likely."""
    rng = generator(seed, shard, PLACES)
    picks = [rng.choice(at, min(PLACES_EACH, len(at)), replace=False) for at in shop.by_family.values()]
    # A family with one place only counts as often as the others.
    return np.concatenate([np.resize(p, PLACES_EACH) for p in picks]).astype(np.intp) if picks else np.zeros(0, np.intp)


def _task(
    plan: Plan, shop: Workshop, shard: int, order: NDArray[np.intp], attempt: int, labels: Labels, soil: ground.Ground,
    steps: int,
) -> tuple[Task, dict[str, NDArray]]:  # fmt: skip
    """What the rows are to do in an attempt, and what of it is kept beside the windows."""
    machine, habit = shop.machine, shop.machine.habit
    robot_channels, starts = channels(machine.settings.robot(machine.model)), ground.count(machine)
    waves = motion.count(steps, robot_channels)
    u = uniforms(plan.manifest.seed, shard, MOTION, order, attempt, 5 + starts + waves)
    low, high = (0, 0) if plan.recorded else habit.warm
    which = picked(u[:, 1], max(len(soil.maps), 1))
    recorded = None
    if plan.recorded is not None:
        window = shard * plan.manifest.per_shard + order + attempt * _ANOTHER
        recorded = plan.recorded.at(window, picked(u[:, 3], len(plan.recorded)))
    if recorded is not None and recorded.which is not None:
        which = recorded.which
    psi = machine.space.low + labels.u[order] * (machine.space.high - machine.space.low)
    task = Task(
        psi=psi,
        which=which,
        start=u[:, 5 : 5 + starts],
        signal=motion.signals(u[:, 5 + starts :], steps, robot_channels, machine.dt, habit.swing, habit.offset),
        jitter=plan.motor
        * draws.normals(plan.manifest.seed, shard, draws.MOTOR, order, attempt, (steps, machine.kind.action_size)),
        warm=low + picked(u[:, 0], high - low + 1),
        guided=(u[:, 2] < plan.policy_share) & (plan.policy is not None),
        given=_given(shop, labels, order),
        recorded=recorded,
    )
    plane = not soil.maps
    kept = {
        "terrain_kind": np.full(len(order), -1, np.int16) if plane else soil.kind[which],
        "terrain_seed": np.zeros(len(order), np.int64) if plane else soil.seed[which],
        "terrain_difficulty": np.zeros(len(order), np.float32) if plane else soil.difficulty[which],
        "camera_seed": between(u[:, 3], 0, 2**31).astype(np.int64),
        "camera_level": geometric(u[:, 4], *LEVELS).astype(np.float32),
    }
    return task, kept


def _given(shop: Workshop, labels: Labels, order: NDArray[np.intp]) -> list[Given]:
    of = labels.effect[order]
    out = []
    for e in np.unique(of[of >= 0]):
        rows = slice(int(np.searchsorted(of, e)), int(np.searchsorted(of, e, "right")))
        out.append(Given(shop.effects[e], rows, labels.theta[order[rows], : len(shop.effects[e].params)]))
    return out


def _keep(
    out: dict[str, NDArray], n: int, order: NDArray[np.intp], good: NDArray[np.bool_], done: Rolled,
    kept: dict[str, NDArray],
) -> None:  # fmt: skip
    """Put the windows that hold into their places of the shard."""
    made = {
        "states": done.states, "actions": done.actions, "delta_s": done.delta_s.astype(np.float32),
        "pose": done.pose, "start": done.start, **kept,
    }  # fmt: skip
    for name, value in made.items():
        if name not in out:
            out[name] = np.zeros((n, *value.shape[1:]), value.dtype)
        out[name][order[good]] = value[good]


def described(shop: Workshop) -> list[dict[str, object]]:
    """The effects that windows may be given, as a manifest has them."""
    return [
        {
            "family": e.family,
            "where": list(e.where),
            "parameters": [p.name for p in e.params],
            "units": [p.unit for p in e.params],
        }
        for e in shop.effects
    ]
