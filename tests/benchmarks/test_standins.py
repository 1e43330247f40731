"""Two separate codes must mean the same by an effect: the stand-ins' own formulas, and the package's library."""

from importlib import import_module
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.hidden import Hidden

# How far up the range of sizes, in its logarithm, so that the effect shows by far.
CASES = [
    ("quadcopter", f, 0.75) for f in ("supply_sag", "gain", "offset", "com_shift", "sensor_bias", "payload", "wind")
]
CASES += [("quadcopter", f, 0.9) for f in ("drag_linear", "drag_quadratic", "rotor_drag")]
CASES += [("jackal", f, 0.75) for f in ("delay", "lag", "coulomb", "stribeck", "slip", "dead_zone", "loss")]
CASES += [("jackal", "slope", 0.85), ("jackal", "external_force", 0.85), ("jackal", "armature", 0.95)]
CASES += [("quadruped", "saturation", 0.75), ("quadruped", "damping_poly", 0.75), ("ant", "spring_offset", 0.75)]
CASES += [("quadcopter", f, 0.75) for f in ("misalignment", "gust", "thermal", "inertia")]
CASES += [("quadcopter", "ground_effect", 0.95), ("jackal", "sinkage", 0.8), ("jackal", "compliance", 0.9)]
CASES += [("jackal", f, 0.8) for f in ("command_gain", "sensor_delay", "sensor_gain")]
CASES += [("jackal", "directional_friction", 0.9), ("jackal", "backlash", 0.7)]


@pytest.mark.parametrize(("robot", "family", "size"), CASES)
def test_the_package_explains_the_stand_in_to_its_noise_floor(
    tmp_path: Path, robot: str, family: str, size: float
) -> None:
    """True effect and true psi in the package's model: X is about 1, while without the effect it is far from it."""
    case = import_module("standin.case")
    kit = import_module("standin.robots").ROBOTS[robot].showing([family])
    rng = np.random.default_rng(7)
    psi = import_module("nfc_gym.measured.standin").draw_psi(kit.psi, rng)
    kind = kit.named[family]
    machine = case.Machine(psi, kind.make(rng, kind.low ** (1 - size) * kind.high**size))
    # Two segments a log, or one; a quadcopter's motors must have forgotten what came before the log.
    seconds = {"quadcopter": 1.3, "jackal": 0.9}.get(robot, 0.45)
    bench = case.make_bench(case.load(case.write_case(tmp_path, kit, machine, seconds, range(3))), 1)
    logs = list(bench.dataset.logs)
    problem = bench.problem(logs)
    known = case.chi2(problem, *case.oracle(bench, logs, machine))
    bare = case.chi2(problem, bench.plant, bench.plant.space.vector(psi))
    assert known < (1.4 if robot == "quadcopter" else 2.0)  # wheels and feet touch down beside the model's own steps
    assert bare > 2.5 * known


