"""Sizes that candidates take from the logs."""

import re
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nfc_gym import assets
from nfc_gym.core import InputError
from nfc_gym.measured.bench import candidates, make_bench, scales
from nfc_gym.measured.checks import require
from nfc_gym.measured.model import bare
from nfc_gym.physics.effects import build as effect
from nfc_gym.physics.effects.each import split

PUSH = 20 * np.sin(0.05)  # of a servo of 10 N m/rad whose goal leads a swing of 1 rad by 0.1 rad of phase
Build = Callable[..., Path]
SLIP = ("lateral", "longitudinal")


def with_ankle(machine: str) -> str:
    """The machine with a second joint below the first."""
    weight = '<geom name="weight" size="0.02" pos="0 0 -0.1" mass="0.1"/>'
    foot = '<body name="foot"><joint name="ankle" axis="0 1 0"/><geom size="0.02" pos="0 0 -0.2" mass="0.05"/></body>'
    assert weight in machine
    return machine.replace(weight, weight + foot).replace(
        "</actuator>", '<position name="second" joint="ankle" kp="10"/></actuator>'
    )


def test_the_largest_push_is_what_the_servo_made_of_the_error_it_saw(build: Build) -> None:
    dataset = require(build())[0]
    found = scales(make_bench(dataset, 1), dataset.logs)
    assert found.push is not None
    assert found.push[0] == pytest.approx(PUSH, rel=0.03)
    assert not found.push[1:].any()  # nothing drives the base


def test_behind_a_firmware_servo_a_drive_is_sized_by_what_the_servo_makes(build: Build, machine: str) -> None:
    """Goals of a radian become commands of 20 sin(0.05) N m; the goal's own effects keep the goal's size."""
    model = re.sub(r'<position name="servo"[^>]*/>', '<motor name="servo" joint="hinge"/>', machine)
    goal = "{column: goal, unit: rad}"
    served = goal.replace("}", ", servo: {joint: hinge, gain: 10}}")
    dataset = require(build(None, (goal, served), model=model))[0]
    found = scales(make_bench(dataset, 1), dataset.logs)
    assert found.drive[0] == pytest.approx(PUSH / np.sqrt(2), rel=0.2)
    assert found.command[0] == pytest.approx(1 / np.sqrt(2), rel=0.2)


def test_a_limit_is_sized_alike_whether_or_not_the_motor_has_a_filter(build: Build, machine: str) -> None:
    """Of a motor behind a fast filter the force is that of its command, and not of a state of zero."""
    found = {}
    for name, actuator in (("plain", ""), ("filtered", 'dyntype="filterexact" dynprm="0.001"')):
        model = re.sub(r'<position name="servo"[^>]*/>', f'<general name="servo" joint="hinge" {actuator}/>', machine)
        dataset = require(build(None, ("{column: goal, unit: rad}", "{column: goal, unit: N m}"), model=model))[0]
        proposed = candidates(make_bench(dataset, 1), dataset.logs)
        (effect,) = [e for e in proposed if e.family == "saturation"]
        found[name] = [*effect.params[0].probes, effect.params[0].high]
    np.testing.assert_allclose(found["filtered"], found["plain"], rtol=0.05)


def test_an_integrating_servo_is_sized_by_what_its_joint_needs(build: Build, machine: str) -> None:
    """Its target is not logged: the force that holds and moves the joint is what it must have made."""
    model = re.sub(
        r'<position name="servo"[^>]*/>', '<intvelocity name="servo" joint="hinge" kp="10" actrange="-9 9"/>', machine
    )
    dataset = require(build(None, ("{column: goal, unit: rad}", "{column: goal, unit: rad/s}"), model=model))[0]
    found = scales(make_bench(dataset, 1), dataset.logs)
    assert found.actuation[0] > 1e-3
    assert found.actuation[0] == pytest.approx(found.force[0], rel=0.5)


def test_noise_is_no_push(build: Build) -> None:
    """Measured twenty times as coarsely, a goal that is reached exactly pushes nothing worth naming."""
    rng = np.random.default_rng(0)

    def spoil(table: dict[str, np.ndarray]) -> None:
        table["goal"] = np.sin(3 * table["t"])
        table["q"] = table["goal"] + 0.02 * rng.standard_normal(len(table["t"]))
        table["v"] = 3 * np.cos(3 * table["t"])

    dataset = require(build(spoil, ("unit: rad, noise: 0.001", "unit: rad, noise: 0.02")))[0]
    bench = make_bench(dataset, 1)
    raw = 10 * np.quantile(np.abs(table_error(dataset)), 0.99)
    push = scales(bench, dataset.logs).push
    assert push is not None
    assert raw > 0.4
    assert push[0] < 0.2 * raw


