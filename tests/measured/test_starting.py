"""Fits of lumps start along the valley in which psi takes up what a lump weighs."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from nfc_gym.measured.fit import Fit
from nfc_gym.measured.metric import Metric
from nfc_gym.measured.screen import Screened
from nfc_gym.measured.starting import starts
from nfc_gym.physics.effects.friction import Coulomb
from nfc_gym.physics.effects.inertial import Payload
from nfc_gym.physics.effects.places import sized

TOTAL, MOMENTS = 3.0, np.array([0.1, -0.04, 0.02])  # kg, and kg m of the lump
LUMP = Payload(("b",), sized(Payload.PARAMS, mass={"high": 5.0}))


class Weighed:
    """A body that shows what it weighs with its lump, and the lump's moments."""

    def __init__(self) -> None:
        self.asked = 0

    def residual(self, plant: Any, x: np.ndarray) -> np.ndarray:
        self.asked += len(x)
        moments = x[:, 1:2] * x[:, 2:] if x.shape[1] > 1 else np.zeros((len(x), 3))
        weight = x[:, :2].sum(1, keepdims=True) - TOTAL
        return np.concatenate([weight, moments - MOMENTS], 1)[:, None]


def bare() -> tuple[Weighed, Metric, Fit]:
    problem = Weighed()
    space = SimpleNamespace(low=np.zeros(1), high=np.full(1, 4.0), free=np.ones(1, bool))
    same = lambda x: x  # noqa: E731
    plant: Any = SimpleNamespace(space=space, effects=(), null=np.ones(1), chart=same, unchart=same)
    x = np.full(1, TOTAL)
    slopes = np.zeros((1, 4, 1))
    slopes[0, 0, 0] = 1.0  # of the scaled mass, a quarter of 4 kg
    return (
        problem,
        Metric(np.eye(4)[None], np.ones((1, 4), bool)),
        Fit(plant, x, problem.residual(plant, x[None])[0], slopes),
    )


def pointed(effect: Any, theta: list[float]) -> Screened:
    return Screened(effect, 1.0, np.array(theta), np.zeros(1), np.zeros((4, 0)))


def test_a_lump_starts_from_other_masses_and_psi_makes_up_for_each() -> None:
    """Screening met the valley at its wrong end: a tenth of the mass, and half the moments."""
    problem, under, current = bare()
    light = pointed(LUMP, [0.06, *(MOMENTS / 2 / 0.06)])
    rows = starts(problem, under, current, None, [light])  # type: ignore[arg-type]
    np.testing.assert_allclose(rows[0], rows[1])
    along = rows[2:]
    np.testing.assert_allclose(along[:, 0], np.maximum(TOTAL - along[:, 1], 0.0))
    assert along[:, 1].min() < 0.1 < 0.6 < along[:, 1].max()
    off = problem.residual(None, rows)[:, 0]
    assert (np.abs(off).max(1)[2:] < 1e-9).any(), "twice the moments, and psi has what the lump weighs"
    assert np.abs(off[:2]).max(1).min() > 0.04


def test_what_knows_no_valley_starts_where_screening_points() -> None:
    problem, under, current = bare()
    before = problem.asked
    rows = starts(problem, under, current, None, [pointed(Coulomb(("j",)), [0.2])])  # type: ignore[arg-type]
    np.testing.assert_allclose(rows, [[TOTAL, 0.2], [TOTAL, 0.2]])
    assert problem.asked == before


def test_of_two_candidates_one_moves_along_its_valley_and_the_other_stays() -> None:
    problem, under, current = bare()
    problem.residual = lambda plant, x: np.zeros((len(x), 1, 4))  # type: ignore[method-assign]
    picks = [pointed(Coulomb(("j",)), [0.2]), pointed(LUMP, [0.06, *(MOMENTS / 0.06)])]
    rows = starts(problem, under, current, None, picks)  # type: ignore[arg-type]
    assert (rows[:, 1] == 0.2).all()
    assert len(set(rows[2:, 2].round(9))) > 3
