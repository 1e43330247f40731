"""Whoever makes the shards makes the same; what is finished stays."""

import hashlib
import io
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from nfc_gym.core import Fidelity, InputError, NfcError
from nfc_gym.inference.windows import Windows, WindowWriter
from nfc_gym.simulate import simulate
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.run import _named, _say, manifest_of

JACKAL = "nfc_gym/JackalFlat-v0"
SET = {"environment": JACKAL, "windows": 22, "per_shard": 4, "seed": 3}
ROOT = Path(__file__).parents[2]


def digests(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.glob("shard_*"))}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The shards that one process makes without interruption."""
    folder = tmp_path_factory.mktemp("whole")
    assert len(simulate(**SET, out=folder, jobs=1)) == 22
    return digests(folder)


def killed_after_a_shard(folder: Path, kill) -> threading.Thread:
    """Runs `kill` once the first shard is there."""

    def watch() -> None:
        until = time.monotonic() + 60
        while time.monotonic() < until and not any(folder.glob("shard_*")):
            time.sleep(0.01)
        kill()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


def test_a_killed_run_goes_on_and_ends_the_same(tmp_path: Path, whole: dict[str, str]) -> None:
    call = f"from nfc_gym.simulate import simulate; simulate(**{SET!r}, out={str(tmp_path)!r}, jobs=1)"
    process = subprocess.Popen([sys.executable, "-c", call], cwd=ROOT)
    killed_after_a_shard(tmp_path, process.kill).join()
    assert process.wait() == -signal.SIGKILL
    there = digests(tmp_path)
    assert 1 <= len(there) < 6
    at = {name: (tmp_path / name).stat().st_mtime_ns for name in there}
    found = simulate(**SET, out=tmp_path, jobs=1)
    assert digests(tmp_path) == whole
    assert found.manifest.complete
    assert all((tmp_path / name).stat().st_mtime_ns == t for name, t in at.items())


@pytest.mark.skipif(not Path("/proc").exists(), reason="children are looked up in /proc")
def test_no_worker_outlives_a_killed_caller(tmp_path: Path) -> None:
    call = f"""if __name__ == '__main__':
    from nfc_gym.simulate import simulate
    simulate(**{SET | {"windows": 400}!r}, out={str(tmp_path / "set")!r}, jobs=2)"""
    (tmp_path / "run.py").write_text(call)
    (tmp_path / "set").mkdir()
    path = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, str(tmp_path / "run.py")], env=path)
    killed_after_a_shard(tmp_path / "set", lambda: None).join()
    listed = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    workers = [p for p in listed if b"spawn_main" in Path(f"/proc/{p}/cmdline").read_bytes()]
    assert len(workers) == 2
    process.kill()
    process.wait()
    until = time.monotonic() + 20
    while time.monotonic() < until and any(alive(p) for p in workers):
        time.sleep(0.05)
    assert not any(alive(p) for p in workers)


def alive(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_processes_make_the_same_and_a_dead_one_is_said_so(tmp_path: Path, whole: dict[str, str]) -> None:
    def kill() -> None:
        for child in multiprocessing.active_children()[:1]:
            os.kill(child.pid, signal.SIGKILL)

    killed_after_a_shard(tmp_path, kill)
    with pytest.raises(NfcError, match=r"a worker process died.*finished shards stay"):
        simulate(**SET, out=tmp_path, jobs=2)
    there = digests(tmp_path)
    assert there.items() <= whole.items()
    assert there
    simulate(**SET, out=tmp_path, jobs=2)
    assert digests(tmp_path) == whole


def test_two_ray_workers_make_the_same_though_one_is_killed(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray")
    mark, driver = tmp_path / "killed", os.getpid()
    real = SET | {"windows": 12}

    def murderous(observation: np.ndarray) -> np.ndarray:
        """Full speed ahead; the first worker to ask is killed."""
        if os.getpid() != driver:
            try:
                mark.touch(exist_ok=False)
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        return np.ones((len(observation), 2))

    assert not ray.is_initialized()
    simulate(**real, out=tmp_path / "ray", policy=murderous, policy_share=1.0, ray="local", jobs=2)
    assert mark.exists()
    simulate(**real, out=tmp_path / "here", policy=murderous, policy_share=1.0, jobs=1)
    assert digests(tmp_path / "ray") == digests(tmp_path / "here")


def test_a_proposal_takes_the_priors_place(tmp_path: Path) -> None:
    space = Machine(JACKAL).space
    narrow = space.low + (0.4 + 0.2 * np.random.default_rng(0).random((500, len(space)))) * (space.high - space.low)
    Fidelity(psi=narrow).save(tmp_path / "proposal.npz")
    found = simulate(JACKAL, 8, tmp_path / "set", per_shard=4, jobs=1, proposal=tmp_path / "proposal.npz")
    u = found[:]["psi"]
    assert (u >= 0.399).all()
    assert (u <= 0.601).all()
    assert len(np.unique(u[:, 0])) == 8
    same = simulate(JACKAL, 8, tmp_path / "again", per_shard=4, jobs=1, proposal=Fidelity(psi=narrow))
    np.testing.assert_array_equal(same[:]["states"], found[:]["states"])
    with pytest.raises(InputError, match=r"made otherwise \(.*proposal"):
        simulate(JACKAL, 8, tmp_path / "set", per_shard=4, jobs=1)
    with pytest.raises(InputError, match=r"base_mass is .* outside the prior's"):
        simulate(JACKAL, 4, tmp_path / "out", jobs=1, proposal=Fidelity(psi=2 * space.high))
    with pytest.raises(InputError, match=r"has psi of shape .*; want \(16, 17\)"):
        simulate(JACKAL, 4, tmp_path / "out", jobs=1, proposal=Fidelity(psi=np.ones(3)))


def test_what_was_drawn_anew_is_said_by_what_says_psi(tmp_path: Path) -> None:
    """Proposed psi stay in windows whose labels are drawn anew: the effects alone are others."""
    writer = WindowWriter(tmp_path / "set", manifest_of(JACKAL, 1, 0, 1, {"proposal": None}))
    for proposal, said in ((None, "psi and effects drawn anew for 3"), ("a1", "; effects drawn anew for 3")):
        counts = {"windows": 1, "unstable": 0, "ended": 15, "relabelled": 3}
        writer.manifest = replace(writer.manifest, settings={"proposal": proposal}, finished={0: counts})
        console = Console(record=True, width=200, file=io.StringIO())
        _say(writer, console, 1, 1.0)
        assert said in console.export_text()


def test_callables_of_one_name_are_told_by_what_they_answer(tmp_path: Path) -> None:
    def act(speed: float, observation: np.ndarray) -> np.ndarray:
        return np.full((len(observation), 2), speed)

    given: dict[str, Any] = {"windows": 2, "out": tmp_path, "jobs": 1, "effects": 0.0, "policy_share": 1.0}
    simulate(JACKAL, **given, policy=partial(act, 1.0))
    assert len(simulate(JACKAL, **given, policy=partial(act, 1.0))) == 2
    with pytest.raises(InputError, match=r"made otherwise \(policy 'partial \w+', now 'partial \w+'\)"):
        simulate(JACKAL, **given, policy=partial(act, -1.0))


class Wandering:
    """Answers otherwise each time."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        return self.rng.uniform(-1, 1, (len(observation), 2))


