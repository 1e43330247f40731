"""From a posterior in a file to one window's own, as `nfc-gym infer --refine` makes it."""

from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from nfc_gym.core import InputError

pytest.importorskip("torch")

import torch

from nfc_gym.cli import app
from nfc_gym.inference import Network, NetworkConfig, NeuralPosterior, PriorBox, Sizes, TrainConfig, Window, load
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.progress import Quiet
from nfc_gym.simulate import Simulator, refined
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.repeated import Repeated

refine = import_module("nfc_gym.inference.refine")  # the package has a function of that name
ENVIRONMENT = "nfc_gym/JackalFlat-v0"
SMALL = {"encoder": "nn", "width": 16, "features": 8, "hidden": 16, "depth": 1, "density": "mixture", "components": 2}


def untrained(environment: str = ENVIRONMENT) -> NeuralPosterior:
    """A posterior that is the prior yet."""
    machine = Machine(environment)
    sizes = Sizes(50, 15, 2, place=place_of(machine.state_names))
    network = Network(NetworkConfig(**SMALL), sizes, PriorBox.of(machine.space, "jackal"))
    return NeuralPosterior(network, notes={"environment": environment})


class Heard(Quiet):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def message(self, text: str) -> None:
        self.said.append(text)


def seen() -> Window:
    """A Jackal that moves."""
    machine = Machine(ENVIRONMENT)
    simulator = Simulator(ENVIRONMENT, effects=0.0, jobs=1, names=("states", "actions"))
    found = simulator(machine.space.nominal[None], np.random.default_rng(0))
    return Window(found["states"][0].numpy(), found["actions"][0].numpy())


def test_a_posterior_is_refined_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refined, "BEGINNINGS", 220)
    monkeypatch.setattr(refine, "FRESH", 200)
    small = replace(refine.NETWORK, width=64, features=32)
    monkeypatch.setattr(refined, "refine", partial(refine.refine, network=small))
    monkeypatch.setattr(refined, "halved", lambda *given: replace(refine.halved(*given), samples=300))
    posterior, window = untrained(), seen()
    window.actions[3, 0] = 1.2  # of which the machine makes 1
    once = TrainConfig(epochs=1, batch=128, warmup=2, average=0.5)
    heard = Heard()
    own = refined.refined(posterior, window, simulations=300, jobs=1, training=once, report=heard)
    told = [text for text in heard.said if text.endswith("windows simulated")]
    beginnings, fresh = ([f"{n * k} of {2 * n} windows simulated" for k in (1, 2)] for n in (110, 100))
    assert told == [*beginnings, *2 * ["150 of 150 windows simulated"], *fresh]
    assert own.notes == posterior.notes | {"refined": 300, "kept": pytest.approx(own.notes["kept"])}
    assert 0.01 < own.notes["kept"] < 0.95  # the second of two rounds
    u = own.prior.u_of(own.sample(500, np.random.default_rng(0)).psi)
    prior = posterior.given(window)
    before = prior.prior.u_of(prior.sample(500, np.random.default_rng(0)).psi)
    assert u.std(0).min() < 0.8 * before.std(0).min()


def test_a_portion_is_a_tenth_and_every_window_is_made_once() -> None:
    heard = Heard()
    batch = refined._in_portions(5000, lambda rows: {"row": torch.from_numpy(rows)}, heard)
    assert batch["row"].tolist() == list(range(5000))
    assert heard.said == [f"{500 * k} of 5000 windows simulated" for k in range(1, 11)]


def test_portions_are_the_same_at_any_number_of_jobs() -> None:
    machine, window = Machine(ENVIRONMENT), seen()
    beginnings = Simulator(ENVIRONMENT, effects=0.0, jobs=1, names=("states", "start"))
    known = {k: t.numpy() for k, t in beginnings.draw(220, np.random.default_rng(0)).items()}
    psi = np.tile(machine.space.nominal, (230, 1))
    found = []
    for jobs in (1, 2):
        simulator = Simulator(ENVIRONMENT, effects=0.0, jobs=jobs, names=("states", "actions"))
        again = Repeated.of(simulator, np.asarray(window.states), np.asarray(window.actions), known)
        found.append(refined._Told(again, Heard())(psi, np.random.default_rng(1))["states"])
    assert torch.equal(*found)


def test_what_cannot_be_refined_is_refused() -> None:
    window = seen()
    with pytest.raises(InputError, match="on a plane only"):
        refined.refined(untrained("nfc_gym/JackalRough-v0"), window)
    nameless = NeuralPosterior(untrained().network)
    with pytest.raises(InputError, match="name the environment"):
        refined.refined(nameless, window)
    with pytest.raises(InputError, match="a posterior of 'jackal', and nfc_gym/AntFlat-v0"):
        refined.refined(nameless, window, environment="AntFlat")
    with pytest.raises(InputError, match="40 steps"):
        refined.refined(untrained(), Window(np.asarray(window.states)[:41], np.asarray(window.actions)[:40]))


def test_the_command_line_refines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, motion, out = tmp_path / "jackal.safetensors", tmp_path / "window.npz", tmp_path / "today.safetensors"
    untrained().save(file)
    window, asked = seen(), {}
    np.savez(motion, states=window.states, actions=window.actions)

    def instead(posterior: NeuralPosterior, window: Window, **how: object) -> NeuralPosterior:
        asked.update(how)
        return NeuralPosterior(posterior.network, posterior.given(window).kept, {"refined": how["simulations"]})

    monkeypatch.setattr(refined, "refined", instead)
    command = ["infer", str(file), str(motion), "--refine", "700", "--out", str(out)]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert asked["jobs"] == 0  # all cores
    done = CliRunner().invoke(app, [*command, "--jobs", "1", "--device", "cpu"])
    assert done.exit_code == 0, done.output
    assert (asked["simulations"], asked["jobs"], asked["seed"]) == (700, 1, 0)
    assert load(out).notes["refined"] == 700
    assert CliRunner().invoke(app, ["infer", str(file), str(motion), "--refine", "10"]).exit_code == 2
