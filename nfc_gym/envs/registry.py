"""The ten environments' ids."""

import gymnasium

ROBOTS = ("Ant", "Humanoid", "Quadruped", "Quadcopter", "Jackal")
EPISODE = 1000  # control steps: 20 s


def register() -> None:
    """Register `nfc_gym/<Robot>Flat-v0` and `nfc_gym/<Robot>Rough-v0`; doing so again changes nothing."""
    for robot in ROBOTS:
        for ground in ("Flat", "Rough"):
            name = f"nfc_gym/{robot}{ground}-v0"
            if name not in gymnasium.registry:
                gymnasium.register(
                    name,
                    entry_point="nfc_gym.envs.single:make",
                    vector_entry_point="nfc_gym.envs.vector:make",
                    max_episode_steps=EPISODE,
                    kwargs={"robot": f"nfc_gym.envs.{robot.lower()}:{robot}", "rough": ground == "Rough"},
                )
