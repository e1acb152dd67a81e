"""Calibration records: a sensor's constants, with their dates of measurement and expiry and their
source.

One file a record, JSON that a person can read. A record is written once and never overwritten; it
states the sensor and the period for which it may be used, and whether it was made on a simulated
bench, in which case a real bench refuses it. Arrays are in the order of the sensor's axes x, y, z.

Three kinds: ``pvdf`` (volts per newton of a film, from a sweep), ``force`` (three-axis force
sensor, from weights), ``load-cell`` (the dynamic load cell, statically, from weights).
"""

from __future__ import annotations

import contextlib
import json
import re
import tempfile
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AwareDatetime, Field, ValidationError, model_validator

from rig.core.atomic import write_text
from rig.core.errors import ConfigurationError, OutputError
from rig.core.settings import Settings
from rig.core.toml_files import MAX_JSON_BYTES, check_nesting, read_text

Kind = Literal["pvdf", "force", "load-cell"]

VALID_DAYS: dict[Kind, int] = {"pvdf": 90, "force": 365, "load-cell": 365}
"""Default period of validity of a record (assumed: a film ages, a strain gauge hardly does)."""
EXPIRY_WARNING_DAYS = 14.0
"""Days before its expiry from which a record gives a warning."""
LARGEST_MISFIT = 0.02
"""Largest difference between a force that was put on and what a record computes from its reading,
as a share of the largest weight: twice what a record is made with (`rig.analysis.weighing`)."""
LEVEL_REFERENCE = " re 1 V/N"
"""Reference of a level in dB, which a record may state."""
LONGEST_SENSOR_NAME = 200
"""Largest number of characters of a sensor's name."""
FOLDER = "calibrations"
"""Folder of the records, next to the bench file."""

COMMANDS: dict[Kind, str] = {
    "pvdf": "rig calibrate pvdf FILE",
    "force": "rig calibrate force",
    "load-cell": "rig calibrate load-cell",
}

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
NotNegative = Annotated[float, Field(ge=0)]


class Quantity(Settings):
    """A value with its standard error and 95 % interval; numbers that are not finite are None."""

    value: float | None
    standard_error: NotNegative | None
    low: float | None
    high: float | None
    unit: str

    @model_validator(mode="after")
    def _in_order(self) -> Quantity:
        low, high, value = self.low, self.high, self.value
        if value is not None and (
            (low is not None and low > value) or (high is not None and high < value)
        ):
            raise ValueError(f"the interval {low} to {high} does not contain the value {value}")
        return self


def _require_units(record: CalibrationRecord, **units: str) -> None:
    """Raise ValueError for a quantity that is stated in another unit than that of its field: its
    value would be used as if it were in that."""
    for name, unit in units.items():
        found = getattr(record, name).unit
        if found.removesuffix(LEVEL_REFERENCE) != unit:
            raise ValueError(f"{name} is stated in {found!r}; it must be in {unit!r}")


class CalibrationFiles(Settings):
    """The records that a bench uses, as paths relative to the bench file."""

    film: Path | None = None
    """Record of the film, by ``rig calibrate pvdf``."""
    force_sensor: Path | None = None
    """Record of the force sensor, by ``rig calibrate force``."""
    load_cell: Path | None = None
    """Record of the load cell, by ``rig calibrate load-cell``."""
    strip_1: Path | None = None
    """Record of the film in strip S1 of the skin, by ``rig calibrate pvdf``."""
    strip_2: Path | None = None
    """Record of the film in strip S2."""
    expiry_warning_days: float = Field(default=EXPIRY_WARNING_DAYS, ge=0, le=3650)
    """Days before its expiry from which a record gives a warning."""


class SourceRun(Settings):
    """The run that a record was computed from."""

    run_uuid: str
    file: str
    simulated: bool


class CalibrationRecord(Settings):
    """Base of all calibration records."""

    format: Literal[1] = 1
    kind: Kind
    sensor: str = Field(min_length=1, max_length=LONGEST_SENSOR_NAME)
    """Label of the film; serial number or name of a sensor."""
    date: AwareDatetime
    """Time of the measurement."""
    valid_until: AwareDatetime
    operator: str = ""
    simulated: bool
    """True for a record made on a simulated bench, which a real bench refuses."""
    program: str = ""
    """Name and version of the program that wrote it."""
    temperature_degC: float | None = None
    """Temperature of the surroundings; None if it was not measured."""
    notes: str = ""

    @model_validator(mode="after")
    def _ends_after_it_begins(self) -> CalibrationRecord:
        if self.valid_until <= self.date:
            raise ValueError("valid_until is not after date")
        return self


