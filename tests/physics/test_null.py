"""Every family: at null the simulator is the nominal one bit for bit, and the change fades with the parameter."""

import mujoco
import numpy as np
import pytest
from machines import ZOO, candidates, plant_of, probe, zoo, zoo_scales, zoo_segments

from nfc_gym.core.errors import InputError
from nfc_gym.measured.export import READ_COMMANDS
from nfc_gym.physics import acting
from nfc_gym.physics.effects import FAMILIES, build, complete_inertia, propose
from nfc_gym.physics.effects.base import Context, Effect, overrides

MODEL = zoo()
CANDIDATES = candidates(MODEL)
SENSING = {"sensor_bias", "sensor_gain", "sensor_delay", "misalignment"}


def _observed(effect: Effect, x: np.ndarray, seed: int) -> list[np.ndarray]:
    """Everything that a roll-out shows, measured through the effect."""
    t = plant_of(MODEL, effect).shoot(x, zoo_segments(MODEL, seed), sensors=True)
    assert t.stable.all()
    assert t.sensordata is not None
    out = [t.qpos, t.qvel, t.sensordata]
    if overrides(effect, "sense"):
        width = {"quat": 4, "linvel": 3}.get(effect.where[0].split(":")[-1], 3 if "sensor:" in effect.where[0] else 1)
        seen = effect.sense(effect.where[0], t.qpos[..., 3 : 3 + width], x[:, None], MODEL.opt.timestep)
        out.append(seen)
    return out


def test_every_family_has_a_candidate() -> None:
    assert [f for f, found in CANDIDATES.items() if not found] == []


def test_ids_are_unique() -> None:
    ids = [e.id for found in CANDIDATES.values() for e in found]
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("family", FAMILIES)
def test_null_is_nominal_bit_for_bit(family: str) -> None:
    for seed, effect in enumerate(CANDIDATES[family]):
        nominal = plant_of(MODEL).shoot(np.zeros((1, 0)), zoo_segments(MODEL, seed), sensors=True)
        # A row at null beside one that is not: per-simulation values must not leak.
        got = _observed(effect, np.stack([effect.null, probe(effect)]), seed)
        for mine, theirs in zip(got, (nominal.qpos, nominal.qvel, nominal.sensordata), strict=False):
            np.testing.assert_array_equal(mine[0], theirs[0], err_msg=effect.id)
        if family in SENSING:
            width = got[3].shape[-1]
            np.testing.assert_array_equal(got[3][0], nominal.qpos[0, ..., 3 : 3 + width], err_msg=effect.id)


@pytest.mark.parametrize("family", FAMILIES)
def test_change_fades_with_the_parameter(family: str) -> None:
    """From the probe down to a thousandth of it the change shrinks, and ends far below where it began."""
    effect = CANDIDATES[family][0]
    null, full = effect.null, probe(effect)
    share = np.array([1, 0.5, 0.25, 1e-3])
    shapes = [i for i, p in enumerate(effect.params) if p.shape]
    x = null + share[:, None] * (full - null)
    x[:, shapes] = full[shapes]
    at_null = null.copy()
    at_null[shapes] = full[shapes]
    shown = _observed(effect, np.concatenate([x, at_null[None]]), 7)
    # a limit bites only once it is below the forces that occur
    change = np.array([max(np.abs(a[i] - a[-1]).max() for a in (*shown[:2], *shown[3:])) for i in range(len(share))])
    assert change[0] > 0, f"{effect.id} changes nothing at {full}"
    # Contact and dry friction switch between steps: monotonic up to a tenth.
    assert (change[1:] <= 1.1 * change[:-1]).all(), change
    assert change[-1] < 0.05 * change[0], change


@pytest.mark.parametrize("family", FAMILIES)
def test_single_model_equals_the_batch(family: str) -> None:
    """Model edits of one compiled model and of a simulation in a batch are the same numbers."""
    from mujoco.batch import Batch

    from nfc_gym.physics.fields import ModelFields

    for effect in CANDIDATES[family][:3]:
        if not overrides(effect, "model"):
            continue
        effect.bind(MODEL)
        single, batch = zoo(), Batch(MODEL, 2, 1)
        one, many = ModelFields(single), ModelFields(batch, MODEL)
        effect.model(one, probe(effect))
        effect.model(many, np.stack([effect.null, probe(effect)]))
        one.commit()
        many.commit()
        for name, values in many._arrays.items():
            np.testing.assert_array_equal(values[1], one[name], err_msg=f"{effect.id} {name}")


