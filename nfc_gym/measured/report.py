"""`report.html`: one self-contained page that a person can read in a minute."""

from typing import Any


def render(report: dict[str, Any], shown: dict[str, Any]) -> str:
    """The page for a report (as in `report.json`) and the data of its pictures (see `details.details`)."""
    return "<!doctype html><title>nfc-gym report</title><pre>" + str(report["verdict"]) + "</pre>"
