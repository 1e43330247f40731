"""The worlds of a belief: what goes together in a draw is together in an episode, and parts are what it speaks of."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym import InputError
from nfc_gym.adaptation.assimilation import Assimilation
from nfc_gym.adaptation.beliefs import require_spoken
from nfc_gym.adaptation.imagined import imagined, spoken
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.wrappers import VectorResidualDynamics

ID = "nfc_gym/JackalFlat-v0"


class Valley:
    """A heavier rover is one with a smaller residual: both are one number."""

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        k = rng.uniform(-1, 1, n)
        psi, delta = np.ones((n, 17)), np.zeros((n, 15))
        psi[:, 0], delta[:, 4] = 17 + k, -0.01 * k
        return Fidelity(psi, delta)


def test_without_hallucination_an_episode_is_one_draw_of_the_belief() -> None:
    made: Any = imagined(
        ID, Valley(), 6, hallucinate=False, parts=("psi", "delta_s"), beta=1.0, episode=50, threads=1, seed=0
    )
    dynamics = made
    while not isinstance(dynamics, VectorResidualDynamics):
        dynamics = dynamics.env

    def drawn() -> np.ndarray:
        psi, delta = made.unwrapped.psi[:, 0], dynamics.delta_s[:, 4]
        np.testing.assert_allclose(delta, -0.01 * (psi - 17), atol=1e-9)
        return psi.copy()

    made.reset(seed=3)
    first = drawn()
    assert np.ptp(first) > 0.5
    made.reset(options={"reset_mask": np.arange(6) < 2})
    second = drawn()
    assert ((first != second) == (np.arange(6) < 2)).all()
    made.reset(seed=3)
    np.testing.assert_array_equal(drawn(), first)
    made.close()


def test_effects_and_noise_are_parts_that_a_belief_may_speak_of() -> None:
    full: Any = SimpleNamespace(sample=Valley().sample, effects=lambda n, rng: [], noise=np.full(15, 0.01))
    assert spoken(full, ("effects", "noise")) == ("effects", "noise")
    assert spoken(full, ("noise", "psi", "delta_e")) == ("noise", "psi")
    quiet: Any = SimpleNamespace(sample=Valley().sample, effects=None, noise=None)
    with pytest.raises(InputError, match="speaks of psi, delta_s, not of effects, noise"):
        spoken(quiet, ("effects", "noise"))
    worlds = imagined(ID, full, 2, hallucinate=True, parts=("noise",), beta=1.0, episode=50, threads=1, seed=0)
    seen = worlds.reset(seed=0)[0]["observation"]
    assert worlds.single_action_space.shape == (2,), "nothing that pi_h could move"
    assert seen[:, :15].any()
    worlds.close()


@pytest.mark.parametrize(
    ("posterior", "wanted", "told"),
    [
        (Valley, ("effects",), "speaks of psi, delta_s, not of effects"),
        (
            lambda: Assimilation(ID, effects=False, delta_s=False),
            ("delta_s", "effects"),
            "speaks of psi, noise, not of",
        ),
    ],
)
def test_parts_that_will_never_be_spoken_of_are_refused_at_once(
    posterior: Callable[[], Any], wanted: tuple[str, ...], told: str
) -> None:
    with pytest.raises(InputError, match=told):
        require_spoken(posterior(), wanted)
    require_spoken(posterior(), (*wanted, "psi"))


def test_sizes_of_effects_are_drawn_apart_from_when_first_episodes_end() -> None:
    drawn: list[np.ndarray] = []

    def effects(n: int, rng: np.random.Generator) -> list[Any]:
        drawn.append(rng.integers(1, 51, n))
        return []

    belief: Any = SimpleNamespace(sample=Valley().sample, effects=effects)
    made: Any = imagined(ID, belief, 8, hallucinate=False, parts=("psi", "effects"), beta=1.0, episode=50, threads=1,
                         seed=5)  # fmt: skip
    made.reset(seed=0)
    assert (drawn[0] != made.env._left).any()
    made.close()
