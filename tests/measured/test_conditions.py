"""Several conditions fitted together: one drag coefficient, and a wind of its own for each day."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.measured.checks import check
from nfc_gym.measured.dataset import load
from nfc_gym.measured.excite import excite
from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.predict import predict
from nfc_gym.physics.effects import build
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.saved import from_row, to_row
from nfc_gym.wrappers import ApplyEffects

DT, SECONDS, NOISE = 0.01, 2.0, {"x": 0.002, "v": 0.01}
DRAG = 0.35  # N s/m
WINDS = {"calm": 0.0, "breeze": 1.5, "gale": 4.0}  # m/s along x

MODEL = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="sled">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <geom name="hull" size="0.1" mass="0.8"/>
    </body>
  </worldbody>
  <actuator><motor name="fx" joint="x"/><motor name="fy" joint="y"/></actuator>
</mujoco>
"""

MAPPING = """
version: 1
model: sled.xml
logs:
  - {path: "fit_*.npz", split: fit, condition: "fit_([a-z]+)_"}
  - {path: "select_*.npz", split: select, condition: "select_([a-z]+)"}
  - {path: "verify_*.npz", split: verify, condition: "verify_([a-z]+)"}
time: {column: t}
controls:
  "ctrl:fx": {column: fx, unit: N}
  "ctrl:fy": {column: fy, unit: N}
channels:
  "joint:x:pos": {column: px, unit: m, noise: 0.002}
  "joint:x:vel": {column: vx, unit: m/s, noise: 0.01}
  "joint:y:pos": {column: py, unit: m, noise: 0.002}
  "joint:y:vel": {column: vy, unit: m/s, noise: 0.01}
segments: {length: 0.4, history: 0.0, horizons: [0.1, 0.2, 0.4]}
effects: {only: [wind, external_force]}
"""


def record(wind: float, seed: int) -> dict[str, np.ndarray]:
    """A log of the sled in a wind, simulated with plain `mj_step` at a fifth of the step."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.opt.timestep = DT / 5
    data = mujoco.MjData(model)
    count = round(SECONDS / DT)
    t = DT * np.arange(count)
    rate, phase = rng.uniform(2, 9, (2, 3)), rng.uniform(0, 6, (2, 3))
    force = 2.0 * np.sin(rate[:, :, None] * t + phase[:, :, None]).mean(1)
    rows = np.empty((count, 4))
    for k in range(count):
        rows[k] = [*data.qpos, *data.qvel]
        data.ctrl[:] = force[:, k]
        for _ in range(5):
            data.qfrc_applied[:] = DRAG * (np.array([wind, 0.0]) - data.qvel)
            mujoco.mj_step(model, data)
    rows += rng.normal(size=rows.shape) * [NOISE["x"], NOISE["x"], NOISE["v"], NOISE["v"]]
    names = ("px", "py", "vx", "vy")
    return {"t": t, "fx": force[0], "fy": force[1]} | {n: rows[:, i] for i, n in enumerate(names)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of three days."""
    folder = tmp_path_factory.mktemp("days")
    (folder / "sled.xml").write_text(MODEL)
    (folder / "mapping.yaml").write_text(MAPPING)
    for i, (day, wind) in enumerate(WINDS.items()):
        for j, name in enumerate((f"fit_{day}_0", f"fit_{day}_1", f"select_{day}", f"verify_{day}")):
            np.savez(folder / f"{name}.npz", **record(wind, 10 * i + j))
    return folder


@pytest.fixture(scope="module")
def report(folder: Path) -> Mapping[str, Any]:
    """The loop closed on them."""
    return close_loop(folder / "mapping.yaml", folder / "out", jobs=1)


def test_one_drag_and_a_wind_for_each_day(report: Mapping[str, Any]) -> None:
    (found,) = report["effects"]
    assert (found["id"], found["conditions"]) == ("wind:sled:conditions", ["breeze", "calm", "gale"])
    assert (found["family"], found["where"]) == ("wind", "sled")
    assert report["verdict"] == "explained"
    values = found["parameters"]
    assert values["drag"]["value"] == pytest.approx(DRAG, rel=0.05)
    for day, wind in WINDS.items():
        push = values[f"push_x@{day}"]
        assert push["low"] - 0.01 < DRAG * wind < push["high"] + 0.01
        assert push["value"] == pytest.approx(DRAG * wind, abs=0.03)
    assert "In gale: Steady wind" in found["sentence"]


