"""`nfc-gym train` and `nfc-gym infer`, from a folder of windows to psi."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from nfc_gym.cli import app
from nfc_gym.core import InputError
from nfc_gym.core.posterior import load_source
from nfc_gym.inference import jobs
from nfc_gym.inference.config import NetworkConfig
from nfc_gym.inference.data import Batch, StoredWindows
from nfc_gym.inference.gains import gains
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import Window, load
from nfc_gym.inference.progress import Quiet
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train
from nfc_gym.inference.windows import Windows
from nfc_gym.simulate import simulate
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.teach import train_structure

ENV = "nfc_gym/QuadcopterFlat-v0"
SMALL = NetworkConfig(encoder="none", summaries=True, linear=True, delta_s=True, features=0, hidden=16, depth=1)


class Heard(Quiet):
    """Keeps the messages."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def message(self, text: str) -> None:
        self.said.append(text)


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("jobs") / "windows"
    simulate(ENV, 60, folder, jobs=1)
    return folder


@pytest.fixture(scope="module")
def prior() -> PriorBox:
    machine = Machine(ENV)
    return PriorBox.of(machine.space, machine.kind.name)


@pytest.fixture(scope="module")
def posterior(windows: Path, prior: PriorBox) -> Path:
    out = windows.parent / "quadcopter.safetensors"
    jobs.train_posterior(windows, prior, out, SMALL, TrainConfig(epochs=1, batch=32), device="cpu")
    return out


@pytest.fixture(scope="module")
def motion(windows: Path) -> Path:
    one = Windows(windows)[0]
    file = windows.parent / "window.npz"
    np.savez(file, states=one["states"], actions=one["actions"])
    return file


def test_draws_lie_in_the_prior_and_open_as_a_source(posterior: Path, motion: Path, prior: PriorBox) -> None:
    out = posterior.parent / "psi.npz"
    drawn, told = jobs.infer(posterior, motion, samples=200, out=out)
    assert ((np.array(drawn.psi) >= prior.low) & (np.array(drawn.psi) <= prior.high)).all()
    assert [t.name for t in told] == list(prior.names)
    again = load_source(out).sample(5, np.random.default_rng(0))
    assert again.psi is not None
    assert again.delta_s is not None
    assert all((drawn.psi == row).all(1).any() for row in again.psi)


def test_the_posterior_given_a_window_is_kept(posterior: Path, motion: Path) -> None:
    out = posterior.parent / "today.safetensors"
    jobs.infer(posterior, motion, samples=10, out=out)
    assert np.shape(load_source(out).sample(7, np.random.default_rng(0)).psi) == (7, 9)


def test_the_table_tells_the_width_over_the_prior(prior: PriorBox) -> None:
    u = np.random.default_rng(0).uniform(size=(20_000, len(prior)))
    u[:, 0] = 0.4 + 0.1 * u[:, 0]
    told = jobs.told(prior, prior.psi_of(u))
    assert told[0].width == pytest.approx(0.1, rel=0.05)
    assert told[0].median == pytest.approx(prior.low[0] + 0.45 * (prior.high[0] - prior.low[0]), rel=0.01)
    assert told[1].width == pytest.approx(1, rel=0.03)


def test_few_draws_of_the_prior_are_as_wide_as_the_prior(prior: PriorBox) -> None:
    rng = np.random.default_rng(0)
    few = [jobs.told(prior, prior.psi_of(rng.uniform(size=(20, len(prior))))) for _ in range(400)]
    assert np.mean([t.width for told in few for t in told]) == pytest.approx(1, abs=0.01)


