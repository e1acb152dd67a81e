"""The summary of a sweep: its curve, figures of it, and the film's model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from procedures.sweep.layout import LAYOUT
from rig.analysis.estimate import COVERAGE_95, with_error
from rig.analysis.response.curve import CurveError, ResponseCurve, points_of
from rig.analysis.verdict import Bounds, Verdict
from rig.files.journal.layout import TRUTH
from rig.run.points import Reading

if TYPE_CHECKING:
    from rig.analysis.film.truth import FilmTruth

NEAR_200 = 1.26
"""Largest ratio to 200 Hz of a frequency near it: a tenth of a decade, the coarse grid's step."""


def curve_of(readings: Sequence[Reading]) -> ResponseCurve:
    """Return the readings as a response curve. Raises CurveError if they do not form one."""
    return ResponseCurve.of(
        *points_of(partial(_column, readings)),
        degrees=_column(readings, "degrees"),
        preloads=_column(readings, "preload"),
        preload_errors=_column(readings, "preload_error"),
        loads=_column(readings, "load_amplitude") if has_several_loads(readings) else None,
    )


def has_several_loads(readings: Sequence[Reading]) -> bool:
    """Return whether the points were measured under different loads."""
    return len({reading["load_set_N"] for reading in readings}) > 1


def figures(readings: Sequence[Reading]) -> dict[str, Any]:
    """Return range, gain near 200 Hz if measured, errors of the gain, and deviations of the load;
    needs at least one reading."""
    frequencies = [float(r["frequency_Hz"] or 0) for r in readings]
    errors = sorted(float(r["gain_standard_error_dB"] or 0) for r in readings)
    return {
        "points": len(readings),
        "lowest_frequency_Hz": min(frequencies),
        "highest_frequency_Hz": max(frequencies),
        **_gain_near_200(readings),
        "median_gain_standard_error_dB": errors[len(errors) // 2],
        "largest_gain_standard_error_dB": errors[-1],
        "largest_deviation_of_load_percent": 100
        * max(
            abs(float(r["load_amplitude_N"] or 0) / float(r["load_set_N"] or 1) - 1)
            for r in readings
        ),
        "largest_load_N": max(float(r["largest_load_N"] or 0) for r in readings),
    }


def model(readings: Sequence[Reading], several_loads: bool, bounds: Bounds) -> dict[str, Any]:
    """Return the results of the gain curve's analysis, with its dependence on the load if several
    were measured; only why there are none for points that are not fitted. `bounds` belong to the
    verdicts."""
    # Takes long to import, so never imported while something is switched on.
    from rig.analysis.film.gain_curve import analyse

    def of_loads(name: str) -> npt.NDArray[np.float64] | None:
        return _column(readings, name) if several_loads else None

    try:
        found = analyse(
            *points_of(partial(_column, readings)),
            degrees=_column(readings, "degrees"),
            preloads=_column(readings, "preload"),
            preload_errors=_column(readings, "preload_error"),
            bounds=bounds,
            loads=of_loads("load_amplitude"),
            load_distortion=of_loads("load_distortion"),
            film_distortion=of_loads("voltage_distortion"),
        )
    except CurveError as error:
        return {"no_fit": error.message}
    return {"analysis": found.sentences(_truth(readings)), "model": found.as_dict()}


def put_in(readings: Sequence[Reading], summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers of the simulated film by the names of those that recover them; of each
    notch the frequency, NaN for one that the film has not. Empty without film or model."""
    from rig.analysis.film.model import FIRST_ORDER_SLOPE

    truth, found = _truth(readings), summary.get("model")
    if truth is None or found is None:
        return {}
    near = [truth.drop_near_Hz(drop["frequency"]["value"]) for drop in found["drops"]]
    return {
        "model.level": truth.level_dB,
        "model.corner": truth.corner_Hz,
        "model.asymptotic_slope": FIRST_ORDER_SLOPE,
        "model.preload_effect": truth.gain_per_newton_dB,
        "model.linearity.slope": truth.gain_per_load_decade_dB,
        "model.drops.frequency": [math.nan if one is None else one for one in near],
    }


VERDICTS = {
    "first_order": "20 dB/decade (stress rate)",
    "linearity": "The gain does not depend on the load",
}


def in_brief(summary: Mapping[str, Any], put_in: Mapping[str, Any]) -> list[str]:
    """Return the verdicts, then the film's values with the half-widths of their 95 % intervals and
    what a World put in; empty without a model."""
    from rig.analysis.chi_square import probability_above
    from rig.analysis.film.fit import MISFIT_PROBABILITY

    found: dict[str, Any] | None = summary.get("model")
    if found is None:
        return []

    def valued(name: str, estimate: Mapping[str, Any] | None, key: str) -> list[str]:
        if not estimate:
            return []
        return [f"{name}: {_valued(estimate)}{_of_world(put_in.get(f'model.{key}'))}"]

    verdicts = {"first_order": found["first_order"]}
    several = found.get("linearity") or {}
    verdicts["linearity"] = several.get("verdict")
    within = _within(found.get("bounds") or {})  # files of older versions have none
    lines = [
        _answer(VERDICTS[name], Verdict(**one), within[name])
        for name, one in verdicts.items()
        if one
    ]
    lines += valued(
        "slope without the fitted low-pass", found["asymptotic_slope"], "asymptotic_slope"
    )
    lines += valued("change with the load", several.get("slope"), "linearity.slope")
    level = {**found["level"], "unit": "dB re 1 V/N"}
    lines += valued("level b at 1 Hz", level, "level")
    lines += valued("corner", found["corner"], "corner")
    worlds = put_in.get("model.drops.frequency", [None] * len(found["drops"]))
    for drop, world in zip(found["drops"], worlds, strict=True):
        lines.append(
            f"notch: {_valued(drop['frequency'])}{_of_world(world)}, "
            f"{drop['depth']['value']:.2f} dB deep, Q {drop['pole_Q']['value']:.2f}"
        )
    if not found["drops"]:
        lines.append("no notch found")
    lines += valued("change with the preload", found["preload_effect"], "preload_effect")
    fit = f"χ² = {found['chi_square']:.0f} for {found['degrees']} d.o.f."
    poor = probability_above(found["chi_square"], found["degrees"]) < MISFIT_PROBABILITY
    means = "good; ± are 95 % intervals"
    if poor:
        means = "poor: the ± above mean little (a notch just outside the swept range does this)"
    return [*lines, f"joint fit: {fit}, {means}"]


def _within(bounds: Mapping[str, float]) -> dict[str, str]:
    """Return for each verdict within which bounds its statement is tested."""
    slope, gain = bounds.get("slope_dB_decade"), bounds.get("gain_dB")
    of_slope = "" if slope is None else f" within ±{slope:g} dB/decade"
    of_gain = "" if slope is None or gain is None else f", ±{gain:g} dB"
    return {"first_order": of_slope, "linearity": of_slope + of_gain}


def _answer(statement: str, verdict: Verdict, within: str) -> str:
    """Return the answer, with its bounds where the statement holds, else with its reason, which
    names them."""
    if verdict.answer == "holds":
        return f"{statement}: holds{within}"
    return verdict.sentence(statement)


def _valued(estimate: Mapping[str, Any]) -> str:
    """Return an estimate as ``1453.50 ± 0.22 Hz``."""
    value, error = estimate["value"], estimate["standard_error"]
    if value is None or error is None:  # not finite
        return "not determined"
    return f"{with_error(value, COVERAGE_95 * error).removeprefix('+')} {estimate['unit']}"


def _of_world(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f" (true value: {value:.6g})"


def _truth(readings: Sequence[Reading]) -> FilmTruth | None:
    """Return the film of a simulated bench; None on a real one."""
    from rig.analysis.film.truth import FilmTruth

    accounts = [str(reading[TRUTH]) for reading in readings if reading.get(TRUTH)]
    return FilmTruth.of(accounts[0] if accounts else None)


def _gain_near_200(readings: Sequence[Reading]) -> dict[str, Any]:
    """Return the gain nearest to 200 Hz and its standard error; empty if none was measured
    near it."""
    nearest = min(readings, key=lambda r: abs(math.log(float(r["frequency_Hz"] or 1) / 200)))
    frequency = float(nearest["frequency_Hz"] or 1)
    if not 1 / NEAR_200 <= frequency / 200 <= NEAR_200:
        return {}
    return {
        "gain_near_200_Hz_dB": nearest["gain_dB"],
        "gain_near_200_Hz_error_dB": nearest["gain_standard_error_dB"],
        "gain_near_200_Hz_at_Hz": frequency,
    }


def _column(readings: Sequence[Reading], name: str) -> npt.NDArray[np.float64]:
    """Return a column of the run's table, (n,)."""
    source = LAYOUT.column(name).key
    # Readings of a run that an older version began lack the newer columns.
    return np.array([float(reading.get(source, math.nan) or 0) for reading in readings])
