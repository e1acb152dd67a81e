"""Calibration records: what is written comes back, and what may not be used is refused by name."""

from __future__ import annotations

import json
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from rig.core.errors import ConfigurationError, ExitCode, OutputError
from rig.instruments.calibration import (
    CalibrationRecord,
    FilmCalibration,
    ForceCalibration,
    LoadCellCalibration,
    as_text,
    header_entry,
    read_calibration,
    require_folder,
    require_valid,
    write_calibration,
)

MEASURED = datetime(2026, 11, 21, 22, 0, tzinfo=timezone(timedelta(hours=1)))
NOW = MEASURED + timedelta(days=1)


def quantity(value: float | None, error: float = 0.1, unit: str = "dB") -> dict[str, Any]:
    ends = (None, None) if value is None else (value - 2 * error, value + 2 * error)
    return {
        "value": value,
        "standard_error": error,
        "low": ends[0],
        "high": ends[1],
        "unit": unit,
    }


def common(days: float = 90, **changes: Any) -> dict[str, Any]:
    return {
        "sensor": "film 7",
        "date": MEASURED,
        "valid_until": MEASURED + timedelta(days=days),
        "operator": "A. Person",
        "simulated": False,
    } | changes


def film(**changes: Any) -> FilmCalibration:
    return FilmCalibration.model_validate(
        common()
        | {
            "source": {"run_uuid": "6d1f3a52", "file": "sweep_r001.h5", "simulated": False},
            "b_dB": quantity(-78.0),
            "corner_Hz": quantity(2000.0, 10.0, "Hz"),
            "delay_us": quantity(0.0, 0.1, "us"),
            "inverse_corner_s": 5e-4,
            "polarity": 1,
            "drops": [{"frequency_Hz": 500.0, "pole_Q": 10.0, "depth_dB": 13.0}],
            "covariance": [[0.1 * (j == k) for j in range(6)] for k in range(6)],
            "points": 141,
            "lowest_frequency_Hz": 2.0,
            "highest_frequency_Hz": 20000.0,
        }
        | changes
    )


def force_sensor(**changes: Any) -> ForceCalibration:
    reading = {
        "force_N": (0, 0, 5),
        "reading_mV_V": (0.01, -0.0006, 0.0795),
        "standard_error_mV_V": (1e-6, 1e-6, 1e-6),
        "samples": 2000,
    }
    return ForceCalibration.model_validate(
        common(365, sensor="21034415")
        | {
            "weights_N": (5, 10),
            "weight_tolerance_percent": 0.02,
            "coverage": 1.96,
            "zero_mV_V": (0.01, 0.0, 0.02),
            "zero_standard_error_mV_V": (1e-6, 1e-6, 1e-6),
            "matrix_N_mV_V": ((83.0, 0.3, 0), (0.3, 80.0, 0.8), (1.5, 0.4, 84.0)),
            "matrix_standard_error_N_mV_V": ((0.01,) * 3,) * 3,
            "residual_rms_N": 0.001,
            "largest_residual_N": 0.002,
            "crosstalk_percent": 1.8,
            "readings": [reading] * 5,
        }
        | changes
    )


def load_cell(**changes: Any) -> LoadCellCalibration:
    reading = {"load_N": 5, "reading_V": 0.501, "standard_error_V": 1e-4, "samples": 20000}
    return LoadCellCalibration.model_validate(
        common(365, sensor="cell 3")
        | {
            "weights_N": (2, 5),
            "weight_tolerance_percent": 0.02,
            "coverage": 3.18,
            "zero_V": quantity(0.001, 1e-4, "V"),
            "sensitivity_V_N": quantity(0.1, 1e-5, "V/N"),
            "residual_rms_N": 0.001,
            "largest_residual_N": 0.002,
            "input_range_V": 1.25,
            "readings": [reading] * 3,
        }
        | changes
    )


RECORDS = (film(), force_sensor(), load_cell())


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: r.kind)
def test_a_record_comes_back_as_it_was_written(tmp_path: Path, record: Any) -> None:
    path = write_calibration(record, tmp_path / "calibrations")
    assert read_calibration(path, type(record)) == record


@given(
    values=st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
    notes=st.text(st.characters(exclude_categories=("Cs",))),
)
def test_any_number_and_any_note_survives_the_file(
    tmp_path_factory: pytest.TempPathFactory, values: tuple[float, float, float], notes: str
) -> None:
    record = force_sensor(zero_mV_V=values, notes=notes)
    path = write_calibration(record, tmp_path_factory.mktemp("records"))
    assert read_calibration(path, ForceCalibration) == record


