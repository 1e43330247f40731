"""`nfc-gym adapt`: from an effects.yaml to a policy and a page, resumed after a kill, refused where it cannot be."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from gymnasium.vector import VectorEnv
from rich.console import Console
from safetensors.torch import load_file
from scipy import stats
from typer.testing import CliRunner

from nfc_gym.adaptation import FineTuneConfig, hand_over, load_policy
from nfc_gym.adaptation.evaluate import Score
from nfc_gym.adaptation.finetuning import FineTuning
from nfc_gym.adaptation.ppo import OnPolicy
from nfc_gym.adaptation.returns import figure, from_plain, gain, mean_interval, share_interval, to_plain
from nfc_gym.adaptation.worlds import vector_env
from nfc_gym.cli import app
from nfc_gym.core.errors import InputError
from nfc_gym.wrappers import VectorRandomizePsi

ROWS = [
    {"family": "loss", "where": "rear_left"}
    | {"parameters": {"fraction": {"value": 0.7, "low": 0.6, "high": 0.8, "unit": "1"}}},
    {"family": "sensor_bias", "where": "joint:rear_left_wheel:vel", "parameters": {"bias": 0.1}},
]  # fmt: skip
SMALL: dict[str, Any] = {"envs": 4, "episode": 40, "every": 1, "curve": 2}  # 128 steps an iteration
STEPS = 384


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Iterations of a quarter of the control steps."""
    monkeypatch.setattr("nfc_gym.adaptation.ppo._LONGEST", 32)


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """What close-loop is to have written."""
    folder = tmp_path / "result"
    folder.mkdir()
    (folder / "effects.yaml").write_text(yaml.safe_dump({"version": 1, "effects": ROWS}))
    return folder


def handed(result: Path, out: Path, policy: Path, *, steps: int = STEPS, **more: Any) -> dict[str, Any]:
    given = {"episodes": 3, "threads": 1, "device": "cpu", **more}
    return hand_over("JackalFlat", result, out, policy=policy, config=FineTuneConfig(steps=steps, **SMALL), **given)


def test_from_effects_to_a_policy_and_a_page(tmp_path: Path, result: Path, jackal: Path) -> None:
    out = tmp_path / "out"
    report = handed(result, out, jackal, ablate=True)
    assert report == json.loads((out / "report.json").read_text())
    assert report["measured_in"] == "extended"
    assert report["world"] is None
    for world in ("nominal", "extended"):
        row = report["returns"][world]
        assert row["gain"]["mean"] == pytest.approx(row["after"]["return"]["mean"] - row["before"]["return"]["mean"])
        assert row["before"]["return"]["low"] < row["before"]["return"]["mean"] < row["before"]["return"]["high"]
        assert {"success", "episodes", "length"} <= set(row["after"])
    loss, bias = report["effects"]
    assert loss["parameters"]["fraction"] == {"value": 0.7, "low": 0.6, "high": 0.8, "unit": "1"}
    after = loss["returns"]["after"]
    assert after["with"] == report["returns"]["extended"]["after"]
    # Without the one effect that acts the extended model is the nominal one.
    assert after["without"] == report["returns"]["nominal"]["after"]
    assert after["cost"]["mean"] == pytest.approx(after["without"]["return"]["mean"] - after["with"]["return"]["mean"])
    assert after["cost"]["mean"] != 0
    worth = loss["ablation"]["extended"]
    assert worth["worth"]["mean"] == pytest.approx(after["with"]["return"]["mean"] - worth["unaware"]["return"]["mean"])
    assert not bias["acts"]
    assert [p["steps"] for p in report["curve"]] == [0, 128, 256, 384]
    best = max(p["return"]["mean"] for p in report["curve"])
    assert report["curve"][report["kept"]]["return"]["mean"] == best
    adapted = load_policy(out / "policy.safetensors")
    assert adapted.about["adapted"]["returns"] == report["returns"]
    assert adapted.sight == load_policy(jackal).sight
    page = (out / "report.html").read_text()
    assert "Every figure is of the extended model, not of the machine." in page
    assert "loss:rear_left" in page
    assert "What it was worth to know each effect" in page
    assert '<svg class="chart"' in page


