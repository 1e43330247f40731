"""The page of the library of effects, made from the code: `python docs/library.py` writes `docs/library.md`."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.measured.export import corrected
from nfc_gym.physics.effects import FAMILIES, complete_inertia, propose
from nfc_gym.physics.effects.base import Effect, Scales
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant

PAGE = Path(__file__).resolve().with_suffix(".md")
NUMBERED = 3  # parameters with names like c0, c1, ... from which on only the first and the last are named
MOST = 12  # effects of a family that are tried for where they are kept; of laws, which are all alike, two
RULER = "tyre_c"  # the geom that has priority over the ground
FEW_UNITS = 2  # more than so many are the unit of whatever the effect sits on

# Something of everything, so that every family finds a place; no two kinds of object share a name.
MODEL = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="20 20 .1"/>
    <body name="craft" pos="0 0 2">
      <joint name="flight" type="free"/>
      <geom name="hull" type="box" size=".1 .15 .03" pos=".01 0 0" mass="1"/>
      <site name="front" pos=".1 0 0"/> <site name="rear" pos="-.1 0 0"/> <site name="imu"/>
    </body>
    <body name="rover" pos="5 0 .12">
      <joint name="drive" type="free"/>
      <geom name="chassis" type="box" size=".2 .15 .03" mass="8" contype="0" conaffinity="0"/>
      <body name="hub_l" pos="0 .2 0"><joint name="axle_l" axis="0 1 0" damping=".01"/>
        <geom name="tyre_l" type="ellipsoid" size=".1 .03 .1" mass=".3"/></body>
      <body name="hub_r" pos="0 -.2 0"><joint name="axle_r" axis="0 1 0" damping=".01"/>
        <geom name="tyre_r" type="ellipsoid" size=".1 .03 .1" mass=".3"/></body>
      <body name="hub_c" pos="-.3 0 0"><joint name="axle_c" axis="0 1 0" damping=".01"/>
        <geom name="tyre_c" type="ellipsoid" size=".1 .03 .1" mass=".3" priority="1"/></body>
    </body>
    <body name="arm" pos="0 5 1.5"><joint name="shoulder" axis="0 1 0" damping=".02"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".2"/>
      <body name="lower" pos="0 0 -.3"><joint name="elbow" axis="0 1 0" range="-2 2" limited="true"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".2"/></body></body>
    <body name="carriage" pos="0 -5 1"><joint name="rail" type="slide" axis="1 0 0"/>
      <geom name="block" type="sphere" size=".05" mass=".3"/></body>
  </worldbody>
  <actuator>
    <general name="thrust_f" site="front" gear="0 0 1 0 0 .02" ctrlrange="0 12" dyntype="filterexact" dynprm=".05"/>
    <general name="thrust_r" site="rear" gear="0 0 1 0 0 -.02" ctrlrange="0 12" dyntype="filterexact" dynprm=".05"/>
    <velocity name="spin_l" joint="axle_l" kv="1" forcerange="-3 3" ctrlrange="-20 20"/>
    <velocity name="spin_r" joint="axle_r" kv="1" forcerange="-3 3" ctrlrange="-20 20"/>
    <motor name="push" joint="shoulder" ctrlrange="-1 1"/>
    <position name="bend" joint="elbow" kp="4" kv=".1"/>
    <velocity name="shift" joint="rail" kv="3"/>
  </actuator>
  <sensor><accelerometer name="acc" site="imu"/></sensor>
</mujoco>
"""

TOP = """\
# The library of effects

An effect is one physical law that a model may lack, with a place and a few numbers: `nfc-gym close-loop` looks for
all of them in logs, and `ApplyEffects` puts them into the simulation of any MuJoCo environment. This page is made
from the code (`python docs/library.py`), and [effects.md](effects.md) says how to write one more.

As a row, as `ApplyEffects` takes it and `effects.yaml` holds it, with a value of every parameter of the family:

```yaml
{family: coulomb, where: shoulder, parameters: {level: 0.2}}   # N m; where: a name, a list of names, or all
```

## All families
- **where**: what the names in `where` are names of. In the plural one or several, which then have the values in
  common. `all` stands for every one that the family applies to, unless something in the model is called so.
- **parameters**: name, unit, and the family's own bounds of a fit; a run sets others, to fit your machine. A value that
  you give may lie beyond them: anywhere where they begin below 0, else from 0 on, or as is *given*; a *share* ends
  at 1. An effect vanishes where its parameters are 0, or at the null that is named. A *shape* parameter has no null: it
  says what the effect is like, and the others say how much of it there is. What is *of the day* may differ between the
  `condition`s of the logs. *Own unit* is that of the place: of an actuator's command, of a channel, of a joint's force.
- **kept in**: where a run writes what it found. What `model.xml` carries needs no wrapper: plain MuJoCo simulates it
  (from rest at a command of 0, see [results.md](results.md#modelxml)). `effects.yaml` lists the others;
  [below](#why-these-are-in-effectsyaml) is why. Both are named where it depends: a delay shorter than a physics step,
  a lag of an actuator that has an activation already, or soil that resists wheels besides letting them sink is in
  `effects.yaml`.
"""