class RecordedDrop(Settings):
    """A notch that the sweep found, of second order."""

    frequency_Hz: float = Field(gt=0)
    pole_Q: float = Field(gt=0)
    depth_dB: float


class FilmCalibration(CalibrationRecord):
    """Volts per newton of a film with its amplifier: slope of 20 dB/decade, one pole, notches.

    The rows of ``covariance`` are b (dB), inverse_corner (s), delay (s), then ln frequency, ln Q
    and depth (dB) of each notch. It contains noise, the load cell's error, and the model error that
    the sweep's scatter about the model requires.
    """

    kind: Literal["pvdf"] = "pvdf"
    source: SourceRun
    b_dB: Quantity
    """Level of equation (2), dB re 1 V/N: the low-frequency asymptote at 1 Hz."""
    corner_Hz: Quantity
    """Frequency of the pole; without a value if the pole does not show in the measured range."""
    delay_us: Quantity
    """Delay of the film's channel relative to the load's."""
    inverse_corner_s: float
    """1 / corner, which stays finite; computations use it."""
    polarity: Literal[-1, 1]
    drops: tuple[RecordedDrop, ...] = ()
    covariance: tuple[tuple[float, ...], ...]
    gain_model_error_dB: NotNegative = 0.0
    """Scatter of single frequencies about the model in excess of noise."""
    phase_model_error_deg: NotNegative = 0.0
    points: int = Field(ge=1)
    lowest_frequency_Hz: float = Field(gt=0)
    highest_frequency_Hz: float = Field(gt=0)
    preload_N: float | None = None
    """Static force on the film during the sweep; None if the run does not state it."""
    amplifier_gain: float | None = Field(default=None, gt=0)
    """Gain of the film's amplifier, which the response contains; None if the run does not
    state it."""
    load_cell_error_percent: NotNegative | None = None
    """Standard error of the load cell's sensitivity as the run's own calibration record states it;
    None if the run had no such record, and the intervals then lack this error."""

    @model_validator(mode="after")
    def _covariance_fits(self) -> FilmCalibration:
        size = 3 + 3 * len(self.drops)
        if len(self.covariance) != size or any(len(row) != size for row in self.covariance):
            raise ValueError(f"covariance: {size} x {size} numbers belong to b, pole, delay, drops")
        if any(row[k] < 0 for k, row in enumerate(self.covariance)):
            raise ValueError("covariance: a variance is negative")
        if self.b_dB.value is None:
            raise ValueError("b_dB has no value")
        return self

    @model_validator(mode="after")
    def _is_in_its_units(self) -> FilmCalibration:
        _require_units(self, b_dB="dB", corner_Hz="Hz", delay_us="us")
        if self.lowest_frequency_Hz > self.highest_frequency_Hz:
            raise ValueError("lowest_frequency_Hz is above highest_frequency_Hz")
        return self


class WeighedForce(Settings):
    """A reading of the force sensor under a known force."""

    force_N: Vector
    reading_mV_V: Vector
    standard_error_mV_V: tuple[NotNegative, NotNegative, NotNegative]
    samples: int = Field(ge=1)


class WeighedLoad(Settings):
    """A reading of the load cell under a known force."""

    load_N: float
    reading_V: float
    standard_error_V: NotNegative
    samples: int = Field(ge=1)


class Weighed(CalibrationRecord):
    """Base of the records that are made with known weights."""

    weights_N: tuple[float, ...] = Field(min_length=1)
    weight_tolerance_percent: NotNegative
    """Relative tolerance of the weight set, taken as evenly distributed and contained in every
    error."""
    preload_N: float = 0.0
    """Constant force on the sensor in addition to the weights."""
    coverage: float = Field(gt=0)
    """Half width of the 95 % interval in standard errors: Student's t if the scatter of the
    readings was estimated from them, else 1.96."""


