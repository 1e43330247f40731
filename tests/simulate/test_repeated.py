"""Where a window may have begun, and windows of its commands: against a start that is known."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.simulate import Repeated, Simulator
from nfc_gym.simulate.likely import LEAST, Likely, _lowest, _touching
from nfc_gym.simulate.machine import Machine

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


def test_starts_stand_on_the_ground_as_those_did_that_are_known(
    case: tuple[Machine, Simulator, dict[str, np.ndarray]],
) -> None:
    machine, _, windows = case
    known, asked = split(windows)
    data, (touching, floor) = mujoco.MjData(machine.model), _touching(machine.model)

    def above(rows: np.ndarray) -> np.ndarray:
        out = []
        for row in rows:
            data.qpos[:] = row[: machine.model.nq]
            out.append(_lowest(machine.model, data, touching, floor))
        return np.array(out)

    found = above(
        Likely(machine, known, asked["states"][0]).draw(known["psi"][:100].astype(float), np.random.default_rng(1))
    )
    allowed = above(np.array([begun(machine, s) for s in known["start"]]))
    assert found.min() > allowed.min() - 1e-6
    assert found.min() < 0.01 or machine.kind.name == "quadcopter"


def test_windows_repeat_the_commands_from_the_first_observation(
    case: tuple[Machine, Simulator, dict[str, np.ndarray]],
) -> None:
    machine, simulator, windows = case
    known, asked = split(windows)
    again = Repeated.of(replace(simulator, names=("states", "actions")), asked["states"], asked["actions"], known)
    rng, space = np.random.default_rng(2), machine.space
    u = np.concatenate([np.tile(asked["psi"], (40, 1)), rng.uniform(size=(40, len(space)))])
    found = again(space.low + u * (space.high - space.low), np.random.default_rng(3))
    assert set(found) == {"states", "actions"}
    np.testing.assert_array_equal(found["states"][:, 0].numpy(), np.tile(asked["states"][0], (80, 1)))
    np.testing.assert_allclose(found["actions"].numpy(), np.tile(asked["actions"], (80, 1, 1)), atol=1e-6)
    assert again.noise.shape == asked["states"].shape
    assert (again.noise[0] == 0).all()
    np.testing.assert_array_equal(again.noise[1], machine.noise)
    # under the psi that it was made with it is met more closely than under any
    seen = np.flatnonzero(machine.told)
    away = ((found["states"][:, 1:, seen].numpy() - asked["states"][1:, seen]) / machine.noise[seen]) ** 2
    assert np.median(away[:40].mean((1, 2))) < 0.8 * np.median(away[40:].mean((1, 2)))
    same = again(space.low + u * (space.high - space.low), np.random.default_rng(3))
    assert (same["states"] == found["states"]).all()


def test_what_cannot_be_repeated_is_refused() -> None:
    _, simulator, windows = simulated("nfc_gym/JackalFlat-v0")
    known, asked = split(windows)
    few = {k: v[: LEAST - 1] for k, v in known.items()}
    with pytest.raises(InputError, match=f"want {LEAST} windows or more"):
        Repeated.of(simulator, asked["states"], asked["actions"], few)
    with pytest.raises(InputError, match=r"states \(41, 15\) and actions \(40, 2\)"):
        Repeated.of(simulator, asked["states"][:41], asked["actions"][:40], known)
    broken = asked["states"].copy()
    broken[3, 4] = np.nan
    with pytest.raises(InputError, match="not finite"):
        Repeated.of(simulator, broken, asked["actions"], known)
    with pytest.raises(InputError, match="on a plane only"):
        Repeated.of(replace(simulator, environment="nfc_gym/JackalRough-v0"), asked["states"], asked["actions"], known)