WHY = """
## Why these are in `effects.yaml`
Of some of them MuJoCo 4.0 has a law of its own. It is not used where it is another law, belongs to the whole model, or
wants an actuator that the model does not have: a passive `dcmotor` (`input="none"`) adds no command, but an actuator,
and the effects and tools of this package take the command of an actuator to be the column of its number. "Nothing"
means that MuJoCo's manual has no element or attribute for it.

- `stribeck`: the `lugre` friction of a `dcmotor` has Stribeck's curve behind a bristle that bends before it slips; such
  an actuator would be one more. Ours sets `frictionloss` anew in every step, so that the solver holds a joint at rest.
- `load_friction`, `directional_friction`: nothing; `frictionloss` is one number for both directions and any load.
- `hysteresis`: the `lugre` friction of a passive `dcmotor`, with `damping` 0 and `static` equal to `coulomb`, is this
  very law (its stiffness is level / transition), so MJCF could say it by one more actuator. `springyield` is another
  one: the joint's only spring, which yields all at once at its threshold.
- `backlash`: a second joint with limits and a rotor's inertia. It would change the model's coordinates, of which no log
  measures the new one. Ours keeps the rotor's state to itself.
- `cogging`: the `cogging` of a passive `dcmotor` is this very torque, so MJCF could say it by one more actuator.
- `lag`, `delay`: in `model.xml` but for what the table's introduction names.
- `dead_zone`: nothing for an actuator; only the spring of a tendon has a dead band.
- `torque_speed`: a `dcmotor` with `input="ff"` and a limit `Vmax` has the same falling line where it drives, if the
  actuator is made anew as such a motor; braking, its limit grows with speed. Ours acts on actuators of any kind
  that move a hinge, a slide or a fixed tendon, and does not limit braking.
- `supply_sag`: nothing that takes a measured signal.
- `thermal`: the `thermal` of a `dcmotor` heats its winding's resistance by its current, in electrical constants of the
  motor. Ours has three numbers, and takes from the command of an actuator of any kind.
- `drag_linear`, `drag_quadratic`: fluid forces by `density` and `viscosity`, which belong to the whole model; what a
  body makes of them follows from its inertia, or from an ellipsoid about a geom with lift and added mass beside
  drag. Ours is a coefficient for each axis of one body, and independent of its inertia, which is fitted too.
- `wind`: `option wind` works through those fluid forces, on all bodies alike, and does nothing without them. Ours is a
  push on one body and its drag, and the push may differ from day to day.
- `gust`: nothing that begins and ends; `option wind` is steady.
- `rotor_drag`, `ground_effect`: nothing that depends on the thrust of other actuators, or on height.
- `external_force`: no constant force on a body is part of a model (`xfrc_applied` and `qfrc_applied` are of the
  simulation); an actuator that always pushes would be one more.
- `slip`: nothing; a geom has one sliding friction, the two of a contact `pair` do not turn with a wheel, and
  `surfacevel` imposes a velocity on a surface.
- `friction_patch`: nothing; friction is a whole geom's.
- `sinkage`: its depth is a negative `margin` in `model.xml`; of resistance there is nothing.
- `sensor_bias`, `sensor_gain`, `misalignment`: nothing; MuJoCo's sensors have `noise`, `cutoff` and `delay` alone.
  `sensor_delay`: those that are sensors of the model have a `delay`; ours acts on joints' and bodies' channels too.
"""

LAWS = """
## Laws that claim no cause
They compete with the families above, so that nothing is named that a smooth function explains better. Those that
begin with `law_` may be proposed in the report: they then stand in `effects.yaml` (`proposal: true`) and act like any
other effect. Their `where` is what is pushed, a joint or one way of a free joint (`root[0]` to `root[2]` along the
world's axes, with `@body` behind along the body's own, `root[3]` to `root[5]` about them), and then, for some, what
the force depends on. A mapping's `effects: {only, exclude}` does not speak of them.

"""