class ForceCalibration(Weighed):
    """Three-axis force sensor with its amplifier: force in N = matrix (reading - zero)."""

    kind: Literal["force"] = "force"
    zero_mV_V: Vector
    zero_standard_error_mV_V: tuple[NotNegative, NotNegative, NotNegative]
    matrix_N_mV_V: Matrix
    matrix_standard_error_N_mV_V: Matrix
    residual_rms_N: NotNegative
    largest_residual_N: NotNegative
    crosstalk_percent: NotNegative
    """Apparent force along another axis, in percent of the force, if every bridge is evaluated
    separately; the largest over all pairs of axes."""
    readings: tuple[WeighedForce, ...] = Field(min_length=5)

    def computed_N(self) -> Iterator[tuple[float, float]]:  # noqa: N802 - the unit keeps its capital
        """Yield, for each reading and axis, the force put on and the one computed of it, in N."""
        for one in self.readings:
            pairs = zip(one.reading_mV_V, self.zero_mV_V, strict=True)
            output_mV_V = [reading - zero for reading, zero in pairs]
            for known_N, row in zip(one.force_N, self.matrix_N_mV_V, strict=True):
                yield known_N, sum(a * b for a, b in zip(row, output_mV_V, strict=True))


class LoadCellCalibration(Weighed):
    """Load cell with its amplifier, statically: volts = zero + sensitivity times load."""

    kind: Literal["load-cell"] = "load-cell"
    zero_V: Quantity
    sensitivity_V_N: Quantity
    residual_rms_N: NotNegative
    largest_residual_N: NotNegative
    input_range_V: float = Field(gt=0)
    """Range of the DAQ's channel: its gain error on that range is in the sensitivity."""
    readings: tuple[WeighedLoad, ...] = Field(min_length=3)

    @model_validator(mode="after")
    def _is_a_sensor(self) -> LoadCellCalibration:
        if not self.sensitivity_V_N.value:
            raise ValueError("sensitivity_V_N has no value")
        _require_units(self, zero_V="V", sensitivity_V_N="V/N")
        return self

    def computed_N(self) -> Iterator[tuple[float, float]]:  # noqa: N802 - the unit keeps its capital
        """Yield, for each reading, the load put on and the one computed of it, in N."""
        sensitivity_V_N, zero_V = self.sensitivity_V_N.value, self.zero_V.value or 0.0
        assert sensitivity_V_N, "a record without one is not read"
        for one in self.readings:
            yield one.load_N, (one.reading_V - zero_V) / sensitivity_V_N


_Kind = TypeVar("_Kind", FilmCalibration, ForceCalibration, LoadCellCalibration)


def read_calibration(path: Path, kind: type[_Kind]) -> _Kind:
    """Return the record in a file. Raises ConfigurationError if it is missing, damaged or of
    another kind."""
    expected: Kind = kind.model_fields["kind"].default
    hint = f"name another record, or make one with `{COMMANDS[expected]}`"
    text = read_text(path, "calibration record", MAX_JSON_BYTES, hint)
    try:
        content = json.loads(text)
        check_nesting(content)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"{path} is not a calibration record: {_first_line(error)}", hint
        ) from error
    found = content.get("kind") if isinstance(content, dict) else None
    if not isinstance(found, str) or found not in VALID_DAYS:
        raise ConfigurationError(
            f"{path} is not a calibration record: it does not state its kind", hint
        )
    if found != expected:
        raise ConfigurationError(
            f"{path} is a record of kind {found}; one of kind {expected} is needed here", hint
        )
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, str(path), hint) from error


def make_record(kind: type[_Kind], fields: dict[str, Any]) -> _Kind:
    """Return a record with these fields. Raises ConfigurationError, which lists every fault."""
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        expected = kind.model_fields["kind"].default
        raise ConfigurationError.from_validation(error, f"{expected} record") from error


def write_calibration(record: CalibrationRecord, folder: Path) -> Path:
    """Write a record to a new file in the folder and return its path; no file is overwritten.

    The name is ``<kind>-<sensor>-<date>.json``, with a number appended from the second record of a
    day on. The file appears whole or not at all. Raises OutputError if it cannot be written.
    """
    day = record.date.strftime("%Y-%m-%d")
    stem = f"{record.kind}-{_in_a_name(record.sensor)}-{day}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = _claim(folder, stem)
        try:
            write_text(path, as_text(record))
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        return path
    except OSError as error:
        raise OutputError(*_unwritable(folder, error)) from error


