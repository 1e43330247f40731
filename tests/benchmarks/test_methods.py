"""Methods of Tables II and III: what each may use, and that what is missing is said."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="methods learn with torch")
pytest.importorskip("torchrl", reason="methods learn by TorchRL")


def untrained(tmp_path: Path, place: str = "JackalFlat") -> str:
    """A policy's file with weights as they are drawn."""
    from worlds.world import World

    from nfc_gym.adaptation.network import ActorCritic, Sizes
    from nfc_gym.adaptation.policy import Policy
    from nfc_gym.adaptation.sight import Sight

    env = World(place, "nominal", 0).make(1, context=["psi"])
    torch.manual_seed(0)
    sight = Sight.of(env)
    sizes = Sizes(sight.size, len(env.unwrapped.psi_space), env.unwrapped.robot.action_size, (16,))
    path = tmp_path / f"{place}.safetensors"
    Policy(sight, ActorCritic(sizes)).save(path)
    return str(path)


def job(tmp_path: Path, **change: Any) -> Any:
    from worlds.learning import Budget
    from worlds.methods import Job
    from worlds.world import World

    budget = Budget(envs=4, steps=800, seconds=60.0, executed=1, judged=2, points=1, threads=1, home=40)
    given = {"world": World("JackalFlat", "axle", 0), "seed": 0, "nominal": untrained(tmp_path), "posterior": None,
             "detector": None, "budget": budget, "task": None, "folder": tmp_path / "states"}  # fmt: skip
    return Job(**{**given, **change})


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> int:
    """Control steps of an episode: fewer than elsewhere."""
    from worlds import learning
    from worlds.world import World

    monkeypatch.setitem(World.make.__kwdefaults__, "max_episode_steps", 200)
    monkeypatch.setattr(learning, "EPISODE", 200)
    return 200


def test_a_curve_has_levelled_where_its_last_quarter_hardly_rises() -> None:
    from worlds.learning import levelled

    steps = np.arange(0, 101, 5)
    assert levelled([(int(s), float(1 - np.exp(-s / 10))) for s in steps])
    assert not levelled([(int(s), float(s)) for s in steps])
    assert not levelled([(0, 0.0), (100, 1.0)])


def test_what_is_missing_is_said_and_not_counted(tmp_path: Path) -> None:
    from worlds.methods import run
    from worlds.world import World

    plain = job(tmp_path)
    assert "--world-models DIR with JackalFlat" in run("tdmpc2", plain, 2)["missing"]
    assert "Jackal" in run("falco", job(tmp_path, world=World("AntFlat", "psi", 0)), 2)["missing"]


def test_without_nfc_no_more_is_learned_from_than_was_executed(tmp_path: Path, short: int) -> None:
    from worlds.methods import METHODS

    found = METHODS["no_nfc"].make(job(tmp_path))
    assert found.notes["steps"] == short  # one episode's
    assert [s for s, _ in found.curve] == [0, short]


def test_an_oracle_learns_in_the_true_world_and_the_nominal_policy_is_left_alone(tmp_path: Path, short: int) -> None:
    from worlds.methods import METHODS, run

    plain = job(tmp_path)
    before = Path(plain.nominal).read_bytes()
    found = METHODS["oracle"].make(plain)
    assert found.notes["steps"] >= 800
    assert len(found.curve) == 2
    assert "levelled" in found.notes
    assert Path(plain.nominal).read_bytes() == before
    cell = run("unadapted", plain, 2)
    assert len(cell["episodes"]["returns"]) == 2
    assert cell["hidden"] == "front_left_wheel_damping 0"
    assert cell["hertz"] > 50  # a small network decides faster than the robot is controlled


