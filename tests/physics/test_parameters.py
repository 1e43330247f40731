"""psi: writing it into one model and a batch, always from nominal; reading, normalising, refusing."""

import copy

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco.batch import Batch

from nfc_gym.core.errors import InputError
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import Parameter, ParameterSpace

XML = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 1"/>
  <body name="base" pos="0 0 1"><freejoint/><geom name="hull" size=".1 .2 .3" type="box" mass="2"/>
    <body name="leg_l"><joint name="leg_l" axis="0 1 0"/><geom name="foot_l" size=".1" mass=".5"/></body>
    <body name="leg_r"><joint name="leg_r" axis="0 1 0"/><geom name="foot_r" size=".1" mass=".5"/></body></body>
</worldbody><actuator><velocity name="spin" joint="leg_l" kv="3"/>
<position name="hold" joint="leg_r" kp="20" kv="1"/></actuator></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(XML)
SPACE = ParameterSpace(
    MODEL,
    [
        Parameter("mass", "body_mass", ("base",), "kg", 1.0, 4.0),
        Parameter("grip", "geom_friction[0]", ("foot_l", "foot_r"), "1", 0.1, 2.0),
        Parameter("damping", "dof_damping", ("leg_l",), "N m s/rad", 0.0, 1.0),
        Parameter("kv", "servo_kv", ("spin",), "N m s/rad", 0.0, 9.0),
        Parameter("kp", "servo_kp", ("hold",), "N m/rad", 0.0, 90.0),
        Parameter("gravity", "opt.gravity[2]", (), "m/s^2", -12.0, -8.0, anchored=True),
        Parameter("bounce", "geom_restitution", ("hull",), "1", 0.0, 0.9, nominal=0.2),
    ],
)
VALUES = np.array([3.0, 1.5, 0.4, 5.0, 40.0, -9.0, 0.6])


def _written(psi: np.ndarray, times: int = 1) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(XML)
    fields = ModelFields(model)
    for _ in range(times):
        SPACE.write(fields, psi)
    fields.commit()
    return model


def test_nominal_is_read_from_the_model() -> None:
    np.testing.assert_allclose(SPACE.nominal, [2.0, 1.0, 0.0, 3.0, 20.0, -9.81, 0.2])


def test_values_arrive_where_they_should() -> None:
    model = _written(VALUES)
    assert model.body_mass[1] == 3.0
    np.testing.assert_array_equal(model.geom_friction[2:, 0], 1.5)
    np.testing.assert_array_equal(model.geom_friction[:2], MODEL.geom_friction[:2])
    assert model.dof_damping[6] == 0.4
    assert (model.actuator_gainprm[0, 0], model.actuator_biasprm[0, 2]) == (5.0, -5.0)
    assert (model.actuator_gainprm[1, 0], model.actuator_biasprm[1, 1]) == (40.0, -40.0)
    assert model.actuator_biasprm[1, 2] == MODEL.actuator_biasprm[1, 2]
    assert model.opt.gravity[2] == -9.0


def test_the_medium_is_a_parameter_of_one_model_and_of_each_of_a_batch() -> None:
    medium = [Parameter(n, f"opt.{n}", (), unit, 0.0, 2000.0) for n, unit in (("density", "kg/m^3"), ("viscosity", ""))]
    space, model = ParameterSpace(MODEL, medium), copy.copy(MODEL)
    np.testing.assert_array_equal(space.nominal, [MODEL.opt.density, MODEL.opt.viscosity])
    fields = ModelFields(model)
    space.write(fields, [998.0, 0.001])
    fields.commit()
    assert (model.opt.density, model.opt.viscosity) == (998.0, 0.001)
    batch = Batch(MODEL, 2, 1)
    space.write(ModelFields(batch), [[998.0, 0.001], [1.2, 0.0]])
    np.testing.assert_array_equal(batch.expand("opt.density"), [998.0, 1.2])
    np.testing.assert_array_equal(batch.expand("opt.viscosity"), [0.001, 0.0])
    with pytest.raises(InputError, match=r"'density' is -1 kg/m\^3, want 0 or more"):
        space.require_possible([-1.0, 0.0])


def test_mass_moves_inertia_and_derived_constants() -> None:
    model = _written(VALUES)
    np.testing.assert_allclose(model.body_inertia[1], 1.5 * MODEL.body_inertia[1])
    assert model.body_subtreemass[1] == pytest.approx(4.0)
    heavy = mujoco.MjModel.from_xml_string(XML.replace('mass="2"', 'mass="3"'))
    np.testing.assert_allclose(model.body_invweight0, heavy.body_invweight0, rtol=1e-12)


