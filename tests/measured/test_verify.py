"""What verification says where there is nothing to verify on."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, InputError, Log
from nfc_gym.core.files import require_writable
from nfc_gym.measured.cuts import Layout
from nfc_gym.measured.outcome import _REPLICAS
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import estimate_states
from nfc_gym.measured.verdict import Models, Verified, bound, gain_interval, null_bound, taken_away, verify
from nfc_gym.physics.effects import build
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant

DT = 0.01
MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody><body><joint name="hinge" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.3"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""


def test_a_model_that_is_unstable_on_every_segment_is_said_so() -> None:
    """Angles of 1e160 rad, of another machine or in another unit."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    rng, time = np.random.default_rng(0), DT * np.arange(100)
    huge = {"joint:hinge:pos": Channel(1e160 * (1 + rng.normal(size=100)), noise=1e-3)}
    log = Log("run", time, {"ctrl:motor": np.zeros(100)}, huge)
    layout = Layout(0.4, 0.0, (0.1, 0.4), 0.4, DT)
    problem = RolloutProblem(model, [log], [estimate_states(model, log)], layout)
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    bare = (plant, plant.null)
    with pytest.raises(InputError, match="unstable on every segment that verifies"), np.errstate(all="ignore"):
        verify(problem, Models(bare, bare, bare), 2, rng)


def test_a_perfect_model_is_above_its_bound_once_in_twenty_whatever_twins_were_drawn() -> None:
    """Of a score of clusters, of unlike size and with long tails, and with the number of twins that a run draws."""
    rng, mean = np.random.default_rng(4), np.random.default_rng(5).gamma(4.0, size=20)
    mean /= mean.sum()
    draw = lambda *count: mean * rng.exponential(size=(*count, 20))  # noqa: E731
    twins: list[Any] = [SimpleNamespace(null=s.sum(1), shares=s) for s in draw(2000, _REPLICAS)]
    bounds, perfect = np.array([null_bound(v) for v in twins]), draw(8000).sum(1)
    assert (perfect[:, None] > bounds).mean() == pytest.approx(0.05, abs=0.01)
    assert bounds.std() < 0.4 * perfect.std()


def swung(noise: float, stiffness: float) -> Verified:
    """A pendulum whose hinge has a spring of 2 N m/rad, as it is verified by models with none, and with this one."""
    rng, time = np.random.default_rng(0), DT * np.arange(300)
    sprung = MODEL.replace('axis="0 1 0"', 'axis="0 1 0" stiffness="2"')
    model = mujoco.MjModel.from_xml_string(sprung)
    data = mujoco.MjData(model)
    command, angle = np.sin(3 * time), []
    for u in command:
        angle.append(float(data.qpos[0]))
        data.ctrl[0] = u
        mujoco.mj_step(model, data)
    seen = {"joint:hinge:pos": Channel(np.array(angle) + noise * rng.normal(size=300), noise=noise)}
    log = Log("run", time, {"ctrl:motor": command}, seen)
    bare = mujoco.MjModel.from_xml_string(MODEL)
    problem = RolloutProblem(bare, [log], [estimate_states(bare, log)], Layout(0.4, 0.0, (0.1, 0.4), 0.4, DT))
    plant = Plant(bare, ParameterSpace(bare, []), nthread=1)
    spring, theta = build("spring_offset", "hinge", {"stiffness": stiffness, "rest": 0.0})
    plain, mended = (plant, plant.null), (plant.with_effects([spring]), theta)
    return verify(problem, Models(plain, plain, mended), 2, rng)


@pytest.mark.parametrize("noise", [1e-3, 1e-8])
def test_what_a_model_mends_shows_however_little_noise_the_logs_have(noise: float) -> None:
    """Logs that were smoothed: every number may lie a thousand standard errors off, and most be mended."""
    found = swung(noise, 1.5)
    left = found.chi2("extended") / found.chi2("calibrated")
    assert left < 0.3
    low, high = gain_interval(found, np.random.default_rng(0))
    assert low <= left <= high < 0.5


def test_one_wild_block_does_not_decide() -> None:
    found = swung(1e-3, 1.5)
    usual = found.chi2("calibrated")
    wild = {stage: white.copy() for stage, white in found.white.items()}
    wild["calibrated"][0] = 1e9
    spoilt = replace(found, white=wild)
    assert usual < spoilt.chi2("calibrated") < found.most
    assert bound(found.problem, wild["calibrated"]) == pytest.approx(found.most, rel=0.5)
    assert bound(found.problem, np.full_like(wild["calibrated"], np.inf)) == 1e4
    assert bound(found.problem, np.full_like(wild["calibrated"], 0.7)) == 1e4


def test_what_clusters_add_is_the_whole_of_a_twin() -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    rng, time = np.random.default_rng(0), DT * np.arange(300)
    angle = {"joint:hinge:pos": Channel(0.5 * np.sin(time) + 1e-3 * rng.normal(size=300), noise=1e-3)}
    log = Log("run", time, {"ctrl:motor": np.zeros(300)}, angle)
    layout = Layout(0.2, 0.0, (0.1, 0.2), 0.2, DT)
    problem = RolloutProblem(model, [log], [estimate_states(model, log)], layout)
    plant = Plant(model, ParameterSpace(model, []), nthread=1)
    v = verify(problem, Models(*[(plant, plant.null)] * 3), 5, rng)
    assert 1 < v.shares.shape[1] < len(problem)
    assert v.shares.sum(1) == pytest.approx(v.null)
    assert (v.shares.std(0) > 0).all()


@pytest.mark.parametrize(
    ("before", "after", "share"),
    [
        ([5.0, 10.0], [5.0, 10.0], 0.0),
        ([5.0, 10.0], [1.0, 1.0], 1.0),  # down to the noise
        ([5.0, None], [3.0, 2.0], 1 - 8 / 24),
        ([5.0, 7.0], [np.sqrt(13), 5.0], 0.5),
        ([1.1, 5.0], [9.0, 3.0], 1 - 8 / 24),  # hardly beyond the noise before: not counted
        ([1.1, 1.0], [9.0, 3.0], 0.25),  # the noise makes up both: of the excess chi-squared
        ([5.0, 5.0], [1e200, 1.0], -np.inf),
    ],
)
def test_what_is_taken_away_is_counted_beyond_the_noise(
    before: list[float | None], after: list[float], share: float
) -> None:
    row = {"calibrated": before, "extended": after, "noise_floor": [1.0, 1.0]}
    v: Any = SimpleNamespace(null=np.ones(6), chi2={"calibrated": 1.4, "extended": 1.3}.__getitem__)
    assert taken_away(v, {"groups": {"angle": row}}) == pytest.approx(share, abs=0.01)


def test_an_option_is_no_place_to_write_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="--out --jobs looks like another option"):
        require_writable(Path("--jobs"))
    require_writable(tmp_path / "--jobs")
