"""What close-loop wrote, read and put into an environment: psi, the rest of the calibration, and the effects."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from scipy import stats

from nfc_gym import assets
from nfc_gym.adaptation.extended import Calibrated, Found, read_found
from nfc_gym.adaptation.extension import Extension, require_read
from nfc_gym.core.errors import InputError

WHEELS = ["front_left", "front_right", "rear_left", "rear_right"]
LOSS = {
    "id": "loss:rear_left", "family": "loss", "where": "rear_left", "sentence": "An axle is lost.",
    "parameters": {"fraction": {"value": 0.7, "low": 0.6, "high": 0.8, "unit": "1"}},
}  # fmt: skip
DRAG = {
    "id": "drag_linear:base", "family": "drag_linear", "where": "base",
    "parameters": {k: {"value": 8.0, "low": 7.0, "high": 9.0, "unit": "N s/m"} for k in "xyz"},
}  # fmt: skip
JOINTS = [f"{w}_wheel" for w in WHEELS]
PSI = [
    {"name": "servo", "unit": "N m s/rad", "field": "servo_kv", "of": WHEELS, "estimate": 6.0, "low": 5.5, "high": 6.5},
    {"name": "rotor", "unit": "kg m^2", "field": "dof_armature", "of": JOINTS}
    | {"estimate": 0.05, "low": 0.04, "high": 0.06},
]  # fmt: skip
ID = "nfc_gym/JackalFlat-v0"


def write(folder: Path, effects: list[Any], report: dict[str, Any] | None = None, **more: Any) -> Path:
    """A folder as close-loop leaves it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "effects.yaml").write_text(yaml.safe_dump({"version": 1, "effects": effects, **more}))
    if report is not None:
        (folder / "report.json").write_text(json.dumps(report))
    return folder


def corrected(path: Path, **servo: float) -> Path:
    """A model.xml of the Jackal with a lighter servo and friction in a joint."""
    spec = mujoco.MjSpec.from_file(str(assets.path("jackal")))
    for name, gain in servo.items():
        spec.actuator(name).gainprm[0], spec.actuator(name).biasprm[2] = gain, -gain
    spec.joint("rear_left_wheel").frictionloss = 0.4
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(spec.to_xml())
    return path


def found_in(path: Path, **more: Any) -> Extension:
    return Extension(read_found(path), ID, **more)


def test_report_and_effects_go_into_the_simulation(tmp_path: Path) -> None:
    """The effect that model.xml carries comes from the report; the servo is psi, the rotor's inertia is not."""
    report = {"effects": [LOSS, DRAG], "parameters": PSI, "verdict": "explained"}
    folder = write(tmp_path, [DRAG], report, carried_by_model=["loss:rear_left"])
    x = found_in(folder)
    assert [e.id for e in x.effects] == ["loss:rear_left", "drag_linear:base"]  # as they were fitted
    assert all(e.acts for e in x.effects)
    assert set(x.moved) == {f"{w}_wheel_damping" for w in WHEELS} | {"rotor"}
    *servos, rotor = x.told()
    assert [(r["psi"], r["nominal"], r["estimate"]) for r in servos] == [(True, 5.0, 6.0)] * 4
    assert rotor == {
        "name": "rotor", "unit": "kg m^2", "nominal": 0.005, "estimate": 0.05, "low": 0.04, "high": 0.06, "psi": False,
    }  # fmt: skip
    envs = x.envs(3, threads=1)
    envs.reset(seed=0)
    fields = envs.unwrapped.fields
    np.testing.assert_allclose(fields["actuator_gainprm"][:, :, 0], np.tile([6.0, 6.0, 0.3 * 6.0, 6.0], (3, 1)))
    np.testing.assert_allclose(fields["dof_armature"][:, 6:], 0.05)
    np.testing.assert_allclose(envs.unwrapped.psi, np.tile(x.psi, (3, 1)))
    bare = x.without("loss:rear_left").envs(2, threads=1)
    bare.reset(seed=0)
    np.testing.assert_allclose(bare.unwrapped.fields["actuator_gainprm"][:, :, 0], 6.0)
    assert [e.id for e in x.effects] == ["loss:rear_left", "drag_linear:base"]


