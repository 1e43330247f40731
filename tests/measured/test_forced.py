"""A force of unknown course is placed at the joint that it acts on."""

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.forced import forced, surest
from nfc_gym.measured.impulse import Tensor

MODEL = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<body name="car" pos="0 0 0.1"><freejoint name="root"/><geom size="0.1"/>
<body name="arm" pos="0 0 0.1"><joint name="knee"/><geom size="0.05"/>
<body name="hand" pos="0 0 0.1"><joint name="wrist"/><geom size="0.05"/></body></body></body></worldbody></mujoco>"""
SEGMENTS, BLOCKS, NUMBERS = 30, 8, 60
SIZES = {d: 0.1 if d < 6 else 2.0 for d in range(8)}


def made(rng: np.random.Generator) -> Tensor:
    """Answers that the joints share by half: what moves one moves the others."""
    own, shared = rng.normal(size=(2, SEGMENTS, 8, BLOCKS, NUMBERS))
    answer = own + shared[:, :1]
    return Tensor(None, np.arange(SEGMENTS), tuple(SIZES), answer / np.array([*SIZES.values()])[:, None, None])  # type: ignore[arg-type]


@pytest.mark.parametrize(("joint", "dofs"), [("root", [3, 4]), ("knee", [6]), ("wrist", [7])])
def test_the_joint_that_is_pushed_has_most_evidence(joint: str, dofs: list[int]) -> None:
    rng, model = np.random.default_rng(0), mujoco.MjModel.from_xml_string(MODEL)
    tensor = made(rng)
    force = 0.3 * rng.normal(size=(SEGMENTS, len(dofs), BLOCKS)) * np.array([SIZES[d] for d in dofs])[:, None]
    rest = rng.normal(size=(SEGMENTS, NUMBERS)) + np.einsum("skb,skbm->sm", force, tensor.answer[:, dofs])
    evidence = forced(model, tensor, SIZES, rest)
    assert next(iter(evidence)) == joint == surest(evidence)
    assert set(evidence) == {"root", "knee", "wrist"}


def test_noise_is_placed_nowhere() -> None:
    rng, model = np.random.default_rng(0), mujoco.MjModel.from_xml_string(MODEL)
    for _ in range(5):
        assert surest(forced(model, made(rng), SIZES, rng.normal(size=(SEGMENTS, NUMBERS)))) is None


def test_a_lead_that_is_small_is_none() -> None:
    assert surest({"root": 30.0, "knee": 17.0}) == "root"
    assert surest({"root": 30.0, "knee": 19.0}) is None
    assert surest({"root": 11.0}) is None
    assert surest({}) is None
