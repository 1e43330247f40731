"""`simulate`: a training set of windows of an environment's motion under the prior, or under a proposal."""

import copy
import hashlib
import platform
import time
from contextlib import closing, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable
from nfc_gym.core.posterior import Sampler, load_source, without_maps
from nfc_gym.core.whole import require_share, require_whole
from nfc_gym.inference.windows import Manifest, Windows, WindowWriter
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.simulate import workers
from nfc_gym.simulate.draws import PROPOSAL, Array, generator
from nfc_gym.simulate.machine import MOTOR, Machine
from nfc_gym.simulate.policy import Act, Perceptron, Policy
from nfc_gym.simulate.residuals import families
from nfc_gym.simulate.shard import Plan, described, workshop

_ASKED, _DIGITS = 32, 3  # observations by which a policy is told from another, and digits of its answers
PER_SHARD = 2048  # windows: enough that arrays are long, few enough that 1e5 windows keep 16 cores busy


def simulate(
    environment: str,
    windows: int,
    out: str | Path,
    *,
    seed: int = 0,
    jobs: int = 0,
    effects: float = 0.5,
    proposal: Sampler | str | Path | None = None,
    policy: Act | str | Path | None = None,
    policy_share: float = 0.5,
    motor: float = MOTOR,
    ray: str | None = None,
    per_shard: int = PER_SHARD,
    console: Console | None = None,
) -> Windows:
    """Simulate windows, or go on where an earlier call with the same arguments was interrupted.

    Args:
      environment: id, `nfc_gym/JackalFlat-v0` or `JackalFlat`.
      windows: how many.
      out: folder for them.
      seed: the same arguments and seed give the same bits, whatever `jobs` and `ray` are.
      jobs: processes; 0 takes all cores.
      effects: share of the windows whose dynamics have an effect that the model lacks.
      proposal: what psi is drawn from in place of the prior: anything with `sample(n, rng)`, or a file of such
        (`core.load_source`). It must stay within the prior's box.
      policy: what moves a share of the windows in place of excitation alone, see `policy.Policy`. To go on, callables
        are told from others by their name and by their answers to a few observations; one that answers twice the same
        in two ways, since it remembers or draws at random, by its name alone.
      policy_share: that share.
      motor: standard deviation of the noise of motors, a share of the actions' full range; actions are kept without.
      ray: address of a Ray cluster, `auto` or `local`; None takes processes of this machine.
      per_shard: windows a shard.
      console: where progress goes; None is silent.

    Returns:
      What lies in the folder.

    Raises:
      InputError: bad input, or the folder holds a set made otherwise.
      NfcError: a worker died.
    """
    _check(windows, seed, jobs, effects, policy_share, motor, per_shard)
    require_writable(Path(out))
    sampler, source, machine = _opened(proposal), settled(policy), workshop(environment).machine
    if source is not None:
        Policy(source, machine)  # says at once what is wrong with it
    settings = {
        "effects": effects,
        "proposal": _digest(sampler, seed, machine),
        "motor": motor,
        "policy": _named(source, machine),
        "policy_share": policy_share if policy is not None else 0.0,
    }
    manifest = manifest_of(environment, windows, seed, per_shard, settings)
    writer = WindowWriter(Path(out), manifest)
    plan = Plan(manifest, source, effects, settings["policy_share"], motor)

    def proposed(shard: int) -> Array | None:
        return None if sampler is None else drawn(sampler, machine, seed, shard, manifest.size(shard))

    _write(writer, workers.made(plan, writer.missing, proposed, jobs, ray), console)
    return Windows(out)


def _check(
    windows: int, seed: int, jobs: int, effects: float, policy_share: float, motor: float, per_shard: int
) -> None:
    for name, value, least in (
        ("windows", windows, 1),
        ("seed", seed, 0),
        ("jobs", jobs, 0),
        ("per_shard", per_shard, 1),
    ):
        require_whole(name, value, least)
    for name, share in (("effects", effects), ("policy_share", policy_share), ("motor", motor)):
        require_share(name, share)


def _opened(proposal: Sampler | str | Path | None) -> Sampler | None:
    found = load_source(proposal) if isinstance(proposal, str | Path) else proposal
    if found is not None and not isinstance(found, Sampler):
        raise InputError(f"proposal: want a file, or something with sample(n, rng), got {type(found).__name__}")
    return found


def drawn(sampler: Sampler, machine: Machine, seed: int, shard: int, n: int) -> Array:
    """u (n, d) that a proposal gives the windows of a shard; errors as `units`."""
    return units(without_maps(sampler).sample(n, generator(seed, shard, PROPOSAL)).psi, machine.space, n)


def units(psi: Array | None, space: ParameterSpace, n: int) -> Array:
    """psi (n, d) in physical units -> u (n, d) in [0, 1].

    Raises:
      InputError: there is none, it has other parameters, or leaves the prior's box.
    """
    if psi is None or psi.shape != (n, len(space)):
        have = "says nothing of psi" if psi is None else f"has psi of shape {psi.shape}"
        raise InputError(f"the proposal {have}; want {(n, len(space))}: {', '.join(space.names)}")
    u = (psi - space.low) / (space.high - space.low)
    out = np.argwhere(~((u >= -1e-6) & (u <= 1 + 1e-6)))
    if len(out):
        i, j = out[0]
        raise InputError(
            f"the proposal's {space.names[j]} is {psi[i, j]:g}, outside the prior's "
            f"[{space.low[j]:g}, {space.high[j]:g}] {space.units[j]}"
        )
    return np.clip(u, 0, 1)