USE = '''
## Around a model of your own
`ApplyEffects` takes what Gymnasium's `MujocoEnv` steps. Here is all of it, from the model to the motion:

```python
from pathlib import Path

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box
from nfc_gym.wrappers import ApplyEffects

Path("arm.xml").write_text("""
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="arm">
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.8"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="shoulder" ctrlrange="-2 2"/></actuator>
</mujoco>
""")


class Arm(MujocoEnv):
    """Torque in, angle and speed out."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 50}

    def __init__(self, model: str = "arm.xml") -> None:
        box = Box(-np.inf, np.inf, (2,), np.float64)
        super().__init__(str(Path(model).absolute()), frame_skip=10, observation_space=box)

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self.observe(), 0.0, False, False, {}

    def reset_model(self):
        self.set_state(self.init_qpos, self.init_qvel)
        return self.observe()

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel])


dry = {"family": "coulomb", "where": "shoulder", "parameters": {"level": 0.2}}  # N m
late = {"family": "delay", "where": "motor", "parameters": {"delay": 0.03}}  # s
env = ApplyEffects(Arm(), [dry, late])
observation, info = env.reset(seed=0)
for _ in range(50):
    observation, *_ = env.step(np.array([0.5], np.float32))
print(env.effects, observation)
```

What a run found goes into an environment that is made from the corrected model:

```python
env = ApplyEffects.from_file(Arm("result/model.xml"), "result/effects.yaml")
```

Effects that `result/model.xml` carries already are listed by id as `carried_by_model` in `effects.yaml`. They act
without any wrapper, and `from_file` does not add them a second time. That is also why it refuses an environment of
another model, unless you say `any_model=True`.

- An environment that steps its model itself needs the attributes `model`, `data` and `frame_skip`, and a list
  `substep_hooks` of callables, each of which it calls with itself before every `mj_step`.
- `exogenous={"exo:supply": 11.5}` gives the signals that effects read: a number, or a function of the episode's time
  in s. `exo:time` is there without it.
- `condition="gale"` chooses whose values an effect has that differs between the conditions of the logs.
- Effects on channels change what `RecordLog` records, not the observation, whose entries have no names.
- `VectorApplyEffects` does the same for vector environments of this package.
'''


def spec() -> mujoco.MjSpec:
    """The model in which every family has a place, as a run prepares it."""
    made = mujoco.MjSpec.from_string(MODEL)
    complete_inertia(made)
    return made


def candidates(model: mujoco.MjModel) -> list[Effect]:
    """Every effect that the model could have, under made-up magnitudes of the motion."""
    channels = ("joint:shoulder:pos", "joint:elbow:vel", "joint:rail:pos", "body:craft:quat", "body:craft:linvel")
    scales = Scales(
        force=np.full(model.nv, 0.5),
        speed=np.ones(model.nv),
        command=np.full(model.nu, 0.5),
        actuation=np.full(model.nu, 0.5),
        interval=0.01,
        exogenous={"exo:supply": 11.0, "exo:time": 1.0},
        channels={name: (0.5, 1e-3) for name in (*channels, "sensor:acc")},
        low=model.qpos0 - 4.0,  # cogging is proposed where a joint travels far
        high=model.qpos0 + 4.0,
    )
    return propose(model, scales) + [e for f in FAMILIES.values() for e in f.asked(model, scales)]


class Names:
    """Which kind of object a name of the model is of."""

    def __init__(self, model: mujoco.MjModel) -> None:
        kinds = {"joint": model.njnt, "actuator": model.nu, "body": model.nbody, "geom": model.ngeom}
        self.of = {
            mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), i): kind
            for kind, count in kinds.items()
            for i in range(count)
        }

    def kind(self, name: str) -> str:
        """`joint`, `actuator`, ..., or the name itself where it is one that every model knows."""
        if name in ("world", "ground"):
            return f"`{name}`"
        return "channel" if ":" in name else self.of[name.partition("[")[0]]  # `flight[0]`: one way of a free joint

    def places(self, effects: Sequence[Effect]) -> str:
        """What a family's effects sit on: in the plural where one of them sits on several; of a law, one by one."""
        if effects[0].generic:
            chains = dict.fromkeys(", then ".join(_a(self.kind(n)) for n in e.where) for e in effects)
            return "; or ".join(sorted(chains, key=len))
        kinds = list(dict.fromkeys(self.kind(e.where[0]) for e in effects))
        many = {self.kind(e.where[0]) for e in effects if len(e.where) > 1}
        plurals = {"body": "bodies"}
        words = [plurals.get(k, f"{k}s") if k in many else _a(k) for k in kinds]
        return " or ".join(words)


def _a(word: str) -> str:
    return word if word[0] == "`" else f"{'an' if word[0] in 'aeiou' else 'a'} {word}"


