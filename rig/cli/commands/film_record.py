"""Calibration record of a film from the run file of a sweep: checks, record, summary, warnings."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from rig.core.errors import ConfigurationError
from rig.core.toml_files import parse_toml

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rig.analysis.film.gain_curve import SweepAnalysis
    from rig.files.runfile.reader import RunFile
    from rig.instruments.calibration import FilmCalibration, Quantity

LEAST_SPAN = 10.0
"""Minimum ratio of highest to lowest frequency of such a sweep."""
POOR_LEVEL_DB = 0.5
"""Half-width of the interval of b above which a warning is given, in dB."""


def analysed(run: RunFile) -> SweepAnalysis:
    """Return the gain-curve analysis of a complete sweep.

    Raises ConfigurationError for any other file and for a sweep with too few frequencies.
    """
    import numpy as np

    from rig.analysis.film.gain_curve import FEWEST_FREQUENCIES, analyse
    from rig.analysis.response.curve import points_of

    header, outcome = run.header, run.outcome
    if header.procedure != "sweep":
        raise ConfigurationError(
            f"{run.path} is a run of {header.procedure}, not of a sweep",
            "a film is calibrated from a sweep: rig sweep",
        )
    if outcome.status != "complete":
        raise ConfigurationError(
            f"{run.path}: the sweep is not complete: {outcome.status}, {outcome.points_done} of "
            f"{outcome.points_planned} points recorded",
            "resume it: rig resume",
        )
    frequency = run.column("frequency")
    different = np.unique(frequency)
    if different.size < FEWEST_FREQUENCIES or different[-1] < LEAST_SPAN * different[0]:
        span = f", {different[0]:g} to {different[-1]:g} Hz" if different.size else ""
        raise ConfigurationError(
            f"{run.path} has {different.size} different frequencies{span}: too few for level and "
            f"corner, which need {FEWEST_FREQUENCIES} over a decade or more",
            "calibrate from a sweep of the default grid",
        )
    degrees, preloads = _column(run, "degrees"), _column(run, "preload")
    return analyse(
        *points_of(run.column),
        degrees=degrees,
        preloads=preloads,
        preload_errors=_column(run, "preload_error"),
        loads=_column(run, "load_amplitude"),
    )


def film_record(
    run: RunFile, analysis: SweepAnalysis, film: str, fields: dict[str, Any]
) -> FilmCalibration:
    """Return the calibration record of the run's film.

    Raises ConfigurationError if the film is unknown, or if the record would already have expired.
    """
    from rig.analysis.film.load import coefficients
    from rig.instruments.calibration import FilmCalibration, make_record

    header = run.header
    described = _film_of(run)
    sensor = film or str(described.get("name") or header.sample.name)
    if not sensor:
        raise ConfigurationError(f"{run.path} does not state the film", "state it with --film")
    cell_error = _load_cell_error(header.calibrations)
    if fields["valid_until"] <= datetime.now().astimezone():
        raise ConfigurationError(
            f"{run.path} was measured on {fields['date']:%Y-%m-%d}: its calibration would have "
            f"expired on {fields['valid_until']:%Y-%m-%d}",
            "measure the film again, or state its validity with --valid",
        )
    preload = _column(run, "preload")
    return make_record(
        FilmCalibration,
        {
            **fields,
            "sensor": sensor,
            "simulated": run.outcome.simulated or header.simulated,
            "source": {
                "run_uuid": header.run_uuid,
                "file": run.path.name,
                "simulated": run.outcome.simulated,
            },
            **coefficients(analysis, cell_error or 0.0),
            "lowest_frequency_Hz": float(run.column("frequency").min()),
            "highest_frequency_Hz": float(run.column("frequency").max()),
            "preload_N": None if preload is None else float(preload.mean()),
            "amplifier_gain": _gain(described),
            "load_cell_error_percent": None if cell_error is None else 100 * cell_error,
        },
    )


def _column(run: RunFile, name: str) -> NDArray[Any] | None:
    """Return an optional column of a sweep; None if it or one of its values is missing."""
    import numpy as np

    if name not in run.columns():
        return None
    values = run.column(name)
    return values if np.isfinite(values).all() else None


def _film_of(run: RunFile) -> dict[str, Any]:
    """Return the [film] table of the bench file that the run recorded."""
    with contextlib.suppress(ConfigurationError):
        table = parse_toml(run.header.bench_toml, str(run.path)).get("film")
        return table if isinstance(table, dict) else {}
    return {}


def _gain(described: dict[str, Any]) -> float | None:
    """Return the gain of the film's amplifier from the run's [film] table, where it may be the
    default; None without a table, or with one that cannot be read."""
    from pydantic import ValidationError

    from rig.bench.settings import FilmSettings

    if described:
        with contextlib.suppress(ValidationError):
            return FilmSettings.model_validate(described).amplifier_gain
    return None


def _load_cell_error(calibrations: Sequence[dict[str, Any]]) -> float | None:
    """Return the relative standard error of the load cell from the run's copy of its record."""
    for record in calibrations:
        if record.get("kind") == "load-cell":
            with contextlib.suppress(KeyError, TypeError, ZeroDivisionError):
                found = record["sensitivity_V_N"]
                return abs(float(found["standard_error"]) / float(found["value"]))
    return None


