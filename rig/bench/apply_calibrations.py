"""Check the calibration records that a bench file names, and apply them to the bench."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from rig.bench.connected import Bench
from rig.bench.plan import BenchPlan
from rig.bench.settings import STRIPS
from rig.core.errors import ConfigurationError
from rig.instruments.calibration import (
    CalibrationFiles,
    CalibrationRecord,
    FilmCalibration,
    ForceCalibration,
    LoadCellCalibration,
    header_entry,
    read_calibration,
    require_valid,
)

R = TypeVar("R", FilmCalibration, ForceCalibration, LoadCellCalibration)


RECORDS: dict[str, type[FilmCalibration] | type[ForceCalibration] | type[LoadCellCalibration]] = {
    "film": FilmCalibration,
    "force_sensor": ForceCalibration,
    "load_cell": LoadCellCalibration,
    "strip_1": FilmCalibration,
    "strip_2": FilmCalibration,
}
"""Kind of each record that a bench file may name, by its key."""


def records_of(plan: BenchPlan) -> Iterator[tuple[str, Path, CalibrationRecord]]:
    """Yield key, file and content of each calibration record that a bench file names.

    Raises ConfigurationError for one that cannot be read.
    """
    folder = Path(plan.source).parent
    for key, kind in RECORDS.items():
        file = getattr(plan.settings.calibrations, key)
        if file is not None:
            yield key, folder / file, read_calibration(folder / file, kind)  # type: ignore[type-var]


def check_records(plan: BenchPlan, now: datetime, allow_expired: bool = False) -> list[str]:
    """Check the calibration records of a bench that is not connected; return warnings.

    Raises what `apply_calibrations` raises, as far as the bench file says which sensors it has: it
    does not state the serial number of the force sensor.
    """
    settings = plan.settings
    mounted: dict[str, str] = {}
    if settings.film is not None:
        mounted["film"] = settings.film.name
    if settings.load_cell is not None:
        mounted["load_cell"] = settings.load_cell.name
    if settings.skin is not None:
        mounted |= {strip: settings.skin.films.get(strip, "") for strip in STRIPS}
    warnings = []
    for key, path, record in records_of(plan):
        _require_part(plan, key, path)
        _require_gain(key, path, record)
        warnings += require_valid(
            record,
            mounted.get(key, record.sensor),
            now,
            source=path,
            simulated_bench=settings.simulation is not None,
            allow_expired=allow_expired,
            warning_days=settings.calibrations.expiry_warning_days,
        )
    return warnings


def _require_part(plan: BenchPlan, key: str, path: Path) -> None:
    """Raise ConfigurationError for a record whose part the bench file does not describe."""
    table = "skin" if key in STRIPS else key
    described = {part.role for part in plan.instruments}
    if table not in described and getattr(plan.settings, table, None) is None:
        raise ConfigurationError(
            f"{plan.source}: calibrations.{key} names {path}, but the bench file has no [{table}] "
            "table",
            f"add a [{table}] table, or remove {key} from [calibrations]",
        )


def _require_gain(key: str, path: Path, record: CalibrationRecord) -> None:
    """Raise ConfigurationError for the record of a strip without the gain of its amplifier: the
    strip's own amplifier has another gain, to which its level could not be scaled."""
    if key in STRIPS and isinstance(record, FilmCalibration) and record.amplifier_gain is None:
        raise ConfigurationError(
            f"calibrations.{key}: {path}: the record of film {record.sensor!r} does not state its "
            "amplifier_gain",
            f"state the gain that the film had in its sweep in the record, or remove {key} from "
            "[calibrations]",
        )


def with_force_record_only(plan: BenchPlan) -> BenchPlan:
    """Return the plan with the calibration record of the force alone: no other, perhaps one that
    cannot be used, keeps a person or the guard from reading the force."""
    of_force = CalibrationFiles(force_sensor=plan.settings.calibrations.force_sensor)
    return replace(plan, settings=plan.settings.model_copy(update={"calibrations": of_force}))


def apply_calibrations(
    bench: Bench, now: datetime, allow_expired: bool = False
) -> tuple[list[dict[str, Any]], list[str]]:
    """Check each calibration record of the bench file against its sensor and apply it to the bench.

    Returns the records in the form of a run's header, and warnings. Raises ConfigurationError for a
    record that has expired (unless `allow_expired`), that belongs to another sensor, that was made
    on a simulated bench and is used on a real one, that is of a strip and states no gain, or
    whose part the bench file does not describe.
    """
    files, plan = bench.settings.calibrations, bench.plan
    folder = Path(plan.source).parent
    entries: list[dict[str, Any]] = []
    warnings: list[str] = []
    for key in RECORDS:
        if (file := getattr(files, key)) is not None:
            _require_part(plan, key, folder / file)

    def used(key: str, file: Path, kind: type[R], sensor: str) -> R:
        path = folder / file
        record = read_calibration(path, kind)
        _require_gain(key, path, record)
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
        used("film", files.film, FilmCalibration, bench.film.name)
    if files.force_sensor is not None:
        sensor = bench.force_sensor
        force = used(
            "force_sensor", files.force_sensor, ForceCalibration, sensor.identity.serial_number
        )
        sensor.calibrate(force.matrix_N_mV_V)
    if files.load_cell is not None:
        cell = used("load_cell", files.load_cell, LoadCellCalibration, bench.load_cell.name)
        calibrated = {"sensitivity_V_N": cell.sensitivity_V_N.value}
        part = bench.load_cell.model_copy(update=calibrated)
        bench.plan = replace(plan, settings=plan.settings.model_copy(update={"load_cell": part}))
    for strip in STRIPS:
        file = getattr(files, strip)
        if file is not None:
            film = bench.skin.films.get(strip, "")
            bench.strip_calibrations[strip] = used(strip, file, FilmCalibration, film)
    return entries, warnings