@given(label=st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=200))
def test_any_label_makes_a_file_in_the_folder(
    tmp_path_factory: pytest.TempPathFactory, label: str
) -> None:
    folder = tmp_path_factory.mktemp("records")
    path = write_calibration(film(sensor=label), folder)
    assert list(folder.iterdir()) == [path]
    assert path.name.startswith("pvdf-")
    assert path.name.endswith("-2026-11-21.json")


def test_a_file_is_for_people_too() -> None:
    lines = as_text(force_sensor()).splitlines()
    assert '  "kind": "force",' in lines
    assert '    [83.0, 0.3, 0.0],' in lines  # fmt: skip
    assert '  "date": "2026-11-21T22:00:00+01:00",' in lines


def test_the_name_says_kind_sensor_and_day_and_nothing_is_overwritten(tmp_path: Path) -> None:
    first = write_calibration(film(), tmp_path)
    content = first.read_bytes()
    second = write_calibration(film(operator="B. Person"), tmp_path)
    assert (first.name, second.name) == (
        "pvdf-film-7-2026-11-21.json",
        "pvdf-film-7-2026-11-21-2.json",
    )
    assert first.read_bytes() == content
    assert sorted(tmp_path.iterdir()) == sorted([first, second])


def test_a_folder_that_takes_no_file_is_a_usage_error_before_anything_is_measured(
    tmp_path: Path,
) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(OutputError, match="taken: File exists") as caught:
        write_calibration(film(), tmp_path / "taken")
    assert "--to" in caught.value.one_line()
    with pytest.raises(ConfigurationError, match="taken: File exists"):
        require_folder(tmp_path / "taken")


# --- reading ---------------------------------------------------------------------------------


def spoiled(record: CalibrationRecord, **changes: Any) -> str:
    return json.dumps(record.model_dump(mode="json") | changes)


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        (None, "No such file"),
        (b"\xff\xfe\x00", "not a calibration record"),
        (b"", "not a calibration record"),
        (b"[1, 2]", "does not state its kind"),
        (b'{"kind": 7}', "does not state its kind"),
        (b'{"kind": ["pvdf"]}', "does not state its kind"),
        (b"[" * 100_000, "not a calibration record"),
        (spoiled(force_sensor()).encode(), "of kind force; one of kind pvdf is needed here"),
        (spoiled(film(), b_db=1).encode(), "b_db: unknown key"),
        (spoiled(film(), b_dB=quantity(None)).encode(), "b_dB has no value"),
        (spoiled(film(), b_dB=quantity(1.0) | {"low": 2.0}).encode(), "does not contain the value"),
        (spoiled(film(), date="2026-11-21T22:00:00").encode(), "date"),
        (spoiled(film(), valid_until="2026-11-20T22:00:00Z").encode(), "not after date"),
        (spoiled(film(), b_dB=quantity(1.0, unit="dB re 1 mV/N")).encode(), "must be in 'dB'"),
        (spoiled(film(), corner_Hz=quantity(2.0, unit="kHz")).encode(), "must be in 'Hz'"),
        (spoiled(film(), lowest_frequency_Hz=3e4).encode(), "above highest_frequency_Hz"),
        (spoiled(film(), covariance=[[1.0]]).encode(), "covariance: 6 x 6 numbers belong"),
        (spoiled(film(), inverse_corner_s=float("nan")).encode(), "inverse_corner_s"),
        (as_text(film())[:-200].encode(), "not a calibration record"),
    ],
)
def test_a_file_that_is_no_such_record_is_reported_in_one_line(
    tmp_path: Path, content: bytes | None, reported: str
) -> None:
    path = tmp_path / "record.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigurationError) as caught:
        read_calibration(path, FilmCalibration)
    line = caught.value.one_line()
    assert reported in line
    assert str(path) in line
    assert "rig calibrate pvdf" in line
    assert caught.value.code is ExitCode.USAGE


def test_a_load_cell_in_another_unit_is_not_taken_for_volts_per_newton() -> None:
    with pytest.raises(ValidationError, match="sensitivity_V_N is stated in 'mV/N'"):
        load_cell(sensitivity_V_N=quantity(100.0, 0.01, "mV/N"))


# --- validity --------------------------------------------------------------------------------


