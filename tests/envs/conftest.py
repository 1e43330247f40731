"""Lets the tests here import `views`, their shared helper (pytest's importlib mode does not add the folder)."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
