"""The calibration records of a bench that is not connected: of a plan, and of a dry run."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from calibrated import write_record

from rig.bench import apply_calibrations as apply_calibrations_module
from rig.bench.apply_calibrations import apply_calibrations, check_records
from rig.bench.connected import Bench
from rig.bench.plan import BenchPlan, read_bench
from rig.core.errors import ConfigurationError
from rig.instruments.calibration import FilmCalibration, as_text, make_record, read_calibration

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


SKIN = """
name = "b"
[fixture]
mounted = "plate"
[skin]
films = { strip_1 = "film 7" }
[daq]
driver = "keysight-u2300a"
resource = "USB0::0x0957::0x1518::TW1::INSTR"
channels = { strip_1 = 101, strip_2 = 102 }
[calibrations]
strip_1 = "film.json"
"""


def write_film(path: Path, amplifier_gain: float | None) -> None:
    """Write the record of film 7."""
    interval: dict[str, Any] = {"standard_error": 0.03, "low": None, "high": None}
    fields = {
        "sensor": "film 7",
        "date": "2026-11-01T00:00:00Z",
        "valid_until": "2027-01-30T00:00:00Z",
        "simulated": False,
        "source": {"run_uuid": "", "file": "", "simulated": False},
        "b_dB": {"value": -30.0, "unit": "dB re 1 V/N", **interval},
        "corner_Hz": {"value": 2000.0, "unit": "Hz", **interval},
        "delay_us": {"value": 0.0, "unit": "us", **interval},
        "inverse_corner_s": 8e-5,
        "polarity": 1,
        "covariance": [[1e-3, 0, 0], [0, 1e-12, 0], [0, 0, 1e-12]],
        "points": 100,
        "lowest_frequency_Hz": 2.0,
        "highest_frequency_Hz": 20e3,
        "amplifier_gain": amplifier_gain,
    }
    path.write_text(as_text(make_record(FilmCalibration, fields)))


def unconnected(plan: BenchPlan) -> Bench:
    """A bench without a connected instrument."""
    nothing: Any = None
    return Bench(plan, nothing, {}, nothing)


def test_the_record_of_a_strip_needs_the_gain_of_its_amplifier(tmp_path: Path) -> None:
    """It is refused before a run is armed, with its file."""
    file = tmp_path / "bench.toml"
    file.write_text(SKIN)
    write_film(tmp_path / "film.json", 1.0)
    plan = read_bench(file)
    assert check_records(plan, NOW) == []
    assert len(apply_calibrations(unconnected(plan), NOW)[0]) == 1
    write_film(tmp_path / "film.json", None)
    words = (
        r"calibrations\.strip_1: .*film\.json: the record of film 'film 7' does not state its am"
    )
    with pytest.raises(ConfigurationError, match=words) as refusal:
        check_records(plan, NOW)
    assert "or remove strip_1 from [calibrations]" in str(refusal.value.hint)
    with pytest.raises(ConfigurationError, match=words):
        apply_calibrations(unconnected(plan), NOW)


@pytest.mark.parametrize(
    ("key", "table"),
    [
        ("film", "film"),
        ("force_sensor", "force_sensor"),
        ("load_cell", "load_cell"),
        ("strip_1", "skin"),
        ("strip_2", "skin"),
    ],
)
def test_a_record_whose_part_the_bench_file_lacks_is_refused_by_its_key(
    tmp_path: Path, key: str, table: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plan of a batch refuses it as its runs would."""
    file = tmp_path / "bench.toml"
    named = f'[calibrations]\n{key} = "it.json"\n'
    file.write_text(f'name = "b"\n[fixture]\nmounted = "plate"\n{named}')
    plan = read_bench(file)
    write_film(tmp_path / "it.json", 1.0)
    record = read_calibration(tmp_path / "it.json", FilmCalibration)
    monkeypatch.setattr(apply_calibrations_module, "read_calibration", lambda *_: record)
    words = rf"calibrations\.{key} names .*it\.json, but the bench file has no \[{table}\] table"
    with pytest.raises(ConfigurationError, match=words) as refusal:
        check_records(plan, NOW)
    assert refusal.value.hint == f"add a [{table}] table, or remove {key} from [calibrations]"
    with pytest.raises(ConfigurationError, match=words):
        apply_calibrations(unconnected(plan), NOW)
