"""Where a window may have begun, and windows of its commands: against a start that is known."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.special import ndtr

from nfc_gym.core import InputError
from nfc_gym.inference.space import PriorBox
from nfc_gym.simulate import Repeated, Simulator
from nfc_gym.simulate.likely import LEAST, Likely, lowest, touching
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.opening import Opening

pytest.importorskip("torch")

WINDOWS = 260


def simulated(name: str) -> tuple[Machine, Simulator, dict[str, np.ndarray]]:
    """Windows of any motion, and the simulator that made them."""
    simulator = Simulator(name, effects=0.0, jobs=1, names=("states", "actions", "start"))
    found = simulator.draw(WINDOWS + 1, np.random.default_rng(0))
    return Machine(name), simulator, {k: t.numpy() for k, t in found.items()}


def begun(machine: Machine, start: np.ndarray) -> np.ndarray:
    """(nq + nv + na) of the simulator's state."""
    data = mujoco.MjData(machine.model)
    mujoco.mj_setState(machine.model, data, start.astype(float), mujoco.mjtState.mjSTATE_INTEGRATION)
    return np.concatenate([data.qpos, data.qvel, data.act])


@pytest.fixture(
    scope="module", params=["nfc_gym/JackalFlat-v0", "nfc_gym/QuadrupedFlat-v0", "nfc_gym/QuadcopterFlat-v0"]
)
def case(request: pytest.FixtureRequest) -> tuple[Machine, Simulator, dict[str, np.ndarray]]:
    """One robot's; the last window is the one that is asked about."""
    return simulated(request.param)