@pytest.mark.parametrize("family", FAMILIES)
def test_structural_edit_equals_the_hooks(family: str) -> None:
    """Where an effect says that plain MJCF carries it, the compiled edit rolls out as the hooks do."""
    effect = CANDIDATES[family][0]
    spec = mujoco.MjSpec.from_string(ZOO)
    theta = probe(effect)
    effect.bind(MODEL)
    if not effect.spec(spec, theta):
        pytest.skip("not carried by MJCF")
    edited = spec.compile()
    # lags and delays begin with what was commanded before
    segments = zoo_segments(MODEL, 3, history=12 if family in ("delay", "lag") else 0)
    # MJCF text keeps what the compiled edit has
    reread = mujoco.MjModel.from_xml_string(spec.to_xml())
    mine = plant_of(MODEL, effect).shoot(theta[None], segments)
    for model in (edited, reread):
        theirs = plant_of(model).shoot(np.zeros((1, 0)), segments)
        np.testing.assert_allclose(mine.qpos, theirs.qpos, atol=2e-6, err_msg=effect.id)


@pytest.mark.parametrize("family", FAMILIES)
def test_who_reads_commands_is_known_to_the_export(monkeypatch: pytest.MonkeyPatch, family: str) -> None:
    """A model that carries effects on commands would show other ones to these laws."""
    seen: list[Context] = []

    class Watched(Context):
        @property
        def ctrl(self) -> np.ndarray:
            seen.append(self)
            return self.held

        @ctrl.setter
        def ctrl(self, values: np.ndarray) -> None:
            self.held = values

    monkeypatch.setattr(acting, "Context", Watched)
    effect = CANDIDATES[family][0]
    _observed(effect, probe(effect)[None], 0)
    assert bool(seen) == (family in READ_COMMANDS)


def test_build_returns_the_effect_that_was_saved() -> None:
    for found in CANDIDATES.values():
        effect, theta = found[0], probe(found[0])
        if effect.generic:
            continue
        saved = {p.name: {"value": float(v), "unit": p.unit} for p, v in zip(effect.params, theta, strict=True)}
        again, values = build(effect.family, list(effect.where), saved)
        assert again.id == effect.id
        assert [(p.name, p.unit) for p in again.params] == [(p.name, p.unit) for p in effect.params]
        np.testing.assert_array_equal(values, theta)
        again.bind(MODEL)


def test_build_refuses_what_it_does_not_know() -> None:
    with pytest.raises(InputError, match="coulomb"):
        build("colomb", "elbow", {"level": 1})
    with pytest.raises(InputError, match="level"):
        build("coulomb", "elbow", {"size": 1})
    effect, _ = build("coulomb", "knee", {"level": 1})
    with pytest.raises(InputError, match="elbow"):
        effect.bind(MODEL)


def test_only_and_exclude() -> None:

    scales = zoo_scales(MODEL)
    named = {e.family for e in propose(MODEL, scales, only=("lag", "coulomb"), generic=False)}
    assert named == {"lag", "coulomb"}
    assert "lag" not in {e.family for e in propose(MODEL, scales, exclude=("lag",))}
    assert {e.family for e in propose(MODEL, scales, only=("lag",)) if e.generic} == {
        n for n, f in FAMILIES.items() if f.generic
    }


def test_probes_lie_within_bounds() -> None:
    for found in CANDIDATES.values():
        for effect in found:
            for p in effect.params:
                assert p.probes, (effect.id, p.name)
                assert all(p.low <= value <= p.high for value in p.probes), (effect.id, p)
                assert p.shape or p.low <= p.null <= p.high, (effect.id, p)


def test_say_names_value_and_unit() -> None:
    effect = CANDIDATES["coulomb"][0]
    assert "0.250 ± 0.020 N m" in effect.say(np.array([0.25]), np.array([0.01]))


def test_what_only_sets_a_unit_is_said_without_an_interval() -> None:
    effect = CANDIDATES["thermal"][0]
    theta = np.array([p.probes[0] for p in effect.params])
    said = effect.say(theta, 0.1 * theta)
    assert [p.name for p in effect.params if p.given] == ["reference"]
    assert f"reference {theta[2]:.3g}." in said
    assert "fade 0.0500 ± 0.0098" in said  # 0.05, to the digits of its interval


def test_simple_bodies_are_refused_and_completed() -> None:
    text = "<mujoco><worldbody><body name='b'><freejoint/><geom size='.1' mass='1'/></body></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    effect, _ = build("payload", "b", {"mass": 1, "x": 0, "y": 0, "z": 0})
    with pytest.raises(InputError, match="simple"):
        effect.bind(model)
    spec = mujoco.MjSpec.from_string(text)
    complete_inertia(spec)
    effect.bind(spec.compile())