def settled(policy: Act | str | Path | None) -> Act | str | None:
    """A policy as plans have it: a path is made absolute, as workers may stand elsewhere."""
    if callable(policy) or policy is None:
        return policy
    if not isinstance(policy, str | Path):
        raise InputError(f"policy: want a file, or a callable of observations, got {type(policy).__name__}")
    return str(Path(policy).resolve())


def _digest(sampler: Sampler | None, seed: int, machine: Machine) -> str | None:
    """What tells one proposal from another: a few of its draws."""
    if sampler is None:
        return None
    return hashlib.sha256(drawn(sampler, machine, seed, 0, 16).tobytes()).hexdigest()[:16]


def _named(policy: Act | str | None, machine: Machine) -> str | None:
    """What tells one policy from another."""
    if policy is None:
        return None
    if isinstance(policy, Perceptron):
        return policy.digest
    if callable(policy):
        name = getattr(policy, "__qualname__", type(policy).__qualname__)
        answers = _answers(policy, machine)
        return name if answers is None else f"{name} {hashlib.sha256(answers).hexdigest()[:16]}"
    return hashlib.sha256(Path(policy).read_bytes()).hexdigest()[:16]


def _answers(policy: Act, machine: Machine) -> bytes | None:
    """A policy's actions under some observations, or None where it answers otherwise when it is asked again, or not.

    They are rounded, since libraries do so from run to run, and it is a copy that is asked, where one can be made: what
    the policy remembers stays as it is.
    """
    with suppress(Exception):  # what holds what cannot be copied is asked itself
        policy = copy.deepcopy(policy)
    size = Policy(policy, machine).observation
    probe = np.random.default_rng(0).standard_normal((_ASKED, size)).astype(np.float32)
    try:
        first, second = (np.nan_to_num(np.array(policy(probe.copy()), float)).round(_DIGITS) + 0.0 for _ in range(2))
    except Exception:  # these are no observations that the robot would ever make
        return None
    return first.tobytes() if np.array_equal(first, second) else None


def manifest_of(environment: str, windows: int, seed: int, per_shard: int, settings: dict[str, Any]) -> Manifest:
    """The manifest of a set that is yet to be made; arguments as of `simulate`, `settings` what else it depends on."""
    shop = workshop(environment)
    machine, space = shop.machine, shop.machine.space
    return Manifest(
        environment=machine.environment,
        robot=machine.kind.name,
        rough=machine.rough,
        psi_names=space.names,
        psi_units=space.units,
        psi_low=tuple(space.low.tolist()),
        psi_high=tuple(space.high.tolist()),
        horizon=machine.habit.horizon,
        dt=machine.dt,
        state_names=machine.state_names,
        action_names=machine.action_names,
        state_noise=tuple(machine.noise.tolist()),
        families=families(shop.effects),
        effects=tuple(described(shop)),
        terrain_kinds=machine.terrain_kinds,
        terrain_scale=machine.kind.terrain_scale,
        seed=int(seed),
        windows=int(windows),
        per_shard=int(per_shard),
        settings=settings,
        versions={n: version(n) for n in ("nfc_gym", "mujoco", "numpy")} | {"python": platform.python_version()},
    )


def _write(writer: WindowWriter, made: workers.Made, console: Console | None) -> None:
    """Write what is made as it comes, and say how it goes."""
    manifest = writer.manifest
    there = sum(c["windows"] for c in manifest.finished.values())
    began = time.monotonic()
    columns = (
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"), TimeRemainingColumn(),
    )  # fmt: skip
    shown = Progress(*columns, console=console, disable=console is None, refresh_per_second=2)
    with closing(made), shown as bar:
        task = bar.add_task(f"windows of {manifest.environment}", total=manifest.windows, completed=there, rate="")
        done = 0
        for shard, data in made:
            done += writer.add(shard, data)["windows"]
            rate = done / max(time.monotonic() - began, 1e-9)
            bar.update(task, completed=there + done, rate=f"{rate:.0f}/s")
    if console is not None:
        _say(writer, console, done, time.monotonic() - began)


def _say(writer: WindowWriter, console: Console, done: int, seconds: float) -> None:
    finished = writer.manifest.finished.values()
    void = {k: sum(c[k] for c in finished) for k in ("unstable", "ended", "relabelled")}
    labels = "psi and effects" if writer.manifest.settings["proposal"] is None else "effects"  # proposed psi stay
    said = f"{sum(c['windows'] for c in finished)} windows in {writer.folder}"
    speed = f"; {done} made now, {done / max(seconds, 1e-9):.0f} a second" if done else "; nothing was left to do"
    console.print(said + speed, highlight=False, markup=False, emoji=False)
    console.print(
        f"redrawn: {void['unstable']} that came apart, {void['ended']} whose episode ended within the window; "
        f"{labels} drawn anew for {void['relabelled']}",
        highlight=False,
    )
