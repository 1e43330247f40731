"""Effects of unknown sizes beside psi: where they are absent, a delay that is no mass, and worlds that have them."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rounds import fewer
from test_assimilation import driven_in

from nfc_gym import InputError
from nfc_gym.adaptation.assimilated import Assimilated
from nfc_gym.adaptation.assimilation import Assimilation
from nfc_gym.adaptation.imagined import imagined
from nfc_gym.adaptation.structure import names, structure_of
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.physics.effects import build
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.residuals import Given, Residuals
from nfc_gym.wrappers import ApplyEffects, PerturbSignals

ID = "nfc_gym/JackalFlat-v0"
DRIVES = "front_left+front_right+rear_left+rear_right"


@pytest.fixture(scope="module", autouse=True)
def few() -> Iterator[None]:
    """Fewer rounds than a mission's, in half the time."""
    with pytest.MonkeyPatch.context() as patch:
        fewer(patch, 0.4, 0.4, 0.2, 0.05, nearer=(1, 0.25, 0.06, 0.015, 0.004))
        yield


@pytest.fixture(scope="module")
def delayed(few: None) -> tuple[Assimilation, Trajectory, Assimilated]:
    """What is inferred of a rover whose commands are late: who infers, from what, and the belief."""
    q, trajectory = Assimilation(ID), driven_in(late(0.08), {}, 100)
    return q, trajectory, q.infer(trajectory)


def test_sizes_are_absent_at_their_null_and_stay_within_bounds() -> None:
    structure = structure_of(Machine(ID))
    far = 40.0 * np.stack([-np.ones(len(structure)), np.ones(len(structure))])
    for effect, sizes, values in zip(structure.effects, structure.sizes, structure.values(far), strict=True):
        assert (effect.low <= values).all(), effect.id
        assert (values <= effect.high).all(), effect.id
        one_sided = [not s.low < s.null < s.high for s in sizes]
        np.testing.assert_allclose(values[0, one_sided], effect.null[one_sided], atol=1e-12)
    both = structure_of(Machine(ID), ["gain", "delay"])
    assert len(both) == 6, "a gain for each drive and one for all, and a delay"
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


def test_a_delay_is_found_and_no_mass_makes_up_for_it(delayed: tuple[Assimilation, Trajectory, Assimilated]) -> None:
    _, trajectory, belief = delayed
    nominal = Machine(ID).space.nominal[0]
    blind = Assimilation(ID, delta_s=False, effects=False).infer(trajectory)
    found = {e.family: theta for e, theta in belief.effects(500, np.random.default_rng(0))}
    assert abs(np.median(found["delay"]) - 0.08) < 0.03
    off = [abs(q.sample(500, np.random.default_rng(0)).psi[:, 0].mean() - nominal) for q in (blind, belief)]
    assert off[1] < off[0], "the base's mass"


def test_worlds_of_a_belief_have_its_effects_each_in_a_size_of_its_own(
    delayed: tuple[Assimilation, Trajectory, Assimilated],
) -> None:
    belief = delayed[2]
    given: Any = {"hallucinate": True, "beta": 1.0, "episode": 50, "threads": 1, "seed": 0}
    ways = []
    for parts in (("psi", "effects"), ("psi",)):
        worlds = imagined(ID, belief, 6, parts=parts, **given)
        worlds.reset(seed=0)
        size = worlds.single_action_space.shape
        assert size is not None
        action = np.zeros((6, size[0]))
        base: Any = worlds.unwrapped
        start = np.array(base.batch.bind("qpos"))[:, :2]
        for k in range(12):
            action[:, 0] = float(k > 1)  # from rest: what was commanded before an episode is its first command
            worlds.step(action)
        ways.append(np.linalg.norm(np.array(base.batch.bind("qpos"))[:, :2] - start, axis=1))
        worlds.close()
    assert np.ptp(ways[0]) > 0
    assert ways[0].mean() < ways[1].mean(), "late commands bring a rover less far"


def test_sensors_noise_is_found_and_worlds_have_it() -> None:
    q = Assimilation(ID, effects=False)
    sd = np.where(q.machine.noise > 0, 3 * q.machine.noise, 0.0)
    noisy = PerturbSignals(gym.make(ID, context=["psi"]), {"proprio": {"sd": sd.tolist()}})
    belief = q.infer(driven_in(noisy, {}, 100))
    assert belief.noise is not None
    assert (belief.noise[q.machine.noise == 0] == 0).all(), "where no sensor is"
    found = belief.noise[sd > 0] / sd[sd > 0]
    assert 0.7 < np.median(found) < 1.5, found
    seen = {}
    for parts in (("psi", "noise"), ("psi",)):
        worlds = imagined(ID, belief, 32, hallucinate=False, parts=parts, beta=1.0, episode=50, threads=1, seed=0)
        observation, _ = worlds.reset(seed=0)
        seen[parts] = observation["observation"][:, : len(sd)]
        worlds.close()
    off = (seen["psi", "noise"] - seen[("psi",)]).std(0)
    np.testing.assert_allclose(off[sd > 0], belief.noise[sd > 0], rtol=0.5)
    assert (off[sd == 0] == 0).all()


def test_worlds_are_drawn_where_replays_do_as_was_seen(delayed: tuple[Assimilation, Trajectory, Assimilated]) -> None:
    q, trajectory, belief = delayed
    near = belief.near()
    assert belief.share < 1
    segments, rng = q.segments(trajectory), np.random.default_rng(0)
    seen = q.machine.noise > 0
    off = {}
    for name, of in (
        ("mean", belief.mean[None]),
        ("near", near.coordinates(8, rng)),
        ("all", belief.coordinates(8, rng)),
    ):
        off[name] = np.median((q._misses([segments], of, seen, q.machine.noise[seen]) ** 2).mean((1, 2)))
    assert off["near"] < 2 * off["mean"]
    assert off["near"] < 0.5 * off["all"]
    d = len(q.machine.space)
    assert not near.covariance[:d, d:].any(), "psi and effects are drawn apart"


def test_what_is_remembered_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    fewer(monkeypatch, 0.4)
    first, second = (driven_in(late(0.08), {}, 120, seed) for seed in (3, 4))
    q = Assimilation(ID, delta_s=False, memory=2)
    alone = q.infer(second)
    both = q.updated(first, alone).infer(second)
    seen = q.machine.noise > 0
    means = np.stack([alone.mean, both.mean])
    off = np.sqrt((q._misses([q.segments(first)], means, seen, q.machine.noise[seen]) ** 2).mean((1, 2)))
    assert off[1] < off[0], "the first trajectory is explained better by a belief that remembers it"
    for _ in range(3):
        q = q.updated(first, alone)
    assert len(q.remembered) == 2
    assert Assimilation(ID, delta_s=False, memory=0).updated(first, alone).remembered == ()