def test_a_killed_run_ends_with_the_same_bits(
    tmp_path: Path, result: Path, jackal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = handed(result, tmp_path / "whole", jackal)
    learn, calls = OnPolicy.learn, []

    def killed(self: OnPolicy, batch: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return learn(self, batch)

    with monkeypatch.context() as patch:
        patch.setattr(OnPolicy, "learn", killed)
        with pytest.raises(KeyboardInterrupt):
            handed(result, tmp_path / "cut", jackal)
    assert not (tmp_path / "cut" / "report.json").exists()
    cut = handed(result, tmp_path / "cut", jackal)
    assert cut["curve"] == whole["curve"]
    assert cut["returns"] == whole["returns"]
    a, b = (load_file(tmp_path / k / "training.safetensors") for k in ("whole", "cut"))
    assert all(torch.equal(v, b[k]) for k, v in a.items())
    first = load_file(jackal)
    assert any(not torch.equal(v, a[f"network/{k}"]) for k, v in first.items())


def test_a_true_world_is_judged_in_and_not_learned_from(tmp_path: Path, result: Path, jackal: Path) -> None:
    truth = tmp_path / "truth.yaml"
    row = {"family": "loss", "where": "front_left", "parameters": {"fraction": 0.9}}
    truth.write_text(yaml.safe_dump({"version": 1, "psi": {"base_mass": 20.0}, "effects": [row]}))
    out = tmp_path / "out"
    first = handed(result, out, jackal, steps=128)
    report = handed(result, out, jackal, steps=128, world=truth)
    assert report["measured_in"] == "world"
    assert report["world"] == str(truth)
    assert report["curve"] == first["curve"]
    assert report["returns"]["extended"] == first["returns"]["extended"]
    assert report["returns"]["world"]["after"] != report["returns"]["extended"]["after"]
    assert "not of the machine" not in (out / "report.html").read_text()
    # A function's world without a time limit is judged in over episodes of the same length.
    plain = handed(result, out, jackal, steps=128, world=lambda n: vector_env("JackalFlat", n, threads=1, episode=-1))
    assert plain["returns"]["world"] == plain["returns"]["nominal"]


def test_functions_of_one_name_are_worlds_of_their_own(tmp_path: Path, result: Path, jackal: Path) -> None:
    def world(**psi: tuple[float, float]) -> Callable[[int], VectorEnv]:
        return lambda n: VectorRandomizePsi(vector_env("JackalFlat", n, threads=1, episode=40), psi)

    stuck = {f"{w}_wheel_friction": (0.0, 0.0) for w in ("front_left", "front_right", "rear_left", "rear_right")}
    easy, hard = (handed(result, tmp_path / "out", jackal, steps=128, world=w) for w in (world(), world(**stuck)))
    fresh = handed(result, tmp_path / "fresh", jackal, steps=128, world=world(**stuck))
    assert hard["returns"]["world"] == fresh["returns"]["world"]
    assert hard["returns"]["world"] != easy["returns"]["world"]
    assert hard["curve"] == easy["curve"], "what was learned is kept"


def test_a_policy_goes_on_with_the_task_that_it_was_trained_to_do(
    tmp_path: Path, result: Path, jackal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks = set()

    def watched(*args: Any, **kwargs: Any) -> VectorEnv:
        envs: Any = vector_env(*args, **kwargs)
        tasks.add(envs.unwrapped.robot.task)
        return envs

    monkeypatch.setattr("nfc_gym.adaptation.handover.vector_env", watched)
    monkeypatch.setattr("nfc_gym.adaptation.extension.vector_env", watched)
    policy = load_policy(jackal)
    policy.about["training"]["task"] = "figure8"
    policy.save(tmp_path / "figure8.safetensors")
    given: dict[str, Any] = {"policy": tmp_path / "figure8.safetensors", "steps": 1, "episodes": 2}
    report = handed(result, tmp_path / "out", **given)
    assert tasks == {"figure8"}
    assert report["policy"]["task"] == "figure8"
    goal = lambda n: vector_env("JackalFlat", n, threads=1, episode=40)  # noqa: E731
    with pytest.raises(InputError, match="world: its task is 'goal', the policy's 'figure8'"):
        handed(result, tmp_path / "out", **given, world=goal)


def test_learning_that_comes_apart_keeps_the_best_weights(
    tmp_path: Path, result: Path, jackal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learn = OnPolicy.learn

    def broken(self: OnPolicy, batch: Any) -> Any:
        batch["next", "reward"][0, 0] = float("nan")
        return learn(self, batch)

    monkeypatch.setattr(OnPolicy, "learn", broken)
    report = handed(result, tmp_path / "out", jackal)
    assert "not finite" in report["diverged"]
    assert "Learning stopped early" in (tmp_path / "out" / "report.html").read_text()
    kept, given = load_file(tmp_path / "out" / "policy.safetensors"), load_file(jackal)
    assert all(torch.equal(v, given[k]) for k, v in kept.items())
    assert report["returns"]["extended"]["gain"]["mean"] == 0
    assert "the policy is unchanged" in (tmp_path / "out" / "report.html").read_text()


def test_folders_of_others_are_left_alone(tmp_path: Path, result: Path, jackal: Path) -> None:
    theirs = json.dumps({"effects": [], "parameters": []})
    for folder, report in ((result, theirs), *((tmp_path / "out", other) for other in ("5", "null", "["))):
        folder.mkdir(exist_ok=True)
        (folder / "report.json").write_text(report)
        with pytest.raises(InputError, match="holds the report of another command"):
            handed(result, folder, jackal)
        (folder / "report.json").unlink()
    handed(result, tmp_path / "out", jackal, steps=128)
    with pytest.raises(InputError, match=r"is of another run \(seed 0, now 1\)"):
        hand_over(
            "JackalFlat", result, tmp_path / "out", policy=jackal, threads=1,
            config=FineTuneConfig(steps=128, seed=1, **SMALL),
        )  # fmt: skip


def test_another_condition_or_signal_is_another_run(tmp_path: Path, jackal: Path) -> None:
    pushes = {f"push_{axis}@{day}": 40.0 * (day == "gale") for day in ("calm", "gale") for axis in "xyz"}
    wind = {"family": "wind", "where": "base", "conditions": ["calm", "gale"], "parameters": {"drag": 1.0, **pushes}}
    wheels = ["front_left", "front_right", "rear_left", "rear_right"]
    sag = {"family": "supply_sag", "where": wheels, "parameters": {"exponent": 1.0, "reference": 24.0}}
    file, out = tmp_path / "effects.yaml", tmp_path / "out"
    file.write_text(yaml.safe_dump({"version": 1, "effects": [wind, sag]}))
    given: dict[str, Any] = {"steps": 1, "condition": "calm", "signals": {"exo:supply": 20.0}}
    first, said = handed(file, out, jackal, **given), Console(record=True, width=200, file=open("/dev/null", "w"))  # noqa: SIM115
    assert handed(file, out, jackal, **given, console=said)["returns"] == first["returns"]
    assert "finished before, at step 128 of 1" in said.export_text()
    with pytest.raises(InputError, match=r"is of another run \(condition"):
        handed(file, out, jackal, **{**given, "condition": "gale"})
    with pytest.raises(InputError, match=r"is of another run \(exo:supply 20.0, now 12.0"):
        handed(file, out, jackal, **{**given, "signals": {"exo:supply": 12.0}})


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"environment": "AntFlat"}, "the policy is of JackalFlat-v0 and cannot act in AntFlat-v0"),
        ({"environment": "Jackal"}, "no environment 'Jackal'"),
        ({"policy": "none.safetensors"}, "no such file"),
        ({"signals": {"exo:foo": 3.0}}, "--signal exo:foo: no effect reads it"),
        ({"condition": "calm"}, "--condition calm: no effect differs between conditions"),
        ({"episodes": 1}, "episodes is 1, want a whole number, 2 or more"),
    ],
)
def test_bad_input_is_named(tmp_path: Path, jackal: Path, arguments: dict[str, Any], says: str) -> None:
    folder = tmp_path / "result"
    folder.mkdir()
    row = {"family": "drag_linear", "where": "base", "parameters": dict.fromkeys("xyz", 1.0)}
    row = row if arguments.get("environment") != "AntFlat" else {**row, "where": "torso"}
    (folder / "effects.yaml").write_text(yaml.safe_dump({"version": 1, "effects": [row]}))
    given = {"environment": "JackalFlat", "policy": jackal, "out": tmp_path / "out", **arguments}
    with pytest.raises(InputError, match=says):
        hand_over(effects=folder, **given)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 0), ("steps", None), ("envs", 0), ("envs", 1.5), ("envs", "a"), ("episode", 0), ("curve", 1),
        ("vary", -1.0), ("vary", 11.0), ("vary", "a"), ("vary", float("nan")),
    ],
)  # fmt: skip
def test_settings_are_checked(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"{name} is {value!r}[,;] want a (whole number|multiple of the intervals)"):
        FineTuneConfig(**{name: value})


