"""Predictions: rows that are those of the logs, whatever the logs are called and wherever roll-outs begin anew."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.export import to_row
from nfc_gym.measured.predict import predict
from nfc_gym.physics.effects import build as build_effect
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments

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


ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody><body name="arm"><joint name="elbow" axis="0 1 0" damping="0.1"/>
    <geom name="tube" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.8"/></body></worldbody>
  <actuator>{}</actuator>
</mujoco>
"""
MOTOR = '<motor name="motor" joint="elbow"/>'
ARM_MAPPING = """
version: 1
model: arm.xml
parameters:
  - {name: mass, field: body_mass, of: [arm], unit: kg, low: 0.5, high: 1.5}
logs:
  - {path: "*.npz"}
time: {column: t}
controls:
  "ctrl:motor": {column: u, unit: N m}
channels:
  "joint:elbow:pos": {column: q, unit: rad, noise: 0.000001}
  "joint:elbow:vel": {column: v, unit: rad/s, noise: 0.00001}
"""


def remembering(
    folder: Path, actuator: str, *effect: object, split: str = "{by: time}"
) -> tuple[Path, Path | None, np.ndarray]:
    """Logs that a machine with a memory made, without noise: their mapping, the fit that knows it, and the first's q.

    With the split `by: time` there is one, else three, each a row shorter than the one before.
    """
    (folder / "arm.xml").write_text(ARM.format(actuator))
    (folder / "mapping.yaml").write_text(ARM_MAPPING + f"split: {split}\n")
    model = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
    effects = [build_effect(*effect)] if effect else []  # type: ignore[arg-type]
    t = np.arange(1600) * 0.005
    u = np.repeat((0.7 * np.sin(4 * t) + 0.5 * np.sin(9 * t + 1) + 0.4 * np.sin(17 * t))[::2], 2)
    plant = Plant(model, ParameterSpace(model, []), [e for e, _ in effects], nthread=1)
    still = np.zeros((1, 1))
    segments = Segments(0.005, 0, still, still, u[None, :, None], channels=frozenset())
    motion = plant.shoot(np.concatenate([plant.space.nominal, *(theta for _, theta in effects)])[None], segments)
    q, v = (a[0, 0, :-1:2, 0] for a in (motion.qpos, motion.qvel))
    columns = {"u": u[::2], "q": q, "v": v}
    for k in range(1 if "time" in split else 3):  # equal logs would be refused
        np.savez(folder / f"run_{k}.npz", t=t[: len(t) - 2 * k : 2], **{n: a[: len(q) - k] for n, a in columns.items()})
    rows = [to_row(e, theta) for e, theta in effects]
    none = {"psi": {}, "effects": []}
    fit = {"fold": "", "nominal": none, "calibrated": none, "extended": {"psi": {}, "effects": rows}}
    (folder / "fit.json").write_text(json.dumps(fit))
    return folder / "mapping.yaml", folder if effect else None, q


@pytest.mark.parametrize("restart", [None, 1.0, 0.37])
@pytest.mark.parametrize(
    ("actuator", "effect", "allowed"),
    [
        (MOTOR, ("delay", "motor", {"delay": 0.1}), 1e-4),
        (MOTOR, ("lag", "motor", {"time_constant": 0.1}), 1e-4),
        (MOTOR, ("thermal", "motor", {"fade": 0.5, "time_constant": 5.0, "reference": 0.5}), 1e-4),
        (MOTOR, ("hysteresis", "elbow", {"level": 0.3, "transition": 0.2}), 1e-3),
        (MOTOR.replace("/>", ' delay="0.1" nsample="20" interp="linear"/>'), (), 1e-4),
        ('<general name="motor" joint="elbow" dyntype="filterexact" dynprm="0.1"/>', (), 1e-4),
    ],
)
def test_what_remembers_goes_on_where_a_piece_begins(
    tmp_path: Path, actuator: str, effect: tuple, allowed: float, restart: float | None
) -> None:
    """Of a log cut by time, too: what it was told before is known."""
    # What was measured before a cut is another part's own, so that joints forget there.
    split = "{by: log}" if "hysteresis" in effect else "{by: time}"
    mapping, fit, q = remembering(tmp_path, actuator, *effect, split=split)
    stage = "extended" if fit else "nominal"
    found = predict(mapping, fit, "rollout", stage, tmp_path / "said" / "out.npz", restart=restart)["run_0"][:, 0]
    assert np.sqrt(np.mean((found - q) ** 2)) < allowed * np.std(q)


def test_pieces_side_by_side_are_those_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mapping, fit, _ = remembering(tmp_path, MOTOR, "lag", "motor", {"time_constant": 0.1})
    out = tmp_path / "said" / "out.npz"
    found = predict(mapping, fit, "rollout", "extended", out, restart=0.3)["run_0"]
    monkeypatch.setattr(sys.modules["nfc_gym.measured.predict"], "_ABREAST", 1)
    np.testing.assert_array_equal(predict(mapping, fit, "rollout", "extended", out, restart=0.3)["run_0"], found)
