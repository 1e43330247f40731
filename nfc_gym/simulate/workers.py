"""Who makes the shards: this process, several, or a Ray cluster. Whoever does, a shard's bits are the same."""

import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from typing import Any

from nfc_gym.core.errors import InputError, MissingExtra, NfcError
from nfc_gym.simulate.draws import Array
from nfc_gym.simulate.shard import Plan, make_shard

Proposed = Callable[[int], Array | None]  # u (n, d) that a proposal gives a shard
Made = Generator[tuple[int, bytes], None, None]
_AHEAD = 2  # shards in flight for each worker: results wait in memory until they are written
_RETRIES = 3  # times that Ray makes a shard again whose worker died
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    with pool_of(jobs) as pool:
        yield from _flow(
            shards, jobs, lambda k: pool.submit(make_shard, plan, k, proposed(k)), _first, lambda f: f.result()
        )


@contextmanager
def pool_of(jobs: int) -> Generator[ProcessPoolExecutor, None, None]:
    """Processes of one thread each, which end at once where this one is interrupted or dies.

    Raises:
      NfcError: one of them died.
    """
    with _single_threaded():
        pool = ProcessPoolExecutor(jobs, get_context("spawn"), _ready)
        try:
            yield pool
        except BrokenProcessPool:
            raise NfcError(
                "a worker process died, perhaps for want of memory; finished shards stay: the same command goes on, "
                "and --jobs with a smaller number needs less"
            ) from None
        finally:
            running = list((pool._processes or {}).values())
            pool.shutdown(wait=False, cancel_futures=True)
            for process in running:
                process.terminate()


def _ready() -> None:
    """In a worker: Ctrl-C is the caller's to answer, and nobody works on for a caller that was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        caller = parent_process()
        if caller is not None:
            caller.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _single_threaded() -> Generator[None, None, None]:
    """Processes started meanwhile compute with one thread each."""
    before = {k: os.environ.get(k) for k in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for k, v in before.items():
            if v is None:
                del os.environ[k]
            else:
                os.environ[k] = v


def _first(running: list[Future]) -> Any:
    return next(iter(wait(running, return_when=FIRST_COMPLETED)[0]))


def _flow(
    shards: Sequence[int],
    jobs: int,
    submit: Callable[[int], Any],
    first: Callable[[list[Any]], Any],
    result: Callable[[Any], bytes],
) -> Made:
    """Shards as they are finished, with `_AHEAD` a worker in flight."""
    waiting, running = list(shards), {}
    while waiting or running:
        while waiting and len(running) < _AHEAD * jobs:
            k = waiting.pop(0)
            running[submit(k)] = k
        done = first(list(running))
        yield running.pop(done), result(done)


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
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtra("a cluster needs Ray: pip install 'nfc_gym[ray]'") from None
    started = not ray.is_initialized()
    if started:
        where = {"num_cpus": jobs or cores()} if address == "local" else {"address": address}
        try:
            ray.init(**where, include_dashboard=False, logging_level="warning", log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as e:
            raise InputError(f"--ray {address}: no such cluster ({e}); want its address, auto or local") from None
    make = ray.remote(num_cpus=1, max_retries=_RETRIES)(make_shard)
    given, jobs = ray.put(plan), jobs or int(ray.cluster_resources().get("CPU", 1))
    try:
        yield from _flow(
            shards, jobs, lambda k: make.remote(given, k, proposed(k)), lambda refs: ray.wait(refs)[0][0], ray.get
        )
    except ray.exceptions.RayTaskError as e:
        raise e.cause if isinstance(e.cause, NfcError) else NfcError(f"a worker failed: {e.cause!r}") from None
    except ray.exceptions.RayError as e:
        raise NfcError(
            f"a shard's workers died {_RETRIES + 1} times ({type(e).__name__}); finished shards stay: "
            "the same command goes on"
        ) from None
    finally:
        if started:
            ray.shutdown()
