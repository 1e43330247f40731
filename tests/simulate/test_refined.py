"""One window's own posterior, as `nfc-gym infer --refine` makes it."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from nfc_gym.core import Fidelity, InputError, load_source

pytest.importorskip("torch")

from nfc_gym.cli import app
from nfc_gym.inference import Network, NetworkConfig, NeuralPosterior, PriorBox, Sizes, Window
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.normal import Normal, NormalPosterior
from nfc_gym.inference.progress import Quiet
from nfc_gym.inference.windows import Windows
from nfc_gym.measured.belief import read_belief
from nfc_gym.simulate import Simulator, refined
from nfc_gym.simulate.machine import Machine

ENVIRONMENT = "nfc_gym/QuadcopterFlat-v0"  # its windows are short
SMALL = {"encoder": "nn", "width": 16, "features": 8, "hidden": 16, "depth": 1, "density": "mixture", "components": 2}
SIMULATIONS = 1800


def untrained(environment: str = ENVIRONMENT) -> NeuralPosterior:
    """A posterior that is the prior yet."""
    machine = Machine(environment)
    sizes = Sizes(
        machine.habit.horizon, machine.kind.proprio_size, machine.kind.action_size, place=place_of(machine.state_names)
    )
    network = Network(NetworkConfig(**SMALL), sizes, PriorBox.of(machine.space, machine.kind.name))
    return NeuralPosterior(network, notes={"environment": environment, "states": list(machine.state_names)})


class Heard(Quiet):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def message(self, text: str) -> None:
        self.said.append(text)


@pytest.fixture(scope="module")
def flown() -> tuple[Window, np.ndarray]:
    """A Quadcopter's window, and the psi that made it."""
    machine = Machine(ENVIRONMENT)
    u = np.random.default_rng(3).uniform(0.2, 0.8, (1, len(machine.space)))
    psi = machine.space.low + u * (machine.space.high - machine.space.low)
    made = Simulator(ENVIRONMENT, effects=0.0, jobs=1, names=("states", "actions"))(psi, np.random.default_rng(5))
    return Window(made["states"][0].numpy(), made["actions"][0].numpy()), psi


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows that starts are learned from: fewer."""
    monkeypatch.setattr(refined, "BEGINNINGS", 400)


@pytest.mark.usefixtures("few")
def test_a_window_is_told_of_without_a_network(flown: tuple[Window, np.ndarray]) -> None:
    window, psi = flown
    heard = Heard()
    own = refined.refined(None, window, environment=ENVIRONMENT, simulations=SIMULATIONS, jobs=1, report=heard)
    assert isinstance(own, NormalPosterior)
    assert own.notes == {"environment": ENVIRONMENT, "refined": SIMULATIONS}
    gain = (own.log_prob(Fidelity(psi))[0] + own.prior.log_volume) / own.prior.size
    assert gain > 1.2  # nats a parameter; a minute of training on a hundred thousand windows tells 2.5
    z = (own.prior.to_z(psi)[0] - own.normal.mean) / np.sqrt(np.diag(own.normal.covariance))
    assert np.abs(z).max() < 4
    assert sum(text.startswith("round ") for text in heard.said) == 4


@pytest.mark.usefixtures("few")
def test_a_posterior_says_where_to_begin(flown: tuple[Window, np.ndarray]) -> None:
    """And nothing else: its psi is another's by now, and the answer is the same but for the simulations' noise."""
    window, psi = flown
    posterior = untrained()
    own = refined.refined(posterior, window, simulations=SIMULATIONS, jobs=1)
    assert own.notes == {"environment": ENVIRONMENT, "refined": SIMULATIONS, "states": posterior.notes["states"]}
    assert (own.log_prob(Fidelity(psi))[0] + own.prior.log_volume) / own.prior.size > 1.2


def test_what_cannot_be_refined_is_refused(flown: tuple[Window, np.ndarray]) -> None:
    window, _ = flown
    with pytest.raises(InputError, match="on a plane only"):
        refined.refined(None, window, environment="QuadcopterRough")
    with pytest.raises(InputError, match="no environment 'Quadcoptre'"):
        refined.refined(None, window, environment="Quadcoptre")
    nameless = NeuralPosterior(untrained().network)
    with pytest.raises(InputError, match="name the environment"):
        refined.refined(nameless, window)
    with pytest.raises(InputError, match="a posterior of 'quadcopter', and nfc_gym/AntFlat-v0"):
        refined.refined(nameless, window, environment="AntFlat")
    with pytest.raises(InputError, match="15 steps"):
        refined.refined(untrained(), Window(np.asarray(window.states)[:16], np.asarray(window.actions)[:15]))
    raw = Window(window.states, 50 * np.asarray(window.actions))
    with pytest.raises(InputError, match="raw commands, or other units"):
        refined.refined(None, raw, environment=ENVIRONMENT)


def test_the_command_line_refines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flown: tuple[Window, np.ndarray]
) -> None:
    file, motion, out = tmp_path / "own.safetensors", tmp_path / "window.npz", tmp_path / "today.safetensors"
    untrained().save(file)
    np.savez(motion, states=flown[0].states, actions=flown[0].actions)
    asked: list[tuple[object, dict[str, object]]] = []

    def instead(posterior: NeuralPosterior | None, window: Window, **how: object) -> NormalPosterior:
        asked.append((posterior, how))
        prior = PriorBox.of(Machine(ENVIRONMENT).space, "quadcopter")
        return NormalPosterior(prior, Normal.prior(prior.size))

    monkeypatch.setattr(refined, "refined", instead)
    command = ["infer", str(file), str(motion), "--refine", "700", "--out", str(out)]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert isinstance(asked[-1][0], NeuralPosterior)
    assert asked[-1][1]["jobs"] == 0  # all cores
    done = CliRunner().invoke(app, ["infer", "QuadcopterFlat", *command[2:], "--jobs", "1"])
    assert done.exit_code == 0, done.output
    assert asked[-1][0] is None
    assert {k: asked[-1][1][k] for k in ("environment", "simulations", "jobs", "seed")} == {
        "environment": "QuadcopterFlat", "simulations": 700, "jobs": 1, "seed": 0,
    }  # fmt: skip
    assert isinstance(load_source(out), NormalPosterior)
    assert "not shown" in done.output
    refused = CliRunner().invoke(app, ["infer", "QuadcopterFlat", str(motion)])
    assert refused.exit_code == 2
    assert "an environment goes with --refine N" in " ".join(refused.output.split())


def test_its_file_is_a_proposal_and_a_belief(tmp_path: Path) -> None:
    machine, file = Machine(ENVIRONMENT), tmp_path / "today.safetensors"
    prior = PriorBox.of(machine.space, "quadcopter")
    NormalPosterior(prior, Normal(np.full(prior.size, 0.5), 0.01 * np.eye(prior.size))).save(file)
    command = ["simulate", "QuadcopterFlat", "--windows", "6", "--jobs", "1", "--proposal", str(file), "--out"]
    done = CliRunner().invoke(app, [*command, str(tmp_path / "windows")])
    assert done.exit_code == 0, done.output
    u = Windows(tmp_path / "windows").take(np.arange(6), ("psi",))["psi"]
    assert 0.5 < u.min() < u.max() < 0.85  # of 0.69 +- 0.035
    refused = CliRunner().invoke(app, ["simulate", "AntFlat", *command[2:], str(tmp_path / "others")])
    assert refused.exit_code == 2
    assert "a posterior of the robot 'quadcopter'" in " ".join(refused.output.split())
    belief = read_belief(file, machine.space, 0)
    assert belief.names == machine.space.names
    np.testing.assert_allclose(prior.u_of(belief.draws).mean(0), 0.69, atol=0.02)


def test_a_window_of_another_robot_is_refused_before_anything_is_simulated(flown: tuple[Window, np.ndarray]) -> None:
    heard = Heard()
    with pytest.raises(InputError, match=r"nfc_gym/JackalFlat-v0 wants \(51 or more, 15\)"):
        refined.refined(None, flown[0], environment="JackalFlat", report=heard)
    assert not heard.said
