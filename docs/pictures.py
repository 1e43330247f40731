"""Pictures of the ten environments for the README, rendered by the environments: `python docs/pictures.py`."""

import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import cv2
import gymnasium
import numpy as np

import nfc_gym  # noqa: F401 (registers the environments)

FOLDER = Path(__file__).resolve().parent / "envs"
SIZE = (320, 240)
# Robot -> control steps before the picture (0.02 s each), what the camera follows, and from where.
SHOTS = {
    "Ant": (40, {"trackbody": "torso", "distance": 3.3, "azimuth": 215, "elevation": -24}),
    "Humanoid": (4, {"trackbody": "torso", "distance": 3.6, "azimuth": 215, "elevation": -16}),
    "Quadruped": (40, {"trackbody": "base", "distance": 1.7, "azimuth": 215, "elevation": -22}),
    "Quadcopter": (0, {"trackbody": "base", "distance": 1.5, "azimuth": 215, "elevation": -22}),
    "Jackal": (40, {"trackbody": "base", "distance": 1.9, "azimuth": 215, "elevation": -24}),
}


def picture(robot: str, ground: str) -> np.ndarray:
    """(240, 320, 3) of a robot, four pixels averaged into one."""
    steps, camera = SHOTS[robot]
    rough = {"terrain_pool": 1, "terrain_seed": 3} if ground == "Rough" else {}
    env = gymnasium.make(
        f"nfc_gym/{robot}{ground}-v0",
        render_mode="rgb_array",
        width=2 * SIZE[0],
        height=2 * SIZE[1],
        camera=camera,
        context=(),
        **rough,
    )
    env.reset(seed=1)
    for _ in range(steps):
        env.step(np.zeros(env.action_space.shape, np.float32))
    image = env.render()
    env.close()
    return cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for robot in SHOTS:
        for ground in ("Flat", "Rough"):
            file = FOLDER / f"{robot}{ground}.jpg"
            cv2.imwrite(str(file), picture(robot, ground)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
            print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")
