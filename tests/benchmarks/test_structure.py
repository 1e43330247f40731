"""The benchmark of the structure head: what it draws, and how two runs of one trial are compared."""

from importlib import import_module

import numpy as np
import pytest

pytest.importorskip("torch", reason="the head is a network")


def trial(verdicts: tuple[str, str], claims: tuple[list[str], list[str]], cpu: tuple[float, float]) -> dict:
    loops = {
        k: {"verdict": v, "claims": c, "cpu": s, "outcome": "right" if c else "missed"}
        for k, v, c, s in zip(("without", "with"), verdicts, claims, cpu, strict=True)
    }
    return {"families": ["wind"], "likely": ["wind", "gust"], **loops}


def test_parameters_of_one_make_are_drawn_together_within_the_mappings_bounds() -> None:
    heads = import_module("standin.heads")
    declared = heads.Declared("quadcopter")
    psi, names = declared.sample(50, np.random.default_rng(0)).psi, declared.space.names
    arms = psi[:, [i for i, n in enumerate(names) if n.endswith("arm_mass")]]
    assert (arms == arms[:, :1]).all()
    assert 0.06 <= arms.min() < 0.08
    assert 0.14 < arms.max() <= 0.16
    base = psi[:, names.index("base_mass")]
    assert base.min() >= 0.6 * 0.85
    assert base.max() <= 0.6 * 1.15
    assert base.std() > 0


def test_the_ratio_is_of_the_same_trial_and_verdicts_are_counted() -> None:
    structure = import_module("structure")
    wind = ["wind:base = external_force:base"]
    trials = [
        trial(("explained", "explained"), (wind, ["wind:base"]), (90.0, 45.0)),
        trial(("explained", "unexplained"), (wind, []), (60.0, 20.0)),
        trial(("nothing missing", "nothing missing"), ([], []), (40.0, 40.0)),
    ]
    rows = {r["name"].removeprefix("quadcopter: "): r for r in structure.loop_rows("quadcopter", trials)}
    assert rows["time without over time with, median of 3"]["value"] == pytest.approx(2.0)
    assert rows["same verdict, of 3"]["value"] == 2
    assert not rows["same verdict, of 3"]["holds"]
    assert rows["same claims, of 3"]["value"] == 2  # equivalents are no claims
    assert rows["right, of 3"] | {"value": 1, "baseline": 2} == rows["right, of 3"]