def test_every_log_is_predicted_in_its_own_condition(folder: Path, report: Mapping[str, Any]) -> None:
    rolled = {
        stage: predict(folder / "mapping.yaml", folder / "out", "rollout", stage, folder / f"{stage}.npz")
        for stage in ("calibrated", "extended")
    }
    for day in WINDS:
        truth = np.load(folder / f"verify_{day}.npz")["px"]
        errors = {s: np.sqrt(np.mean((r[f"verify_{day}"][:, 0] - truth) ** 2)) for s, r in rolled.items()}
        assert errors["extended"] < 0.3 * errors["calibrated"]


def test_commands_are_proposed_for_the_condition_of_the_first_log(
    report: Mapping[str, Any], folder: Path, tmp_path: Path
) -> None:
    found = excite(
        folder / "mapping.yaml", folder / "out", tmp_path / "next.csv", jobs=1, seconds=1.0, tries=2, budget=0.1
    )
    assert found["sentences"]
    assert (tmp_path / "next.csv").exists()


def test_a_condition_that_was_never_fitted_is_named(folder: Path, report: Mapping[str, Any], tmp_path: Path) -> None:
    for file in ("sled.xml", "verify_gale.npz"):
        (tmp_path / file).write_bytes((folder / file).read_bytes())
    for name in ("fit_storm_0", "select_storm", "verify_storm"):
        (tmp_path / f"{name}.npz").write_bytes((folder / "verify_gale.npz").read_bytes())
    (tmp_path / "verify_gale.npz").unlink()
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    with pytest.raises(InputError, match=r"no values for the condition 'storm'.*breeze, calm, gale"):
        predict(tmp_path / "mapping.yaml", folder / "out", "rollout", "extended", tmp_path / "p.npz")


def test_a_day_that_no_log_is_fitted_to_is_told_of(folder: Path, tmp_path: Path) -> None:
    for file in folder.glob("*.npz"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    for name in ("sled.xml", "mapping.yaml"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    assert "'gale'" not in "".join(map(str, check(tmp_path / "mapping.yaml")))
    for k in range(2):
        (tmp_path / f"fit_gale_{k}.npz").unlink()
    (found,) = (f for f in check(tmp_path / "mapping.yaml") if "'gale'" in str(f))
    assert found.severity == "warning"
    assert "is fitted to" in str(found)


def test_a_pattern_that_does_not_match_is_named(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "sled.xml").write_text(MODEL)
    (tmp_path / "fit_0.npz").write_bytes((folder / "fit_calm_0.npz").read_bytes())
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    with pytest.raises(InputError, match=r"condition pattern .* does not match the file name 'fit_0'"):
        load(tmp_path / "mapping.yaml")


def test_saved_and_read_back(report: Mapping[str, Any], folder: Path) -> None:
    (row,) = json.loads((folder / "out" / "fit.json").read_text())["extended"]["effects"]
    effect, theta = from_row(row)
    assert to_row(effect, theta) == row
    assert isinstance(effect, Conditioned)
    gale = effect.inside(theta, "gale")
    assert gale[3] == theta[[p.name for p in effect.params].index("drag")]


def test_a_wrapper_takes_one_condition() -> None:
    wind, _ = build("wind", "torso", {"push_x": 0, "push_y": 0, "push_z": 0, "drag": 0})
    both = Conditioned(wind, ["calm", "gale"])
    names = [p.name for p in both.params]
    theta = np.zeros(len(names))
    theta[names.index("drag")], theta[names.index("push_x@gale")] = 0.1, 0.7
    env = gym.make("Ant-v5")
    with pytest.raises(InputError, match="condition=, one of calm, gale"):
        ApplyEffects(env, [(both, theta)])
    wrapped = ApplyEffects(env, [to_row(both, theta)], condition="gale")
    assert wrapped.effects[0].id == "wind:torso"
    assert wrapped.thetas[0].tolist() == [0.7, 0, 0, 0.1]
    with pytest.raises(InputError, match="no values for the condition 'storm'"):
        ApplyEffects(env, [(both, theta)], condition="storm")