def table_error(dataset) -> np.ndarray:
    """Goal less measured angle of every sample."""
    return np.concatenate([log.controls["ctrl:servo"] - log.channels["joint:hinge:pos"].values for log in dataset.logs])


def test_values_of_their_own_have_bounds_of_their_own(build: Build, machine: str) -> None:
    """What bounds both joints alike would be wrong for each."""
    goal = '"ctrl:servo": {column: goal, unit: rad}'
    path = build(still, (goal, f'{goal}\n  "ctrl:second": {{column: still, unit: rad}}'), model=with_ankle(machine))
    dataset = require(path)[0]
    bench = make_bench(dataset, 1)
    pool = {e.id: e for e in candidates(bench, dataset.logs)}
    apart = split(pool["coulomb:hinge+ankle"], bench.plant)
    assert apart is not None
    highs = {p.name: p.high for p in apart[0].params}
    for joint in ("hinge", "ankle"):
        assert highs[f"level@{joint}"] == pool[f"coulomb:{joint}"].params[0].high
    assert highs["level@hinge"] > highs["level@ankle"]


def still(table: dict[str, np.ndarray]) -> None:
    """A goal for the ankle."""
    table["still"] = np.zeros_like(table["t"])


@pytest.mark.parametrize("robot", assets.ROBOTS)
def test_what_is_only_looked_at_changes_no_bit_of_a_motion(robot: str) -> None:
    spec = mujoco.MjSpec.from_file(str(assets.path(robot)))
    whole, lean = spec.compile(), bare(spec).compile()
    assert lean.ngeom < whole.ngeom
    ends = []
    for model in (whole, lean):
        rng, data = np.random.default_rng(0), mujoco.MjData(model)
        for _ in range(200):  # long enough for all of them to land
            data.ctrl[:] = rng.uniform(-1, 1, model.nu)
            mujoco.mj_step(model, data)
        ends.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_array_equal(ends[0], ends[1])


def test_a_geom_that_is_asked_for_by_name_stays() -> None:
    spec = mujoco.MjSpec.from_file(str(assets.path("quadruped")))
    assert "base_shell" not in [g.name for g in bare(spec).geoms]
    assert "base_shell" in [g.name for g in bare(spec, {"base_shell"}).geoms]
    assert "base_shell" in [g.name for g in spec.geoms]


def test_what_nothing_drives_has_candidates_too(build: Build, machine: str) -> None:
    """A free pendulum: its logs hold no commands."""
    servo = 'controls:\n  "ctrl:servo": {column: goal, unit: rad}\n'
    model = re.sub(r"<actuator>.*</actuator>", "", machine, flags=re.DOTALL)
    dataset = require(build(None, (servo, ""), model=model))[0]
    bench = make_bench(dataset, 1)
    found = scales(bench, dataset.logs)
    assert found.command.shape == (0,)
    assert found.force[0] > 0.0
    assert "coulomb:hinge" in [e.id for e in candidates(bench, dataset.logs)]


def test_names_with_colons_are_measured_and_known(build: Build, machine: str) -> None:
    """`robot0:hinge`, as gymnasium-robotics names them: everything is sized and led as under another name."""
    residuals = []
    for name in ("hinge", "robot0:hinge"):
        bob = name.replace("hinge", "bob")
        model = machine.replace('"hinge"', f'"{name}"').replace('"bob"', f'"{bob}"')
        known = f'known:\n  - {{field: dof_damping, of: "{name}", column: worn}}\nchannels:'
        edits = [("joint:hinge", f"joint:{name}"), ("[bob]", f'["{bob}"]'), ("channels:", known)]
        dataset = require(build(lambda table: table.update(worn=0.01 + 0.001 * table["t"]), *edits, model=model))[0]
        bench = make_bench(dataset, 1)
        assert f"sensor_bias:joint:{name}:pos" in [e.id for e in candidates(bench, dataset.logs)]
        residuals.append(bench.problem(dataset.logs, 4).residual(bench.plant, bench.plant.null))
    np.testing.assert_array_equal(*residuals)


