"""Who makes the shards: this process, several, or a Ray cluster. Whoever does, a shard's bits are the same."""

import pickle
from collections.abc import Callable, Generator, Sequence
from typing import Any

from nfc_gym.core.errors import InputError, NfcError
from nfc_gym.simulate.cluster import connected, cores
from nfc_gym.simulate.draws import Array
from nfc_gym.simulate.pool import unordered
from nfc_gym.simulate.shard import Plan, make_shard

Proposed = Callable[[int], Array | None]  # u (n, d) that a proposal gives a shard
Made = Generator[tuple[int, bytes], None, None]
_AHEAD = 2  # shards in flight for each of a cluster's workers: results wait in memory until they are written
_RETRIES = 3  # times that Ray makes a shard again whose worker died


def made(plan: Plan, shards: Sequence[int], proposed: Proposed, jobs: int, ray: str | None) -> Made:
    """Shards as they are finished, from whoever is to make them.

    Args:
      plan, shards: what is made.
      proposed: u (n, d) of a shard's windows, or None for draws from the prior.
      jobs: processes, or threads where a single shard is left; 0 takes all cores.
      ray: address of a cluster, see `on_ray`; None takes this machine.
    """
    if ray is not None:
        return on_ray(plan, shards, proposed, ray, jobs)
    several = min(jobs or cores(), len(shards))
    return processes(plan, shards, proposed, several) if several > 1 else serial(plan, shards, proposed, jobs)


def serial(plan: Plan, shards: Sequence[int], proposed: Proposed, threads: int) -> Made:
    """One after the other in this process."""
    for k in shards:
        yield k, make_shard(plan, k, proposed(k), threads)


def processes(plan: Plan, shards: Sequence[int], proposed: Proposed, jobs: int) -> Made:
    """In `jobs` processes of one thread each.

    Raises:
      InputError: the policy cannot be sent to another process.
      NfcError: a process died.
    """
    try:
        pickle.dumps(plan)
    except (pickle.PicklingError, AttributeError, TypeError) as e:
        raise InputError(f"policy: cannot be sent to other processes ({e}); give a file, or jobs=1") from None
    for i, found in unordered(make_shard, ((plan, k, proposed(k)) for k in shards), jobs):
        yield shards[i], found


def on_ray(plan: Plan, shards: Sequence[int], proposed: Proposed, address: str, jobs: int) -> Made:
    """On a Ray cluster, a task for each shard; a task whose worker dies is made again.

    Args:
      plan, shards, proposed: what is made.
      address: of a running cluster, `auto` for the one that this machine belongs to, `local` to start one here.
      jobs: workers, where one is started; on a running cluster half as many as shards are asked for at a time. 0 takes
        all cores.

    Raises:
      MissingExtra: Ray is not installed.
      InputError: no such cluster.
      NfcError: a shard's workers died again and again.
    """
    with connected(address, jobs) as ray:
        yield from _as_tasks(ray, plan, shards, proposed, jobs)


def _as_tasks(ray: Any, plan: Plan, shards: Sequence[int], proposed: Proposed, jobs: int) -> Made:
    make = ray.remote(num_cpus=1, max_retries=_RETRIES)(make_shard)
    given, jobs = ray.put(plan), jobs or int(ray.cluster_resources().get("CPU", 1))
    try:
        waiting, running = list(shards), {}
        while waiting or running:
            while waiting and len(running) < _AHEAD * jobs:
                k = waiting.pop(0)
                running[make.remote(given, k, proposed(k))] = k
            done = ray.wait(list(running))[0][0]
            yield running.pop(done), ray.get(done)
    except ray.exceptions.RayTaskError as e:
        raise e.cause if isinstance(e.cause, NfcError) else NfcError(f"a worker failed: {e.cause!r}") from None
    except ray.exceptions.RayError as e:
        raise NfcError(
            f"a shard's workers died {_RETRIES + 1} times ({type(e).__name__}); finished shards stay: "
            "the same command goes on"
        ) from None