def test_a_watcher_of_the_motion_at_home_sees_another_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from worlds.learning import opened
    from worlds.players import seen_by
    from worlds.watching import EVERY, HORIZON, watcher, windows
    from worlds.world import World

    policy = opened(untrained(tmp_path), "cpu")
    home = World("JackalFlat", "nominal", 0)
    detector = watcher(policy, home, 0, 300)
    robots = windows(policy, seen_by(policy, home, 40, max_episode_steps=300), 15, 99, 300)
    assert robots[0][0].shape[1:] == (HORIZON + 1, 15)
    score, limit = detector.windows.scorer.score, detector.threshold
    assert limit is not None
    quiet = [detector.lasting(score(*each)).max() for each in robots]
    assert np.mean(np.array(quiet) >= limit) < 0.25
    rng, turning = np.random.default_rng(0), np.where(np.arange(15) == 9, 0.5, 0.0)
    loud = [detector.lasting(score(s + turning * rng.standard_normal(s.shape), a)).max() for s, a in robots]
    assert np.mean(np.array(loud) >= limit) > 0.9
    # Transition by transition it says the same as all at once; before the first window nothing.
    states, actions = (part[::2] for part in robots[0])  # windows that touch
    detector.reset()
    said = [detector.update(states[0][k], actions[0][k], states[0][k + 1]) for k in range(HORIZON)]
    assert said[:-1] == [0.0] * (HORIZON - 1)
    assert said[-1] == pytest.approx(detector.lasting(score(states[:1], actions[:1]))[0])
    assert EVERY * 2 == HORIZON


def test_robots_that_crash_at_once_leave_a_watcher_enough_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from worlds import watching
    from worlds.learning import opened
    from worlds.world import World

    seeds: list[int] = []

    def crashing(policy: Any, env: Any, size: int, seed: int, steps: int) -> list[Any]:
        env.close()
        seeds.append(seed)
        rng = np.random.default_rng(seed)
        length = watching.HORIZON
        return [(rng.normal(size=(2, length + 1, size)), rng.normal(size=(2, length, 2))) for _ in range(100)]

    monkeypatch.setattr(watching, "windows", crashing)
    policy, home = opened(untrained(tmp_path), "cpu"), World("JackalFlat", "nominal", 0)
    assert watching.watcher(policy, home, 7).threshold is not None
    assert seeds == [7, 7 + watching.ROBOTS]


def test_algorithm_one_runs_in_a_hidden_world(tmp_path: Path, short: int) -> None:
    from worlds.machines import ROBOTS, nominal_space
    from worlds.methods import run

    class Alarm:
        threshold = 1.0

        def reset(self, rows: Any = None) -> None:
            """Nothing is kept."""

        def update(self, obs: Any, action: Any, next_obs: Any) -> float:
            return 2.0

    space = nominal_space(ROBOTS["jackal"])
    prior = tmp_path / "JackalFlat.npz"
    np.savez(prior, psi=np.random.default_rng(0).uniform(space.low, space.high, (64, len(space))))
    cell = run("nfc", job(tmp_path, posterior=str(prior), detector=Alarm()), 2)
    assert len(cell["curve"]) == 1  # of the one mission
    assert cell["notes"]["anomalies"] == 1
    assert (tmp_path / "states").is_dir()


