"""A head that names suspects: the answer is the same with a right head, a wrong one and none; what it held is told."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import Closed, claims

from nfc_gym.core import InputError
from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.suspects import Suspects, kept, restored


class Says:
    """A head whose answer is given; it remembers what it was shown."""

    horizon, dt = 20, 0.02

    def __init__(self, **told: float) -> None:
        self.told = told

    def __call__(
        self, motion: tuple, expected: tuple, sent: Mapping[str, np.ndarray], noise: Mapping[str, float], seed: int = 0
    ) -> dict[str, float]:
        self.motion, self.expected, self.sent, self.noise = motion, expected, sent, noise
        return self.told


def test_likely_families_make_up_nearly_all_of_the_probability_of_an_effect() -> None:
    told = {"none": 0.9, "wind": 0.06, "payload": 0.03, "lag": 0.006, "gain": 0.004}
    assert Suspects("head", told).likely == ("wind", "payload", "lag")
    assert Suspects("head", {"none": 1.0}).likely == ()
    assert len(Suspects("head", {f"f{i}": 0.05 for i in range(20)}).likely) == 8


def test_suspects_are_kept_to_the_bit() -> None:
    suspects = Suspects("head", {"none": 0.1, "wind": 0.9 / 7}, 48, 0.25)
    assert restored(json.loads(json.dumps(kept(suspects)))) == suspects
    assert restored(None) is None


@dataclass
class Asked:
    """A head, and the run in which it was asked."""

    head: Says
    out: Path
    report: dict[str, Any]


@pytest.fixture(
    scope="module", params=[{"none": 0.1, "coulomb": 0.9}, {"none": 0.5, "armature": 0.5}, {"none": 1.0}],
    ids=["right", "wrong", "none"],
)  # fmt: skip
def asked(request: pytest.FixtureRequest, closed: Closed, tmp_path_factory: pytest.TempPathFactory) -> Asked:
    """A head that is right, one that is wrong, one that knows nothing."""
    head, folder = Says(**request.param), tmp_path_factory.mktemp("asked")
    file = folder / "head.safetensors"
    file.write_bytes(b"head")
    report = close_loop(closed.mapping, folder / "out", seed=3, jobs=1, witness=(head, file))
    return Asked(head, folder / "out", report)


def test_a_head_changes_the_order_and_not_the_answer(closed: Closed, asked: Asked) -> None:
    alone, report, head = closed.report, asked.report, asked.head
    assert claims(report) == claims(alone)
    assert claims(alone)[1] == ["coulomb:hinge"]
    said = report["structure"]
    assert said["families"] == pytest.approx(head.told)
    assert said["file"] == "head.safetensors"
    assert said["windows"] == len(head.motion[0]) > 0
    assert alone["structure"] is None
    assert "coulomb:hinge" in {r["id"] for r in report["identifiability"]}
    page = (asked.out / "report.html").read_text()
    assert "What the structure head held possible" in page
    assert "What the structure head held possible" not in (closed.out / "report.html").read_text()


def test_the_head_is_shown_windows_of_the_fit_logs_and_what_the_calibrated_model_makes_of_them(asked: Asked) -> None:
    head = asked.head
    count = len(head.motion[0])
    assert head.motion[0].shape == head.expected[0].shape == (count, 21, 1)
    assert head.motion[1].shape == head.expected[1].shape == (count, 21, 1)
    assert head.sent["ctrl:motor"].shape == (count, 20)
    assert head.noise == {"joint:hinge:pos": 0.002, "joint:hinge:vel": 0.02}
    start = head.motion[0][:, 0] - head.expected[0][:, 0]
    end = head.motion[0][:, -1] - head.expected[0][:, -1]
    assert np.abs(start).max() < 4 * 0.002  # noise of the sensor alone
    assert np.abs(end).max() > 10 * np.abs(start).max()  # dry friction that the model does not know


def test_logs_slower_than_the_head_are_refused(closed: Closed, tmp_path: Path) -> None:
    head, file = Says(none=1.0), tmp_path / "head.safetensors"
    head.dt, head.horizon = 0.004, 100  # type: ignore[misc]
    file.write_bytes(b"head")
    with pytest.raises(InputError, match="record at 250 Hz"):
        close_loop(closed.mapping, tmp_path / "out", seed=3, jobs=1, witness=(head, file))
