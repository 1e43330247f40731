"""The corrected model, as plain MuJoCo loads it, moves as the plant that was fitted."""

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from nfc_gym import assets
from nfc_gym.measured.export import corrected
from nfc_gym.measured.model import bare, compile_model, read_spec
from nfc_gym.measured.moments import physical
from nfc_gym.physics.effects import build, complete_inertia
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.names import name_all
from nfc_gym.physics.parameters import Parameter, ParameterSpace, parameters_from_toml
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments

Array = NDArray[np.float64]
Rows = list[tuple[str, str, dict[str, float]]]
STEPS, DT = 200, 0.002
ROUNDED = 1e-5  # MJCF text has six digits

ARM = """
<mujoco>
  <compiler {compiler}/>
  <option timestep="0.002" {option}/>
  <worldbody>
    <body name="a" pos="0 0 1">
      <joint name="j" axis="0 1 0" {joint}/>
      <geom name="look" type="box" size=".1 .1 .1" contype="0" conaffinity="0" mass="0"/>
      <geom name="rod" type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5"/>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
MOTOR, LIMITED = '<motor name="m" joint="j"/>', '<motor name="m" joint="j" ctrlrange="-0.8 0.8"/>'
SERVO = '<position name="m" joint="j" kp="20" dampratio="1" inheritrange="0.5"/>'
PAYLOAD = ("payload", "a", {"mass": 0.5, "x": 0.1, "y": 0.1, "z": 0.0})


def arm(actuators: str = MOTOR, compiler: str = "", option: str = "", joint: str = "") -> str:
    return ARM.format(actuators=actuators, compiler=compiler, option=option, joint=joint)


def mass(value: float) -> tuple[Parameter, float]:
    return Parameter("mass", "body_mass", ("a",), "kg", 0.01, 50.0), value


def level(value: float) -> tuple[Parameter, float]:
    return Parameter("level", "dof_frictionloss", ("j",), "N m", 0.0, 5.0), value


class Case:
    """A machine, its plant as the bench makes it, and what a fit found."""

    def __init__(self, xml: str | Path, rows: Rows, psi: tuple[tuple[Parameter, float], ...] = ()) -> None:
        read = mujoco.MjSpec.from_file if isinstance(xml, Path) else mujoco.MjSpec.from_string
        self.spec = name_all(read(str(xml)))
        complete_inertia(self.spec)
        model = compile_model(bare(self.spec, {n for p, _ in psi for n in p.of}), "m")
        effects, thetas = zip(*(build(*row) for row in rows), strict=True) if rows else ((), ())
        self.plant = Plant(model, ParameterSpace(model, [p for p, _ in psi]), effects, nthread=1)
        self.x = np.concatenate([[value for _, value in psi], *thetas])

    def export(self, folder: Path | None = None) -> tuple[str, list[Effect]]:
        return corrected(self.spec, self.plant, self.x, folder)

    def segments(self) -> Segments:
        model, time = self.plant.model, np.arange(STEPS) * DT
        ctrl = np.repeat(np.sin(6 * time + 0.5)[:, None], model.nu, 1)
        return Segments(DT, 0, model.qpos0[None], np.full((1, model.nv), 0.1), ctrl[None])

    def fitted(self) -> Array:
        """(K + 1, nq) as the plant moves."""
        return self.plant.shoot(self.x[None], self.segments()).qpos[0, 0]

    def exported(self) -> Array:
        """The same of the text, with the effects that it does not carry."""
        text, outside = self.export()
        model = mujoco.MjModel.from_xml_string(text)
        thetas = [t for e, t in zip(self.plant.effects, self.plant.split(self.x)[1], strict=True) if e in outside]
        again = Plant(model, ParameterSpace(model, []), outside, nthread=1)
        moved = again.shoot(np.concatenate([np.zeros(0), *thetas])[None], self.segments()).qpos[0, 0]
        if not outside and not model.na and not model.actuator_delay.any():  # these begin with the first command
            np.testing.assert_allclose(plainly(model, self.segments()), moved, atol=1e-9)
        return moved


def plainly(model: mujoco.MjModel, segments: Segments) -> Array:
    """(K + 1, nq) by `mj_step`."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = segments.qpos[0], segments.qvel[0]
    rows = [data.qpos.copy()]
    for ctrl in segments.ctrl[0]:
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return np.array(rows)


