"""An earlier law gives way to the one that does better beside the others."""

import numpy as np
import pytest
from hinge import DRY, FRICTION, LAGGING, SPRING, VISCOUS, arena, pool

from nfc_gym.measured.lookout import Lookout
from nfc_gym.measured.swap import swapped
from nfc_gym.physics.effects import build


@pytest.mark.parametrize(
    ("physics", "first", "right"),
    [(FRICTION, VISCOUS, "coulomb:hinge"), (LAGGING, DRY, "damping_poly:hinge"), (FRICTION, DRY, None)],
    ids=["dry for viscous", "viscous for dry", "right from the start"],
)
def test_the_wrong_law_beside_a_right_one_is_exchanged(physics: str, first: tuple, right: str | None) -> None:
    contest = arena(physics, [build(*first), build(*SPRING)])
    lookout = Lookout(contest.fit_data.problem, np.random.default_rng(0), lambda text: None)
    said: list[str] = []
    found = swapped(contest, lookout, pool(), 0.02, said.append)
    if right is None:
        assert found is None
        return
    assert found is not None
    assert {e.id for e in found.plant.effects} == {right, "spring_offset:hinge"}
    assert said == [f"{right} in place of {first[0]}:hinge: together they explain more"]
