"""Wrappers around any Gymnasium MuJoCo environment, each with a twin for vector environments (`Vector...`)."""

from nfc_gym.wrappers.anomaly import MonitorAnomaly, VectorMonitorAnomaly
from nfc_gym.wrappers.dynamics import ResidualDynamics
from nfc_gym.wrappers.effects import ApplyEffects
from nfc_gym.wrappers.psi import RandomizePsi
from nfc_gym.wrappers.record import RecordLog
from nfc_gym.wrappers.signals import PerturbSignals, VectorPerturbSignals
from nfc_gym.wrappers.terrain import ResidualTerrain

__all__ = [
    "ApplyEffects",
    "MonitorAnomaly",
    "PerturbSignals",
    "RandomizePsi",
    "RecordLog",
    "ResidualDynamics",
    "ResidualTerrain",
    "VectorMonitorAnomaly",
    "VectorPerturbSignals",
]