def test_the_command_trains_and_the_other_tells(windows: Path, motion: Path, tmp_path: Path) -> None:
    file = tmp_path / "q.safetensors"
    run = CliRunner()
    made = run.invoke(app, ["train", str(windows), "--out", str(file), "--encoder", "none", "--epochs", "1",
                            "--no-delta-s", "--device", "cpu"])  # fmt: skip
    assert made.exit_code == 0, made.output
    assert "of psi a window tells" in made.output
    assert "12 windows that neither trained nor chose the epoch" in made.output
    found = run.invoke(app, ["infer", str(file), str(motion), "--samples", "50"])
    assert found.exit_code == 0, found.output
    assert "base_mass" in found.output
    for out, what in ((tmp_path / "psi.npz", "50 draws of psi"), (tmp_path / "p.safetensors", "the posterior given")):
        kept = run.invoke(app, ["infer", str(file), str(motion), "--samples", "50", "--out", str(out)])
        assert f"{out}: {what}" in kept.stdout


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"states": np.zeros((21, 21))}, "no array 'actions'"),
        ({"states": np.zeros((11, 21)), "actions": np.zeros((10, 4))}, "trained on windows of 20"),
        ({"states": np.full((21, 21), np.nan), "actions": np.zeros((20, 4))}, "nan"),
        ({"states": np.full((21, 21), "a"), "actions": np.zeros((20, 4))}, "states holds no numbers"),
    ],
)
def test_a_window_that_is_none_is_refused(
    posterior: Path, tmp_path: Path, arrays: dict[str, np.ndarray], said: str
) -> None:
    file = tmp_path / "w.npz"
    np.savez(file, **arrays)
    done = CliRunner().invoke(app, ["infer", str(posterior), str(file)])
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())


def test_a_folder_for_the_draws_is_made_and_one_that_cannot_be_is_refused_at_once(
    posterior: Path, motion: Path, tmp_path: Path
) -> None:
    out = tmp_path / "new" / "psi.npz"
    jobs.infer(posterior, motion, samples=10, out=out)
    assert load_source(out).sample(3, np.random.default_rng(0)).psi is not None
    for name in ("psi.npz", "psi.safetensors"):
        with pytest.raises(InputError, match="/proc/none cannot be written"):  # before the posterior is looked for
            jobs.infer(tmp_path / "gone.safetensors", motion, out=Path("/proc/none") / name)


def test_training_into_a_place_that_cannot_be_written_is_refused_at_once(prior: PriorBox, tmp_path: Path) -> None:
    out = Path("/proc/none/x.safetensors")
    with pytest.raises(InputError, match="/proc/none cannot be written"):  # before the windows are looked for
        jobs.train_posterior(tmp_path / "gone", prior, out, SMALL, TrainConfig(), device="cpu")
    for more in ([], ["--structure"]):
        done = CliRunner().invoke(app, ["train", str(tmp_path / "gone"), "--out", str(out), *more])
        assert done.exit_code == 2
        assert "/proc/none cannot be written" in " ".join(done.output.split())


def test_actions_of_other_units_are_refused_in_the_rows_that_count(
    posterior: Path, motion: Path, tmp_path: Path
) -> None:
    with np.load(motion) as one:
        states, actions = one["states"].copy(), one["actions"].copy()
    actions[12, 0] = 1.2  # a log may command a little more than the machine takes
    jobs.infer(posterior, Window(states, actions), samples=10)
    actions[12, 0] = 30
    file = tmp_path / "raw.npz"
    for more in (0, 12):  # rows behind: the last 20 count, of 32 those from 12 on
        np.savez(
            file, states=np.concatenate([states, states[:more]]), actions=np.concatenate([actions, actions[:more]])
        )
        with pytest.raises(InputError, match=re.escape("in [-1, 1]; actions[12, 0] is 30: raw")) as caught:
            jobs.infer(posterior, file)
        assert str(caught.value).startswith(f"{file}: actions are what env.step takes")
    longer = Window(np.concatenate([states, states[:13]]), np.concatenate([actions, np.zeros((13, 4))]))
    jobs.infer(posterior, longer, samples=10)


def test_commands_beyond_what_the_machine_takes_are_seen_as_it_took_them(posterior: Path, motion: Path) -> None:
    with np.load(motion) as one:
        states, actions = one["states"].copy(), one["actions"].copy()
    actions[3, 1], actions[7, 0] = 1.4, -1.2
    cut, raw = (jobs.infer(posterior, Window(states, a), samples=20)[0].psi for a in (np.clip(actions, -1, 1), actions))
    np.testing.assert_array_equal(raw, cut)


def test_arrays_that_run_backwards_are_inferred_from_as_others_are(posterior: Path, motion: Path) -> None:
    with np.load(motion) as one:
        states, actions = one["states"].astype(float), one["actions"].astype(float)
    other = Window(*(x[::-1].copy()[::-1] for x in (states, actions)))
    found, wanted = (jobs.infer(posterior, w, samples=10)[0].psi for w in (other, Window(states, actions)))
    np.testing.assert_array_equal(found, wanted)