def test_sizes_vary_within_their_intervals(tmp_path: Path) -> None:
    x = found_in(write(tmp_path, [LOSS], {"effects": [LOSS], "parameters": PSI}))
    envs = x.envs(40, vary=1.0, seed=3, threads=1)
    envs.reset(seed=0)
    fields = envs.unwrapped.fields
    gain = fields["actuator_gainprm"][:, :, 0].copy()
    np.testing.assert_array_equal(gain[:, 0], gain[:, 3])  # the wheels share a servo
    assert 5.5 <= gain[:, 0].min() < 5.8 < 6.2 < gain[:, 0].max() <= 6.5
    left = gain[:, 2] / gain[:, 0]
    assert 0.2 - 1e-9 <= left.min() < 0.25 < 0.35 < left.max() <= 0.4 + 1e-9
    rotor = fields["dof_armature"][:, 6:].copy()
    assert 0.04 <= rotor.min() < 0.045 < 0.055 < rotor.max() <= 0.06
    # A row that begins anew has another psi, and the sizes that it had.
    mask = np.arange(40) % 3 == 1
    envs.reset(options={"reset_mask": mask})
    again = fields["actuator_gainprm"][:, :, 0]
    np.testing.assert_allclose(again[:, 2] / again[:, 0], left)
    np.testing.assert_array_equal(fields["dof_armature"][:, 6:], rotor)
    assert ((again[:, 0] != gain[:, 0]) == mask).all()
    wide = x.envs(40, vary=10.0, seed=3, threads=1)
    wide.reset(seed=0)
    kept = wide.unwrapped.fields["actuator_gainprm"][:, :, 0]
    assert (kept >= 0).all()  # ten times the interval would be a loss of more than everything


@pytest.mark.parametrize("vary", [2.0, 5.0])
def test_wider_sizes_end_where_nature_does(vary: float) -> None:
    """Beyond the intervals, uniformly: nothing below 0, and nothing piled up at a bound."""
    grip = Calibrated("grip", "1", "geom_friction[0]", ("front_left_wheel",), 0.3, 0.1, 0.5)
    rotor = Calibrated("rotor", "kg m^2", "dof_armature", ("front_left_wheel",), 0.02, 0.01, 0.03)
    load = Calibrated("load", "kg", "body_mass", ("base",), 2.0, 0.5, 4.0)
    envs = Extension(Found(Path("x"), parameters=(grip, rotor, load)), ID).envs(400, vary=vary, threads=1)
    envs.reset(seed=0)
    fields = envs.unwrapped.fields
    model = fields.nominal_model
    at = [model.geom("front_left_wheel").id, model.joint("front_left_wheel").dofadr[0], model.body("base").id]
    drawn = [fields["geom_friction"][:, at[0], 0], fields["dof_armature"][:, at[1]], fields["body_mass"][:, at[2]]]
    for values, p in zip(drawn, (grip, rotor, load), strict=True):
        high = p.value + vary * (p.high - p.value)
        low = max(p.value - vary * (p.value - p.low), 0.0)
        assert len(np.unique(values)) > 350  # episodes draw psi from a few thousand
        assert stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > 1e-3
        assert low <= values.min()
        assert values.max() <= high


def test_a_model_alone_is_read_field_by_field(tmp_path: Path) -> None:
    x = found_in(corrected(tmp_path / "model.xml", front_left=3.0))
    assert x.effects == ()
    assert dict(zip(x.space.names, x.psi, strict=True))["front_left_wheel_damping"] == 3.0
    for environment in (ID, "nfc_gym/JackalRough-v0"):
        pool = {"terrain_pool": 1} if "Rough" in environment else {}
        envs = Extension(read_found(tmp_path), environment).envs(2, threads=1, settings=pool)
        envs.reset(seed=0)
        model, fields = envs.unwrapped.fields.nominal_model, envs.unwrapped.fields
        dof = model.joint("rear_left_wheel").dofadr[0]
        np.testing.assert_allclose(fields["dof_frictionloss"][:, dof], 0.4)
        np.testing.assert_allclose(fields["actuator_gainprm"][0, :, 0], [3.0, 5.0, 5.0, 5.0])
        np.testing.assert_allclose(fields["actuator_biasprm"][0, :, 2], [-3.0, -5.0, -5.0, -5.0])


def test_a_hand_written_world_has_psi_by_name(tmp_path: Path) -> None:
    x = found_in(write(tmp_path, [], psi={"base_mass": 20.0}))
    assert x.moved == ("base_mass",)
    with pytest.raises(InputError, match=r"no parameter named 'bse_mass'; there are: base_mass, .*\(of nfc_gym/Jack"):
        found_in(write(tmp_path, [], psi={"bse_mass": 20.0}))


def test_psi_by_name_and_a_model_that_say_otherwise_are_refused(tmp_path: Path) -> None:
    corrected(tmp_path / "model.xml", front_left=3.0)
    told = write(tmp_path, [], psi={"front_left_wheel_damping": 4.0})
    with pytest.raises(InputError, match=r"psi is said to have front_left_wheel_damping = 4, and .*model\.xml has 3;"):
        found_in(told)
    x = found_in(write(tmp_path, [], psi={"front_left_wheel_damping": 3.0, "base_mass": 20.0}))
    envs = x.envs(2, threads=1)
    envs.reset(seed=0)
    assert envs.unwrapped.fields["body_mass"][0, x.model.body("base").id] == pytest.approx(20.0)
    np.testing.assert_allclose(envs.unwrapped.fields["actuator_gainprm"][0, 0, 0], 3.0)


def test_effects_on_sensors_change_nothing_that_moves(tmp_path: Path) -> None:
    bias = {"family": "sensor_bias", "where": "joint:rear_left_wheel:vel", "parameters": {"bias": 0.1}}
    (effect,) = found_in(write(tmp_path, [bias])).effects
    assert not effect.acts


