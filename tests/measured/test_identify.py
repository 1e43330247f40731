"""What logs show and what they cannot: mimics, and the smallest size of an effect that would have been found."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotor import lively, record

from nfc_gym.measured.bench import candidates, make_bench
from nfc_gym.measured.contest import price
from nfc_gym.measured.dataset import load
from nfc_gym.measured.fisher import Lens, left_over, span, without
from nfc_gym.measured.fit import fit
from nfc_gym.measured.identify import table
from nfc_gym.measured.metric import metric
from nfc_gym.measured.stakes import Stakes


def seen(path: Path) -> tuple[Lens, Stakes, list[Any]]:
    """The logs of a mapping, from the model as given: no friction at all."""
    bench = make_bench(load(path), 1)
    logs = [*bench.dataset.of("fit"), *bench.dataset.of("select")]
    problem, plant = bench.problem(logs), bench.plant
    lens = Lens(problem, metric(problem, problem.covariance(plant, plant.null)), plant, plant.null)
    return lens, Stakes(int(problem.mask.sum()), 1.0, 0.02), candidates(bench, logs)


def test_at_constant_speed_dry_and_viscous_friction_are_one(tmp_path: Path) -> None:
    rows = {r["id"]: r for r in table(*(lambda a, s, c: (a, c, s))(*seen(record(tmp_path, lambda t, s: 0 * t, 0.0))))}
    assert rows["coulomb:shaft"]["worst_mimic"] == "damping_poly:shaft"
    assert rows["damping_poly:shaft"]["worst_mimic"] == "coulomb:shaft"
    assert rows["coulomb:shaft"]["similarity"] > 0.99
    assert not rows["coulomb:shaft"]["distinguishable"]
    assert rows["coulomb:shaft"]["unit"] == "N m"
    lively_rows = {r["id"]: r for r in table(*(lambda a, s, c: (a, c, s))(*seen(record(tmp_path, lively, 0.0, 0.0))))}
    assert lively_rows["coulomb:shaft"]["angle"] > max(8, 5 * rows["coulomb:shaft"]["angle"])


def test_an_effect_of_the_smallest_size_gains_what_the_table_says(tmp_path: Path) -> None:
    """A machine with just that much friction, fitted: the drop of the loss is the needed one, to its scatter."""
    lens, stakes, pool = seen(record(tmp_path / "null", lively, 0.0, 0.0))
    row = next(r for r in table(lens, pool, stakes) if r["id"] == "coulomb:shaft")
    lens, _, pool = seen(record(tmp_path / "real", lively, row["smallest_detectable"], 0.0))
    coulomb = next(e for e in pool if e.id == "coulomb:shaft")
    plant = lens.plant.with_effects([coulomb])
    fitted = fit(lens.problem, lens.under, plant, plant.null + 1e-3)
    gain = float((lens.base**2).sum() - (fitted.white**2).sum())
    needed = stakes.needed(1)
    assert gain == pytest.approx(needed**2, abs=3 * 2 * needed)
    assert fitted.x[0] == pytest.approx(row["smallest_detectable"], rel=0.5)


def test_the_smallest_size_is_found_in_all_but_one_of_two_hundred_draws() -> None:
    stakes = Stakes(count=1000, dispersion=1.3, worth=0.02)
    least = price(1000, 2, 1.3) + 0.02 * 1000 * 1.3
    rng, length = np.random.default_rng(0), stakes.needed(2)
    gains = length**2 + 2 * length * rng.normal(size=200_000)  # |r|^2 - |r - c|^2 with r = c + noise
    assert (gains > least).mean() == pytest.approx(0.995, abs=0.001)
    assert Stakes(1000, 1.3, 0.02, repeats=4.0).needed(2) == pytest.approx(length / 2)


def test_what_declared_damping_imitates_is_no_finding(tmp_path: Path) -> None:
    path = record(tmp_path, lambda t, s: 0 * t, 0.0)
    text = (
        "parameters:\n  - {name: bearing, field: dof_damping, of: [shaft], low: 0.0, high: 0.5, nominal: 0.001}\nlogs:"
    )
    path.write_text(path.read_text().replace("logs:", text, 1))
    lens, stakes, pool = seen(path)
    row = next(r for r in table(lens, pool, stakes) if r["id"] == "coulomb:shaft")
    assert row["detectable_share"] < 0.2
    assert row["absorbed_by"] == "bearing"


def test_left_over_is_what_a_projection_leaves() -> None:
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(30, 5))
    columns[:, 3] = columns[:, 1] + columns[:, 2]  # nothing new
    left = without(columns[:, 0], span(columns[:, 1:]))
    assert span(columns[:, 1:]).shape == (30, 3)
    assert left_over(columns.T @ columns, 0, range(1, 5)) == pytest.approx(left @ left)
    assert left_over(columns.T @ columns, 3, (1, 2, 4)) == pytest.approx(0, abs=1e-6)
    assert left_over(columns.T @ columns, 0, ()) == pytest.approx(columns[:, 0] @ columns[:, 0])
