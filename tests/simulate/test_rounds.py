"""Windows in memory, one for each psi that is asked for."""

import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.simulate import Simulator
from nfc_gym.simulate.machine import Machine

torch = pytest.importorskip("torch")
JACKAL = "nfc_gym/JackalFlat-v0"


def test_each_window_is_made_under_its_own_psi() -> None:
    """The same generator's state gives the same windows but where psi differs: those of the changed row alone."""
    space = Machine(JACKAL).space
    psi = space.sample(np.random.default_rng(0), 5)
    other = psi.copy()
    other[2, 0] = space.high[0]
    simulator = Simulator(JACKAL, effects=0.0, jobs=1, noise=0.0)
    one, two = (simulator(p, np.random.default_rng(7)) for p in (psi, other))
    assert {k: tuple(v.shape) for k, v in one.items()} == {
        "states": (5, 51, 15), "actions": (5, 50, 2), "delta_s": (5, 15), "family": (5,)
    }  # fmt: skip
    same = (one["states"] == two["states"]).all(-1).all(-1)
    assert same.tolist() == [True, True, False, True, True]
    assert torch.equal(one["actions"], two["actions"])


def test_sensors_have_noise() -> None:
    psi = Machine(JACKAL).space.sample(np.random.default_rng(0), 40)
    quiet, loud = (Simulator(JACKAL, 0.0, jobs=1, noise=k)(psi, np.random.default_rng(1))["states"] for k in (0, 2))
    sd = (loud - quiet).std((0, 1)).numpy()
    np.testing.assert_allclose(sd, 2 * Machine(JACKAL).noise, rtol=0.1)


def test_maps_where_they_are_named_and_errors_where_nothing_is() -> None:
    psi = Machine(JACKAL).space.sample(np.random.default_rng(0), 2)
    found = Simulator(JACKAL, jobs=1, names=("states", "map", "delta_e"))(psi, np.random.default_rng(0))
    assert found["map"].shape == found["delta_e"].shape == (2, 128, 128)
    with pytest.raises(InputError, match="no array 'walls'"):
        Simulator(JACKAL, jobs=1, names=("walls",))(psi, np.random.default_rng(0))
    with pytest.raises(InputError, match=r"base_mass is .* outside"):
        Simulator(JACKAL, jobs=1)(3 * psi, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"effects": 2.0}, r"simulator: effects is 2\.0, want a share from 0 to 1"),
        ({"motor": float("nan")}, "simulator: motor is nan, want a share"),
        ({"policy_share": -0.1}, r"simulator: policy_share is -0\.1"),
        ({"jobs": 1.5}, r"simulator: jobs is 1\.5, want a whole number, 0 or more"),
        ({"noise": -1.0}, r"noise multiplies the sensors' own, want 0 or more, got -1\.0"),
        ({"noise": float("nan")}, "want 0 or more, got nan"),
    ],
)
def test_settings_that_make_no_windows_are_refused(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Simulator(JACKAL, **wrong)  # type: ignore[arg-type]


def test_no_window_at_all_is_refused() -> None:
    simulator, rng = Simulator(JACKAL, jobs=1), np.random.default_rng(0)
    for ask in (lambda: simulator.draw(0, rng), lambda: simulator(np.zeros((0, 17)), rng)):
        with pytest.raises(InputError, match="the number of windows is 0, want a whole number, 1 or more"):
            ask()
