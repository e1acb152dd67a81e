"""The calibration records of a bench that is not connected: of a plan, and of a dry run."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
from calibrated import write_record

from rig.bench.apply_calibrations import check_records
from rig.bench.plan import BenchPlan, read_bench
from rig.core.errors import ConfigurationError

NOW = datetime(2026, 11, 28, tzinfo=UTC)
BENCH = """
name = "b"
[fixture]
mounted = "film-clamp"
[load_cell]
name = "{cell}"
sensitivity_V_N = 0.1
[daq]
driver = "keysight-u2300a"
resource = "USB0::0x0957::0x1518::TW1::INSTR"
channels = {{ load_cell = 101 }}
[calibrations]
load_cell = "cell.json"
"""


def bench(
    folder: Path, cell: str = "cell 3", valid_until: str = "2027-06-01T00:00:00Z"
) -> BenchPlan:
    write_record(folder / "cell.json", datetime(2026, 1, 1, tzinfo=UTC), valid_until)
    (folder / "bench.toml").write_text(BENCH.format(cell=cell))
    return read_bench(folder / "bench.toml")


def test_a_record_that_runs_can_use_is_accepted_and_one_about_to_expire_is_a_warning(
    tmp_path: Path,
) -> None:
    assert check_records(bench(tmp_path), NOW) == []
    (warning,) = check_records(bench(tmp_path, valid_until="2026-12-01T00:00:00Z"), NOW)
    assert "expires on 2026-12-01" in warning


def test_a_record_of_another_load_cell_is_refused_without_the_instruments(tmp_path: Path) -> None:
    """Found by an attack: a batch plan and a dry run compared a record with itself."""
    with pytest.raises(ConfigurationError, match="is the calibration of 'cell 3', on the bench is"):
        check_records(bench(tmp_path, cell="cell 4"), NOW)


def test_an_expired_record_is_refused_unless_it_is_allowed(tmp_path: Path) -> None:
    expired = bench(tmp_path, valid_until="2026-06-01T00:00:00Z")
    with pytest.raises(ConfigurationError, match="expired on 2026-06-01"):
        check_records(expired, NOW)
    (warning,) = check_records(expired, NOW, allow_expired=True)
    assert "is used because that was allowed" in warning
