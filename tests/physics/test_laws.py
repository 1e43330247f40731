"""A law is the same for one robot and for each row of many, to the bit."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from machines import candidates, probe, zoo, zoo_scales

from nfc_gym.physics.effects import FAMILIES, Context, Effect, Forces
from nfc_gym.physics.effects.base import overrides
from nfc_gym.physics.effects.lookup import index, limited

MODEL = zoo()
CANDIDATES = candidates(MODEL)
HOOKS = ("action", "friction", "modulate", "force")
ACTING = [f for f, found in CANDIDATES.items() if any(overrides(found[0], h) for h in HOOKS)]
ROWS, STEPS = 5, 12
RNG = np.random.default_rng(5)


def _states() -> dict[str, np.ndarray]:
    """State, command and derived fields of robots in motion, (ROWS, ...) each."""
    names = {"qpos", "qvel", "ctrl", "cvel", "xipos", "subtree_com", "xquat", "xaxis", "geom_xpos"}
    found: dict[str, list[np.ndarray]] = {n: [] for n in (*names, "actuator_force", "qfrc_actuator", "qfrc_bias")}
    for _ in range(ROWS):
        data = mujoco.MjData(MODEL)
        data.qvel[:], data.ctrl[:] = 3 * RNG.normal(size=MODEL.nv), 8 * RNG.normal(size=MODEL.nu)
        mujoco.mj_step(MODEL, data, 20)
        for name, values in found.items():
            values.append(getattr(data, name).copy())
    return {n: np.array(v) for n, v in found.items()}


STATES = _states()
SIGNALS = {"exo:supply": RNG.uniform(10, 12, ROWS), "exo:time": RNG.uniform(0, 0.3, ROWS)}


def _felt(effect: Effect, theta: np.ndarray, row: Any) -> list[np.ndarray]:
    """What the hooks of an effect make of some rows, or of one."""

    def nominal(name: str) -> np.ndarray:
        value = getattr(MODEL.opt, name[4:]) if name.startswith("opt.") else getattr(MODEL, name)
        return np.broadcast_to(value, (ROWS, *np.shape(value)))[row]

    q, v, ctrl = (STATES[n][row] for n in ("qpos", "qvel", "ctrl"))
    signals = {n: s[row] for n, s in SIGNALS.items()}
    dt, theta = float(MODEL.opt.timestep), theta[row]
    ctx = Context(MODEL, dt, q, v, ctrl, signals, lambda name: STATES[name][row], nominal)
    shape = q.shape[:-1]
    out = Forces(np.zeros((*shape, MODEL.nv)), np.zeros((*shape, MODEL.nbody, 6)))
    made: list[np.ndarray] = []
    if overrides(effect, "action"):
        memory = effect.state0(shape, ctrl, theta, dt)
        for k in range(STEPS):
            reached, memory = effect.action(np.cos(k) * ctrl, theta, memory, signals, dt)
            made.append(reached)
    if overrides(effect, "friction"):
        made.append(effect.friction(ctx, theta)[1])
    if overrides(effect, "follow"):
        ctx.memory = effect.rest(ctx, theta)
        for k in range(STEPS):
            ctx.v, ctx.ctrl = np.cos(k) * v, np.sin(k) * ctrl
            ctx.memory = effect.follow(ctx, theta, ctx.memory)
        made += ctx.memory if isinstance(ctx.memory, tuple) else [ctx.memory]
    if overrides(effect, "modulate"):
        fields = {n: nominal(n).copy() for n in effect.MODULATES}
        effect.modulate(ctx, theta, fields)
        made += [fields[n] - nominal(n) for n in effect.MODULATES]
    if overrides(effect, "force"):
        effect.force(ctx, theta, out)
    return [*made, out.qfrc, out.xfrc]


@pytest.mark.parametrize("family", ACTING)
def test_one_robot_is_a_row_of_many(family: str) -> None:
    acts = False
    for effect in CANDIDATES[family]:
        effect.bind(MODEL)
        theta = probe(effect) * np.linspace(0.2, 1.0, ROWS)[:, None]
        many = _felt(effect, theta, slice(None))
        acts = acts or any(m.any() for m in many)
        for row in range(ROWS):
            for one, all_rows in zip(_felt(effect, theta, row), many, strict=True):
                np.testing.assert_array_equal(one, all_rows[row], err_msg=effect.id)
    assert acts


@pytest.mark.parametrize("rows", [[3], [2, 3, 4], [1, 4, 7], [4, 2], [0, 1, 5], [2, 2]])
def test_an_index_picks_its_rows(rows: list[int]) -> None:
    array = np.arange(20.0).reshape(2, 10)
    np.testing.assert_array_equal(array[..., index(np.array(rows))], array[..., rows])


def test_limited_is_clip() -> None:
    x = np.array([-3.0, -1.0, 0.2, 5.0, np.nan])
    low, high = np.array([-1.0, -np.inf, 0.3, -1.0, -1.0]), np.ones(5)
    np.testing.assert_array_equal(limited(x, low, high), np.clip(x, low, high))


def test_a_smooth_force_by_position_covers_where_the_logs_were() -> None:
    """A craft that flew ten metres above where its model begins meets the bumps there."""
    scales, height = zoo_scales(MODEL), MODEL.joint("flight").qposadr[0] + 2
    assert scales.low is not None
    assert scales.high is not None
    low, high = scales.low.copy(), scales.high.copy()
    low[height], high[height] = 12.0, 13.0
    flown = dataclasses.replace(scales, low=low, high=high)
    (effect,) = (e for e in FAMILIES["generic_position"].propose(MODEL, flown) if e.where == ("flight[2]",))
    ctx = SimpleNamespace(q=np.zeros((7, MODEL.nq)))
    ctx.q[:, height] = np.linspace(11.9, 13.1, 7)
    effect.bind(MODEL)
    for unit in np.eye(6)[1:5]:  # those whose middles lie within
        out = Forces(np.zeros((7, MODEL.nv)), np.zeros((7, MODEL.nbody, 6)))
        effect.force(ctx, unit, out)  # pyright: ignore[reportArgumentType]
        assert out.qfrc[:, MODEL.joint("flight").dofadr[0] + 2].max() > 0.5


def test_nothing_repeats_with_a_hinge_that_does_not_go_round() -> None:
    scales, rest = zoo_scales(MODEL), MODEL.qpos0
    wheel = MODEL.joint("wheel_l").qposadr[0]
    high = rest.copy() + 1.0
    high[wheel] += 20.0
    propose = FAMILIES["law_harmonic"].propose
    turned = {e.where[1] for e in propose(MODEL, dataclasses.replace(scales, high=high)) if len(e.where) == 2}
    assert turned == {"wheel_l"}
    unknown = {e.where[1] for e in propose(MODEL, dataclasses.replace(scales, low=None)) if len(e.where) == 2}
    assert {"wheel_l", "wheel_r", "shoulder"} <= unknown