def sentences(record: FilmCalibration, analysis: SweepAnalysis) -> Iterator[str]:
    """Yield the results as lines of text."""
    mark = "SIMULATED " if record.simulated else ""
    yield (
        f"{mark}film {record.sensor!r}: {record.points} points, "
        f"{record.lowest_frequency_Hz:g} to {record.highest_frequency_Hz:g} Hz"
    )
    yield f"  b = {in_words(record.b_dB)} re 1 V/N at 1 Hz"
    yield f"  corner = {in_words(record.corner_Hz)}"
    for drop in analysis.drops:
        yield f"  notch at {drop.frequency}, {drop.depth} deep"
    if record.gain_model_error_dB:
        yield f"  scatter about the model beyond noise: {record.gain_model_error_dB:.3f} dB"


def gain_is_assumed(run: RunFile) -> bool:
    """Return whether the run's [film] table leaves out the gain of its amplifier, which then is 1.
    On a real bench nothing but the record depends on it, so it is easily left out."""
    described = _film_of(run)
    return bool(described) and "amplifier_gain" not in described


def doubts(record: FilmCalibration, gain_is_assumed: bool = False) -> list[str]:
    """Return warnings to be read before the record is used."""
    warnings = []
    if gain_is_assumed and record.amplifier_gain is not None:
        warnings.append(
            f"the bench file of the run does not state amplifier_gain in [film]: it is taken as "
            f"{record.amplifier_gain:g}; if the film had another amplifier, correct amplifier_gain "
            "in the record before it is used for a strip of the skin"
        )
    if record.load_cell_error_percent is None:
        warnings.append(
            "the run had no calibration record of its load cell: the interval of b does not "
            "include the error of the load"
        )
    if record.amplifier_gain is None:
        warnings.append(
            "the run does not state the gain of the film's amplifier: the record cannot be used "
            "for a strip of the skin"
        )
    b = record.b_dB
    if b.low is None or b.high is None or b.high - b.low > 2 * POOR_LEVEL_DB:
        warnings.append(f"b is poorly determined ({in_words(b)}): check the sweep")
    if record.corner_Hz.value is None or record.corner_Hz.high is None:
        warnings.append("there is no corner in the measured range; only b is determined")
    return warnings


def in_words(quantity: Quantity) -> str:
    """Return a quantity as text, to the figures that its interval justifies."""
    from rig.analysis.estimate import Estimate

    value, error, low, high = (
        math.inf if number is None else number
        for number in (quantity.value, quantity.standard_error, quantity.low, quantity.high)
    )
    return str(Estimate(value, error, low, high, quantity.unit))
