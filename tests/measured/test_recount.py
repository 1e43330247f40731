"""Of rivals that the search left standing, all segments exclude those that explain them worse, and no others."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotor import LEVEL, Torque, lively, record, steady

from nfc_gym.measured.advice import _recounted, advise
from nfc_gym.measured.bench import make_bench
from nfc_gym.measured.dataset import load
from nfc_gym.measured.distances import Ask, Model
from nfc_gym.measured.fit import fit
from nfc_gym.measured.metric import metric
from nfc_gym.measured.questions import TOLD, Present, look
from nfc_gym.measured.recount import excluded
from nfc_gym.physics.effects import build

DRY = build("coulomb", "shaft", {"level": LEVEL})
VISCOUS = build("damping_poly", "shaft", {"linear": 0.04, "quadratic": 0.0, "cubic": 0.0})
Machine = Callable[[Torque], tuple[Any, list[Any], Any]]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    """Logs of a rotor with dry friction under some torque: the bench, its logs, and a fit of an effect to them."""

    def made(torque: Torque) -> tuple[Any, list[Any], Any]:
        bench = make_bench(load(record(tmp_path, torque)), 1)
        logs = [*bench.dataset.of("fit"), *bench.dataset.of("select")]

        def fitted(effect: Any, theta: np.ndarray) -> Model:
            plant, whole = bench.plant.with_effects([effect]), bench.searched(logs)
            under = metric(whole, whole.covariance(plant, theta))
            return Model(plant, fit(whole, under, plant, theta, 12).x)

        return bench, logs, fitted

    return made


def test_who_explains_the_logs_worse_is_excluded_and_who_does_better_is_not(machine: Machine) -> None:
    bench, logs, fitted = machine(lively)
    dry, viscous = fitted(*DRY), fitted(*VISCOUS)
    assert excluded(bench.searched(logs), [Ask(dry, viscous, TOLD), Ask(dry, dry, TOLD)], print, 0) == [True, False]
    assert excluded(bench.searched(logs), [Ask(viscous, dry, TOLD)], print, 0) == [False]


def test_who_explains_the_logs_as_well_is_not_excluded(machine: Machine) -> None:
    bench, logs, fitted = machine(steady)
    assert excluded(bench.searched(logs), [Ask(fitted(*DRY), fitted(*VISCOUS), TOLD)], print, 0) == [False]


def test_an_equivalent_that_the_searched_segments_alone_could_not_exclude_is_taken_out(machine: Machine) -> None:
    bench, logs, fitted = machine(lively)
    dry = fitted(*DRY)

    def asked(seen: Callable[[Present], Present]) -> tuple[list[str], list[str]]:
        claim = {"id": "coulomb:shaft", "equivalents": ["damping_poly:shaft"]}
        rows = [{"id": "coulomb:shaft", "worst_mimic": None, "distinguishable": True}]
        report = {"effects": [claim], "identifiability": rows}
        advice = advise(bench, logs, report, seen(look(bench, logs, dry.plant, dry.x)), lambda text: None, 0)
        assert advice.rows[0]["sigma"] > TOLD
        assert claim["equivalents"] == ["damping_poly:shaft"]  # what is asked about stays as it is
        return advice.effects[0]["equivalents"], [f["text"] for f in advice.findings if f["kind"] == "recount"]

    assert asked(lambda p: p) == (["damping_poly:shaft"], [])  # the search saw all of them, and has the last word
    few = lambda p: replace(p, repeats=0.5)  # noqa: E731
    left, (text,) = asked(few)
    assert left == []
    assert text.startswith("damping_poly:shaft does as well as coulomb:shaft on the 14 segments that were searched")
    assert text.endswith("and is excluded by all 28: it is no equivalent.")


@pytest.mark.parametrize(("others", "left"), [(0, ["damping_poly:shaft"]), (1, [])])
def test_who_did_as_well_before_the_rest_was_there_is_asked_again_beside_it(
    machine: Machine, others: int, left: list[str]
) -> None:
    bench, logs, fitted = machine(lively)
    told = [(Ask(fitted(*DRY), fitted(*VISCOUS), TOLD), ("coulomb:shaft", "damping_poly:shaft"))]
    claim = {"id": "coulomb:shaft", "equivalents": ["damping_poly:shaft"]}
    effects = [claim, *({"id": f"delay:{k}", "equivalents": []} for k in range(others))]
    seen = len(bench.searched(logs))
    (first, *_), findings = _recounted(bench, logs, effects, told, seen, lambda text: None, 0)
    assert first["equivalents"] == left
    said = ["damping_poly:shaft does not do as well as coulomb:shaft beside the rest: it is no equivalent."]
    assert [f["text"] for f in findings] == ([] if left else said)


@pytest.mark.parametrize(
    ("torque", "alike", "near"), [(lively, (), False), (lively, ("damping_poly:shaft",), True), (steady, (), True)]
)
def test_a_rival_is_not_called_too_near_that_loses_when_it_is_fitted(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, torque: Torque, alike: tuple[str, ...], near: bool
) -> None:
    """Its distance along slopes is that of a point where it does not stay; who is listed as alike was fitted before."""
    bench, logs, fitted = machine(torque)
    dry, viscous = fitted(*DRY), fitted(*VISCOUS)
    told = [Ask(dry, viscous, TOLD)], [("coulomb:shaft", "damping_poly:shaft")], [1.9]
    monkeypatch.setattr("nfc_gym.measured.advice._apart", lambda *_: told)
    claim = {"id": "coulomb:shaft", "equivalents": list(alike)}
    report = {"effects": [claim], "identifiability": [{"id": "coulomb:shaft", "distinguishable": True}]}
    advice = advise(bench, logs, report, look(bench, logs, dry.plant, dry.x), lambda text: None, 0)
    assert advice.rows[0]["distinguishable"] is not near
    assert advice.rows[0].get("sigma") == (1.9 if near else None)
    assert any("too near to choose" in f["text"] for f in advice.findings) is near
