"""Where the steps come from that policies learn from: simulations in this process, or spread over a Ray cluster.

On a cluster TorchRL's Ray collector holds the workers, each with its part of the simulations and a copy of the actor.
Each batch is gathered with the actor's present weights, so that learning is the same as with simulations here. A worker
that dies takes only the part with it that it was gathering: the others' parts are kept, another worker is made in its
place, with new episodes, and gathers that part.
"""

import copy
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper

from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.worlds import batches, torchrl_env
from nfc_gym.core.errors import InputError, NfcError
from nfc_gym.inference.random import mixed
from nfc_gym.simulate.cluster import connected, require_ray

Make = Callable[..., VectorSight]  # (n, threads=, seed=): n simulations
Batches = Generator[TensorDictBase, None, None]
ATTEMPTS = 4  # at a part of a batch, until it is said that its workers die again and again
PATIENCE = 120.0  # s that a worker in a dead one's place may take to begin
_TEMPLATE = 64  # simulations that are made here, at most, to see what the workers' are like


@dataclass(frozen=True)
class Cluster:
    """A Ray cluster, and what is wanted of it.

    Attributes:
      address: of a running cluster, `auto` for the one that this machine belongs to, `local` to start one here.
      workers: how many; 0 takes as many as the cluster has cores for.
      threads: of the physics in each, and the cores that it takes; 0 is 1.

    Raises:
      InputError: there is no address, or numbers below 0.
    """

    address: str
    workers: int = 0
    threads: int = 0

    def __post_init__(self) -> None:
        if not self.address:
            raise InputError("--ray is empty; want a cluster's address, auto or local")
        for name in ("workers", "threads"):
            if getattr(self, name) < 0:
                raise InputError(f"--{name} {getattr(self, name)}: want 0 or more")

    @property
    def cores(self) -> int:
        """That a worker takes."""
        return max(1, self.threads)


def cluster_of(ray: str | None, workers: int, threads: int, simulations: int) -> Cluster | None:
    """The cluster that arguments speak of; None is this process.

    Args:
      ray, workers, threads: see `Cluster`.
      simulations: that the workers are to share.

    Raises:
      InputError: workers without a cluster, or a number of them that cannot share equally.
      MissingExtra: Ray is not installed.
    """
    if ray is None:
        if workers:
            raise InputError(f"--workers {workers} is of a Ray cluster: give --ray too (local, auto or an address)")
        return None
    if simulations % max(1, workers):
        raise InputError(
            f"--workers {workers}: {simulations} simulations cannot be shared equally; want a number that "
            f"{simulations} can be divided by"
        )
    require_ray()
    return Cluster(ray, workers, threads)


class RayWorlds:
    """Simulations on a cluster, in the place of a vector environment where policies learn.

    Args:
      make: (n, threads=, seed=) -> n simulations; it is sent to the workers, so it is made of what can be pickled.
      num_envs: simulations in all; each worker has as many.
      cluster: where.

    Attributes:
      template: a few of the simulations, in this process: what they are like.
      restarted: is told the rows of a batch whose episodes begin anew, since their worker died.
    """

    def __init__(self, make: Make, num_envs: int, cluster: Cluster) -> None:
        self.make, self.num_envs, self.cluster = make, num_envs, cluster
        self.template = make(min(num_envs, _TEMPLATE), threads=1, seed=0)
        self.sight, self.single_action_space = self.template.sight, self.template.single_action_space
        self.restarted: Callable[[slice], None] = lambda rows: None

    def batches(self, actor: Any, horizon: int, device: torch.device, seed: int) -> Batches:
        """Batches (num_envs, horizon) of steps that the actor takes, on a device, without end.

        Args:
          actor: TorchRL's; it may go on learning here meanwhile.
          horizon: control steps.
          device: of the batches.
          seed: of all draws; the batches depend on the number of workers too.

        Raises:
          InputError: no such cluster, or it is too small.
          MissingExtra: Ray is not installed.
          NfcError: workers died again and again.
        """
        cluster = self.cluster
        with connected(cluster.address, cluster.workers * cluster.cores) as ray:
            count = workers_of(int(ray.cluster_resources().get("CPU", 1)), cluster, self.num_envs)
            try:
                workers = _Workers(ray, self, actor, count, horizon, seed)
                try:
                    while True:
                        yield workers.batch().to(device)
                finally:
                    workers.collector.shutdown()
            except ray.exceptions.RayError as e:
                raise NfcError(
                    f"the cluster failed ({type(e).__name__}: {str(e).splitlines()[0]}); what was learned before it "
                    "stays: the same command goes on"
                ) from None

    def close(self) -> None:
        """End the simulations that are in this process; those of the workers end with `batches`."""
        self.template.close()


def spread(make: Make, n: int, threads: int, seed: int, cluster: Cluster | None) -> VectorSight | RayWorlds:
    """n simulations that `make` makes, in this process on some threads, or on a cluster."""
    return make(n, threads=threads, seed=seed) if cluster is None else RayWorlds(make, n, cluster)


def portable(belief: Any) -> Any:
    """A belief as it can be sent to a machine without a GPU."""
    return copy.deepcopy(belief).to("cpu") if callable(getattr(belief, "to", None)) else belief