def test_motion_that_no_window_of_the_training_set_was_like_is_said(
    windows: Path, prior: PriorBox, motion: Path, tmp_path: Path
) -> None:
    out, small = tmp_path / "q.safetensors", replace(SMALL, encoder="nn", width=8)
    jobs.train_posterior(windows, prior, out, small, TrainConfig(epochs=1, batch=32), device="cpu")
    with np.load(motion) as one:
        states, actions = one["states"].astype(float), one["actions"]
    blow, degrees = states.copy(), states.copy()
    blow[5:8, 12] = 50.0  # that much for a moment may be an impact
    degrees[:, 12] = 57.3 * (1 + degrees[:, 12])
    heard = Heard()
    for each in (states, blow):
        jobs.infer(out, Window(each, actions), samples=10, report=heard)
    assert heard.said == []
    jobs.infer(out, Window(np.concatenate([states[:7], degrees[1:]]), np.concatenate([actions[:7], actions[1:]])),
               samples=10, report=heard)  # fmt: skip
    (said,) = heard.said
    middle = np.median(np.concatenate([states[6:7], degrees[1:]])[-21:, 12])
    assert said.startswith(f"states[:, 12] (body:base:angvel@body.z) has the median {middle:.4g}, ")
    file = tmp_path / "degrees.npz"
    np.savez(file, states=degrees, actions=actions)
    done = CliRunner().invoke(app, ["infer", str(out), str(file), "--samples", "10"])
    assert done.exit_code == 0
    assert "standard deviations from the training set's mean" in " ".join(done.stderr.split())


def test_a_structure_head_is_told_as_that(posterior: Path, motion: Path, tmp_path: Path) -> None:
    head = load(posterior)
    head.notes["misfit"] = True
    head.save(tmp_path / "head.safetensors")
    with pytest.raises(InputError, match=r"head\.safetensors is a structure head, which knows families of effects"):
        jobs.infer(tmp_path / "head.safetensors", motion)


def test_a_window_of_another_robot_is_refused_by_its_files_name(posterior: Path, tmp_path: Path) -> None:
    file = tmp_path / "jackal.npz"
    np.savez(file, states=np.zeros((21, 15)), actions=np.zeros((20, 2)))
    said = rf"^{file}: states must have shape \(time, 21\), got \(21, 15\); .* is of the robot 'quadcopter'"
    with pytest.raises(InputError, match=said):
        jobs.infer(posterior, file)


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--log", "run_0", "--log run_0 is of a mapping's logs"),
        ("--until", "1.5", "--until 1.5 is of a mapping's logs"),
        ("--jobs", "0", "--jobs 0 is for --refine"),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    posterior: Path, motion: Path, option: str, value: str, said: str
) -> None:
    done = CliRunner().invoke(app, ["infer", str(posterior), str(motion), option, value])
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["train", "--structure", "--encoder", "tcn"], "--encoder tcn is for a posterior: give it without --structure"),
        (["train", "--structure", "--no-delta-s"], "--no-delta-s is for a posterior"),
        (["train", "--structure", "--maps"], "--maps is for a posterior"),
        (
            ["simulate", "--windows", "3", "--policy-share", "0.4"],
            "--policy-share 0.4 is for --policy: give --policy too",
        ),
    ],
)
def test_options_of_training_that_would_do_nothing_are_refused(
    windows: Path, tmp_path: Path, given: list[str], said: str
) -> None:
    command, *options = given
    what = str(windows) if command == "train" else ENV
    done = CliRunner().invoke(app, [command, what, "--out", str(tmp_path / "x.safetensors"), *options])
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())
    assert not list(tmp_path.iterdir())


