"""The record of a film from the run file of a sweep: what is refused, computed, said, doubted."""

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

FEWEST_FREQUENCIES = 12
"""Different frequencies that a film's record needs, over a decade at least."""
LEAST_SPAN = 10.0
POOR_LEVEL_DB = 0.5
"""A half-width of b's interval beyond which the sweep deserves a warning."""


def analysed(run: RunFile) -> SweepAnalysis:
    """The gain-curve analysis of a complete sweep; refuses any other file."""
    import numpy as np

    from rig.analysis.film.gain_curve import analyse
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
            f"{outcome.points_planned} points kept",
            "go on with it: rig resume",
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
    return analyse(*points_of(run.column), degrees=degrees, preloads=preloads)


def film_record(
    run: RunFile, analysis: SweepAnalysis, film: str, fields: dict[str, Any]
) -> FilmCalibration:
    """The record of the run's film; ConfigurationError where nobody knows which film it was, and
    where the record would have expired already."""
    from rig.analysis.film.load import coefficients
    from rig.instruments.calibration import FilmCalibration, make_record

    header = run.header
    described = _film_of(run)
    sensor = film or str(described.get("name") or header.sample.name)
    if not sensor:
        raise ConfigurationError(f"{run.path} does not say which film it was", "say it with --film")
    cell_error = _load_cell_error(header.calibrations)
    if fields["valid_until"] <= datetime.now().astimezone():
        raise ConfigurationError(
            f"{run.path} was measured on {fields['date']:%Y-%m-%d}: its calibration would have "
            f"expired on {fields['valid_until']:%Y-%m-%d}",
            "measure the film again, or state how long it holds with --valid",
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
            "amplifier_gain": described.get("amplifier_gain"),
            "load_cell_error_percent": None if cell_error is None else 100 * cell_error,
        },
    )


def _column(run: RunFile, name: str) -> NDArray[Any] | None:
    """A column that not every sweep has; None where it or one of its values is missing."""
    import numpy as np

    if name not in run.columns():
        return None
    values = run.column(name)
    return values if np.isfinite(values).all() else None


def _film_of(run: RunFile) -> dict[str, Any]:
    """The [film] table of the bench file that the run has kept."""
    with contextlib.suppress(ConfigurationError):
        table = parse_toml(run.header.bench_toml, str(run.path)).get("film")
        return table if isinstance(table, dict) else {}
    return {}


def _load_cell_error(calibrations: Sequence[dict[str, Any]]) -> float | None:
    """Relative standard error of the load cell as the record that the run has copied states it."""
    for record in calibrations:
        if record.get("kind") == "load-cell":
            with contextlib.suppress(KeyError, TypeError, ZeroDivisionError):
                found = record["sensitivity_V_N"]
                return abs(float(found["standard_error"]) / float(found["value"]))
    return None


def sentences(record: FilmCalibration, analysis: SweepAnalysis) -> Iterator[str]:
    """What was found, for a person."""
    mark = "SIMULATED " if record.simulated else ""
    yield (
        f"{mark}film {record.sensor!r}: {record.points} points, "
        f"{record.lowest_frequency_Hz:g} to {record.highest_frequency_Hz:g} Hz"
    )
    yield f"  b = {told(record.b_dB)} re 1 V/N at 1 Hz"
    yield f"  corner = {told(record.corner_Hz)}"
    for drop in analysis.drops:
        yield f"  drop at {drop.frequency}, {drop.depth} deep"
    if record.gain_model_error_dB:
        yield f"  scatter about the model beyond noise: {record.gain_model_error_dB:.3f} dB"


def doubts(record: FilmCalibration) -> list[str]:
    """What a person should know before relying on the record."""
    warnings = []
    if record.load_cell_error_percent is None:
        warnings.append(
            "the run had no calibration record of its load cell: the interval of b lacks the "
            "error of the load"
        )
    b = record.b_dB
    if b.low is None or b.high is None or b.high - b.low > 2 * POOR_LEVEL_DB:
        warnings.append(f"b is known no better than {told(b)}: look at the sweep")
    if record.corner_Hz.value is None or record.corner_Hz.high is None:
        warnings.append("no corner shows in the measured range; only b is determined")
    return warnings


def told(quantity: Quantity) -> str:
    """A quantity in words, to the figures that its interval gives."""
    from rig.analysis.estimate import Estimate

    value, error, low, high = (
        math.inf if number is None else number
        for number in (quantity.value, quantity.standard_error, quantity.low, quantity.high)
    )
    return str(Estimate(value, error, low, high, quantity.unit))
