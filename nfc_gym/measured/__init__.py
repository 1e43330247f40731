"""Measured logs in, the missing effect out: mapping, readers, checks, calibration, attribution, report.

Needs the extra `measured`; importing this package without it says so.
"""

from importlib.util import find_spec
from typing import TYPE_CHECKING

from nfc_gym.core import MissingExtra, lazy

if TYPE_CHECKING:
    from nfc_gym.measured.checks import check
    from nfc_gym.measured.dataset import Dataset, load
    from nfc_gym.measured.excite import excite
    from nfc_gym.measured.loop import close_loop
    from nfc_gym.measured.predict import predict

_NEEDED = ("pandas", "pyarrow", "pydantic", "yaml", "jinja2", "markupsafe")
_missing = [name for name in _NEEDED if find_spec(name) is None]
if _missing:
    raise MissingExtra(f"nfc_gym.measured needs {', '.join(_missing)}: pip install 'nfc_gym[measured]'")

_HOME = {
    "Dataset": "dataset",
    "check": "checks",
    "close_loop": "loop",
    "excite": "excite",
    "load": "dataset",
    "predict": "predict",
}
__all__ = ["Dataset", "check", "close_loop", "excite", "load", "predict"]

lazy.export(__name__, _HOME, "measured")