def test_no_window_that_judges_has_trained_or_chosen(
    windows: Path, prior: PriorBox, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the labels that each of the three parts asks for; the printed gain is that of the third."""
    parts: list[np.ndarray] = []

    def seen(*sets: StoredWindows) -> None:
        parts.extend(np.concatenate([b["psi"].numpy() for b in s.batches(64, None)]) for s in sets)

    def trained(network: Network, first: StoredWindows, held_out: StoredWindows, *args: Any, **how: Any) -> Outcome:
        seen(first, held_out)
        return train(network, first, held_out, *args, **how)

    def judged(network: Network, batch: Batch) -> np.ndarray:
        parts.append(batch["psi"].numpy())
        return gains(network, batch)

    monkeypatch.setattr(jobs, "train", trained)
    monkeypatch.setattr(jobs, "gains", judged)
    for seed in (0, 1):
        out = tmp_path / f"q{seed}.safetensors"
        jobs.train_posterior(windows, prior, out, SMALL, TrainConfig(epochs=1, batch=32, seed=seed), device="cpu")
        told = load(out).notes["told"]
        assert told["windows"] == len(parts[-1]) == 12
    assert [len(p) for p in parts] == [46, 2, 12] * 2
    for each in (parts[:3], parts[3:]):
        np.testing.assert_array_equal(
            np.unique(np.concatenate(each), axis=0), np.unique(Windows(windows)[:]["psi"], axis=0)
        )
    assert not np.array_equal(parts[2], parts[5])  # drawn by the seed


@pytest.mark.parametrize(
    ("windows", "judging"), [(1, 0), (4, 0), (5, 1), (60, 12), (100, 20), (399, 20), (1000, 50), (10_000, 256)]
)
def test_few_windows_are_kept_to_judge_by(windows: int, judging: int) -> None:
    assert jobs.judges(windows) == judging


@pytest.mark.parametrize("windows", [2, 5])
def test_fewer_than_two_windows_judge_nothing(tmp_path: Path, windows: int) -> None:
    simulate(ENV, windows, tmp_path / "few", jobs=1)
    out = str(tmp_path / "q.safetensors")
    made = CliRunner().invoke(app, ["train", str(tmp_path / "few"), "--out", out, "--encoder", "none", "--epochs", "1",
                                    "--no-delta-s", "--device", "cpu"])  # fmt: skip
    assert made.exit_code == 0, made.output
    assert "too few windows to keep some by which to judge" in made.output
    assert "standard error" not in made.output


def test_a_proposal_of_another_robot_or_without_a_window_is_told_as_that(posterior: Path, tmp_path: Path) -> None:
    def said(environment: str) -> str:
        out = str(tmp_path / "windows")
        done = CliRunner().invoke(
            app, ["simulate", environment, "--windows", "1", "--out", out, "--proposal", str(posterior)]
        )
        assert done.exit_code == 2, done.output
        return " ".join(done.output.split())

    assert "a posterior of the robot 'quadcopter', and nfc_gym/AntFlat-v0 is of 'ant'" in said("AntFlat")
    assert f"`nfc-gym infer {posterior} window.npz --out given.safetensors`" in said("QuadcopterFlat")


def test_files_that_are_something_else_are_refused(posterior: Path, motion: Path, tmp_path: Path) -> None:
    text = tmp_path / "w.npz"
    text.write_text("no archive")
    with pytest.raises(InputError) as caught:
        jobs.infer(posterior, text)
    assert "pickle" not in str(caught.value)
    assert str(caught.value).count("no .npz") == 1
    for at, said in ((text, "no .npz"), (tmp_path / "gone.npz", "no such file")):
        with pytest.raises(InputError, match=said):
            jobs.infer(posterior, at)
    with pytest.raises(InputError, match=r"\.npz"):
        jobs.infer(posterior, motion, out=tmp_path / "draws.csv")


def test_training_says_what_is_wrong(windows: Path, prior: PriorBox, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--maps"):
        jobs.train_posterior(windows, prior, tmp_path / "a.safetensors",
                             NetworkConfig(elevation=True), TrainConfig(), device="cpu")  # fmt: skip
    with pytest.raises(InputError, match=r"ends in \.safetensors"):
        jobs.train_posterior(windows, prior, tmp_path / "a.pt", SMALL, TrainConfig(), device="cpu")
    with pytest.raises(InputError, match="there is auto, cpu"):
        jobs.device_of("tpu9")
    other = tmp_path / "other"
    shutil.copytree(windows, other)
    about = json.loads((other / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps(about | {"robot": "ant"}))
    with pytest.raises(InputError, match="'ant'"):
        jobs.train_posterior(other, prior, tmp_path / "a.safetensors", SMALL, TrainConfig(), device="cpu")
    with pytest.raises(InputError, match="'meta' computes nothing; there is auto, cpu"):
        jobs.device_of("meta")


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("psi_names", None, "psi_names is None"),
        ("psi_units", ["kg"], "1 psi_units and 9 psi_names"),
        ("state_noise", "none", "state_noise is none"),
        ("windows", True, "windows is True"),
        ("horizon", 0, "horizon is 0"),
        ("finished", {"first": {}}, "finished is"),
        ("settings", [1], "settings is"),
        ("environment", 3, "environment is 3"),
    ],
)
def test_a_manifest_whose_values_are_none_is_refused(
    windows: Path, tmp_path: Path, key: str, value: object, said: str
) -> None:
    about = json.loads((windows / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps(about | {key: value}))
    with pytest.raises(InputError, match=rf"manifest\.json: {said}.*simulate again"):
        Windows(tmp_path)


def test_windows_of_other_bounds_are_refused(windows: Path, prior: PriorBox, tmp_path: Path) -> None:
    """As of another version of the robot: their u would be read as psi that nothing was simulated under."""
    other = tmp_path / "other"
    shutil.copytree(windows, other)
    about = json.loads((other / "manifest.json").read_text())
    about["psi_low"][0] -= 0.1
    (other / "manifest.json").write_text(json.dumps(about))
    said = rf"^{other} has low of '{prior.names[0]}' = {about['psi_low'][0]}, here it is {prior.low[0]}"
    with pytest.raises(InputError, match=said):
        jobs.train_posterior(other, prior, tmp_path / "a.safetensors", SMALL, TrainConfig(), device="cpu")
    with pytest.raises(InputError, match=said):
        train_structure(other, tmp_path / "s.safetensors", TrainConfig(epochs=1))


def test_training_on_a_set_that_is_not_finished_is_said(windows: Path, prior: PriorBox, tmp_path: Path) -> None:
    part = tmp_path / "part"
    simulate(ENV, 60, part, jobs=1, per_shard=40)
    (part / "shard_00001.safetensors").unlink()
    about = json.loads((part / "manifest.json").read_text())
    del about["finished"]["1"]  # as a run that was killed leaves it
    (part / "manifest.json").write_text(json.dumps(about))
    heard, once = Heard(), TrainConfig(epochs=1, batch=32)
    jobs.train_posterior(part, prior, tmp_path / "a.safetensors", SMALL, once, device="cpu", report=heard)
    assert heard.said == [
        f"{part}: 40 of 60 windows are there, and these are trained on; `nfc-gym simulate` with the same arguments "
        "makes the rest"
    ]
    heard.said.clear()
    jobs.train_posterior(windows, prior, tmp_path / "b.safetensors", SMALL, once, device="cpu", report=heard)
    assert heard.said == []


def test_training_does_not_go_on_from_other_windows_or_other_noise(
    windows: Path, prior: PriorBox, tmp_path: Path
) -> None:
    """As many of them, so that nothing else differs."""
    out, once = tmp_path / "q.safetensors", TrainConfig(epochs=1, batch=32)
    jobs.train_posterior(windows, prior, out, SMALL, once, device="cpu")
    jobs.train_posterior(windows, prior, out, SMALL, once, device="cpu")
    with pytest.raises(InputError, match=r"is of another run \(noise 1\.0, now 0\.5\)"):
        jobs.train_posterior(windows, prior, out, SMALL, once, device="cpu", noise=0.5)
    simulate(ENV, 60, tmp_path / "others", jobs=1, seed=1)
    with pytest.raises(InputError, match="the windows' seed 0, now 1"):
        jobs.train_posterior(tmp_path / "others", prior, out, SMALL, once, device="cpu")


@pytest.mark.parametrize("spoil", [lambda b: b[: len(b) // 2], lambda b: b[:200] + bytes(40) + b[240:], lambda b: b""])
def test_a_damaged_window_is_the_files_fault(motion: Path, posterior: Path, tmp_path: Path, spoil) -> None:
    file = tmp_path / "window.npz"
    file.write_bytes(spoil(motion.read_bytes()))
    with pytest.raises(InputError, match=r"is no \.npz file"):
        jobs.infer(posterior, file)
    with file.open("wb") as handle:
        np.save(handle, np.zeros(3))
    with pytest.raises(InputError, match=r"is no \.npz file"):
        jobs.infer(posterior, file)
