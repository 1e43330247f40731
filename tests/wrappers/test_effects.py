"""`ApplyEffects`: an effect in a wrapper is the effect in the calibrator, bit for bit."""

import pickle
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import yaml
from fakes import CUBE, STATELESS, FakeEnv, NoModel, ZooEnv, roll, same
from machines import candidates, make, plant_of, probe

from nfc_gym.core import InputError
from nfc_gym.physics.effects import FAMILIES, Effect, build
from nfc_gym.physics.effects.each import each
from nfc_gym.physics.effects.saved import from_row, to_row
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments
from nfc_gym.wrappers import ApplyEffects, RandomizePsi, VectorApplyEffects

MODEL = mujoco.MjModel.from_xml_string(STATELESS)
CANDIDATES = candidates(MODEL)
IN_PHYSICS = [f for f in FAMILIES if f not in ("sensor_bias", "sensor_gain", "sensor_delay", "misalignment")]
SKIP, STEPS = 10, 6


def _start(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A state near rest and commands for each control step."""
    rng = np.random.default_rng(seed)
    qpos = MODEL.qpos0.copy()
    for name in ("shoulder", "elbow", "rail", "wheel_l", "wheel_r"):
        qpos[MODEL.joint(name).qposadr[0]] += 0.3 * rng.normal()
    ctrl = rng.normal(size=(STEPS, MODEL.nu)) * np.array([3, 3, 8, 8, 0.7, 1, 1])
    ctrl[:, :2] += 5.0
    return qpos, 0.4 * rng.normal(size=MODEL.nv), ctrl


def _wrapped(pairs: list[tuple[Effect, np.ndarray]], seed: int) -> np.ndarray:
    """(physics steps + 1, nq + nv) states of a wrapped environment."""
    qpos, qvel, ctrl = _start(seed)
    env = ApplyEffects(ZooEnv(frame_skip=SKIP), pairs, exogenous={"exo:supply": lambda t: 11.0 - 5.0 * t})
    base = env.unwrapped
    base.start = (qpos, qvel)
    states: list[np.ndarray] = []
    env.sim.on_substep.add(lambda: states.append(base._observe()))
    env.sim.attach("test")
    env.reset(seed=0)
    for action in ctrl:
        env.step(action)
    return np.array([*states, base._observe()])


def _rolled(pairs: list[tuple[Effect, np.ndarray]], seed: int) -> np.ndarray:
    qpos, qvel, ctrl = _start(seed)
    count = STEPS * SKIP
    time = np.zeros(count)
    for k in range(1, count):
        time[k] = time[k - 1] + MODEL.opt.timestep
    signals = {"exo:supply": (11.0 - 5.0 * time)[None], "exo:time": time[None]}
    segments = Segments(MODEL.opt.timestep, 0, qpos[None], qvel[None], np.repeat(ctrl, SKIP, 0)[None], signals)
    plant = plant_of(MODEL, *(e for e, _ in pairs))
    t = plant.shoot(np.concatenate([np.zeros(0), *(x for _, x in pairs)])[None], segments)
    return np.concatenate([t.qpos[0, 0], t.qvel[0, 0]], -1)


@pytest.mark.parametrize("family", IN_PHYSICS)
def test_an_effect_is_the_same_in_a_wrapper_and_in_the_calibrator(family: str) -> None:
    for seed, effect in enumerate(CANDIDATES[family][:3]):
        pair = [(effect, probe(effect))]
        np.testing.assert_array_equal(_wrapped(pair, seed), _rolled(pair, seed), err_msg=effect.id)
    assert (_rolled(pair, seed) != _rolled([(effect, effect.null)], seed)).any()


def test_several_effects_act_in_the_calibrators_order() -> None:
    families = ("delay", "dead_zone", "thermal", "stribeck", "load_friction", "drag_quadratic", "slip", "payload")
    pairs = [(CANDIDATES[f][0], probe(CANDIDATES[f][0])) for f in families]
    np.testing.assert_array_equal(_wrapped(pairs, 5), _rolled(pairs, 5))
    backwards = pairs[::-1]
    np.testing.assert_array_equal(_wrapped(backwards, 5), _rolled(backwards, 5))


@pytest.mark.parametrize("family", IN_PHYSICS)
def test_null_is_no_wrapper_bit_for_bit(family: str) -> None:
    effect = CANDIDATES[family][0]
    given = {"exo:supply": 12.0}
    same(roll(ApplyEffects(ZooEnv(), [(effect, effect.null)], given), 5), roll(ZooEnv(), 5))


def test_hidden_states_begin_anew_with_each_episode() -> None:
    effects = [
        make("delay", "push", {"delay": 0.05}),
        make("thermal", "push", {"fade": 0.3, "time_constant": 0.1, "reference": 1}),
        make("hysteresis", "elbow", {"level": 0.3, "transition": 0.1}),
        make("backlash", "wheel_l", {"gap": 0.1, "rotor": 0.01}),
        make("friction_patch", "ground", {"lost": 0.5, "x": 5.0, "y": 0.0, "radius_x": 0.1, "radius_y": 1.0}),
    ]
    env = ApplyEffects(ZooEnv(), effects)
    first, second = roll(env, 8), roll(env, 8)
    same(first, second)
    assert any((a[0] != b[0]).any() for a, b in zip(first[1:], roll(ZooEnv(), 8)[1:], strict=True))


def test_episodes_begun_beneath_the_wrapper_are_seen() -> None:
    """Somebody below resets without telling the wrappers above."""
    env = ApplyEffects(ZooEnv(), [make("delay", "push", {"delay": 0.05})])
    first = roll(env, 8)
    env.unwrapped.reset(seed=0)
    rng = np.random.default_rng(99)
    again = [env.step(rng.uniform(-0.4, 0.4, env.action_space.shape))[0] for _ in range(8)]
    same([s[0] for s in first[1:]], again)


@pytest.mark.parametrize(
    ("family", "place", "parameters", "field"),
    [
        ("stribeck", "shoulder", {"level": 0.5, "rise": 0.2, "speed": 0.1}, "dof_frictionloss"),
        ("backlash", "wheel_l", {"gap": 0.1, "rotor": 0.5}, "dof_armature"),
        ("coulomb", "shoulder", {"level": 0.5}, "dof_frictionloss"),
    ],
)
def test_what_an_effect_writes_each_step_does_not_add_up(
    family: str, place: str, parameters: dict[str, float], field: str
) -> None:
    """Where somebody below resets, the model still holds what the last step of the last episode wrote."""
    env = ApplyEffects(ZooEnv(), [make(family, place, parameters)])
    env.reset(seed=0)
    found = []
    for _ in range(3):
        for _ in range(3):
            env.step(np.zeros(env.action_space.shape))
        found.append(getattr(env.unwrapped.model, field).copy())
        env.unwrapped.reset(seed=0)
    np.testing.assert_array_equal(found[1:], [found[0]] * 2)


@pytest.mark.parametrize("signal", [np.nan, None, "12", np.ones(3)])
def test_a_signal_that_is_no_number_stops_at_its_name(signal: object) -> None:
    wanted = r"exogenous 'exo:supply' is .*; want a finite number"
    with pytest.raises(InputError, match=wanted):
        ApplyEffects(ZooEnv(), [_sag()], exogenous={"exo:supply": signal})
    env = ApplyEffects(ZooEnv(), [_sag()], exogenous={"exo:supply": lambda t: signal})
    env.reset(seed=0)
    with pytest.raises(InputError, match=wanted):
        env.step(np.zeros(env.action_space.shape))


def test_model_edits_start_from_nominal_at_each_reset() -> None:
    env = ApplyEffects(ZooEnv(), [make("payload", "craft", {"mass": 0.7, "x": 0, "y": 0, "z": 0})])
    nominal = MODEL.body("craft").mass[0]
    for _ in range(3):
        env.reset(seed=0)
        assert env.unwrapped.model.body("craft").mass[0] == pytest.approx(nominal + 0.7)


def test_own_values_at_each_place() -> None:
    names = ("spin_l", "spin_r")
    both = each([make("gain", n, {"gain": 0.1})[0] for n in names])
    both.bind(MODEL)
    theta = np.array([0.3, -0.2])
    np.testing.assert_array_equal(_wrapped([(both, theta)], 2), _rolled([(both, theta)], 2))
    again = ApplyEffects(ZooEnv(), [to_row(both, theta)])
    assert again.effects[0].id == both.id
    np.testing.assert_array_equal(again.thetas[0], theta)
    for family, places, values in (
        ("hysteresis", ("shoulder", "elbow"), {"level": 0.3, "transition": 0.1}),
        ("backlash", ("wheel_l", "wheel_r"), {"gap": 0.1, "rotor": 0.01}),
    ):
        own = each([make(family, n, values)[0] for n in places])
        own.bind(MODEL)
        theta = np.array([*values.values()] * 2)
        tied = make(family, list(places), values)
        np.testing.assert_array_equal(_wrapped([(own, theta)], 2), _rolled([(own, theta)], 2))
        np.testing.assert_array_equal(_rolled([(own, theta)], 2), _rolled([tied], 2))


def test_a_wrapped_environment_is_pickled_and_remade_from_its_spec() -> None:
    gym.register("FakeZoo-v0", "fakes:ZooEnv")
    env = ApplyEffects(gym.make("FakeZoo-v0", disable_env_checker=True), [make("coulomb", "elbow", {"level": 0.2})])
    again = pickle.loads(pickle.dumps(env))
    remade = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    expected = roll(env, 5)
    same(roll(again, 5), expected)
    same(roll(remade, 5), expected)


def _file(folder: Path, digest: str) -> Path:
    effect, theta = make("coulomb", "hinge", {"level": 0.05})
    row = {"id": effect.id, **to_row(effect, theta), "where": "hinge", "sentence": "…"}
    path = folder / "effects.yaml"
    path.write_text(yaml.safe_dump({"version": 1, "model_sha256": digest, "effects": [row]}))
    return path


def test_from_file(tmp_path: Path) -> None:
    import hashlib

    path = _file(tmp_path, hashlib.sha256(CUBE.encode()).hexdigest())
    env = ApplyEffects.from_file(FakeEnv(), path)
    assert [e.id for e in env.effects] == ["coulomb:hinge"]
    with pytest.raises(InputError, match="any_model"):
        ApplyEffects.from_file(FakeEnv(CUBE.replace(".5", ".6")), path)
    ApplyEffects.from_file(FakeEnv(CUBE.replace(".5", ".6")), path, any_model=True)


def test_from_file_without_a_model_file_compares_the_model_beside_it(tmp_path: Path) -> None:
    import hashlib

    path = _file(tmp_path, hashlib.sha256(CUBE.encode()).hexdigest())
    env = FakeEnv()
    env.fullpath = None
    with pytest.raises(InputError, match=r"model\.xml"):
        ApplyEffects.from_file(env, path)
    (tmp_path / "model.xml").write_text(CUBE)
    ApplyEffects.from_file(env, path)
    other = FakeEnv(CUBE.replace('mass=".5"', 'mass=".6"'))
    other.fullpath = None
    with pytest.raises(InputError, match="body_mass"):
        ApplyEffects.from_file(other, path)
    heavy = FakeEnv()
    heavy.fullpath = None
    heavy.model.opt.gravity[2] = -1.62
    with pytest.raises(InputError, match="option gravity"):
        ApplyEffects.from_file(heavy, path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("effects: [", "no YAML"),
        ("[]", r"`effects`, a list; this has no keys but \[\]"),
        ("version: 1\npsi: {}", "a list; this has version, psi"),
        ("effects: []", "add the line `version: 1`"),
        ("version: 2\neffects: []", "version 2"),
        ("version: 1\neffects: []\npsi: [3]", r"psi is a mapping of names to numbers, and not \[3\]"),
        ("version: 1\neffects: []\npsi: {cube: heavy}", "psi cube is 'heavy', want a finite number"),
        ("version: 1\neffects: [{family: gain}]", "where"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "effects.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        ApplyEffects.from_file(FakeEnv(), tmp_path / "effects.yaml", any_model=True)


def test_bad_input_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="MuJoCo"):
        ApplyEffects(NoModel(), [])
    with pytest.raises(InputError, match="coulomb"):
        ApplyEffects(FakeEnv(), [{"family": "colomb", "where": "hinge", "parameters": {"level": 1}}])
    with pytest.raises(InputError, match="hinge"):
        ApplyEffects(FakeEnv(), [{"family": "coulomb", "where": "knee", "parameters": {"level": 1}}])
    with pytest.raises(InputError, match="number"):
        ApplyEffects(FakeEnv(), [{"family": "coulomb", "where": "hinge", "parameters": {"level": "much"}}])
    with pytest.raises(InputError, match="exo:supply"):
        ApplyEffects(ZooEnv(), [_sag()])
    with pytest.raises(InputError, match="exogenous maps names to numbers"):
        ApplyEffects(ZooEnv(), [_sag()], exogenous=[12.0])
    with pytest.raises(InputError, match="effects is None"):
        ApplyEffects(FakeEnv(), None)
    with pytest.raises(InputError, match="only once"):
        ApplyEffects(ApplyEffects(FakeEnv(), []), [])


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (("coulomb", {"level": -1}), "level is -1 N m; it must be 0 or more"),
        (("loss", {"fraction": 3.0}), "fraction is 3; it must be 0 or more and at most 1"),
        (("delay", {"delay": -0.1}), "delay is -0.1 s; it must be 0 or more"),
        (("stribeck", {"level": 1, "rise": 1, "speed": 0}), "speed is 0 rad/s; it must be more than 0"),
        (("delay", {"time": 0.1}), r"delay has the parameters delay \(0 to 0.5 s\), got: time"),
    ],
)
def test_values_that_no_machine_can_have(row: tuple[str, dict], message: str) -> None:
    family, parameters = row
    where = "hinge" if family in ("coulomb", "stribeck") else "twist"
    with pytest.raises(InputError, match=message):
        ApplyEffects(FakeEnv(), [{"family": family, "where": where, "parameters": parameters}])
    if "time" not in parameters:
        with pytest.raises(InputError, match=message):
            ApplyEffects(FakeEnv(), [build(family, where, parameters)])


def test_what_is_no_row_is_refused_by_name() -> None:
    row = {"family": "loss", "where": "twist", "parameters": {"fraction": 0.3}}
    effect, theta = build(**row)
    for given, message in (
        ("loss", "an effect is a mapping with the keys family, where, parameters, and not 'loss'"),
        (("loss",), "and not \\('loss',\\)"),
        ({**row, "extra": 1}, "'extra' is none"),
        ((effect, [0.1, 0.2]), "takes finite values of fraction"),
        ((effect, ["much"]), "takes finite values of fraction"),
    ):
        with pytest.raises(InputError, match=message):
            ApplyEffects(FakeEnv(), [given])
    told = dict.fromkeys(
        ("id", "sentence", "share_of_excess", "equivalents", "proposal", "nearest", "alike", "mended_by")
    )
    env = ApplyEffects(FakeEnv(), [{**row, **told, "own_values": False}])  # as the measured loop writes it
    np.testing.assert_array_equal(env.thetas[0], theta)


@pytest.mark.parametrize("family", FAMILIES)
def test_what_a_fit_may_end_at_is_loaded(family: str) -> None:
    """At the bounds of all that is proposed, and beyond them by what arithmetic leaves behind."""
    for effect in CANDIDATES[family]:
        for theta in (effect.low, effect.high, effect.null, effect.low - 1e-12, effect.high + 1e-12):
            np.testing.assert_array_equal(from_row(to_row(effect, theta))[1], theta)
            effect.require_possible(theta)


def _sag() -> tuple[Effect, np.ndarray]:
    effect = CANDIDATES["supply_sag"][0]
    return effect, probe(effect)


def test_on_top_of_psi(tmp_path: Path) -> None:
    """Psi below effects and effects below psi: psi is written first, effects edit what is there."""
    from nfc_gym.wrappers import RandomizePsi

    payload = [make("payload", "craft", {"mass": 0.7, "x": 0, "y": 0, "z": 0})]
    bounds = {"craft": (2.0, 2.0)}
    for env in (
        ApplyEffects(RandomizePsi(ZooEnv(), bounds), payload),
        RandomizePsi(ApplyEffects(ZooEnv(), payload), bounds),
    ):
        for _ in range(2):
            env.reset(seed=0)
            assert env.unwrapped.model.body("craft").mass[0] == pytest.approx(2.7)


def test_psi_then_effects_is_what_the_calibrator_writes() -> None:
    from nfc_gym.wrappers import RandomizePsi

    effect, theta = CANDIDATES["payload"][0], probe(CANDIDATES["payload"][0])
    env = RandomizePsi(ApplyEffects(ZooEnv(), [(effect, theta)]), {"craft": (2.0, 2.0)})
    env.reset(seed=0)
    mine = env.unwrapped.model
    theirs = mujoco.MjModel.from_xml_string(STATELESS)
    fields = ModelFields(theirs)
    plant = Plant(MODEL, ParameterSpace(MODEL, env.psi_space.parameters), [effect], 1)
    plant.write(fields, np.concatenate([[2.0], theta]))
    fields.commit()
    for name in ("body_mass", "body_inertia", "body_ipos", "dof_invweight0", "body_subtreemass"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)


def test_psi_beside_the_effects_of_a_file_holds_in_every_episode(tmp_path: Path) -> None:
    file = tmp_path / "effects.yaml"
    row = {"family": "payload", "where": "base", "parameters": {"mass": 2.0, "x": 0.0, "y": 0.0, "z": 0.0}}
    file.write_text(yaml.safe_dump({"version": 1, "psi": {"base_mass": 18.0}, "effects": [row]}))
    env = ApplyEffects(gym.make("nfc_gym/JackalFlat-v0"), file)
    envs = VectorApplyEffects(gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=2), file)
    base = env.unwrapped.model.body("base").id
    for made in (env, gym.make(env.spec), pickle.loads(pickle.dumps(env))):
        for seed in (0, None):
            made.reset(seed=seed)
            assert made.unwrapped.model.body_mass[base] == pytest.approx(20)
            assert made.unwrapped.psi[0] == 18
    envs.reset(seed=0)
    np.testing.assert_allclose(envs.unwrapped.batch.expand("body_mass")[:, base], 20)
    with pytest.raises(InputError, match="psi is written by"):
        RandomizePsi(env)
    drawn = RandomizePsi(gym.make("nfc_gym/JackalFlat-v0"), np.tile(env.unwrapped.psi_space.nominal, (2, 1)))
    with pytest.raises(InputError, match="psi is written by"):
        ApplyEffects(drawn, file)


HEAVY = {"family": "payload", "where": "torso", "parameters": {"mass": 6.0, "x": 0.1, "y": 0.0, "z": 0.0}}


def test_the_first_step_has_the_quantities_of_the_edited_model() -> None:
    env = ApplyEffects(gym.make("nfc_gym/AntFlat-v0", context=["psi"]), [HEAVY])
    many = VectorApplyEffects(
        gym.make_vec("nfc_gym/AntFlat-v0", num_envs=2, context=["psi"], max_episode_steps=2), [HEAVY]
    )
    model, data = env.unwrapped.model, env.unwrapped.data
    whole = many.unwrapped.batch.bind("M")
    mass = model.body("torso").mass[0]
    shown = many.reset(seed=0)[0]["proprio"][0]
    np.testing.assert_array_equal(env.reset(seed=0)[0]["proprio"], shown)
    assert model.body("torso").mass[0] == pytest.approx(mass + 6)
    inertia, sensed = data.M.copy(), data.sensordata.copy()
    np.testing.assert_array_equal(whole[0], inertia)
    mujoco.mj_forward(model, data)
    np.testing.assert_array_equal(data.M, inertia)
    np.testing.assert_array_equal(data.sensordata, sensed)
    for _ in range(3):  # the third begins another episode by itself
        many.step(np.zeros((2, 8)))
    env.reset()
    np.testing.assert_array_equal(whole[0], data.M)
