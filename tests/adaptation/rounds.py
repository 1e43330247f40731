"""Assimilation in less time than a mission gives it."""

import pytest


def fewer(patch: pytest.MonkeyPatch, *near: float, draws: int = 64, nearer: tuple[float, ...] = (1.0,)) -> None:
    """Rounds with draws at these shares of the covariance; `nearer` the shares that `Assimilated.near` may have."""
    patch.setattr("nfc_gym.adaptation.assimilation._NEAR", near)
    patch.setattr("nfc_gym.adaptation.assimilation._NEARER", nearer)
    patch.setattr("nfc_gym.adaptation.assimilation.DRAWS", draws)
