"""Batches from a Ray cluster: the present weights, every part once, and a dead worker that is replaced."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from nfc_gym import InputError
from nfc_gym.adaptation import AdaptConfig, adapt, load_policy, ppo_agent, pretrain
from nfc_gym.adaptation.gathering import Cluster, RayWorlds, cluster_of, portable, workers_of
from nfc_gym.adaptation.record import Episodes
from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.adaptation.worlds import training_env, vector_env
from nfc_gym.cli import app
from nfc_gym.core import MissingExtra, NfcError
from nfc_gym.core.fidelity import Fidelity

HERE = Cluster("local", 2)
CPU = torch.device("cpu")
JACKAL = "nfc_gym/JackalFlat-v0"


@pytest.fixture(scope="module")
def ray() -> Iterator[Any]:
    """Two workers' worth of Ray on this machine, for all tests."""
    pytest.importorskip("ray", reason="needs Ray: pip install 'nfc_gym[ray]'")
    from nfc_gym.simulate.cluster import connected

    with connected("local", 2) as module:
        yield module


def make(n: int, threads: int, seed: int) -> VectorSight:
    return training_env(JACKAL, n, threads=threads, seed=seed, spread=0.5, episode=400, settings={})


def collectors() -> list[int]:
    """Processes of TorchRL's collectors."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if (entry / "cmdline").read_bytes().startswith(b"ray::Collector"):
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def ended() -> bool:
    """Whether no collector is left; Ray ends them in the background."""
    until = time.monotonic() + 30
    while time.monotonic() < until and collectors():
        time.sleep(0.05)
    return not collectors()


def test_workers_act_by_the_present_weights_and_each_in_its_own_way(ray: Any, jackal: Path) -> None:
    actor = load_policy(jackal).actor
    worlds = RayWorlds(partial(training_env, JACKAL, spread=0.5, episode=400, settings={}), 8, HERE)
    with closing(worlds.batches(actor, 6, CPU, 0)) as batches:
        first = next(batches)
        with torch.no_grad():
            for weight in actor.parameters():
                weight.mul_(0.5)
        second = next(batches)
    assert first.shape == (8, 6)
    assert second["next", "done"].shape == (8, 6, 1)
    assert not torch.equal(first["action"][:4], first["action"][4:]), "of one worker and of the other"
    with torch.no_grad():
        torch.testing.assert_close(actor(second.clone())["loc"], second["loc"])
        assert (actor(first.clone())["loc"] - first["loc"]).abs().max() > 1e-4, "the weights have changed since"
    torch.testing.assert_close(second["observation"][:, 0], first["next", "observation"][:, -1])
    assert ended(), "the workers end with the batches"


def test_a_dead_worker_is_replaced_and_takes_no_others_part_along(ray: Any, jackal: Path, tmp_path: Path) -> None:
    driver, path = os.getpid(), str(tmp_path)

    def mortal(n: int, threads: int, seed: int) -> Any:
        """Simulations whose steps are counted in a file of each process; the first to take 10 is killed by them."""
        import os
        import signal
        from pathlib import Path

        from nfc_gym.adaptation.sight import VectorSight
        from nfc_gym.adaptation.worlds import vector_env

        class Counted(VectorSight):
            def step(self, actions):
                if os.getpid() != driver:
                    with open(f"{path}/{os.getpid()}", "a") as file:
                        file.write(".")
                    if os.path.getsize(f"{path}/{os.getpid()}") == 10:
                        try:
                            Path(f"{path}/killed").touch(exist_ok=False)
                        except FileExistsError:
                            pass
                        else:
                            os.kill(os.getpid(), signal.SIGKILL)
                return super().step(actions)

        return Counted(vector_env("JackalFlat", n, threads=threads, episode=400))

    worlds, restarted = RayWorlds(mortal, 4, HERE), []
    worlds.restarted = restarted.append
    with closing(worlds.batches(load_policy(jackal).actor, 8, CPU, 0)) as batches:
        found = [next(batches) for _ in range(3)]
    assert (tmp_path / "killed").exists()
    assert restarted in ([slice(0, 2)], [slice(2, 4)])
    whole = slice(0, 2) if restarted == [slice(2, 4)] else slice(2, 4)
    assert all(b.shape == (4, 8) for b in found)
    for before, after in pairwise(found):
        torch.testing.assert_close(after["observation"][whole, 0], before["next", "observation"][whole, -1])
    steps = sorted(p.stat().st_size for p in tmp_path.iterdir() if p.name != "killed")
    assert steps == [10, 16, 24], "the one that died, the one in its place, and the one that nothing happened to"


def test_workers_that_die_again_and_again_end_the_run(ray: Any, jackal: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nfc_gym.adaptation.gathering.ATTEMPTS", 2)
    driver = os.getpid()

    def doomed(n: int, threads: int, seed: int) -> Any:
        import os

        from nfc_gym.adaptation.sight import VectorSight
        from nfc_gym.adaptation.worlds import vector_env

        class Doomed(VectorSight):
            def step(self, actions):
                if os.getpid() != driver:
                    os._exit(1)
                return super().step(actions)

        return Doomed(vector_env("JackalFlat", n, threads=threads, episode=400))

    worlds = RayWorlds(doomed, 2, Cluster("local", 1))
    batches = worlds.batches(load_policy(jackal).actor, 4, CPU, 0)
    with pytest.raises(NfcError, match=r"died 2 times over one batch.*the same command goes on"):
        next(batches)


def test_pretraining_goes_on_though_a_worker_is_killed(
    ray: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nfc_gym.adaptation.pretraining.EPISODES", 2)
    path, curve = tmp_path / "p.safetensors", tmp_path / "p.safetensors.log" / "csv" / "scalars" / "loss.csv"
    killed = []
    assert ended(), "of the tests before"

    def kill() -> None:
        until = time.monotonic() + 120
        while time.monotonic() < until and not curve.is_file():
            time.sleep(0.01)
        killed.extend(collectors()[:1])
        os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    each = {"seed": 1, "envs": 32, "horizon": 16, "device": "cpu"}
    policy = pretrain("JackalFlat", path, steps=60 * 512, ray="local", workers=2, **each)
    killer.join()
    assert killed
    assert policy.about["steps"] == 60 * 512
    steps = [int(row.split(",")[0]) for row in curve.read_text().split()]
    assert steps == [512 * (k + 1) for k in range(60)], "every batch once"
    again = pretrain("JackalFlat", path, steps=62 * 512, threads=1, **each)
    assert again.about["steps"] == 62 * 512, "and goes on without a cluster"


def test_adaptation_gathers_there_too(ray: Any, jackal: Path) -> None:
    import gymnasium as gym

    from nfc_gym.wrappers import RandomizePsi

    policy, space = load_policy(jackal), gym.make(JACKAL).unwrapped.psi_space
    world = RandomizePsi(gym.make(JACKAL, context=["psi"], max_episode_steps=30), {"base_mass": (30.0, 30.0)})
    before = {k: v.clone() for k, v in policy.network.gaussian.state_dict().items()}
    belief = Fidelity(np.tile(space.nominal, (64, 1)) + 0.01 * np.random.default_rng(0).random((64, len(space))))

    class Alarm:
        threshold = 1.0

        def reset(self, rows: Any = None) -> None: ...

        def update(self, obs: Any, action: Any, next_obs: Any) -> float:
            return 2.0

    config = AdaptConfig(missions=1, worlds=8, steps=512, episode=20)
    done = adapt(ppo_agent(policy), world, belief, Alarm(), config=config, ray="local", workers=2)
    assert done.anomalies == 1
    assert np.isfinite(done.history[0]["imagined_after"]), "episodes of the workers ended"
    assert any((v != before[k]).any() for k, v in policy.network.gaussian.state_dict().items())


def test_what_cannot_be_shared_is_said_at_once(tmp_path: Path, jackal: Path) -> None:
    path = tmp_path / "p.safetensors"
    with pytest.raises(InputError, match=r"--workers 2 is of a Ray cluster: give --ray"):
        pretrain("JackalFlat", path, steps=10, workers=2)
    with pytest.raises(InputError, match=r"--workers 3: 32 simulations cannot be shared equally"):
        pretrain("JackalFlat", path, steps=10, envs=32, ray="local", workers=3)
    with pytest.raises(InputError, match="--threads -1: want 0 or more"):
        Cluster("local", 1, -1)
    with pytest.raises(InputError, match="--ray is empty"):
        Cluster("")
    assert not any(tmp_path.iterdir())


def test_as_many_workers_as_the_cores_and_equal_shares_allow() -> None:
    assert workers_of(16, Cluster("auto"), 1024) == 16
    assert workers_of(12, Cluster("auto"), 1024) == 8
    assert workers_of(12, Cluster("auto", 0, 4), 1023) == 3
    assert workers_of(12, Cluster("auto", 6, 2), 1024) == 6
    with pytest.raises(InputError, match=r"--workers 7 of 2 cores each .*the cluster has 12; want at most 6"):
        workers_of(12, Cluster("auto", 7, 2), 1024)
    with pytest.raises(InputError, match="want at most 0"):
        workers_of(1, Cluster("auto", 0, 2), 1024)


def test_a_missing_ray_is_said_before_anything_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nfc_gym.simulate.cluster.find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"pip install 'nfc_gym\[ray\]'"):
        cluster_of("auto", 2, 0, 32)


def test_beliefs_leave_the_gpu_before_they_travel() -> None:
    class Moved:
        device = "cuda"

        def to(self, device: str) -> "Moved":
            self.device = device
            return self

    belief, plain = Moved(), Fidelity(np.zeros((2, 3)))
    assert portable(belief).device == "cpu"
    assert belief.device == "cuda"
    assert portable(plain) is plain


def test_episodes_that_begin_anew_are_not_counted_on() -> None:
    from tensordict import TensorDict

    episodes = Episodes()
    for last in (False, True):
        done = torch.full((2, 3, 1), last)
        after = TensorDict({"reward": torch.ones(2, 3, 1), "done": done}, [2, 3])
        if last:
            done[:, :2] = False
            episodes.forget(slice(1, 2))
        episodes.see(TensorDict({"next": after}, [2, 3]))
    assert episodes.count == 2
    assert episodes.means() == {"return": 4.5, "length": 4.5}, "six steps in one, three in the other"


def test_the_command_speaks_of_it() -> None:
    call = ["pretrain", "JackalFlat", "--steps", "10", "--out", "p.safetensors", "--workers", "2"]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 2
    assert "give --ray too" in done.output


def test_the_template_is_small() -> None:
    made: list[int] = []

    def counted(n: int, threads: int, seed: int) -> VectorSight:
        made.append(n)
        return VectorSight(vector_env("JackalFlat", n, threads=threads))

    worlds = RayWorlds(counted, 4096, Cluster("auto"))
    assert worlds.num_envs == 4096
    assert made == [64]
    worlds.close()