def test_the_measured_loop_explains_what_was_executed_and_ppo_learns_in_that(
    tmp_path: Path, short: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    import json
    from dataclasses import replace

    from worlds import looped
    from worlds.methods import METHODS, run
    from worlds.world import World

    from nfc_gym.measured.dataset import load

    asked: list[int] = []

    def loop(mapping: Path, out: Path, **_: Any) -> dict[str, Any]:
        """Finds in no time that the rover is heavier."""
        asked.append(len(load(mapping).logs))
        mass = {"name": "base_mass", "unit": "kg", "field": "body_mass", "of": ["base"], "estimate": 20.0}
        report = {"verdict": "explained", "effects": [], "chi2": {}, "seconds": 0.0,
                  "parameters": [mass | {"low": 19.0, "high": 21.0}]}  # fmt: skip
        out.mkdir()
        (out / "report.json").write_text(json.dumps(report))
        return report

    monkeypatch.setattr(looped, "close_loop", loop)
    monkeypatch.setattr(looped, "EPISODE", short)
    given = job(tmp_path)
    given = replace(given, budget=replace(given.budget, executed=3))
    found = METHODS["measured_loop"].make(given)
    assert asked == [3]
    assert found.notes["verdict"] == "explained"
    assert len(found.notes["executed"]) == 3
    assert (given.folder / "adapted" / "policy.safetensors").is_file()
    METHODS["measured_loop"].make(given)  # the same once more: the report is read, the learning is over
    assert asked == [3]
    assert "rough ground" in run("measured_loop", replace(given, world=World("JackalRough", "axle", 0)), 2)["missing"]


def test_a_table_takes_its_references_from_an_earlier_run(tmp_path: Path) -> None:
    import json

    import policies
    from worlds import tables

    (tmp_path / "cells").mkdir()
    for method in ("random", "oracle", "nfc"):
        file = tmp_path / "cells" / f"II_JackalFlat_axle_5_{method}_0.json"
        file.write_text(json.dumps({"curve": [[0, 1.0]]}))
    said = ["--tables", "II", "--places", "JackalFlat", "--scenario", "axle", "--seed", "5", "--seeds", "0"]
    args = policies.parse([*said, "--beside", str(tmp_path)])
    cells = tables.Cells()
    policies.references(args, cells)
    found = {method: {"curve": [[0, 1.0]]} for method in ("random", "oracle")}
    assert cells.found == {("II", "JackalFlat", "axle", 5, 0): found}


def test_a_table_shows_cells_of_other_runs_in_the_same_world_alone(tmp_path: Path) -> None:
    import json

    import policies
    from worlds import tables

    from nfc_gym.core.errors import InputError

    (tmp_path / "cells").mkdir()
    for method, hidden in (("tdmpc2", "a load"), ("nfc", "another load")):
        file = tmp_path / "cells" / f"III_JackalFlat_axle_5_{method}_0.json"
        file.write_text(json.dumps({"hidden": hidden}))
    said = ["--tables", "III", "--grounds", "Flat", "--scenarios", "axle", "--seed", "5", "--seeds", "0"]
    args = policies.parse([*said, "--also", str(tmp_path)])
    cells, key = tables.Cells(), ("III", "JackalFlat", "axle", 5, 0)
    cells.add(key, "nfc", {"hidden": "a load"})  # is there, so the other run's is not taken
    policies.joined(args, tmp_path, cells)
    assert cells.found == {key: {"nfc": {"hidden": "a load"}, "tdmpc2": {"hidden": "a load"}}}
    cells = tables.Cells()
    cells.add(key, "oracle", {"hidden": "a load"})
    with pytest.raises(InputError, match="another world"):
        policies.joined(args, tmp_path, cells)
    with pytest.raises(InputError, match="no cells there"):
        policies.joined(args, tmp_path / "cells", cells)


def test_what_is_found_to_count_must_do_so_with_other_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    import hidden_worlds
    from worlds.counting import Drop
    from worlds.figures import Interval
    from worlds.judge import Episodes

    drops = iter([0.5, 0.1, 0.2, 0.6, 0.4])
    seeds = []

    def measure(policy: str, world: Any, episodes: int, seed: int, **_: Any) -> Drop:
        seeds.append(seed)
        some = Interval(1.0, 0.0, 2.0)
        played = Episodes([1.0], [1.0], [0.0], [1.0], [0.0], [0.0], [1])
        return Drop(world, some, some, some, next(drops), played)

    monkeypatch.setattr(hidden_worlds, "measure", measure)
    args = hidden_worlds.parse(["--find", "1", "--seed", "3", "--draws", "5"])
    rows = list(hidden_worlds.worlds(args, None, "AntFlat", "psi+effect"))
    assert [row["counts"] for row in rows] == [False, False, True]
    assert [row.get("again") for row in rows] == [0.1, None, 0.4]
    assert seeds == [3, 1_000_003, 3, 3, 1_000_003]
