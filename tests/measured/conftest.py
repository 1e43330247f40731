"""A pendulum with a motor, measured without fault: the data set that the tests then spoil, one thing at a time."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from arm import Closed

sys.path.insert(0, str(Path(__file__).parent))  # `writers`, `rotor`, ...: importlib mode does not add the folder

MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="bob">
      <joint name="hinge" axis="0 1 0" range="-2.5 2.5" limited="true"/>
      <geom name="weight" size="0.02" pos="0 0 -0.1" mass="0.1"/>
    </body>
    <body name="base" pos="0 1 1">
      <freejoint name="root"/>
      <geom name="hull" size="0.1" mass="1"/>
      <site name="imu"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="hinge" kp="10" ctrlrange="-2.5 2.5"/>
  </actuator>
  <sensor>
    <gyro name="gyro" site="imu"/>
    <accelerometer name="acc" site="imu"/>
  </sensor>
</mujoco>
"""

MAPPING = """
version: 1
model: machine.xml
parameters:
  - {name: mass, field: body_mass, of: [bob], unit: kg, low: 0.05, high: 0.2}
logs:
  - {path: "*.npz"}
time: {column: t}
controls:
  "ctrl:servo": {column: goal, unit: rad}
channels:
  "joint:hinge:pos": {column: q, unit: rad, noise: 0.001}
  "joint:hinge:vel": {column: v, unit: rad/s, noise: 0.01}
  "body:base:quat": {columns: [qw, qx, qy, qz], order: wxyz, noise: 0.01}
  "sensor:gyro": {columns: [gx, gy, gz], unit: rad/s, noise: 0.01}
segments: {length: 0.4}
"""


def columns(seed: int = 0, seconds: float = 4.0, rate: float = 100.0) -> dict[str, np.ndarray]:
    """A swing, and a body that yaws to and fro by 0.8 rad."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate)) / rate
    phase = rng.uniform(0, 2 * np.pi)
    q, v = np.sin(3 * t + phase), 3 * np.cos(3 * t + phase)
    yaw, yaw_rate = 0.8 * np.sin(2 * t), 1.6 * np.cos(2 * t)
    zero = np.zeros_like(t)
    noisy = lambda x, sd: x + sd * rng.standard_normal(len(t))  # noqa: E731
    return {
        "t": t,
        "goal": np.sin(3 * t + phase + 0.1),
        "q": noisy(q, 1e-3),
        "v": noisy(v, 1e-2),
        "qw": np.cos(yaw / 2),
        "qx": zero,
        "qy": zero,
        "qz": np.sin(yaw / 2),
        "gx": noisy(zero, 1e-2),
        "gy": noisy(zero, 1e-2),
        "gz": noisy(yaw_rate, 1e-2),
    }


@pytest.fixture(scope="session")
def machine() -> str:
    """The model."""
    return MODEL


@pytest.fixture(scope="session")
def closed(tmp_path_factory: pytest.TempPathFactory) -> "Closed":
    """A finished run on the machine of `arm`; read, never written to."""
    from arm import close

    return close(tmp_path_factory.mktemp("arm"))


Spoil = Callable[[dict[str, np.ndarray]], None]
Build = Callable[..., Path]


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """Write model, mapping and logs, `edit`ed (mapping text) and `spoil`ed (columns); returns the mapping's path."""

    def write(
        spoil: Spoil | None = None, *edits: tuple[str, str], logs: int = 3, seconds: float = 4.0, model: str = MODEL
    ) -> Path:
        text = MAPPING
        for old, new in edits:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "machine.xml").write_text(model)
        (tmp_path / "mapping.yaml").write_text(text)
        for k in range(logs):
            table = columns(k, seconds)
            if spoil is not None:
                spoil(table)
            np.savez(tmp_path / f"run_{k}.npz", **table)
        return tmp_path / "mapping.yaml"

    return write