def require_folder(folder: Path) -> Path:
    """Return the folder, which is made if needed. Raises ConfigurationError if it is not
    writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise ConfigurationError(*_unwritable(folder, error)) from error


def as_text(record: CalibrationRecord) -> str:
    """Return the text of a record's file: JSON with one key a line and a list of numbers on one
    line."""
    return _json(record.model_dump(mode="json"), "") + "\n"


def require_valid(
    record: CalibrationRecord,
    sensor: str,
    now: datetime,
    *,
    source: Path | str,
    simulated_bench: bool,
    allow_expired: bool = False,
    warning_days: float = EXPIRY_WARNING_DAYS,
) -> list[str]:
    """Check that a record may be used for `sensor` at the time `now` on this bench; return
    warnings.

    Raises ConfigurationError, which names file, sensor, dates and remedy, for a record of another
    sensor, for one of a simulated bench on a real one, for one of weights whose constants do not
    fit its own readings, and for one that has expired unless `allow_expired`.
    """
    remedy = f"calibrate with `{COMMANDS[record.kind]}`"
    if record.sensor != sensor:
        raise ConfigurationError(
            f"{source} is the calibration of {record.sensor!r}, on the bench is {sensor!r}",
            f"name the record of {sensor!r} in [calibrations], or {remedy}",
        )
    if record.simulated and not simulated_bench:
        raise ConfigurationError(
            f"{source}: this calibration of {sensor!r} was made on a simulated bench and cannot "
            "be used on a real one",
            remedy,
        )
    if isinstance(record, ForceCalibration | LoadCellCalibration):
        _refuse_misfit(record, str(source), remedy)
    whose = f"{source}: the calibration of {sensor!r} of {_day(record.date)}"
    if now >= record.valid_until:
        ended = f"{whose} expired on {_day(record.valid_until)}"
        if not allow_expired:
            raise ConfigurationError(ended, f"{remedy}, or allow it with --allow-expired")
        return [f"{ended} and is used because that was allowed"]
    if now < record.date:
        return [f"{whose} lies in the future: check this computer's clock"]
    if record.valid_until - now <= timedelta(days=warning_days):
        return [f"{whose} expires on {_day(record.valid_until)}"]
    return []


def _refuse_misfit(record: ForceCalibration | LoadCellCalibration, source: str, hint: str) -> None:
    """Raise ConfigurationError for a record whose constants do not fit its own readings: it
    was changed after it was made, and a run would press with another force than it reads."""
    for known_N, computed_N in record.computed_N():
        if not abs(computed_N - known_N) <= LARGEST_MISFIT * max(record.weights_N):
            raise ConfigurationError(
                f"{source}: the constants of {record.sensor!r} do not fit the readings in the same "
                f"record: they give {computed_N:.3g} N where {known_N:g} N was put on, so the "
                "record has been changed since it was made",
                f"{hint}, or remove the record from [calibrations]",
            )


def header_entry(record: CalibrationRecord, source: Path | str) -> dict[str, Any]:
    """Return a record as it is written to a run's header: all its fields and its file."""
    return {**record.model_dump(mode="json"), "file": str(source)}


def _claim(folder: Path, stem: str) -> Path:
    """Create an empty file under the first free name, so that no other process takes the name."""
    number = 1
    while True:
        path = folder / (f"{stem}.json" if number == 1 else f"{stem}-{number}.json")
        with contextlib.suppress(FileExistsError):
            path.touch(exist_ok=False)
            return path
        number += 1


def _unwritable(folder: Path, error: OSError) -> tuple[str, str]:
    """Return message and hint."""
    return (
        f"the calibration record cannot be written to {folder}: {error.strerror or error}",
        "give another folder with --to",
    )


def _in_a_name(sensor: str) -> str:
    return re.sub(r"[^\w.]+", "-", sensor).strip("-.")[:60] or "sensor"


def _day(when: datetime) -> str:
    return when.strftime("%Y-%m-%d")


def _first_line(error: Exception) -> str:
    return str(error).split("\n", 1)[0]


def _json(value: Any, indent: str) -> str:
    inner = indent + "  "
    if isinstance(value, dict) and value:
        lines = [f"{inner}{json.dumps(key)}: {_json(item, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, list | dict) for item in value):
        return "[\n" + ",\n".join(inner + _json(item, inner) for item in value) + f"\n{indent}]"
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
