"""A run that starts from a posterior: the same answer as without, what it inferred beside it, wrong files refused."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from arm import DAMPING, GIVEN, Closed, claims, machine

from nfc_gym.core import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.measured.belief import Belief, read_belief
from nfc_gym.measured.calibrate import calibrate
from nfc_gym.measured.loop import close_loop
from nfc_gym.physics.parameters import Parameter, ParameterSpace


def draws(path: Path, middle: float, spread: float, extra: int = 0) -> Path:
    """A posterior of the damping, as draws in an `.npz`."""
    rng = np.random.default_rng(0)
    psi = middle + spread * rng.standard_normal((200, 1 + extra))
    Fidelity(psi, delta_s=0.01 * rng.standard_normal((200, 2)) + np.array([0.0, -0.03])).save(path)
    return path


def test_a_posterior_changes_the_start_and_not_the_answer(closed: Closed, tmp_path: Path) -> None:
    alone = closed.report
    file = draws(tmp_path / "psi.npz", DAMPING, 0.01)
    report = close_loop(closed.mapping, tmp_path / "out", seed=3, jobs=1, posterior=file, compare=True)
    assert claims(report) == claims(alone)
    one, other = (r["parameters"][0]["estimate"] for r in (report, alone))
    assert one == pytest.approx(other, rel=1e-2)
    told = report["parameters"][0]["inferred"]
    assert told["low"] < DAMPING < told["high"]
    assert "inferred" not in alone["parameters"][0]
    said = report["posterior"]
    assert said["start"] == "posterior"
    assert said["misfit"]["posterior"] < said["misfit"]["nominal"]
    assert said["seconds_saved"] == pytest.approx(said["seconds_from_nominal"] - said["seconds"], abs=0.011)
    assert said["delta_s"][0]["state"] == "entry 1"  # the one that is surely not zero comes first
    assert said["delta_s"][0]["high"] < 0
    assert {r["place"] for r in said["fitted_delta_s"]} == {"joint:hinge"}
    assert all(r["rms"] > 0 for r in said["fitted_delta_s"])  # dry friction does something
    assert json.loads((tmp_path / "out" / "report.json").read_text())["posterior"] == said
    page = (tmp_path / "out" / "report.html").read_text()
    assert "What the posterior had inferred" in page
    assert "What the posterior had inferred" not in (closed.out / "report.html").read_text()


def test_other_draws_make_another_run(closed: Closed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies in the folder of a run that was interrupted belongs to its posterior."""
    one, other = draws(tmp_path / "one.npz", DAMPING, 0.01), draws(tmp_path / "other.npz", DAMPING, 0.02)

    class Stopped(Exception):
        pass

    def interrupted(*_: object) -> None:
        raise Stopped

    monkeypatch.setattr("nfc_gym.measured.loop.calibrate", interrupted)
    run = partial(close_loop, closed.mapping, tmp_path / "out", seed=3, jobs=1)
    for _ in range(2):  # the second goes on
        with pytest.raises(Stopped):
            run(posterior=one)
    for posterior in (other, None):
        with pytest.raises(InputError, match="holds an unfinished run on other inputs"):
            run(posterior=posterior)


def hinge() -> ParameterSpace:
    """The test machine's one parameter."""
    import mujoco

    parameter = Parameter("damping", "dof_damping", ("hinge",), "N m s/rad", 0.0, 0.4)
    return ParameterSpace(mujoco.MjModel.from_xml_string(GIVEN), [parameter])


def test_a_belief_stays_in_the_bounds_and_keeps_the_rest_nominal(tmp_path: Path) -> None:
    space = hinge()
    belief = read_belief(draws(tmp_path / "psi.npz", 0.4, 0.1), space, 0)
    assert belief.draws.max() == 0.4
    rows = belief.psi(space)
    assert rows.shape == (1 + len(belief.draws), 1)
    assert rows[0, 0] == pytest.approx(np.median(belief.draws))


@pytest.mark.parametrize(
    ("extra", "match"), [(1, "draws of 2 parameters; declared are damping"), (2, "draws of 3 parameters")]
)
def test_draws_of_other_parameters_are_refused(tmp_path: Path, extra: int, match: str) -> None:
    with pytest.raises(InputError, match=match):
        read_belief(draws(tmp_path / "psi.npz", 0.1, 0.01, extra), hinge(), 0)


def test_a_wrong_posterior_is_not_begun_from(tmp_path: Path) -> None:
    from nfc_gym.measured.bench import make_bench
    from nfc_gym.measured.dataset import load

    mapping = machine(tmp_path, loss=0.0, damping=0.05)
    bench = make_bench(load(mapping), 1)
    problem = bench.problem(bench.dataset.of("fit"), most=40)
    wrong = Belief("psi.npz", ("damping",), np.full((50, 1), 0.39))
    found = calibrate(problem, bench.plant, 0, lambda text: None, wrong)
    assert found["start"] == "nominal"
    alone = calibrate(problem, bench.plant, 0, lambda text: None)
    assert found["x"] == alone["x"]


def test_a_neural_posterior_says_its_own_names_and_needs_a_window(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="the posterior is a network")
    from nfc_gym.inference import checkpoint
    from nfc_gym.inference.config import NetworkConfig, Sizes
    from nfc_gym.inference.network import Network
    from nfc_gym.inference.posterior import NeuralPosterior, Window
    from nfc_gym.inference.space import PriorBox

    def saved(unit: str, names: tuple[str, ...]) -> Path:
        prior = PriorBox("arm", names, (unit,) * len(names), (0.0,) * len(names), (0.4,) * len(names))
        config = NetworkConfig(encoder="nn", width=8, features=8, hidden=8, depth=1, delta_s=True)
        network = Network(config, Sizes(4, 2, 1), prior)
        checkpoint.save(tmp_path / "bare.safetensors", network)
        window = Window(np.zeros((5, 2)), np.zeros((4, 1)))
        NeuralPosterior(network, notes={"states": ["q", "v"]}).given(window).save(tmp_path / "given.safetensors")
        return tmp_path / "given.safetensors"

    file = saved("N m s/rad", ("mass", "damping"))
    with torch.random.fork_rng():
        belief = read_belief(file, hinge(), 0)
    assert (belief.names, belief.beyond, belief.states) == (("damping",), ("mass",), ("q", "v"))
    with pytest.raises(InputError, match="was given no window"):
        read_belief(tmp_path / "bare.safetensors", hinge(), 0)
    with pytest.raises(InputError, match="damping is in 'N' there and in 'N m s/rad'"):
        read_belief(saved("N", ("mass", "damping")), hinge(), 0)
    with pytest.raises(InputError, match="none of these is declared: damping"):
        read_belief(saved("kg", ("mass",)), hinge(), 0)
