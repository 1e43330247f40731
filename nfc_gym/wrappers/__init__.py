"""Wrappers around any Gymnasium MuJoCo environment, each with a twin, `Vector...`, around vector environments.

Those that act in the physics need `unwrapped.model` and `unwrapped.data` of an environment (their twins the vector
environments of this package, which run on `mujoco.batch`); `PerturbSignals` and `MonitorAnomaly` need nothing of
MuJoCo.
"""

from nfc_gym.wrappers.anomaly import Detector, MonitorAnomaly, VectorMonitorAnomaly
from nfc_gym.wrappers.dynamics import ResidualDynamics, VectorResidualDynamics
from nfc_gym.wrappers.effects import ApplyEffects, VectorApplyEffects
from nfc_gym.wrappers.hallucinate import Hallucinate, VectorHallucinate
from nfc_gym.wrappers.perceive import PerceiveTerrain, VectorPerceiveTerrain
from nfc_gym.wrappers.psi import RandomizePsi, VectorRandomizePsi
from nfc_gym.wrappers.record import RecordLog, VectorRecordLog
from nfc_gym.wrappers.signals import PerturbSignals, VectorPerturbSignals
from nfc_gym.wrappers.terrain import ResidualTerrain, VectorResidualTerrain

__all__ = [
    "ApplyEffects",
    "Detector",
    "Hallucinate",
    "MonitorAnomaly",
    "PerceiveTerrain",
    "PerturbSignals",
    "RandomizePsi",
    "RecordLog",
    "ResidualDynamics",
    "ResidualTerrain",
    "VectorApplyEffects",
    "VectorHallucinate",
    "VectorMonitorAnomaly",
    "VectorPerceiveTerrain",
    "VectorPerturbSignals",
    "VectorRandomizePsi",
    "VectorRecordLog",
    "VectorResidualDynamics",
    "VectorResidualTerrain",
]
