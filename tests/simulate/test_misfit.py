"""Motion and misfit: nothing is missed where the model is right, and nothing hangs on where the window happened."""

from pathlib import Path

import numpy as np
import pytest

from nfc_gym.inference.windows import Windows
from nfc_gym.simulate import simulate
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.misfit import images, levelled, of_windows, predicted, shown

ROBOTS = ("Quadcopter", "Jackal")


def windows(folder: Path, robot: str, effects: float) -> Windows:
    return simulate(f"nfc_gym/{robot}Flat-v0", 24, folder, seed=3, jobs=1, effects=effects, motor=0.0)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_right_model_misses_nothing(tmp_path: Path, robot: str) -> None:
    stored, machine = windows(tmp_path, robot, 0.0), Machine(f"nfc_gym/{robot}Flat-v0")
    batch, model, space = stored.take(np.arange(24)), machine.model, machine.space
    starts = batch["start"][:, 1 : 1 + model.nq + model.nv + model.na]
    psi = space.low + batch["psi"] * (space.high - space.low)
    expected = predicted(machine, starts, psi, batch["actions"].astype(float))
    missed = shown(machine, batch["states"].astype(float), expected, machine.noise)[..., len(machine.state_names) :]
    told = machine.noise > 0
    assert np.quantile(np.abs(missed[..., told]), 0.99) < 0.05  # standard deviations of the sensors


def test_an_effect_is_missed(tmp_path: Path) -> None:
    machine, missed = Machine("nfc_gym/QuadcopterFlat-v0"), {}
    for share in (0.0, 1.0):
        stored = windows(tmp_path / str(share), "Quadcopter", share)
        states, fine = of_windows(machine, stored, np.arange(24), 0.1, np.random.default_rng(0))
        assert fine.all()
        missed[share] = np.abs(states[:, 1:, len(machine.state_names) :]).max((1, 2))
    assert np.quantile(missed[1.0], 0.75) > np.quantile(missed[0.0], 0.9) > 0


@pytest.mark.parametrize("robot", ROBOTS)
def test_where_and_facing_where_is_left_out(tmp_path: Path, robot: str) -> None:
    stored, machine = windows(tmp_path, robot, 0.0), Machine(f"nfc_gym/{robot}Flat-v0")
    states = stored.take(np.arange(24), ["states"])["states"].astype(float)
    seen = levelled(machine, states, states[:, 0])
    names = list(machine.state_names)
    quat = [names.index(f"body:base:quat.{c}") for c in "wxyz"]
    turn = 1.1
    w, x, y, z = (states[..., i] for i in quat)
    c, s = np.cos(turn / 2), np.sin(turn / 2)
    turned = states.copy()
    turned[..., quat] = np.stack((c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w), -1)
    place = [0, 1] if robot == "Quadcopter" else [names.index(f"body:base:pos.{a}") for a in "xy"]
    pairs = [place] + ([[7, 8]] if robot == "Quadcopter" else [])
    c, s = np.cos(turn), np.sin(turn)
    for a, b in pairs:
        turned[..., a], turned[..., b] = (
            c * states[..., a] - s * states[..., b],
            s * states[..., a] + c * states[..., b],
        )
    turned[..., place] += (3.0, -2.0)
    assert levelled(machine, turned, turned[:, 0]) == pytest.approx(seen, abs=1e-6)


@pytest.mark.parametrize("robot", ROBOTS)
def test_in_a_mirror_motion_and_misfit_are_their_own_images(tmp_path: Path, robot: str) -> None:
    stored, machine = windows(tmp_path, robot, 0.0), Machine(f"nfc_gym/{robot}Flat-v0")
    seen = stored.take(np.arange(24), ["states"])["states"].astype(float)
    expected = seen + 0.1 * machine.noise * np.random.default_rng(0).standard_normal(seen.shape)
    both = shown(machine, seen, expected, machine.noise)
    assert len(images(machine)) == len(machine.mirrors) == 2
    for image, mirror in zip(images(machine), machine.mirrors, strict=True):
        there = shown(machine, mirror.states(seen), mirror.states(expected), machine.noise)
        assert image.states(both) == pytest.approx(there, abs=2e-5)
        assert np.abs(there - both).max() > 0.1