def test_laws_of_the_ground_may_be_asked_in_inverse_mode(build: Build, machine: str) -> None:
    """They read gravity, an option of the model."""
    edits = [
        ('  "sensor:gyro"', '  "force:servo": {column: goal, unit: N m, noise: 0.01}\n  "sensor:gyro"'),
        ("{length: 0.4}", "{mode: inverse, length: 0.4}"),
    ]
    weight = '<geom name="weight" size="0.02" pos="0 0 -0.1" mass="0.1"/>'
    rim = '<body name="rim" pos="0 0 -0.1"><joint name="axle" axis="0 1 0"/><geom name="tyre" size="0.01"/></body>'
    dataset = require(build(None, *edits, model=machine.replace(weight, weight + rim)))[0]
    bench = make_bench(dataset, 1)
    problem, found = bench.problem(dataset.logs), []
    for size in (0.0, 0.3):
        law, theta = effect("slip", "tyre", dict.fromkeys(SLIP, size))
        x = np.concatenate([bench.plant.null, theta])[None]
        found.append(problem.residual(bench.plant.with_effects([law]), x))
    np.testing.assert_array_equal(found[0], problem.residual(bench.plant, bench.plant.null[None]))
    assert np.isfinite(found[1]).all()


def test_roll_outs_of_a_model_that_sleeps_are_awake(build: Build, machine: str) -> None:
    """MuJoCo lets no batch begin anywhere with sleep on; where nothing sleeps the motion is the same, to the bit."""
    flag = '<option><flag sleep="enable"/></option><worldbody>'
    residuals = []
    for model in (machine, machine.replace("<worldbody>", flag)):
        dataset = require(build(model=model))[0]
        bench = make_bench(dataset, 1)
        residuals.append(bench.problem(dataset.logs, 4).residual(bench.plant, bench.plant.null))
    np.testing.assert_array_equal(*residuals)


def test_a_state_that_no_log_shows_is_refused(build: Build, machine: str) -> None:
    flag = '<option integrator="discrete"><flag ipc="enable"/></option><worldbody>'
    with pytest.raises(InputError, match="flag 'ipc' keeps a state that no log shows; disable it"):
        require(build(model=machine.replace("<worldbody>", flag)))


def _one_arm(compiler: str = "", more: str = "") -> mujoco.MjSpec:
    """An arm of which one geom is only looked at, over a floor that nothing touches."""
    shown = 'contype="0" conaffinity="0"'
    return mujoco.MjSpec.from_string(
        f'<mujoco><compiler {compiler}/><worldbody><geom name="floor" type="plane" size="1 1 1" {shown}/>'
        '<body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0"/><geom name="tube" size="0.1" pos="0.2 0 0"/>'
        f'<geom name="shell" size="0.2" {shown}/><site name="eye" pos="0 0 -0.3" zaxis="0 0 -1"/></body></worldbody>'
        f"{more}</mujoco>"
    )


def test_inertias_that_are_had_from_geoms_alone_keep_the_geoms() -> None:
    """Gymnasium's reacher says so of geoms that touch nothing: MuJoCo refuses to leave these out."""
    spec = _one_arm('inertiafromgeom="true"')
    whole, lean = spec.compile(), bare(spec).compile()
    np.testing.assert_array_equal(lean.body_inertia, whole.body_inertia)
    assert bare(_one_arm()).compile().ngeom < whole.ngeom


def test_a_range_finder_sees_what_is_only_looked_at() -> None:
    spec = _one_arm(more='<sensor><rangefinder name="height" site="eye"/></sensor>')
    model = bare(spec).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.sensordata[0] == pytest.approx(0.7)


def test_where_slopes_cannot_follow_segments_are_shorter(build: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same stretch of the logs, to the last of the horizons that are left; `most` counts the mapping's segments."""
    dataset = require(build())[0]
    bench, segments = make_bench(dataset, 1), dataset.mapping.segments
    logs = dataset.of("fit")
    whole = bench.searched(logs)
    assert len(whole) == len(bench.problem(logs))
    short = make_bench(dataset, 1)
    monkeypatch.setattr("nfc_gym.measured.foresight.followed", lambda *_: 2)
    cut = short.searched(logs)
    assert cut.columns.horizon.max() == segments.horizons[1]
    apart = len(whole) - len(logs)  # the last of a log may share its beginning with the one before
    assert len(cut) >= apart * segments.length / segments.horizons[1]
    assert len(short.searched(logs, 2)) == round(2 * segments.length / segments.horizons[1])
    assert short.problem(logs).columns.horizon.max() == segments.horizons[-1]
