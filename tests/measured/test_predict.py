"""Predictions: rows that are those of the logs, whatever the logs are called and wherever roll-outs begin anew."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nfc_gym.measured.predict import predict

Build = Callable[..., Path]
ROWS = 400
BY_TIME = ("time: {column: t}", "split: {by: time}\ntime: {column: t}")


def rolled(mapping: Path, restart: float | None = None) -> dict[str, np.ndarray]:
    return predict(mapping, None, "rollout", "nominal", mapping.parent / "said" / "out.npz", restart=restart)


@pytest.mark.parametrize("restart", [3.985, 1.3283, 0.374, None])
def test_the_last_row_needs_no_piece_of_its_own(build: Build, restart: float | None) -> None:
    """400 rows 10 ms apart, cut at 3.985 s, leave one: the end of the piece before it."""
    mapping = build()
    for values in rolled(mapping, restart).values():
        assert len(values) == ROWS
        assert np.isfinite(values).all()
    if restart == 3.985:
        whole, cut = rolled(mapping)["run_0"], rolled(mapping, restart)["run_0"]
        np.testing.assert_allclose(cut, whole, atol=1e-12)


@pytest.mark.parametrize("edits", [[], [BY_TIME]])
def test_logs_keep_the_names_of_their_files(build: Build, edits: list[tuple[str, str]]) -> None:
    """A mark in a name is no part of a log, even where it reads like one."""
    plain = rolled(build(None, *edits, logs=4))
    mapping = build(None, *edits, logs=4)
    for old, new in (("run_1", "run_1@2024"), ("run_2", "run_2@fit"), ("run_3", "run_2@verify")):
        (mapping.parent / f"{old}.npz").rename(mapping.parent / f"{new}.npz")
    found = rolled(mapping)
    assert set(found) == {"run_0", "run_1@2024", "run_2@fit", "run_2@verify"}
    assert all(len(values) == ROWS for values in found.values())
    if edits:  # each log is cut in the same places, whatever it is called
        np.testing.assert_array_equal(found["run_1@2024"], plain["run_1"])
        np.testing.assert_array_equal(found["run_2@verify"], plain["run_3"])