def test_signals_and_conditions_must_be_said(tmp_path: Path) -> None:
    sag = {"family": "supply_sag", "where": WHEELS, "parameters": {"exponent": 1.0, "reference": 24.0}}
    pushes = {f"push_{axis}@{day}": 5.0 * (day == "gale") for day in ("calm", "gale") for axis in "xyz"}
    wind = {"family": "wind", "where": "base", "conditions": ["calm", "gale"], "parameters": {"drag": 1.0, **pushes}}
    with pytest.raises(InputError, match="reads 'exo:supply': give it"):
        found_in(write(tmp_path / "a", [sag]))
    found_in(write(tmp_path / "a", [sag]), signals={"exo:supply": 20.0})
    with pytest.raises(InputError, match="say --condition, one of calm, gale"):
        found_in(write(tmp_path / "b", [wind]))
    (effect,) = found_in(write(tmp_path / "b", [wind]), condition="gale").effects
    np.testing.assert_array_equal(effect.theta, [5.0, 5.0, 5.0, 1.0])
    supply = {"exo:supply": 20.0}
    read, windy = found_in(tmp_path / "a", signals=supply), found_in(tmp_path / "b", condition="gale")
    require_read([read, windy], "gale", supply)  # of two models it will do if one asks for it
    with pytest.raises(
        InputError, match="exo:foo: no effect reads it, leave it out; signals that are read: exo:supply"
    ):
        require_read([read], None, {**supply, "exo:foo": 3.0})
    with pytest.raises(InputError, match="signals that are read: none"):
        require_read([windy], "gale", supply)
    with pytest.raises(InputError, match="--condition gale: no effect differs between conditions, leave it out"):
        require_read([read], "gale", supply)


def lost(**fraction: float) -> dict[str, Any]:
    return {**LOSS, "parameters": {"fraction": fraction}}


@pytest.mark.parametrize(
    ("effects", "report", "more", "says"),
    [
        ([], None, {}, "nothing to adapt to: no effect is named"),
        ([], {"effects": [], "parameters": [], "verdict": "nothing missing"}, {}, "the verdict is 'nothing missing'"),
        ([{**LOSS, "where": "rear_middle"}], None, {}, "no actuator named 'rear_middle'; it has: front_left, "),
        ([{**LOSS, "family": "lost"}], None, {}, "no family of effects named 'lost'"),
        ([lost(value=float("nan"))], None, {}, "must be a finite number"),
        ([LOSS, LOSS], None, {}, "'loss:rear_left' is there twice"),
        ([lost(value=0.7, low=0.8, high=0.9)], None, {}, "outside its interval from 0.8 to 0.9"),
        ([lost(value=0.7, low=float("nan"))], None, {}, "low is nan"),
        ([], None, {"carried_by_model": ["loss:rear_left"]}, "carries loss:rear_left, and neither"),
        ([], {"effects": [], "parameters": []}, {"carried_by_model": ["loss:x"]}, "are of two runs: 'loss:x'"),
        ([], {"folds": {"a": {}, "b": {}}}, {}, "summary over folds; give the folder of one: a, b"),
        ([], {"effects": []}, {}, "no `effects` and `parameters`"),
        ([], {"effects": [], "parameters": [{"name": "m"}]}, {}, "does not say where parameter 'm' goes"),
        ([], {"effects": [], "parameters": [{**PSI[0], "estimate": None}]}, {}, "servo estimate is None"),
        ([], {"effects": [], "parameters": [{**PSI[0], "of": ["rear"]}]}, {}, "no actuator named 'rear'"),
        ([LOSS], None, {"psi": {"base_mass": "heavy"}}, "psi base_mass is 'heavy'"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_named(tmp_path: Path, effects: list, report: dict | None, more: dict, says: str) -> None:
    folder = write(tmp_path, effects, report, **more)
    with pytest.raises(InputError, match=says):
        found_in(folder).require_something()


def test_models_that_are_not_ours_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        read_found(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"with effects.yaml, report.json or model.xml; it has: nothing"):
        read_found(tmp_path / "empty")
    (tmp_path / "ant.xml").write_text(assets.path("ant").read_text())
    with pytest.raises(InputError, match="is no model of nfc_gym/JackalFlat-v0: it has the body 'torso'"):
        found_in(tmp_path / "ant.xml")
    (tmp_path / "broken.xml").write_text("<mujoco><nothing/></mujoco>")
    with pytest.raises(InputError, match="not a model that MuJoCo can read"):
        found_in(tmp_path / "broken.xml")
    spec = mujoco.MjSpec.from_file(str(assets.path("jackal")))
    spec.actuator("rear_left").dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
    spec.actuator("rear_left").dynprm[0] = 0.05
    (tmp_path / "lag.xml").write_text(spec.to_xml())
    with pytest.raises(InputError, match=r"gives 'rear_left' a lag .* keep the report.json"):
        found_in(tmp_path / "lag.xml")
