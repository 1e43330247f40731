"""Measured logs in, the missing effect out: mapping, readers, checks, calibration, attribution, report.

Needs the extra `measured`; importing this package without it says so.
"""

from importlib.util import find_spec

from nfc_gym.core import MissingExtra

_NEEDED = ("pandas", "pyarrow", "pydantic", "yaml", "jinja2", "markupsafe")
_missing = [name for name in _NEEDED if find_spec(name) is None]
if _missing:
    raise MissingExtra(f"nfc_gym.measured needs {', '.join(_missing)}: pip install 'nfc_gym[measured]'")