def test_the_command_teaches_and_refuses(tmp_path: Path, result: Path) -> None:
    helped = CliRunner().invoke(app, ["adapt", "--help"], terminal_width=100)
    assert "Example: nfc-gym adapt JackalFlat --effects result --out adapted" in helped.output
    call = ["adapt", "JackalFlat", "--effects", str(result), "--out", str(tmp_path / "out")]
    wrong = CliRunner().invoke(app, [*call, "--signal", "exo:supply=much"])
    assert wrong.exit_code == 2
    assert "want NAME=VALUE with a finite number" in wrong.output
    (result / "effects.yaml").write_text(yaml.safe_dump({"version": 1, "effects": []}))
    nothing = CliRunner().invoke(app, call)
    assert nothing.exit_code == 2
    assert "there is nothing to adapt to" in nothing.output


def test_intervals_are_the_textbook_ones() -> None:
    x = np.random.default_rng(0).normal(3.0, 2.0, 20)
    found = mean_interval(x)
    low, high = stats.t.interval(0.95, 19, x.mean(), stats.sem(x))
    assert (found["low"], found["mean"], found["high"]) == pytest.approx((low, x.mean(), high))
    flags = np.arange(25) < 20
    wilson = stats.binomtest(20, 25).proportion_ci(method="wilson")
    found = share_interval(flags)
    assert (found["low"], found["mean"], found["high"]) == pytest.approx((wilson.low, 0.8, wilson.high))