def verdict(
    record: CalibrationRecord,
    now: datetime = NOW,
    sensor: str = "film 7",
    simulated: bool = False,
    allow_expired: bool = False,
) -> list[str]:
    return require_valid(
        record,
        sensor,
        now,
        source="calibrations/film.json",
        simulated_bench=simulated,
        allow_expired=allow_expired,
    )


def test_a_record_in_force_is_used_without_a_word() -> None:
    assert verdict(film()) == []


@pytest.mark.parametrize(
    ("record", "reported"),
    [
        (
            force_sensor(matrix_N_mV_V=((8.3, 0.03, 0), (0.03, 8.0, 0.08), (0.15, 0.04, 8.4))),
            "they give 0.5 N where 5 N was put on",
        ),
        (
            force_sensor(matrix_N_mV_V=((83.0, 0.3, 0), (0.3, 80.0, 0.8), (1.5, 0.4, -84.0))),
            "they give -5 N where 5 N was put on",
        ),
        (load_cell(sensitivity_V_N=quantity(1.0, 1e-4, "V/N")), "they give 0.5 N where 5 N was"),
    ],
    ids=["a digit lost", "a sign", "a load cell"],
)
def test_a_record_that_was_edited_by_hand_is_refused(
    record: CalibrationRecord, reported: str
) -> None:
    """Found by an attack: a matrix of a tenth had the film pressed up to the torque limit."""
    assert verdict(force_sensor(), sensor="21034415") == []
    assert verdict(load_cell(), sensor="cell 3") == []
    with pytest.raises(ConfigurationError) as caught:
        verdict(record, sensor=record.sensor, allow_expired=True)
    line = caught.value.one_line()
    assert "calibrations/film.json" in line
    assert reported in line
    assert "changed since it was made" in line
    assert "rig calibrate" in line


def test_an_expired_record_is_refused_with_its_dates_and_the_remedy() -> None:
    with pytest.raises(ConfigurationError) as caught:
        verdict(film(), MEASURED + timedelta(days=90))
    line = caught.value.one_line()
    for words in ("film.json", "'film 7'", "2026-11-21", "expired on 2027-02-19", "--allow-expired",
                  "rig calibrate pvdf"):  # fmt: skip
        assert words in line


def test_an_expired_record_is_used_when_asked_for_and_says_so() -> None:
    (warning,) = verdict(film(), MEASURED + timedelta(days=400), allow_expired=True)
    assert "expired on 2027-02-19 and is used because that was allowed" in warning


@given(days_left=st.floats(min_value=1e-3, max_value=89))
def test_a_record_warns_exactly_in_its_last_fortnight(days_left: float) -> None:
    warnings = verdict(film(), film().valid_until - timedelta(days=days_left))
    assert [("expires on 2027-02-19" in w) for w in warnings] == [True] * (days_left <= 14)


def test_days_are_compared_across_time_zones() -> None:
    ends = film().valid_until
    elsewhere = timezone(timedelta(hours=-8))
    assert verdict(film(), (ends - timedelta(days=20)).astimezone(elsewhere)) == []
    with pytest.raises(ConfigurationError, match="expired"):
        verdict(film(), (ends + timedelta(seconds=1)).astimezone(elsewhere))


@pytest.mark.parametrize("allow_expired", [False, True])
def test_a_record_of_another_strip_is_refused_whatever_is_allowed(allow_expired: bool) -> None:
    with pytest.raises(ConfigurationError) as caught:
        verdict(film(), sensor="film 8", allow_expired=allow_expired)
    line = caught.value.one_line()
    for words in ("film.json", "calibration of 'film 7'", "on the bench is 'film 8'"):
        assert words in line


def test_a_simulated_record_stays_on_simulated_benches() -> None:
    record = film(simulated=True)
    assert verdict(record, simulated=True) == []
    with pytest.raises(ConfigurationError, match="made on a simulated bench") as caught:
        verdict(record, allow_expired=True)
    assert "film.json" in caught.value.one_line()


def test_a_record_of_tomorrow_points_to_the_clock() -> None:
    (warning,) = verdict(film(), MEASURED - timedelta(days=1))
    assert "clock" in warning


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: r.kind)
def test_a_run_can_carry_a_record_in_its_header(record: CalibrationRecord) -> None:
    entry = header_entry(record, "calibrations/it.json")
    assert json.loads(json.dumps(entry, allow_nan=False)) == entry
    assert entry["sensor"] == record.sensor
    assert entry["file"] == "calibrations/it.json"
