"""`nfc-gym train --maps --delta-e --families` and what `nfc-gym infer` says of it: one network of all heads."""

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from nfc_gym.cli import app
from nfc_gym.core import InputError, load_source
from nfc_gym.inference import jobs
from nfc_gym.inference.around import PLACES, heights
from nfc_gym.inference.config import NetworkConfig
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig
from nfc_gym.inference.windows import Windows
from nfc_gym.simulate import simulate
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.maps import keep_maps

ENV = "nfc_gym/JackalRough-v0"


def run(*args: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in args])


def said(result: Result) -> str:
    return " ".join(result.output.split())


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("heads") / "windows"
    simulate(ENV, 10, folder, jobs=1)
    return folder


@pytest.fixture(scope="module")
def trained(bare: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """Posterior, window, and what training said; the network is a small one."""
    folder = tmp_path_factory.mktemp("trained")
    windows = folder / "windows"
    shutil.copytree(bare, windows)
    keep_maps(windows, jobs=1)
    out = folder / "jackal.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        small = partial(NetworkConfig, hidden=8, depth=1, features=8, width=16)
        patch.setattr("nfc_gym.inference.config.NetworkConfig", small)
        made = run("train", windows, "--out", out, "--encoder", "none", "--epochs", 1, "--batch", 4, "--device", "cpu",
                   "--maps", "--delta-e", "--families")  # fmt: skip
    assert made.exit_code == 0, made.output
    one = Windows(windows)[0]
    np.savez(folder / "window.npz", states=one["states"], actions=one["actions"], elevation=one["map"])
    return out, folder / "window.npz", made.output


def test_one_network_infers_all_parts_and_says_which_family(trained: tuple[Path, Path, str], tmp_path: Path) -> None:
    posterior, window, _ = trained
    plain = run("infer", posterior, window, "--samples", 20, "--out", tmp_path / "psi.npz")
    assert plain.exit_code == 0, plain.output
    assert "family of effects: " in said(plain)
    assert "--delta-e draws it" in said(plain)
    assert load_source(tmp_path / "psi.npz").given == ("psi", "delta_s")
    assert "20 draws of psi and delta_s" in said(plain)

    out = tmp_path / "all.npz"
    whole = run("infer", posterior, window, "--samples", 3, "--delta-e", "--out", out)
    assert whole.exit_code == 0, whole.output
    assert "3 draws of psi and delta_s and delta_e" in said(whole)
    drawn = load_source(out)
    assert drawn.delta_e.shape == (3, 128, 128)
    assert len(drawn.psi) == len(drawn.delta_s) == 3
    for each in heights(drawn.delta_e):
        assert each.place in said(whole)
        assert f"{each.median:.3f}" in said(whole)


def test_heights_are_those_at_the_places() -> None:
    forward, left = (np.arange(128) - 63.5) * 0.1, (np.arange(128) - 63.5) * 0.1
    plane = 0.1 * forward[:, None] + 0.01 * left[None, :]
    told = heights(plane + np.array([-0.2, 0.0, 0.2])[:, None, None])
    for each, (ahead, aside) in zip(told, PLACES.values(), strict=True):
        assert each.median == pytest.approx(0.1 * ahead + 0.01 * aside, abs=1e-9)
        assert each.low < each.median < each.high


def test_what_cannot_be_trained_or_drawn_is_refused(
    bare: Path, trained: tuple[Path, Path, str], tmp_path: Path
) -> None:
    out = tmp_path / "x.safetensors"
    for more, message in (
        (["--delta-e"], "--delta-e is what the ground is beyond the map that is seen: give --maps too"),
        (["--maps", "--delta-e", "--density", "flow"], "--delta-e is inferred by --density score, not flow"),
        (["--maps", "--delta-e"], "the windows have no elevation maps; make them with `nfc-gym simulate ... --maps`"),
        (["--structure", "--families"], "--families is for a posterior: give it without --structure"),
    ):
        refused = run("train", bare, "--out", out, *more)
        assert refused.exit_code == 2
        assert message in said(refused)
    assert not list(tmp_path.iterdir())
    machine = Machine(ENV)
    prior = PriorBox.of(machine.space, machine.kind.name)
    small = NetworkConfig(encoder="none", summaries=True, features=8, hidden=8, depth=1)
    plain = tmp_path / "plain.safetensors"
    jobs.train_posterior(bare, prior, plain, small, TrainConfig(epochs=1, batch=4), device="cpu")
    with pytest.raises(InputError, match=r"infers psi, no delta_e; `nfc-gym train \.\.\. --maps --delta-e`"):
        jobs.infer(plain, trained[1], samples=2, maps=True)
    refused = run("infer", ENV, trained[1], "--refine", 10, "--delta-e")
    assert refused.exit_code == 2
    assert "--delta-e is not refined, which is of psi alone" in said(refused)
