"""A calibration record for tests of when it expires."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from rig.instruments.calibration import LoadCellCalibration, as_text


def write_record(path: Path, date: datetime, valid_until: str) -> None:
    """Write the record of a load cell, valid until then (ISO 8601)."""
    quantity = {"value": 0.1, "standard_error": 1e-4, "low": 0.0998, "high": 0.1002, "unit": "V/N"}
    zero = {"value": 0.0, "standard_error": 1e-4, "low": -2e-4, "high": 2e-4, "unit": "V"}
    reading = {"load_N": 1.0, "reading_V": 0.1, "standard_error_V": 1e-4, "samples": 9}
    record = LoadCellCalibration.model_validate(
        {
            "sensor": "cell 3",
            "date": date,
            "valid_until": valid_until,
            "simulated": False,
            "weights_N": (1.0,),
            "weight_tolerance_percent": 0.1,
            "coverage": 1.96,
            "zero_V": zero,
            "sensitivity_V_N": quantity,
            "residual_rms_N": 0.01,
            "largest_residual_N": 0.02,
            "input_range_V": 1.25,
            "readings": (reading,) * 3,
        }
    )
    path.write_text(as_text(record))