def test_the_gain_is_of_the_same_episodes() -> None:
    """What episodes differ by from one another does not widen the interval of what the policies differ by."""
    luck = np.random.default_rng(1).normal(0, 100.0, 30)
    before = Score(luck, np.full(30, 9), None)
    after = Score(luck + np.linspace(0.9, 1.1, 30), np.full(30, 9), np.ones(30, bool))
    found = gain(after, before)
    assert 0.95 < found["low"] < found["mean"] < found["high"] < 1.05
    assert figure(after)["success"]["mean"] == 1.0
    assert "success" not in figure(before)
    again = from_plain(json.loads(json.dumps(to_plain(after))))
    np.testing.assert_array_equal(again.returns, after.returns)
    assert again.reached is not None
    assert again.reached.all()


def test_the_best_point_is_kept(result: Path) -> None:
    tuning = object.__new__(FineTuning)
    tuning.curve = [{"return": {"mean": m}} for m in (1.0, 3.0, 2.0)]
    assert tuning.kept == 1


@pytest.mark.parametrize("text", ["{broken", "[]", '{"of": "x", "scores": {"a": 3}}'])
def test_a_damaged_file_of_what_was_judged_is_named(tmp_path: Path, result: Path, jackal: Path, text: str) -> None:
    handed(result, tmp_path / "out", jackal, steps=128)
    (tmp_path / "out" / "judged.json").write_text(text)
    with pytest.raises(InputError, match=r"judged\.json: damaged, or none of this command's .*remove it to judge anew"):
        handed(result, tmp_path / "out", jackal, steps=128)
