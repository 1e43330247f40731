"""Packages export their public names without loading what these need."""

import subprocess
import sys
from importlib import import_module
from types import ModuleType

import pytest

import nfc_gym

PACKAGES = ("nfc_gym.inference", "nfc_gym.measured")


@pytest.mark.parametrize("name", PACKAGES)
def test_every_name_is_there_and_listed(name: str) -> None:
    package = import_module(name)
    assert package.__all__ == sorted(package._HOME)
    assert set(package.__all__) <= set(dir(package))
    for each in package.__all__:
        assert getattr(package, each).__name__ == each
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = package.nothing


def test_a_function_is_not_hidden_by_the_module_that_it_lives_in() -> None:
    for package, name in (("nfc_gym.measured", "predict"), ("nfc_gym.inference", "train")):
        module = import_module(f"{package}.{name}")
        assert isinstance(module, ModuleType)
        assert getattr(import_module(package), name) is getattr(module, name)


def test_the_names_load_only_when_they_are_asked_for() -> None:
    code = f"import sys, {', '.join(PACKAGES)}; print([m for m in ('torch', 'pandas', 'pydantic') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_root_has_the_plain_data() -> None:
    assert "Fidelity" in nfc_gym.__all__
    assert nfc_gym.Fidelity(psi=[[1.0]]).psi is not None