def _number(value: float) -> str:
    return f"{value:g}".replace("e+0", "e").replace("e-0", "e-")


def _unit(units: Iterable[str]) -> str:
    found = list(dict.fromkeys(units))
    return "*own unit*" if len(found) > FEW_UNITS else " or ".join(found)


def _told(names: Sequence[str], unit: str, p: Param) -> str:
    """Parameters that are alike, named together."""
    numbered = len(names) > NUMBERED and all(n[1:].isdigit() for n in names)
    listed = f"`{names[0]}` … `{names[-1]}`" if numbered else ", ".join(f"`{n}`" for n in names)
    notes = [unit] if unit != "1" else []
    notes.append(f"{_number(p.low)} to {_number(p.high)}")
    notes += ["*share*"] if p.natural else []
    if p.floor is not None:
        notes.append("*given*: any" if p.floor == -np.inf else f"*given*: more than {_number(p.floor)}")
    notes += [f"null {_number(p.null)}"] if p.null and not p.shape else []
    notes += ["*shape*"] if p.shape else []
    notes += ["*of the day*"] if p.ambient else []
    return f"{listed} ({', '.join(notes)})"


def _variant(family: type[Effect], effects: Sequence[Effect]) -> str:
    """The parameters of effects that have the same ones, with the units that they were seen in."""
    names = [p.name for p in effects[0].params]
    alike: dict[tuple[object, ...], tuple[list[str], str, Param]] = {}
    for i, p in enumerate(family.declare(names)):
        unit = _unit(e.params[i].unit for e in effects)
        key = unit, p.low, p.high, p.null, p.shape, p.ambient, p.floor, p.natural
        alike.setdefault(key, ([], unit, p))[0].append(p.name)
    return ", ".join(_told(*told) for told in alike.values())


def parameters(family: type[Effect], effects: Sequence[Effect]) -> str:
    """A family's parameters; where it has others in other places, each set of them."""
    variants: dict[tuple[str, ...], list[Effect]] = {}
    for effect in effects:
        variants.setdefault(tuple(p.name for p in effect.params), []).append(effect)
    names = [set(v) for v in variants]
    # Fewer of the same parameters at some of the places are no further kind.
    whole = [of for v, of in variants.items() if not any(set(v) < other for other in names)]
    return "; or ".join(_variant(family, of) for of in whole)


def kept(effects: Sequence[Effect], made: mujoco.MjSpec, model: mujoco.MjModel) -> str:
    """Which of the two files carries effects: of realistic sizes, of tiny ones, and with one parameter alone."""
    found: set[str] = set()
    for effect in effects[: 2 if effects[0].generic else MOST]:
        real = np.array([p.probes[0] if p.probes else p.null for p in effect.params])
        shape = np.array([p.shape for p in effect.params])
        for share in (1.0, 1e-4, *np.eye(len(shape))):
            theta = np.where(shape, real, effect.null + share * (real - effect.null))
            plant = Plant(model, ParameterSpace(model, []), [effect], nthread=1)
            found.add("`effects.yaml`" if corrected(made, plant, theta)[1] else "`model.xml`")
    return " or ".join(sorted(found, reverse=True))


def on_geoms(effects: Sequence[Effect], model: mujoco.MjModel) -> bool:
    """Whether a law that is proposed for the whole ground alone can be given for single geoms that touch it as well."""
    first = effects[0]
    if first.generic or any(e.where != ("ground",) for e in effects):
        return False
    try:
        type(first)((RULER,), first.params).bind(model)
    except InputError:
        return False
    return True


def rows(generic: bool) -> list[str]:
    """The table's lines, in the library's order."""
    made = spec()
    model = made.compile()
    names, every = Names(model), candidates(model)
    lines = ["| family | what it is | where | parameters | kept in |", "|---|---|---|---|---|"]
    for family in FAMILIES.values():
        if family.generic != generic:
            continue
        own = [e for e in every if e.family == family.family]
        if not own:
            raise RuntimeError(f"{family.family} has no place in the model above: add what it sits on")
        place = names.places(own) + (" or geoms" if on_geoms(own, model) else "")
        numbers, file = parameters(family, own), kept(own, made, model)
        what = f"{family.summary} ({family.remark})" if family.remark else family.summary
        lines.append(f"| `{family.family}` | {what} | {place} | {numbers} | {file} |")
    return lines


def page() -> str:
    """The whole page."""
    return "\n".join([TOP, *rows(generic=False), WHY + LAWS + "\n".join(rows(generic=True)), USE])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE}: {len(FAMILIES)} families")