def test_writing_starts_from_nominal_and_does_not_compound() -> None:
    once, thrice = _written(VALUES), _written(VALUES, times=3)
    np.testing.assert_array_equal(once.body_inertia, thrice.body_inertia)
    model = mujoco.MjModel.from_xml_string(XML)
    fields = ModelFields(model)
    SPACE.write(fields, VALUES)
    fields.restore()
    fields.commit()
    for name in ("body_mass", "body_inertia", "geom_friction", "geom_solref", "actuator_gainprm", "body_invweight0"):
        np.testing.assert_array_equal(getattr(model, name), getattr(MODEL, name), err_msg=name)


@settings(max_examples=10)
@given(st.integers(0, 2**31))
def test_single_model_equals_the_batch(seed: int) -> None:
    psi = SPACE.sample(np.random.default_rng(seed), 3)
    batch = Batch(MODEL, 3, 1)
    fields = ModelFields(batch, MODEL)
    SPACE.write(fields, psi)
    fields.commit()
    for i in range(3):
        mine, theirs = _written(psi[i]), batch.get_model(i)
        for name in ("body_mass", "body_inertia", "geom_friction", "geom_solref", "dof_damping", "actuator_gainprm",
                     "actuator_biasprm", "body_invweight0", "dof_M0", "body_subtreemass"):  # fmt: skip
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)
        np.testing.assert_array_equal(mine.opt.gravity, theirs.opt.gravity)


@pytest.mark.parametrize("rows", [[1], [0, 2]])
def test_some_rows_of_a_batch_are_written_as_all_would_be_and_leave_the_others(rows: list[int]) -> None:
    """Edits of other fields go back to nominal in those rows too, and derived constants follow there alone."""
    psi, other = SPACE.sample(np.random.default_rng(0), 3), SPACE.sample(np.random.default_rng(1), 3)
    some, whole = (ModelFields(Batch(MODEL, 3, 1), MODEL) for _ in range(2))
    for fields in (some, whole):
        SPACE.write(fields, psi)
        fields["body_ipos"][..., 1, 2] += 0.1
        fields.commit()
    part = some.rows(np.array(rows))
    part.restore()
    SPACE.write(part, other[rows])
    part.commit()
    mixed = psi.copy()
    mixed[rows] = other[rows]
    whole.restore()
    SPACE.write(whole, mixed)
    lifted = np.setdiff1d(np.arange(3), rows)
    whole["body_ipos"][lifted, 1, 2] += 0.1
    whole.commit()
    for i in range(3):
        mine, theirs = some._target.get_model(i), whole._target.get_model(i)
        for name in ("body_mass", "body_inertia", "body_ipos", "geom_friction", "geom_solref", "dof_damping",
                     "actuator_gainprm", "body_invweight0", "dof_M0", "body_subtreemass"):  # fmt: skip
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=f"{name} of {i}")


def test_rows_that_stay_as_they_were_are_recomputed_only_if_somebody_else_wrote_to_them() -> None:
    batch = Batch(MODEL, 2, 1)
    fields = ModelFields(batch, MODEL)
    SPACE.write(fields, np.tile(SPACE.nominal, (2, 1)))
    fields.commit()
    calls = []
    batch.set_const = lambda ids=None: calls.append(ids)  # type: ignore[method-assign]
    part = fields.rows(np.array([1]))
    part.restore()
    SPACE.write(part, SPACE.nominal[None])
    part.commit()
    assert calls == []
    fields["body_mass"][1] *= 2  # and not committed
    part = fields.rows(np.array([1]))
    part.commit()
    assert [c.tolist() for c in calls] == [[1]]


def test_normalise_maps_the_box_and_inverts() -> None:
    np.testing.assert_allclose(SPACE.normalise(SPACE.low), -1)
    np.testing.assert_allclose(SPACE.normalise(SPACE.high), 1)
    np.testing.assert_allclose(SPACE.denormalise(SPACE.normalise(VALUES)), VALUES)


def test_sample_stays_in_the_box_and_leaves_anchored_alone() -> None:
    draws = SPACE.sample(np.random.default_rng(0), 500)
    assert (draws >= SPACE.low).all()
    assert (draws <= SPACE.high).all()
    assert (draws[:, 5] == -9.81).all()
    np.testing.assert_allclose(draws[:, 0].mean(), 2.5, atol=0.15)