def gain(value: float) -> tuple[str, str, dict[str, float]]:
    return "gain", "m", {"gain": value}


SCALED = ("command_gain", "m", {"gain": 1.4})
OFFSET, DEAD = ("offset", "m", {"offset": 0.3}), ("dead_zone", "m", {"width": 0.5})
LAG, DELAY = ("lag", "m", {"time_constant": 0.1}), ("delay", "m", {"delay": 0.05})
BETWEEN = ("delay", "m", {"delay": 2.5 * DT})  # in units of steps no whole number
CUT, FORCE = ("saturation", "m", {"removed": 0.4}), ("saturation", "m", {"inverse_limit": 2.0})
DRY, RISE = ("coulomb", "j", {"level": 0.1}), ("stribeck", "j", {"level": 0.1, "rise": 0.1, "speed": 0.3})
SPRING, ROTOR = ("spring_offset", "j", {"stiffness": 3.0, "rest": 0.5}), ("armature", "j", {"inertia": 0.2})
STOUT = ("inertia", "a", {"x": 1.1, "y": 0.95, "z": 1.0})
SHIFT, WIDE = ("com_shift", "a", {"x": 0.05, "y": 0.0, "z": 0.0}), 'range="-90 90"'
TIP = {"x": 0.3, "y": 0.0, "z": 0.1}
LINE, PLAY = ("torque_speed", "m", {"fall": 0.8}), ("backlash", "j", {"gap": 0.1, "rotor": 0.001})
BACK = ("offset", "m", {"offset": -0.9})  # a drive that turns round
YIELD = ("hysteresis", "j", {"level": 1.0, "transition": 1e-4})
BOUNDED = '<motor name="m" joint="j" gear="2" forcerange="-0.8 0.8"/>'
STRENGTH = Parameter("strength", "actuator_gainprm[0]", ("m",), "1", 0.1, 5.0)
CENTRE = Parameter("centre", "body_ipos[0]", ("a",), "m", -1.0, 1.0)
DRAG = ("drag_linear", "a", {"x": 2.0, "y": 2.0, "z": 2.0})
DENSE = arm().replace('mass=".5"', 'density="600"')
THICK = Parameter("size", "geom_size[0]", ("rod",), "m", 0.01, 0.3), 0.05
HELD = '<motor name="m" joint="j" delay="0.02" nsample="40" interp="linear"/>'
LATER = (Parameter("delay", "actuator_delay", ("m",), "s", 0.0, 0.07), 0.06)
WEAK = (Parameter("limit", "jnt_actfrcrange[1]", ("j",), "N m", 0.01, 3.0), 0.2)
TENDON = """<tendon><spatial name="t" stiffness="10"><site site="on"/><site site="off"/></spatial></tendon>"""
ON, OFF = '<site name="on" pos="0 0 2"/>', '<site name="off" pos=".3 0 0"/>'
HUNG = arm(joint='springref="40"').replace("<worldbody>", f"<worldbody>{ON}")
HUNG = HUNG.replace('<geom name="rod"', f'{OFF}<geom name="rod"').replace("<actuator>", f"{TENDON}<actuator>")
MIXING = '<motor name="m" joint="j" ctrlrange="-0.8 0.8" delay="0.025" nsample="40" interp="linear"/>'
CASES: dict[str, tuple[Any, ...]] = {
    # what MuJoCo would compute anew from what is corrected, and what it does not copy back
    "friction, geom's size": (DENSE, [], (level(0.2), THICK)),
    "native delay": (arm(HELD), [], (LATER,)),
    "joint's limit": (arm(joint='actuatorfrcrange="-2 2" actuatorfrclimited="true"'), [], (WEAK,)),
    "spring, tendon": (HUNG, [SPRING]),
    # a servo's damping, given as a ratio, is that of the nominal model
    "dampratio, gain": (arm(SERVO, joint=WIDE), [gain(0.5)]),
    "dampratio, turned round": (arm(SERVO, joint=WIDE), [gain(-0.5)]),
    "dampratio, payload": (arm(SERVO, joint=WIDE), [("payload", "a", {"mass": 2.0} | TIP)]),
    "dampratio, armature": (arm(SERVO, joint=WIDE), [ROTOR]),
    "dampratio, mass": (arm(SERVO, joint=WIDE), [], (mass(1.5),)),
    "springdamper, mass": (arm(joint='springdamper="0.1 1"'), [], (mass(1.5),)),
    "springdamper, spring and payload": (arm(joint='springdamper="0.1 1"'), [SPRING, PAYLOAD]),
    # the compiler's options on inertias
    **{
        f"{name}, {option}": (arm(compiler=option), rows, psi)
        for option in ('inertiafromgeom="true"', 'balanceinertia="true"', 'boundmass="0.6" boundinertia="0.01"')
        for name, rows, psi in (("payload", [PAYLOAD], ()), ("mass", [], (mass(0.3),)))
    },
    # inertias that no body has, about the one axis that shows
    "inertia": (arm(), [STOUT]),
    "inertia, then payload": (arm(), [STOUT, PAYLOAD]),
    "payload, then inertia and shift": (arm(), [PAYLOAD, STOUT, SHIFT]),
    # what is before and after on the way of a command
    **{
        " then ".join(e[0] for e in rows) + f", {kind}": (arm(actuators), list(rows))
        for kind, actuators in (("free", MOTOR), ("limited", LIMITED))
        for rows in (
            (OFFSET, DEAD), (DEAD, OFFSET), (LAG, DEAD), (DEAD, LAG), (LAG, OFFSET), (OFFSET, LAG), (DELAY, LAG),
            (LAG, DELAY), (OFFSET, gain(0.5)), (FORCE, gain(0.5)), (gain(0.5), FORCE), (FORCE, DEAD, LAG),
            (SCALED, OFFSET), (OFFSET, SCALED), (SCALED, gain(0.5)), (LAG, SCALED),
        )
    },
    "saturation then a delay between steps": (arm(LIMITED), [CUT, BETWEEN]),
    "a delay between steps then saturation": (arm(LIMITED), [BETWEEN, CUT]),
    "a delay between steps": (arm(LIMITED), [BETWEEN]),
    "lag, native delay between steps": (arm(MIXING), [LAG]),
    "saturation then offset": (arm(LIMITED), [CUT, OFFSET]),
    "saturation then command gain": (arm(LIMITED), [CUT, SCALED]),
    "command gain then saturation": (arm(LIMITED), [SCALED, CUT]),
    "offset then saturation": (arm(LIMITED), [OFFSET, CUT]),
    "a law that reads the command": (arm(), [LAG, ("law_command", ["j", "m"], {"size": 0.3})]),
    # friction is as soft as the nominal model's friction makes it
    "friction, coulomb": (arm(), [DRY], (level(0.3),)),
    "friction, stribeck": (arm(), [RISE], (level(0.3),)),
    "coulomb, stribeck": (arm(), [DRY, RISE]),
    "soft friction, coulomb": (arm(joint='frictionloss="0.05"'), [DRY], (level(0.3),)),
    "gravcomp, payload": (arm().replace('<body name="a"', '<body name="a" gravcomp="1"'), [PAYLOAD]),
    # laws outside of the model that read what is in it
    "loss, torque_speed": (arm(BOUNDED), [("loss", "m", {"fraction": 0.5}), LINE]),
    **{
        f"{e[0]} {', '.join(e[2])}, torque_speed": (arm(LIMITED), [e, LINE])
        for e in (gain(0.6), OFFSET, LAG, CUT, FORCE)
    },
    "strength, torque_speed": (arm(LIMITED), [LINE], ((STRENGTH, 0.6),)),
    "gear, torque_speed": (arm(LIMITED), [LINE], ((replace(STRENGTH, field="actuator_gear[0]"), 1.5),)),
    "saturation, backlash": (arm(BOUNDED), [("saturation", "m", {"inverse_limit": 10.0}), BACK, PLAY]),
    "gear, backlash": (arm(BOUNDED), [BACK, PLAY], ((replace(STRENGTH, field="actuator_gear[0]"), 1.5),)),
    "mass, hysteresis": (arm(), [YIELD], (mass(3.0),)),
    "armature, hysteresis": (arm(), [ROTOR, YIELD]),
    "centre, drag_linear": (arm(), [DRAG], ((CENTRE, 0.3),)),
    "springs": (arm(joint='stiffness="2" springref="20"'), [SPRING, SPRING]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_corrected_model_moves_as_the_plant(name: str) -> None:
    case = Case(*CASES[name])
    found = case.fitted()
    nominal = case.plant.with_effects([])
    change = np.abs(nominal.shoot(nominal.null[None], case.segments()).qpos[0, 0] - found).max()
    assert change > 100 * ROUNDED, "nothing to carry"
    np.testing.assert_allclose(case.exported(), found, atol=ROUNDED)


@pytest.mark.parametrize(
    ("rows", "outside"),
    [
        ((DELAY, LAG), ()),
        ((OFFSET, gain(0.5)), ()),
        ((OFFSET, DEAD), ("offset:m", "dead_zone:m")),
        ((DEAD, LAG), ("dead_zone:m", "lag:m")),
        ((gain(0.5), DEAD), ("dead_zone:m",)),
        ((("lag", "n", {"time_constant": 0.1}), LAG, DEAD), ("lag:m", "dead_zone:m")),
        ((LAG, ("law_command", ["j", "m"], {"size": 0.3})), ("lag:m", "law_command:j+m")),
    ],
)
def test_the_effects_on_an_actuators_commands_stay_together(rows: Rows, outside: tuple[str, ...]) -> None:
    case = Case(arm(MOTOR + MOTOR.replace('"m"', '"n"')), list(rows))
    assert tuple(e.id for e in case.export()[1]) == outside
    assert all(e in case.plant.effects for e in case.export()[1])


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
def test_a_total_mass_is_not_made_anew() -> None:
    case = Case(arm(compiler='settotalmass="2"'), [PAYLOAD], (mass(1.5),))
    text, _ = case.export()
    model = mujoco.MjModel.from_xml_string(text)
    assert model.body("a").mass == pytest.approx(2.0, abs=1e-5)


def test_a_free_body_that_is_aligned_to_its_inertia_keeps_it() -> None:
    free = """<mujoco><compiler alignfree="true" inertiafromgeom="true"/><option timestep="0.002"/><worldbody>
    <body name="a" pos="0 0 1"><freejoint/><geom type="box" size=".1 .2 .3" pos=".1 0 .1" euler="30 20 10"/></body>
    </worldbody></mujoco>"""
    for rows, psi in (([], (mass(40.0),)), ([("payload", "a", {"mass": 20.0} | TIP)], ())):
        case = Case(free, rows, psi)
        np.testing.assert_allclose(case.exported(), case.fitted(), atol=ROUNDED)
        text, outside = case.export()
        assert [e.family for e in outside] == [name for name, *_ in rows]
        assert mujoco.MjModel.from_xml_string(text).body("a").mass == pytest.approx(40.0 if psi else 48.0)


VISUAL = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction="0.5"/>
    <body name="b" pos="0 0 .099" euler="0 0 10"><freejoint/><inertial mass="1" pos="0 0 0" diaginertia=".01 .01 .01"/>
      <geom name="shell" type="box" size=".1 .1 .1" contype="0" conaffinity="0" friction="0.9"/>
      <geom name="foot" type="box" size=".1 .1 .1" friction="0.9"/>
      <geom type="sphere" size=".01" contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("rows", [[], [("compliance", "ground", {"softness": 3.0, "damping": 0.0})]])
def test_values_of_geoms_go_to_those_that_were_fitted(rows: Rows) -> None:
    """The plant lacks what is only looked at."""
    case = Case(VISUAL, rows, ((Parameter("mu", "geom_friction[0]", ("foot",), low=0.1, high=2.0), 1.7),))
    text, outside = case.export()
    assert not outside
    model = mujoco.MjModel.from_xml_string(text)
    assert [float(model.geom(n).friction[0]) for n in ("floor", "shell", "foot")] == [0.5, 0.9, 1.7]
    assert [float(model.geom(n).solref[0]) for n in ("floor", "shell", "foot")] == (
        [0.08, 0.02, 0.08] if rows else [0.02] * 3
    )
    assert case.plant.model.ngeom == 2  # and its effects are still bound to it
    np.testing.assert_allclose(case.exported(), case.fitted(), atol=ROUNDED)


def test_wheels_of_a_robot_of_the_package_get_their_friction(tmp_path: Path) -> None:
    spec = read_spec("nfc_gym/JackalFlat-v0", tmp_path)
    complete_inertia(spec)
    declared = parameters_from_toml(assets.path("jackal").with_name("psi.toml"))
    model = compile_model(bare(spec, {n for p in declared for n in p.of}), "jackal")
    space = ParameterSpace(model, declared)
    rubbed = [i for i, p in enumerate(declared) if p.field.startswith("geom_friction")]
    psi = space.nominal.copy()
    psi[rubbed] = 0.123
    (tmp_path / "model.xml").write_text(corrected(spec, Plant(model, space, [], 1), psi, tmp_path)[0])
    made = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    wheels = {n for i in rubbed for n in declared[i].of}
    assert {made.geom(g).name for g in range(made.ngeom) if made.geom_friction[g, 0] == 0.123} == wheels


@pytest.mark.parametrize(("axis", "seen"), [("1 0 0", 0), ("0 1 0", 1), ("0 0 1", 2)])
def test_the_moment_about_the_only_axis_is_kept(axis: str, seen: int) -> None:
    rod = f"""<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body name="a">
    <joint name="j" axis="{axis}"/><inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .0004"/></body></worldbody>
    <actuator><motor name="m" joint="j" gear=".05"/></actuator></mujoco>"""
    case = Case(rod, [STOUT])
    text, _ = case.export()
    made = mujoco.MjModel.from_xml_string(text).body("a").inertia
    assert made[seen] == pytest.approx([0.011, 0.0095, 0.0004][seen], rel=1e-5)
    assert "no body can have the moments of inertia (0.011, 0.0095, 0.0004) kg m^2 of 'a'" in text.split("-->")[0]
    np.testing.assert_allclose(case.exported(), case.fitted(), atol=ROUNDED)
    assert "no body" not in Case(rod, []).export()[0]


def test_the_nearest_moments_that_a_body_can_have() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        moments, seen = rng.uniform(0.01, 1.0, 3), rng.normal(size=3)
        seen /= np.linalg.norm(seen)
        for axis in (None, seen, np.eye(3)[0]):
            made = physical(moments, axis)
            assert 2 * made.max() < made.sum()
            if axis is not None:
                assert axis**2 @ made == pytest.approx(axis**2 @ moments, rel=1e-6)
            # no way from there towards what was found is open
            others = made + rng.normal(size=(300, 3)) * 0.1
            if axis is not None:
                others -= np.outer((others - made) @ axis**2, axis**2) / (axis**2 @ axis**2)
            possible = others[2 * others.max(1) < (1 - 1e-4) * others.sum(1)]
            if len(possible):
                assert np.linalg.norm(possible - moments, axis=1).min() > np.linalg.norm(made - moments) - 1e-5
    plate = np.array([1.0, 1.0, 1.9])
    np.testing.assert_array_equal(physical(plate), plate)


KEYS = """
<mujoco><worldbody><body name="a"><joint name="j"/><geom size=".1"/></body></worldbody>
<actuator><motor name="m" joint="j"/><motor name="n" joint="j" ctrlrange="-.15 .15"/>{more}</actuator>
<keyframe><key name="home" qpos=".3" ctrl=".1 .2 {ctrl}" {act}/><key name="rest"/></keyframe></mujoco>
"""


def test_keyframes_keep_the_states_of_actuators() -> None:
    more = '<general name="f" joint="j" dyntype="filter" dynprm=".1"/>'
    lags: Rows = [(*LAG[:1], n, LAG[2]) for n in ("m", "n")]
    for text, wanted in (
        (KEYS.format(more="", ctrl="", act=""), [[0.1, 0.15], [0.0, 0.0]]),
        (KEYS.format(more=more, ctrl=".3", act='act=".5"'), [[0.1, 0.15, 0.5], [0.0, 0.0, 0.0]]),
    ):
        made = mujoco.MjModel.from_xml_string(Case(text, lags).export()[0])
        np.testing.assert_allclose(made.key_act, wanted)
        np.testing.assert_allclose(made.key_qpos, [[0.3], [0.0]])
    kept = mujoco.MjModel.from_xml_string(Case(KEYS.format(more=more, ctrl=".3", act='act=".5"'), []).export()[0])
    np.testing.assert_allclose(kept.key_act, [[0.5], [0.0]])


BOX = """v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""


def machine_of_files(folder: Path) -> Path:
    """A model whose files lie in folders of their own, some of them named by files that it includes and attaches."""
    for name in ("parts/meshes/box.obj", "parts/meshes/other.obj", "more/own/arm.obj"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(BOX)
    Image.fromarray(np.full((8, 8), 100, np.uint8)).save(folder / "parts/meshes/hills.png")
    Image.fromarray(np.full((8, 8, 3), 100, np.uint8)).save(folder / "parts/skin.png")
    (folder / "included.xml").write_text('<mujoco><asset><mesh name="other" file="other.obj"/></asset></mujoco>')
    (folder / "more/arm.xml").write_text(
        '<mujoco><compiler meshdir="own"/><asset><mesh file="arm.obj"/></asset><worldbody><body name="arm">'
        '<joint name="j"/><geom type="mesh" mesh="arm"/></body></worldbody></mujoco>'
    )
    (folder / "machine.xml").write_text(
        '<mujoco><compiler meshdir="parts/meshes" texturedir="parts"/><include file="included.xml"/><asset>'
        '<mesh file="box.obj"/><texture name="t" type="2d" file="skin.png"/><material name="m" texture="t"/>'
        '<texture name="sky" type="skybox" fileup="skin.png" filedown="skin.png"/>'
        '<hfield name="h" file="hills.png" size="1 1 1 1"/><model name="arm" file="more/arm.xml"/></asset><worldbody>'
        '<geom type="hfield" hfield="h"/><body name="a" pos="0 0 9"><joint/><geom type="mesh" mesh="box" material="m"/>'
        '<geom type="mesh" mesh="other"/><attach model="arm" body="arm" prefix="x_"/></body></worldbody></mujoco>'
    )
    return folder / "machine.xml"


def test_what_happens_to_a_firmware_servos_goal_stays_outside_of_the_model() -> None:
    """The model's own delay would be one of the commands that the firmware makes."""
    case = Case(arm(LIMITED), [DELAY, ("saturation", "m", {"removed": 0.2})])
    assert not case.export()[1]
    text, outside = corrected(case.spec, case.plant, case.x, firmware=["m"])
    assert [e.family for e in outside] == ["delay"]
    made = mujoco.MjModel.from_xml_string(text)
    np.testing.assert_allclose(made.actuator("m").ctrlrange, [-0.64, 0.64])


def test_the_model_loads_from_where_it_is_written(tmp_path: Path) -> None:
    case = Case(machine_of_files(tmp_path / "pro & 'ject'"), [], (mass(3.0),))
    out = tmp_path / "pro & 'ject'/results/run"
    text = case.export(out)[0]  # the folder comes later
    out.mkdir(parents=True)
    (out / "model.xml").write_text(text)
    shutil.move(tmp_path / "pro & 'ject'", tmp_path / "elsewhere")
    made = mujoco.MjModel.from_xml_path(str(tmp_path / "elsewhere/results/run/model.xml"))
    assert (made.nmesh, made.ntex, made.nhfield) == (3, 2, 1)
    assert made.body("a").mass == pytest.approx(3.0)
    assert str(tmp_path) not in (tmp_path / "elsewhere/results/run/model.xml").read_text()


def test_the_model_loads_through_links_and_from_anywhere(tmp_path: Path) -> None:
    case = Case(machine_of_files(tmp_path / "project"), [], (mass(3.0),))
    (tmp_path / "deep/down").mkdir(parents=True)
    os.symlink(tmp_path / "deep/down", tmp_path / "project/out")
    (tmp_path / "project/out/model.xml").write_text(case.export(tmp_path / "project/out")[0])
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "project/out/model.xml")).nmesh == 3
    (tmp_path / "deep/model.xml").write_text(case.export()[0])  # nobody said where
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "deep/model.xml")).nmesh == 3
