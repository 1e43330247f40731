"""Lessons for a fault classifier: half of the machines are sound, the others have a fault of the kind that is said."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.simulate import faulty as module
from nfc_gym.simulate.fault_kinds import KINDS, fault_kinds
from nfc_gym.simulate.faulty import faulty, lessons
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.trials import trials

JACKAL = "nfc_gym/JackalFlat-v0"


def test_lessons_say_what_is_wrong_and_do_not_depend_on_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_ROWS", 40)
    space = Machine(JACKAL).space
    psi = np.tile(space.nominal, (100, 1))
    made = lessons(JACKAL, psi, 5)
    kind, psi_of = made["family"], made["psi"] * (space.high - space.low) + space.low
    assert (kind == 0).sum() == 50
    assert (kind > 0).sum() == pytest.approx(50, abs=2)  # a fault may throw a robot at once
    assert set(kind) == set(range(len(KINDS)))
    assert made["states"].dtype == made["actions"].dtype == made["psi"].dtype == np.float32
    scaled = {"none": "", "mass": "base_mass", "friction": "_friction", "gain": "_damping", "effect": ""}
    for k, name in enumerate(KINDS):
        changed = np.abs(psi_of[kind == k] / space.nominal - 1) > 1e-4
        meant = np.array([bool(scaled[name]) and n.endswith(scaled[name]) for n in space.names])
        assert not changed[:, ~meant].any()
        assert (changed.any(1) == bool(scaled[name])).all()
    again = lessons(JACKAL, psi, 5, jobs=2)
    for name, value in made.items():
        assert np.array_equal(value, again[name]), name
    assert not np.array_equal(lessons(JACKAL, psi[:40], 6)["states"], made["states"][:40])


def test_faults_are_told_apart_by_their_kind() -> None:
    machine = Machine(JACKAL)
    found = faulty(machine, np.tile(machine.space.nominal, (30, 1)), 2)
    assert len(found["kind"]) == len(found["row"]) == len(found["states"])
    assert sorted(found["row"]) == sorted(set(found["row"]))
    heavier = found["psi"][:, list(machine.space.names).index("base_mass")] != machine.space.nominal[
        list(machine.space.names).index("base_mass")
    ]  # fmt: skip
    assert np.array_equal(heavier, found["kind"] == KINDS.index("mass"))
    for shape in ((4, 2), (0, 17), (17,)):
        with pytest.raises(InputError, match="psi has shape"):
            lessons(JACKAL, np.zeros(shape), 0)


def drawn(robot: str, monkeypatch: pytest.MonkeyPatch) -> tuple[Counter[str], dict[str, np.ndarray]]:
    """How many windows have each kind of fault, and what its effects were given, by family."""
    given: dict[str, list[np.ndarray]] = {}

    def told(*args: Any, effect: Any = None, theta: Any = None, **how: Any) -> Any:
        if effect is not None:
            given.setdefault(effect.family, []).append(theta)
        return trials(*args, effect=effect, theta=theta, **how)

    monkeypatch.setattr(module, "trials", told)
    machine = Machine(f"nfc_gym/{robot}Flat-v0")
    found = faulty(machine, np.tile(machine.space.nominal, (60, 1)), 3)
    return Counter(KINDS[k] for k in found["kind"]), {name: np.concatenate(parts) for name, parts in given.items()}


def test_a_robot_whose_psi_has_no_friction_and_no_gains_is_given_such_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds, given = drawn("Quadruped", monkeypatch)
    assert set(kinds) == {"mass", "friction", "gain", "effect"}
    factor = given["fault_friction"]
    assert len(set(factor[:, 0])) == len(factor)
    assert 0.2 <= factor.min() < factor.max() <= 0.8
    assert len(np.unique(given["loss"])) >= kinds["gain"] > 5  # each window's own; of the library some have the same
    machine = Machine("nfc_gym/QuadrupedFlat-v0")
    (slippery,), fields = fault_kinds(machine)["friction"].effects, {"geom_friction": np.ones((2, 3, 3))}
    slippery.model(fields, np.array([[0.5], [1.0]]))
    assert np.array_equal(fields["geom_friction"], [[[0.5, 1, 1]] * 3, [[1, 1, 1]] * 3])


def test_what_flies_is_given_no_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds, given = drawn("Quadcopter", monkeypatch)
    assert {"mass", "gain"} <= set(kinds) <= {"mass", "gain", "effect"}
    assert "fault_friction" not in given


def test_a_damaged_part_of_the_lessons_is_told_by_name(tmp_path: Path) -> None:
    psi = np.tile(Machine(JACKAL).space.nominal, (4, 1))
    made = lessons(JACKAL, psi, 0, folder=tmp_path)
    (part,) = tmp_path.iterdir()
    whole = part.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"no archive"):
        part.write_bytes(damaged)
        with pytest.raises(InputError, match=rf"{part.name}: damaged .*remove it"):
            lessons(JACKAL, psi, 0, folder=tmp_path)
    part.unlink()
    assert np.array_equal(lessons(JACKAL, psi, 0, folder=tmp_path)["states"], made["states"])
