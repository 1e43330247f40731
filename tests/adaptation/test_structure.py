"""Effects of unknown sizes beside psi: where they are absent, a delay that is no mass, and worlds that have them."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from test_assimilation import driven_in

from nfc_gym import InputError
from nfc_gym.adaptation.assimilation import Assimilation
from nfc_gym.adaptation.imagined import imagined
from nfc_gym.adaptation.structure import names, structure_of
from nfc_gym.physics.effects import build
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.residuals import Given, Residuals
from nfc_gym.wrappers import ApplyEffects

ID = "nfc_gym/JackalFlat-v0"
DRIVES = "front_left+front_right+rear_left+rear_right"


def test_sizes_are_absent_at_their_null_and_stay_within_bounds() -> None:
    structure = structure_of(Machine(ID))
    far = 40.0 * np.stack([-np.ones(len(structure)), np.ones(len(structure))])
    for effect, sizes, values in zip(structure.effects, structure.sizes, structure.values(far), strict=True):
        assert (effect.low <= values).all(), effect.id
        assert (values <= effect.high).all(), effect.id
        one_sided = [not s.low < s.null < s.high for s in sizes]
        np.testing.assert_allclose(values[0, one_sided], effect.null[one_sided], atol=1e-12)
    both = structure_of(Machine(ID), ["gain", "delay"])
    assert len(both) == 5
    assert f"delay:{DRIVES}.delay" in names(both)
    with pytest.raises(InputError, match="no family 'ghost'"):
        structure_of(Machine(ID), ["ghost"])


def test_effects_of_the_same_rows_act_one_after_another() -> None:
    """A step of the command that lags and then is late is an exponential that begins late."""
    machine = Machine(ID)
    made = []
    for parts in (("lag", {"time_constant": 0.03}), ("delay", {"delay": 0.01})), (("delay", {"delay": 0.01}),):
        sims = machine.simulations(2, 1, [])
        sims.begin(np.arange(2), {"psi": np.tile(machine.space.nominal, (2, 1))})
        given = []
        for family, sizes in parts:
            effect, theta = build(family, DRIVES, sizes)
            effect.bind(machine.model)
            given.append(Given(effect, slice(0, 2), np.tile(theta, (2, 1))))
        residuals = Residuals(sims, given)
        residuals.recall(np.zeros((2, 4)), 5)
        residuals.command(np.ones((2, 4)))
        steps = []
        for _ in range(12):
            residuals.act()
            steps.append(sims.view.ctrl[0, 0])
        made.append(np.array(steps))
    dt = float(machine.model.opt.timestep)
    whole = round(0.01 / dt)
    time = dt * (1 + np.arange(12))
    late = np.concatenate([np.zeros(whole), 1 - np.exp(-time / 0.03)])[:12]
    np.testing.assert_allclose(made[0], late, atol=1e-9)
    np.testing.assert_allclose(made[1], np.arange(12) >= whole, atol=1e-9)


def late(delay: float) -> Any:
    effect, theta = build("delay", DRIVES, {"delay": delay})
    return ApplyEffects(gym.make(ID, context=["psi"]), [(effect, theta)])


def test_a_delay_is_found_and_no_mass_makes_up_for_it() -> None:
    trajectory = driven_in(late(0.08), {}, 300)
    nominal = Machine(ID).space.nominal[0]
    blind = Assimilation(ID, delta_s=False, effects=False).infer(trajectory)
    seeing = Assimilation(ID)
    belief = seeing.infer(trajectory)
    found = {e.family: theta for e, theta in belief.effects(500, np.random.default_rng(0))}
    assert abs(np.median(found["delay"]) - 0.08) < 0.03
    off = [abs(q.sample(500, np.random.default_rng(0)).psi[:, 0].mean() - nominal) for q in (blind, belief)]
    assert off[1] < off[0], "the base's mass"


def test_worlds_of_a_belief_have_its_effects_each_in_a_size_of_its_own() -> None:
    belief = Assimilation(ID).infer(driven_in(late(0.08), {}, 120))
    given: Any = {"hallucinate": True, "beta": 1.0, "episode": 50, "threads": 1, "seed": 0}
    ways = []
    for parts in (("psi", "effects"), ("psi",)):
        worlds = imagined(ID, belief, 6, parts=parts, **given)
        worlds.reset(seed=0)
        size = worlds.single_action_space.shape
        assert size is not None
        action = np.zeros((6, size[0]))
        action[:, 0] = 1.0
        for _ in range(4):
            worlds.step(action)
        base: Any = worlds.unwrapped
        ways.append(np.array(base.batch.bind("qpos"))[:, 0])
        worlds.close()
    assert np.ptp(ways[0]) > 0
    assert ways[0].mean() < ways[1].mean(), "late commands bring a rover less far"
