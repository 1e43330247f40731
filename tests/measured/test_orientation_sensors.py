"""Orientations that a sensor reads (`framequat`): the scalar order is said, and q and -q are the same."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import MODEL, Build

from nfc_gym.measured.bench import make_bench
from nfc_gym.measured.checks import check, require
from nfc_gym.measured.observe import observer
from nfc_gym.measured.predict import predict
from nfc_gym.measured.states import channel_noise
from nfc_gym.physics.state import quat_multiply, vector_to_quat

READS = MODEL.replace("<gyro", '<framequat name="camera" objtype="site" objname="eye"/><gyro').replace(
    '<geom name="weight"', '<site name="eye" pos="0 0 -0.1"/><geom name="weight"'
)
CAMERA = '  "sensor:camera": {columns: [cw, cx, cy, cz], order: wxyz, noise: 0.004}\nsegments:'


def turned(flip: bool = False, noise: float = 0.004, scale: float = 1.0) -> object:
    """The hinge's angle about y, as a camera on the bob sees it; with `flip` of either sign, as detectors give it."""

    def spoil(table: dict) -> None:
        rng = np.random.default_rng(5)
        q = table["q"][:, None]
        clean = np.concatenate([np.cos(q / 2), 0 * q, np.sin(q / 2), 0 * q], 1)
        read = scale * quat_multiply(clean, vector_to_quat(noise * rng.normal(size=(len(q), 3))))
        read = read * rng.choice([-1.0, 1.0], (len(q), 1)) if flip else read
        table.update({f"c{name}": read[:, i] for i, name in enumerate("wxyz")})

    return spoil


def errors(path: object) -> str:
    return "\n".join(str(f) for f in check(path) if f.severity == "error")  # type: ignore[arg-type]


def test_either_sign_is_the_same_orientation(build: Build) -> None:
    problems = []
    for flip in (False, True):
        data, _ = require(build(turned(flip), ("segments:", CAMERA), model=READS))
        bench = make_bench(data, 1)
        problem = bench.problem(data.logs)
        at = [i for i, p in enumerate(problem.columns.place) if p == "sensor:camera"]
        assert len(at) == 3 * 4  # a rotation vector at each of four horizons
        assert {problem.columns.unit[i] for i in at} == {"rad"}
        problems.append(problem.residual(bench.plant, bench.plant.space.nominal[None])[0][:, at])
    np.testing.assert_allclose(problems[0], problems[1], atol=1e-12)
    assert np.abs(problems[0]).max() < 1.0  # q against -q would be off by 2


def test_scalar_last_is_turned_round(build: Build) -> None:
    last = CAMERA.replace("[cw, cx, cy, cz], order: wxyz", "[cx, cy, cz, cw], order: xyzw")
    read = [require(build(turned(), ("segments:", c), model=READS))[0].logs[0] for c in (CAMERA, last)]
    one, other = (log.channels["sensor:camera"].values for log in read)
    assert np.array_equal(one, other)


def test_noise_is_estimated_in_rad(build: Build) -> None:
    """Of the rotation: that of the four numbers is half of it."""
    data, _ = require(build(turned(noise=0.02), ("segments:", CAMERA.replace(", noise: 0.004", "")), model=READS))
    assert channel_noise(data.logs[0], "sensor:camera") == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (CAMERA.replace("order: wxyz", "unit: 1"), ["sensor:camera", "which column is the scalar", "order"]),
        (CAMERA.replace("order: wxyz", "order: wxyz, axes: [x]"), ["`axes` is for vector sensors"]),
        (CAMERA.replace("order: wxyz", "order: wxyz, unit: rad"), ["a quaternion has none"]),
        (CAMERA.replace("cx, cy, cz", "cx, cy"), ["3 columns where 4 are wanted"]),
        (CAMERA.replace("sensor:camera", "sensor:acc"), ["`order` is for orientations", "'acc'"]),
        (CAMERA.replace("segments:", "segments: {mode: forward, length: 0.4}\n#"), ["mode forward", "roll-outs"]),
    ],
)
def test_what_does_not_fit_is_an_error(build: Build, camera: str, words: list[str]) -> None:
    found = errors(build(turned(), ("segments:", camera), model=READS))
    for word in words:
        assert word in found


def test_what_is_no_unit_quaternion_is_an_error(build: Build) -> None:
    assert "unit quaternions" in errors(build(turned(scale=2.0), ("segments:", CAMERA), model=READS))


def test_forward_predicts_what_it_does_not_compare(build: Build, tmp_path: Path) -> None:
    """`nfc-gym predict --mode forward` of a mapping for roll-outs: w, x, y and z along the log."""
    path = build(turned(), ("segments:", CAMERA), model=READS)
    camera = require(path)[0].logs[0].channels["sensor:camera"].values
    out = predict(path, None, "forward", "nominal", tmp_path / "p.npz")["run_0"]
    assert out.shape == (400, 3 + 4)  # the gyroscope first
    assert np.abs(np.abs((out[:, 3:] * camera).sum(1)) - 1).max() < 1e-3  # within the noise of a rotation


def test_a_ball_joints_sensor_is_one() -> None:
    ball = '<body><joint name="b" type="ball"/><geom size=".1" mass="1"/></body>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody>{ball}</worldbody><sensor><ballquat name="q" joint="b"/></sensor></mujoco>'
    )
    found = observer(model, "sensor:q")
    assert found is not None
    assert (found.quaternion, found.size, found.needs_sensors) == (True, 3, True)