def test_vector_takes_names() -> None:
    np.testing.assert_array_equal(SPACE.vector({"kv": 7.0}), [2.0, 1.0, 0.0, 7.0, 20.0, -9.81, 0.2])
    with pytest.raises(InputError, match="there are: mass, grip"):
        SPACE.vector({"kq": 7.0})


@pytest.mark.parametrize(
    ("index", "value", "words"), [(0, 0.0, "mass must be positive"), (0, -1.0, "mass"), (2, np.nan, "not finite")]
)
def test_impossible_values_are_refused(index: int, value: float, words: str) -> None:
    psi = VALUES.copy()
    psi[index] = value
    with pytest.raises(InputError, match=words):
        SPACE.write(ModelFields(mujoco.MjModel.from_xml_string(XML)), psi)


@pytest.mark.parametrize(
    ("index", "value", "words"),
    [
        (0, 0.0, "'mass': a mass must be positive"),
        (1, -0.1, "'grip' is -0.1, want 0 or more"),
        (2, -0.1, "'damping' is -0.1 N m s/rad, want 0 or more"),
        (3, -5.0, "'kv' is -5 N m s/rad"),
        (4, -5.0, "'kp' is -5 N m/rad"),
        (6, 1.5, "'bounce' is 1.5, want a number from 0 to 1"),
        (6, -0.1, "'bounce' is -0.1"),
    ],
)
def test_what_nature_does_not_allow_is_told(index: int, value: float, words: str) -> None:
    SPACE.require_possible(VALUES)
    SPACE.require_possible(np.array([900.0, 30.0, 50.0, 90.0, 900.0, 5.0, 1.0]))  # beyond the prior
    psi = np.tile(VALUES, (3, 1))
    psi[1, index] = value
    for some in (psi[1], psi):
        with pytest.raises(InputError, match=words):
            SPACE.require_possible(some)


def test_values_that_are_no_numbers_are_told() -> None:
    for values in ({"grip": "firm"}, ["firm"] * 7, [1, [2]]):
        with pytest.raises(InputError, match=r"^psi.* is .*, want a number"):
            SPACE.vector(values)
    with pytest.raises(InputError, match=r"psi\['grip'\] has shape \(2,\), want one number"):
        SPACE.vector({"grip": [1, 2]})


def test_a_space_shows_names_units_and_bounds() -> None:
    assert repr(ParameterSpace(MODEL, SPACE.parameters[:2])) == "ParameterSpace(mass 1..4 kg, grip 0.1..2)"
    lines = repr(SPACE).splitlines()
    assert (lines[0], lines[1], lines[-1]) == ("ParameterSpace(", "  mass 1..4 kg,", ")")
    assert len(lines) == len(SPACE) + 2


def test_values_beyond_the_prior_are_allowed() -> None:
    assert _written(np.array([9.0, *VALUES[1:]])).body_mass[1] == 9.0


@pytest.mark.parametrize(
    ("field", "of", "words"),
    [
        ("body_mass", ("bass",), "leg_l"),
        ("geom_friction", ("foot_l",), "3 components"),
        ("geom_friction[7]", ("foot_l",), "component 7"),
        ("opt.gravity", (), "name one of its 3 components, for instance opt.gravity\\[0\\]"),
        ("opt.gravity[7]", (), "name one of its 3 components"),
        ("opt.density[0]", (), "opt.density is one number and has no components: leave the brackets out"),
        ("opt.timestep", (), "not an array field"),
        ("body_weight", ("base",), "not an array field"),
        ("body_mass", (), "at least one"),
    ],
)
def test_unknown_fields_and_objects_are_refused(field: str, of: tuple[str, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        ParameterSpace(MODEL, [Parameter("p", field, of, "1", -100, 100)])


def test_bounds_and_names_are_checked() -> None:
    with pytest.raises(InputError, match="twice"):
        ParameterSpace(MODEL, [Parameter("p", "body_mass", ("base",), "kg", 0, 9)] * 2)
    with pytest.raises(InputError, match="below"):
        ParameterSpace(MODEL, [Parameter("p", "body_mass", ("base",), "kg", 3, 3)])
    with pytest.raises(InputError, match="outside"):
        ParameterSpace(MODEL, [Parameter("p", "body_mass", ("base",), "kg", 3, 4)])
