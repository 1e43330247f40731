"""What is damaged must be healthy before: in every format of logs the undamaged case passes the check."""

from importlib import import_module
from pathlib import Path

import pytest

from nfc_gym.measured.checks import check


@pytest.mark.parametrize("suffix", ["npz", "csv", "parquet", "mat", "bag", "mcap"])
def test_a_case_is_healthy_in_every_format(suffix: str, tmp_path: Path) -> None:
    case = import_module("damage.case")
    if suffix not in case.FORMATS:
        pytest.skip("needs the extra ros")
    findings = check(case.healthy(suffix).write(tmp_path))
    assert [f.message for f in findings if f.level == "error"] == []
    first = {"bag": b"#ROSBAG ", "mcap": b"\x89MCAP0\r\n", "parquet": b"PAR1"}.get(suffix, b"")
    assert (tmp_path / f"run_0.{suffix}").read_bytes().startswith(first)


def test_a_log_that_a_bag_cannot_hold_is_of_another_format_under_its_name(tmp_path: Path) -> None:
    case = import_module("damage.case")
    broken = case.healthy("bag")
    if "bag" not in case.FORMATS:
        pytest.skip("needs the extra ros")
    broken.logs["run_1"]["q"] = broken.logs["run_1"]["q"][:3]
    broken.write(tmp_path)
    assert (tmp_path / "run_1.bag").read_bytes().startswith(b"PK")