WHEEL = """<mujoco><option gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="wheel" armature=".05"/><geom type="cylinder" size=".1 .05" mass="12"/></body></worldbody>
<actuator><motor name="drive" joint="wheel" ctrlrange="-1 1" forcerange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("speed", [0.3, 3.0])
def test_stops_of_play_throw_nothing_back_wherever_in_a_step_they_are_met(speed: float) -> None:
    """Two masses that meet in a plastic impact: their common speed is that of their momentum."""
    play, rotor, gap = import_module("standin.play"), 0.05, 0.1
    for part in np.linspace(0, 1, 6):
        spec, hidden = mujoco.MjSpec.from_string(WHEEL), play.Backlash("wheel", gap)
        hidden.shape(spec)
        model = spec.compile()
        data = mujoco.MjData(model)
        wheel, own = (int(model.joint(name).dofadr[0]) for name in ("wheel", "rotor"))
        data.qpos[own], data.qvel[own] = gap / 2 - (2 + part) * speed * play.STEP, speed
        for _ in range(40):
            mujoco.mj_step(model, data)
        assert data.qvel[wheel] == pytest.approx(speed * rotor / (rotor + 12 * 0.1**2 / 2), rel=0.04)
        assert data.qvel[wheel] - data.qvel[own] < 0.04 * speed


ARM = """<mujoco><option gravity="0 0 0" timestep="0.001"/><worldbody><body name="arm"><joint name="hinge"/>
<geom name="arm" type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="1"/></body></worldbody></mujoco>"""


def test_hysteresis_yields_at_its_size_and_pushes_back_as_a_spring_before() -> None:
    bouc = import_module("standin.outside").BoucWen("hinge", 2.0, 0.1)
    bouc.begin(mujoco.MjModel.from_xml_string(ARM))
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(ARM))

    def turn(speed: float, angle: float) -> float:
        """Force after turning by an angle at a constant speed."""
        data.qvel[0] = speed
        for _ in range(round(abs(angle / speed) / 0.001)):
            data.qfrc_applied[:] = 0
            bouc.push(data)
        return float(data.qfrc_applied[0])

    assert turn(0.1, 0.001) == pytest.approx(-2.0 * 0.001 / 0.1, rel=0.02)
    assert turn(1.0, 1.0) == pytest.approx(-2.0, rel=1e-3)
    assert turn(-1.0, 1.0) == pytest.approx(2.0, rel=1e-3)


def test_cogging_repeats_its_order_times_a_turn() -> None:
    cogs = import_module("standin.outside").Cogging("hinge", 0.5, 6, 0.3)
    angles = np.linspace(0, 2 * np.pi, 61)
    torque = cogs.torque(angles, 0 * angles)
    np.testing.assert_allclose(torque[10:], torque[:-10], atol=1e-12)
    assert torque.max() == pytest.approx(0.5, rel=0.05)


def test_a_patch_lowers_friction_beyond_its_line_and_gives_it_back() -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    patch = import_module("standin.outside").Patch(["arm"], "arm", 0.6, np.array([1.0, 0.0]))
    patch.begin(model)
    data = mujoco.MjData(model)
    full = float(model.geom_friction[0, 0])
    for angle, share in ((0.0, 0.4), (np.pi, 1.0)):
        data.qpos[0] = angle
        mujoco.mj_forward(model, data)
        patch.push(data)
        assert model.geom_friction[0, 0] == pytest.approx(share * full)


@pytest.mark.parametrize("robot", ["quadcopter", "jackal", "quadruped", "ant"])
def test_a_loose_load_adds_its_mass_and_one_freedom(robot: str) -> None:
    kit = import_module("standin.robots").ROBOTS[robot]
    module = import_module(f"standin.{robot}") if robot != "jackal" else None
    outside, standin = import_module("standin.outside"), import_module("nfc_gym.measured.standin")
    build = module.build if module else standin.build_jackal
    body = kit.weighed.removesuffix("_mass")
    bare, laden = (build(standin.Machine(kit.psi, h)) for h in (outside.Both(()), outside.LooseLoad(body, 0.5, 0.1, 0)))
    assert laden.nv == bare.nv + 1
    assert laden.body_mass.sum() == pytest.approx(bare.body_mass.sum() + 0.5)
    assert laden.joint("loose").qposadr[0] == bare.nq  # last: no address that a log reads has moved


def test_a_bent_axle_lifts_the_wheel_once_a_turn() -> None:
    standin, outside = import_module("nfc_gym.measured.standin"), import_module("standin.outside")
    hidden = outside.BentAxle("front_left_wheel", 0.01)
    model = standin.build_jackal(standin.Machine(standin.JACKAL_PSI, hidden))
    data = mujoco.MjData(model)
    heights = []
    for angle in np.linspace(0, 2 * np.pi, 9):
        data.qpos[model.joint("front_left_wheel").qposadr[0]] = angle
        mujoco.mj_kinematics(model, data)
        heights.append(float(data.geom_xpos[model.geom("front_left_wheel").id, 2]))
    assert max(heights) - min(heights) == pytest.approx(0.02, rel=1e-6)
    assert heights[0] == pytest.approx(heights[-1])


def test_lift_grows_with_height_from_three_metres() -> None:
    outside = import_module("standin.outside")
    lift, data = outside.HeightLift("base", 0.4), mujoco.MjData(mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="base"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    ))  # fmt: skip
    data.qpos[2] = 4.5
    np.testing.assert_allclose(lift.pull(data, np.zeros(3), np.zeros(3)), [0, 0, 0.6])


OWN = ("faults", "pushes", "outside", "legged", "quadruped", "ant", "quadcopter")


@pytest.mark.parametrize("name", [*OWN, "air", "drives", "grounds", "joints", "play", "sensing", "wider"])
def test_the_stand_ins_share_no_physics_with_the_package(name: str) -> None:
    text = Path(import_module(f"standin.{name}").__file__).read_text()
    assert "nfc_gym.physics" not in "".join(line for line in text.splitlines(True) if "import" in line)


@pytest.mark.parametrize("robot", ["quadruped", "ant"])
def test_legged_machines_move_and_stay_upright(robot: str) -> None:
    """A log of a machine that lies on its back, or stands, would say little."""
    kit = import_module("standin.robots").ROBOTS[robot]
    standin = import_module("nfc_gym.measured.standin")
    for seed in range(2):
        log = kit.log(standin.Machine(kit.psi), 3.0, seed)
        assert (1 - 2 * (log["qx"] ** 2 + log["qy"] ** 2)).min() > 0.7  # the body's own z stays within 45 degrees
        assert np.std(log["z"]) > 0.01
        speeds = [v for k, v in log.items() if k.endswith("_speed")]
        assert np.median([np.std(v) for v in speeds]) > 0.3


@pytest.mark.parametrize("robot", ["quadcopter", "jackal", "quadruped", "ant"])
def test_what_lies_outside_the_library_changes_the_motion(robot: str) -> None:
    """With the same commands and noise; at their largest sizes machines still run."""
    kit, standin = import_module("standin.robots").ROBOTS[robot], import_module("nfc_gym.measured.standin")
    bare = kit.log(standin.Machine(kit.psi), 0.6, 1)
    for family, kind in kit.outside.items():
        hidden = kind.make(np.random.default_rng(3), kind.high)
        log = kit.log(standin.Machine(kit.psi, hidden), 0.6, 1)
        assert np.isfinite(np.stack(list(log.values()))).all(), family
        assert any(np.abs(log[k] - bare[k]).max() > 1e-6 for k in bare), family


@pytest.mark.parametrize("robot", ["quadcopter", "jackal", "quadruped", "ant"])
def test_wider_effects_act_and_do_nothing_at_no_size(robot: str) -> None:
    """With the same commands and noise, against the spread of each column."""
    whole, standin = import_module("standin.robots").ROBOTS[robot], import_module("nfc_gym.measured.standin")

    class Finer(Hidden):
        """Play has a rotor of its own, and a step that suits it."""

        def shape(self, spec: mujoco.MjSpec) -> None:
            spec.option.timestep = import_module("standin.play").STEP

    for family, kind in whole.wider.items():
        kit, change = whole.showing([family]), {}
        hidden = Finer() if family == "backlash" else Hidden()
        bare = kit.log(standin.Machine(kit.psi, hidden), 0.6, 1)
        for size in (kind.high, 1e-9 * kind.low):
            log = kit.log(standin.Machine(kit.psi, kind.make(np.random.default_rng(3), size)), 0.6, 1)
            assert np.isfinite(np.stack(list(log.values()))).all(), family
            change[size] = max(np.sqrt(((log[k] - bare[k]) ** 2).mean()) / (np.std(bare[k]) + 1e-3) for k in bare)
        acts, none = change.values()
        assert acts > 0.05, family
        # A rotor tied to its joint rounds otherwise, and touch-downs differ as by a step of two fifths: by 5 %.
        assert none < (0.08 if family == "backlash" else 1e-5), (family, none)