def workers_of(cores: int, cluster: Cluster, simulations: int) -> int:
    """How many workers a cluster of so many cores is to have.

    Raises:
      InputError: it has not as many cores as are asked for.
    """
    most = cores // cluster.cores
    if max(1, cluster.workers) > most:
        raise InputError(
            f"--workers {max(1, cluster.workers)} of {cluster.cores} cores each (--threads): the cluster has {cores}; "
            f"want at most {most} of them"
        )
    return cluster.workers or max(k for k in range(1, most + 1) if simulations % k == 0)


def gathered(worlds: "VectorSight | RayWorlds", actor: Any, horizon: int, device: torch.device, seed: int) -> Batches:
    """Batches (n, horizon) of steps that an actor takes in n simulations, here or on a cluster, without end.

    Arguments and errors as of `RayWorlds.batches`.
    """
    if isinstance(worlds, RayWorlds):
        return worlds.batches(actor, horizon, device, seed)
    env = torchrl_env(worlds)
    env.set_seed(seed % 2**31)
    return batches(env, actor, horizon, device)


class _Workers:
    """TorchRL's Ray collector, whose workers are asked one by one, so that one that dies takes no other's part along.

    Args:
      ray: the module, connected.
      worlds, actor, horizon, seed: as of `RayWorlds.batches`.
      count: workers.
    """

    def __init__(self, ray: Any, worlds: RayWorlds, actor: Any, count: int, horizon: int, seed: int) -> None:
        self.ray, self.worlds, self.actor, self.count, self.seed = ray, worlds, actor, count, seed
        self.share, self.made = worlds.num_envs // count, 0
        self.given = ray.put(worlds.make)
        self.sent = copy.deepcopy(actor).to("cpu")  # what workers begin with; a GPU here need not be one there
        self.resources = {"num_cpus": worlds.cluster.cores, "num_gpus": 0}
        makers = [self._maker() for _ in range(count)]
        self.collector: Any = Collector(
            makers, self.sent, backend="ray", sync=True, num_collectors=count,
            frames_per_batch=worlds.num_envs * horizon, total_frames=-1, trust_policy=True,
            policy_device="cpu", storing_device="cpu", env_device="cpu",
            backend_options={
                # Weights go by the object store, with each batch: a process group would lose all when one worker dies.
                "weight_sync_schemes": {}, "remote_configs": self.resources,
                "collector_kwargs": [
                    {"track_traj_ids": False, "auto_register_policy_transforms": False} for _ in makers
                ],
            },
        )  # fmt: skip

    def _maker(self) -> Callable[[], GymWrapper]:
        """Of the next worker's simulations; each has seeds of its own."""
        self.made += 1
        return partial(_made, self.given, self.share, self.resources["num_cpus"], mixed(self.seed, self.made) % 2**31)

    def batch(self) -> Any:
        """(num_envs, horizon) steps by the actor as it is now."""
        parts: dict[int, TensorDictBase] = {}
        for _ in range(ATTEMPTS):
            parts |= self._asked([i for i in range(self.count) if i not in parts])
            if len(parts) == self.count:
                return torch.cat([parts[i] for i in range(self.count)])
        raise NfcError(
            f"the cluster's workers died {ATTEMPTS} times over one batch, perhaps for want of memory; what was learned "
            "before it stays: the same command goes on, and fewer --workers or --envs need less"
        )

    def _asked(self, of: Sequence[int]) -> dict[int, TensorDictBase]:
        """The parts of some workers; those that died are replaced, and their parts left out."""
        weights = self.ray.put(TensorDict.from_module(self.actor).data.to("cpu"))
        workers = self.collector.remote_collectors
        asked = [(i, workers[i].update_policy_weights_.remote(weights), workers[i].next.remote()) for i in of]
        found = {}
        for i, told, part in asked:
            try:
                self.ray.get(told)
                found[i] = self.ray.get(part)
            except self.ray.exceptions.RayTaskError as e:
                raise e.cause if isinstance(e.cause, NfcError) else NfcError(f"a worker failed: {e.cause!r}") from None
            except self.ray.exceptions.RayError:  # its process or its machine died, or what it gathered is lost
                self._replace(i)
        return found

    def _replace(self, i: int) -> None:
        """A new worker in the place of one that died.

        Raises:
          NfcError: the cluster has no room for it.
        """
        collector = self.collector
        collector.add_collectors([self._maker()], 1, self.sent, [collector.collector_kwargs[i]], [self.resources])
        collector.remote_collectors[i] = new = collector.remote_collectors.pop()
        ready, _ = self.ray.wait([new.__ray_ready__.remote()], timeout=PATIENCE)
        if not ready:
            raise NfcError(
                f"a worker died, and within {PATIENCE:.0f} s the cluster had no room for another; what was learned "
                "stays: the same command goes on, with fewer --workers too"
            )
        self.worlds.restarted(slice(i * self.share, (i + 1) * self.share))


def _made(given: Any, n: int, threads: int, seed: int) -> GymWrapper:
    """In a worker: its simulations."""
    from ray import get  # pyright: ignore[reportMissingImports]

    torch.manual_seed(seed)  # of the actions
    env = torchrl_env(get(given)(n, threads=threads, seed=seed))
    env.set_seed(seed)
    return env
