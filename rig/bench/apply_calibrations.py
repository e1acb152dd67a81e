"""Check the calibration records that a bench file names, and apply them to the bench."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from rig.bench.connected import Bench
from rig.bench.settings import STRIPS
from rig.instruments.calibration import (
    FilmCalibration,
    ForceCalibration,
    LoadCellCalibration,
    header_entry,
    read_calibration,
    require_valid,
)

R = TypeVar("R", FilmCalibration, ForceCalibration, LoadCellCalibration)


def apply_calibrations(
    bench: Bench, now: datetime, allow_expired: bool = False
) -> tuple[list[dict[str, Any]], list[str]]:
    """Check each calibration record of the bench file against its sensor and apply it to the bench.

    Returns the records in the form of a run's header, and warnings. Raises ConfigurationError for a
    record that has expired (unless `allow_expired`), that belongs to another sensor, or that was
    made on a simulated bench and is used on a real one.
    """
    files, plan = bench.settings.calibrations, bench.plan
    folder = Path(plan.source).parent
    entries: list[dict[str, Any]] = []
    warnings: list[str] = []

    def used(file: Path, kind: type[R], sensor: str) -> R:
        path = folder / file
        record = read_calibration(path, kind)
        warnings.extend(
            require_valid(
                record,
                sensor,
                now,
                source=path,
                simulated_bench=bench.simulated,
                allow_expired=allow_expired,
                warning_days=files.expiry_warning_days,
            )
        )
        entries.append(header_entry(record, path))
        return record

    if files.film is not None:
        used(files.film, FilmCalibration, bench.film.name)
    if files.force_sensor is not None:
        sensor = bench.force_sensor
        force = used(files.force_sensor, ForceCalibration, sensor.identity.serial_number)
        sensor.calibrate(force.matrix_N_mV_V)
    if files.load_cell is not None:
        cell = used(files.load_cell, LoadCellCalibration, bench.load_cell.name)
        calibrated = {"sensitivity_V_N": cell.sensitivity_V_N.value}
        part = bench.load_cell.model_copy(update=calibrated)
        bench.plan = replace(plan, settings=plan.settings.model_copy(update={"load_cell": part}))
    for strip in STRIPS:
        file = getattr(files, strip)
        if file is not None:
            film = bench.skin.films.get(strip, "")
            bench.strip_calibrations[strip] = used(file, FilmCalibration, film)
    return entries, warnings
