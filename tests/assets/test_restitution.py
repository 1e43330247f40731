"""The measured table of damping ratios: a piece of the measurement again, between its rows too."""

import tomllib
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym import assets

WHEELS = ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")
GRAVITY = 9.81
TABLE: dict[str, Any] = tomllib.loads((assets.path("jackal").parents[1] / "restitution.toml").read_text())


def jackal_with(restitution: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_path(str(assets.path("jackal")))
    zeta = np.interp(restitution, TABLE["restitution"], TABLE["zeta"])
    for wheel in WHEELS:
        model.geom(wheel).solref[:] = -(TABLE["omega"] ** 2), -2 * zeta * TABLE["omega"]
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    return model, data


def rebound(model: mujoco.MjModel, data: mujoco.MjData, speed: float, phase: float) -> float:
    """Rebound over impact speed of a flat drop that starts `phase` of a step above the touch."""
    dt, touch = model.opt.timestep, model.geom(WHEELS[0]).size[0]

    def energy() -> float:  # per kg; the half-step term makes it exact along the integrator's free flight
        return (data.qvel[2] - GRAVITY * dt / 2) ** 2 / 2 + GRAVITY * (data.qpos[2] - touch)

    mujoco.mj_resetData(model, data)
    data.qpos[2], data.qvel[2] = touch + phase * speed * dt + 1e-9, -speed
    before, touched = energy(), False
    for _ in range(200):
        mujoco.mj_step(model, data)
        touched |= data.qpos[2] < touch
        if touched and data.qpos[2] > touch and data.qvel[2] > 0:
            return float(np.sqrt(energy() / before))
    return 0.0


@pytest.mark.parametrize("restitution", [0.0, 0.15, 0.25, 0.4, 0.55, 0.7, 0.8, 0.9])
@pytest.mark.parametrize("speed", [2.0, 2.5, 3.0])
def test_mean_over_phases_is_the_wanted_restitution(restitution: float, speed: float) -> None:
    model, data = jackal_with(restitution)
    values = [rebound(model, data, speed, phase) for phase in (np.arange(8) + 0.5) / 8]
    assert np.mean(values) == pytest.approx(restitution, abs=0.05)
    assert max(values) < 1.0


@pytest.mark.parametrize("restitution", [0.4, 0.8, 0.9])
def test_slower_impacts_never_bounce_more(restitution: float) -> None:
    model, data = jackal_with(restitution)
    for speed in (0.2, 0.5, 1.0, 1.5):
        assert np.mean([rebound(model, data, speed, p) for p in (0.1, 0.4, 0.7)]) < restitution + 0.05


@pytest.mark.parametrize("restitution", [0.4, 0.8, 0.9])
def test_no_bounce_is_higher_than_the_last(restitution: float) -> None:
    model, data = jackal_with(restitution)
    data.qpos[2] += 0.3
    heights = []
    for _ in range(1600):
        mujoco.mj_step(model, data)
        heights.append(data.qpos[2])
    z = np.array(heights)
    apexes = z[1:-1][(z[1:-1] > z[:-2]) & (z[1:-1] >= z[2:])]
    assert len(apexes) >= 2
    assert np.all(np.diff(apexes) <= 1e-4)
    assert apexes[0] < 0.4


def test_table_is_ordered_and_within_its_own_limits() -> None:
    assert np.all(np.diff(TABLE["restitution"]) > 0)
    assert np.all(np.diff(TABLE["zeta"]) < 0)
    assert TABLE["omega"] <= 50
    assert max(TABLE["highest"]) < 1
    model, _ = jackal_with(0.4)
    for wheel in WHEELS:
        np.testing.assert_allclose(model.geom(wheel).solimp, TABLE["solimp"])
    assert model.opt.timestep == TABLE["timestep"]
    assert model.opt.impratio == TABLE["impratio"]
    assert int(model.opt.cone) == int(mujoco.mjtCone.mjCONE_ELLIPTIC)
