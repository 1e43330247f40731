"""Lets the tests here import `machines` of the physics tests and `fakes`, their own helpers."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "physics"))