def split(windows: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Those that are known, and the one that is asked about."""
    return {k: v[:-1] for k, v in windows.items()}, {k: v[-1] for k, v in windows.items()}


def test_starts_surround_the_true_one(case: tuple[Machine, Simulator, dict[str, np.ndarray]]) -> None:
    machine, _, windows = case
    known, asked = split(windows)
    drawn = Likely(machine, known, asked["states"][0]).draw(np.tile(asked["psi"], (400, 1)), np.random.default_rng(1))
    truth, model = begun(machine, asked["start"]), machine.model
    told = slice(7, model.nq) if machine.kind.name == "quadruped" else slice(3, 7)  # joints; the attitude
    np.testing.assert_allclose(drawn[:, told].mean(0), truth[told], atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(drawn[:, 3:7], axis=1), 1, atol=1e-9)
    moving = slice(model.nq, model.nq + model.nv)
    if machine.kind.name == "quadruped":  # which way it faces nothing tells: rates and joints alone can be compared
        moving = slice(model.nq + 3, model.nq + model.nv)
    away = (drawn[:, moving].mean(0) - truth[moving]) / drawn[:, moving].std(0)
    assert np.abs(away).max() < 5
    # beforehand they were not known so well
    before = np.array([begun(machine, s)[moving] for s in known["start"]])
    assert (drawn[:, moving].std(0) < 0.9 * before.std(0)).mean() > 0.5


def above(machine: Machine, rows: np.ndarray) -> np.ndarray:
    """(n,) m between starts' lowest geoms and the plane."""
    data, (geoms, floor) = mujoco.MjData(machine.model), touching(machine.model)
    out = []
    for row in rows:
        data.qpos[:] = row[: machine.model.nq]
        out.append(lowest(machine.model, data, geoms, floor))
    return np.array(out)


def test_starts_stand_on_the_ground_as_those_did_that_are_known(
    case: tuple[Machine, Simulator, dict[str, np.ndarray]],
) -> None:
    machine, _, windows = case
    known, asked = split(windows)
    likely = Likely(machine, known, asked["states"][0])
    found = above(machine, likely.draw(known["psi"][:100].astype(float), np.random.default_rng(1)))
    allowed = above(machine, np.array([begun(machine, s) for s in known["start"]]))
    assert found.min() > allowed.min() - 1e-6
    assert found.min() < 0.01 or machine.kind.name == "quadcopter"


def test_an_opening_has_the_mean_and_the_spread_of_starts(
    case: tuple[Machine, Simulator, dict[str, np.ndarray]],
) -> None:
    machine, _, windows = case
    known, asked = split(windows)
    likely, rng, model = Likely(machine, known, asked["states"][0]), np.random.default_rng(1), machine.model
    opening = Opening(likely, rng)
    z = rng.standard_normal((600, len(machine.space)))
    starts = opening.starts(z, rng.standard_normal((600, opening.size)))
    drawn = likely.draw(ndtr(z), rng)
    assert starts.shape == (600, model.nq + model.nv + model.na)
    np.testing.assert_allclose(np.linalg.norm(starts[:, 3:7], axis=1), 1, atol=1e-9)
    for part in (slice(7, model.nq), slice(model.nq, None)):  # joints; all that moves
        spread = drawn[:, part].std(0)
        varies = spread > 1e-6
        away = (starts[:, part].mean(0) - drawn[:, part].mean(0))[varies] / spread[varies]
        assert np.abs(away).max() < 0.4
        share = starts[:, part].std(0)[varies] / spread[varies]
        assert (share > 0.7).all()
        assert (share < 1.4).all()
    found, wanted = above(machine, starts), above(machine, drawn)
    np.testing.assert_allclose(found.mean(), wanted.mean(), atol=0.3 * wanted.std() + 1e-6)
    np.testing.assert_allclose(found.std(), wanted.std(), rtol=0.25, atol=1e-6)


def test_windows_repeat_the_commands_from_where_this_one_began(
    case: tuple[Machine, Simulator, dict[str, np.ndarray]],
) -> None:
    machine, simulator, windows = case
    known, asked = split(windows)
    rng, d = np.random.default_rng(2), len(machine.space)
    simulator = replace(simulator, names=("states",))
    again = Repeated.of(simulator, asked["states"], asked["actions"], known, rng)
    prior = PriorBox.of(machine.space, machine.kind.name)
    assert again.size == d + again.opening.size
    own = prior.to_z(machine.space.low + asked["psi"] * (machine.space.high - machine.space.low))
    theta = rng.standard_normal((80, again.size))
    theta[:40, :d] = own
    off = again(theta, 3)
    assert off.shape == (80, machine.habit.horizon * int(machine.told.sum()))
    # under the psi that it was made with it is met more closely than under any
    assert np.median((off[:40] ** 2).mean(1)) < 0.8 * np.median((off[40:] ** 2).mean(1))
    assert (again(theta, 3) == off).all()
    other = again(theta, 4)  # the motors' noise is another
    assert (other != off).any()
    louder = replace(again, simulator=replace(simulator, noise=2.0))
    np.testing.assert_allclose(2 * louder(theta, 3), off)


def test_what_cannot_be_repeated_is_refused() -> None:
    _, simulator, windows = simulated("nfc_gym/JackalFlat-v0")
    (known, asked), rng = split(windows), np.random.default_rng(0)
    few = {k: v[: LEAST - 1] for k, v in known.items()}
    with pytest.raises(InputError, match=f"want {LEAST} windows or more"):
        Repeated.of(simulator, asked["states"], asked["actions"], few, rng)
    with pytest.raises(InputError, match=r"states \(41, 15\) and actions \(40, 2\)"):
        Repeated.of(simulator, asked["states"][:41], asked["actions"][:40], known, rng)
    broken = asked["states"].copy()
    broken[3, 4] = np.nan
    with pytest.raises(InputError, match="not finite"):
        Repeated.of(simulator, broken, asked["actions"], known, rng)
    rough = replace(simulator, environment="nfc_gym/JackalRough-v0")
    with pytest.raises(InputError, match="on a plane only"):
        Repeated.of(rough, asked["states"], asked["actions"], known, rng)


def test_what_comes_apart_is_nan_and_the_others_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rover at a million metres a second: what is simulated in its place begins where another did."""
    machine, simulator, windows = simulated("nfc_gym/JackalFlat-v0")
    (known, asked), rng = split(windows), np.random.default_rng(2)
    again = Repeated.of(replace(simulator, names=("states",)), asked["states"], asked["actions"], known, rng)
    theta, begin = rng.standard_normal((6, again.size)), Opening.starts

    def flung(self: Opening, z: np.ndarray, v: np.ndarray) -> np.ndarray:
        starts = begin(self, z, v)
        starts[2, machine.model.nq : machine.model.nq + 3] = 1e6
        return starts

    whole = again(theta, 3)
    monkeypatch.setattr(Opening, "starts", flung)
    off = again(theta, 3)
    assert np.isnan(off[2]).all()
    others = [0, 1, 3, 4, 5]
    assert np.isfinite(off[others]).all()
    assert np.isfinite(whole).all()
