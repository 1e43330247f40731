"""Packages whose public names are imported when they are first asked for, so that importing the package stays light."""

import sys
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

from nfc_gym.core.errors import MissingExtra


def export(package: str, homes: Mapping[str, str], extra: str) -> None:
    """Give a package public names that load the modules they live in.

    A module may be called like the function that it is there for (`measured/predict.py`). The package's attribute is
    then the function, whichever was imported first; the module is reached by `from package.predict import ...`.

    Args:
      package: its full name; it is being imported.
      homes: public name -> module of the package that has it.
      extra: of `pip install 'nfc_gym[...]'` that those modules need.
    """

    class Lazy(ModuleType):
        def __getattr__(self, name: str) -> Any:
            if name not in homes:
                raise AttributeError(f"module {package!r} has no attribute {name!r}")
            try:
                return getattr(import_module(f"{package}.{homes[name]}"), name)
            except ModuleNotFoundError as e:
                raise MissingExtra(f"{package} needs {e.name}: pip install 'nfc_gym[{extra}]'") from None

        def __setattr__(self, name: str, value: Any) -> None:
            if not (name in homes and isinstance(value, ModuleType)):  # a submodule that hides the function in it
                super().__setattr__(name, value)

        def __dir__(self) -> list[str]:
            return sorted({*super().__dir__(), *homes})

    sys.modules[package].__class__ = Lazy