def test_a_callable_with_a_memory_is_told_by_its_name_and_not_disturbed() -> None:
    policy, machine = Wandering(), Machine(JACKAL)
    assert _named(policy, machine) == "Wandering"
    assert policy.rng.random() == np.random.default_rng(0).random()


def test_policies_from_files_move_their_share(tmp_path: Path) -> None:
    """Weights 0 and a bias: full speed ahead, whatever is seen."""
    size = 15 + 2
    np.savez(tmp_path / "ahead.npz", weight_0=np.zeros((2, size)), bias_0=[5.0, 0.0])
    found = simulate(JACKAL, 4, tmp_path / "set", jobs=1, policy=tmp_path / "ahead.npz", policy_share=1.0, effects=0)
    assert (found[:]["actions"][..., 0] == 1).all()
    torch = pytest.importorskip("torch")
    net = torch.nn.Linear(size, 2)
    torch.nn.init.zeros_(net.weight)
    net.bias.data = torch.tensor([5.0, 0.0])
    torch.jit.script(net).save(str(tmp_path / "ahead.pt"))
    same = simulate(JACKAL, 4, tmp_path / "torch", jobs=1, policy=tmp_path / "ahead.pt", policy_share=1.0, effects=0)
    np.testing.assert_array_equal(same[:]["states"], found[:]["states"])
    (tmp_path / "bad.pt").write_bytes(b"no script")
    np.savez(tmp_path / "narrow.npz", weight_0=np.zeros((2, 3)), bias_0=np.zeros(2))
    for file, why in (
        ("bad.pt", "no TorchScript"),
        ("narrow.npz", "fails on observations"),
        ("none.pt", "no such file"),
    ):
        with pytest.raises(InputError, match=why):
            simulate(JACKAL, 4, tmp_path / "bad", jobs=1, policy=tmp_path / file)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"environment": "nfc_gym/Jackal-v0"}, "no environment .*JackalFlat-v0"),
        ({"windows": 0}, "windows is 0"),
        ({"effects": 1.5}, "effects is 1.5"),
        ({"motor": float("nan")}, "motor is nan"),
        ({"seed": -1}, "seed is -1"),
        ({"policy": 42}, "policy: want a file, or a callable of observations, got int"),
        ({"proposal": 42}, r"proposal: want a file, or something with sample\(n, rng\), got int"),
    ],
)
def test_bad_input_is_said_so(tmp_path: Path, wrong: dict, why: str) -> None:
    with pytest.raises(InputError, match=why):
        simulate(**(SET | {"out": tmp_path} | wrong))
    assert not any(tmp_path.iterdir())


def test_the_command_says_what_it_made(tmp_path: Path) -> None:
    call = [sys.executable, "-c", "from nfc_gym.cli import main; main()", "simulate", JACKAL, "--out", str(tmp_path)]
    done = subprocess.run([*call, "--windows", "6", "--jobs", "1"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "6 windows in" in done.stdout
    assert "redrawn" in done.stdout
    assert len(Windows(tmp_path, robot="jackal")) == 6
    bad = subprocess.run([*call, "--windows", "7", "--jobs", "1"], capture_output=True, text=True, cwd=ROOT)
    assert bad.returncode == 2
    assert "windows 6, now 7" in bad.stderr
