"""Analysis of a complete sweep of a film: chapter 3 of the paper, from arrays to sentences.

The input is frequencies, complex responses with their covariances, loads and distortions. The
result is a :class:`SweepAnalysis`:

- ``level`` is ``b`` of the paper's equation (2): the low-frequency asymptote at 1 Hz of a circuit
  with 20 dB/decade and one pole, fitted together with all notches (`rig.analysis.film.model`);
- ``corner`` is the frequency of that pole;
- ``slopes`` and ``plain`` are the slopes and the paper's own fit (`rig.analysis.film.slope`);
- ``drops`` are the notches: each has the frequency at which it is deepest, and the depth and Q of a
  second-order notch.

Intervals include noise and, if there is one, the model error. The calibration error of the load
cell adds to ``b`` and is not included.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rig.analysis.estimate import Estimate
from rig.analysis.film.circuit import CircuitComparison, compare_circuit
from rig.analysis.film.drops import fit_with_drops
from rig.analysis.film.fit import MISFIT_PROBABILITY, DropEstimate, FilmFit, fit_film
from rig.analysis.film.linearity import (
    DistortionSummary,
    LoadLinearity,
    distortion_summary,
    load_linearity,
)
from rig.analysis.film.model import FIRST_ORDER_SLOPE, SLOPE_BAND_HZ
from rig.analysis.film.slope import PlainFit, Slopes, plain_fit, slopes
from rig.analysis.film.stress_jerk import StressJerkTest, stress_jerk_test
from rig.analysis.film.truth import FilmTruth
from rig.analysis.response.complex_response import DB_PER_RELATIVE
from rig.analysis.response.curve import CurveError, ResponseCurve
from rig.analysis.verdict import Bounds
from rig.core.units import counted
from rig.physics.pvdf import SKIN_STRIP, CircuitSettings

__all__ = [
    "CurveError",
    "PlainFit",
    "ResponseCurve",
    "Slopes",
    "SweepAnalysis",
    "analyse",
]

FEWEST_FREQUENCIES = 12
"""Minimum number of different frequencies from which level, corner and notches are fitted: between
fewer, a whole notch may lie unseen."""
WHOLE_RANGE_TO_HZ = 18e3
"""Highest frequency from which a sweep covers the paper's range, to 20 kHz."""
DEFAULT_BOUNDS = Bounds()
LARGEST_MODEL_ERROR = 0.5
"""Largest relative model error: a model that is off by half has not been fitted."""


@dataclass(frozen=True, eq=False)
class SweepAnalysis:
    """Results of a sweep of a film."""

    curve: ResponseCurve
    """The points that were analysed."""
    fit: FilmFit
    """The joint fit: level, corner, notches, misfit."""
    slopes: Slopes | None
    """Slopes; None if less than an octave of 2 to 2000 Hz was measured."""
    plain: PlainFit | None
    """The paper's fit; None with fewer than two points outside the notches from 2 to 2000 Hz."""
    circuit: CircuitComparison
    """Comparison with the circuit of the paper."""
    linearity: LoadLinearity | None
    """Dependence of the gain on the load; None if there was only one load."""
    distortion: DistortionSummary | None
    """Harmonic distortion; None if it was not measured."""
    bounds: Bounds
    """Differences up to which a statement counts as true."""

    @property
    def points(self) -> int:
        """Number of points that were analysed."""
        return len(self.curve)

    @cached_property
    def stress_jerk(self) -> StressJerkTest:
        """Test of the alternative model with a break. Computed on first use, because it takes
        longest."""
        return stress_jerk_test(self.curve, self.fit)

    @property
    def level(self) -> Estimate:
        """Level b, in dB re 1 V/N at 1 Hz."""
        return self.fit.level

    @property
    def corner(self) -> Estimate:
        """Frequency of the pole, in Hz."""
        return self.fit.corner

    @property
    def drops(self) -> tuple[DropEstimate, ...]:
        """The notches, by ascending frequency."""
        return self.fit.drops

    def sentences(self, truth: FilmTruth | None = None) -> list[str]:
        """Return the results in words, in the order of the paper.

        With the film of a simulated bench each number is said to be found, with its true value
        in the simulation; without one it is said to be measured.
        """
        lines = [f"{self.points} points. {self._slope_sentence(truth)}"]
        lines.append(self._level_sentence(truth))
        lines += [self._drop_sentence(drop, truth) for drop in self.drops] or [
            "No notch was found."
        ]
        lines.append(self._saturation_sentence(truth))
        lines.append(self.stress_jerk.sentence())
        lines += self.circuit.sentences()
        if self.linearity is not None:
            lines.append(
                self.linearity.sentence(self.bounds)
                + _put_in(
                    None if truth is None else truth.gain_per_load_decade_dB, "dB/decade of load"
                )
            )
        if self.distortion is not None:
            lines.append(self.distortion.sentence())
        if self.fit.preload_effect is not None:
            lines.append(
                self._preload_sentence(self.fit.preload_effect)
                + _put_in(None if truth is None else truth.gain_per_newton_dB, "dB/N")
            )
        lines.append(self._misfit_sentence())
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON and HDF5 attributes; numbers that are not finite become
        None."""
        whole = {
            "points": self.points,
            "level": self.level.as_dict(),
            "corner": self.corner.as_dict(),
            "slope": self.slopes.slope.as_dict() if self.slopes else None,
            "bounds": asdict(self.bounds),
            "first_order": asdict(self.slopes.verdict(self.bounds)) if self.slopes else None,
            "asymptotic_slope": self.slopes.asymptotic.as_dict() if self.slopes else None,
            "delay": self.fit.delay.as_dict(),
            "plain": asdict(self.plain) if self.plain else None,
            "drops": [
                {
                    "frequency": drop.frequency.as_dict(),
                    "depth": drop.depth.as_dict(),
                    "pole_Q": drop.pole_Q.as_dict(),
                }
                for drop in self.drops
            ],
            "polarity": self.fit.model.polarity,
            "chi_square": self.fit.chi_square,
            "degrees": self.fit.degrees,
            "model_error_dB": self.fit.gain_error_dB,
            "preload_effect": effect.as_dict() if (effect := self.fit.preload_effect) else None,
            "stress_jerk": {**asdict(self.stress_jerk), "verdict": self.stress_jerk.verdict},
            "circuit": {
                "rate_sensitivity": self.circuit.rate_sensitivity.as_dict(),
                "time_constant": self.circuit.time_constant.as_dict(),
                "film_corner_Hz": self.circuit.film_corner_Hz,
                "circuit_corner_Hz": self.circuit.circuit_corner_Hz,
                "offsets": {n: e.as_dict() for n, e in self.circuit.offsets.items()},
                "separability": self.circuit.separability.as_dict(),
            },
            "linearity": _linearity_as_dict(self.linearity, self.bounds),
            "distortion": asdict(self.distortion) if self.distortion else None,
        }
        plain: dict[str, Any] = _plain(whole)
        return plain

    def _beyond(self, drop: DropEstimate) -> str:
        beyond = drop.frequency.value > self.circuit.highest_Hz
        return ", beyond the measured range and visible by its flank" if beyond else ""

    def _drop_sentence(self, drop: DropEstimate, truth: FilmTruth | None) -> str:
        true_Hz = truth and truth.drop_near_Hz(drop.frequency.value)
        found = "measured at" if truth is None else "found at"
        world = f" (true value in the simulation: {true_Hz:.2f} Hz)" if true_Hz else ""
        if truth is not None and not true_Hz:
            world = " (the simulation has none there)"
        return (
            f"Notch {found} {drop.frequency}{world}{self._beyond(drop)}, {drop.depth} deep, pole Q "
            f"{drop.pole_Q}."
        )

    def _saturation_sentence(self, truth: FilmTruth | None) -> str:
        if truth is None:
            return f"Corner measured: {self.corner} (the paper's gain saturates above 2 kHz)."
        return (
            f"Corner found: {self.corner} (true value in the simulation: {truth.corner_Hz:.2f} "
            "Hz). The simulated film has one pole near 2 kHz, after the paper's measurement; no "
            "circuit of Table 1 gives it."
        )

    def _slope_sentence(self, truth: FilmTruth | None) -> str:
        if self.slopes is None:
            low, high = SLOPE_BAND_HZ
            return f"No slope: less than one octave of {low:g} to {high:g} Hz was measured."
        low, high = self.slopes.band_Hz
        asymptotic = self.slopes.asymptotic
        expected = f"{FIRST_ORDER_SLOPE:g} dB/decade"
        verdict = self.slopes.verdict(self.bounds).sentence(f"{expected} (stress rate)")
        world = _put_in(None if truth is None else FIRST_ORDER_SLOPE, "dB/decade")
        return (
            f"Slope of the straight line through the gain from {low:g} to {high:g} Hz, with the "
            f"fitted notches removed: {self.slopes.slope}. After removing the fitted first-order "
            f"low-pass: slope {asymptotic}{world}. {verdict}"
        )

    def _level_sentence(self, truth: FilmTruth | None) -> str:
        how = "measured" if truth is None else "found"
        text = f"Level b {how}: {self.level} re 1 V/N at 1 Hz (asymptote{self._at_load()})"
        if truth is not None:
            one_newton = " and 1 N" if truth.gain_per_load_decade_dB else ""
            text += (
                f" (true value in the simulation: {truth.level_dB:.3f} dB at the nominal "
                f"preload{one_newton})"
            )
        if self.plain is None:
            return text + "."
        return (
            f"{text}. The paper's eq. (2), a 20 dB/decade line without corner, fitted to "
            f"{self.plain.points} points outside the notches: {self.plain.level_dB:.2f} dB (rms "
            f"{self.plain.rms_dB:.2f} dB; depends on the grid; line with free slope: "
            f"{self.plain.slope_dB_decade:.2f} dB/decade)."
        )

    def _at_load(self) -> str:
        """Return the load at which the level is stated, if there are several."""
        if self.curve.loads_N is None:
            return ""
        mean_N = 10 ** float(np.log10(self.curve.loads_N).mean())
        return f", at the mean load {mean_N:.3g} N"

    def _preload_sentence(self, effect: Estimate) -> str:
        assert self.curve.preloads_N is not None
        preloads = self.curve.preloads_N
        return (
            f"Mean preload {preloads.mean():.2f} N "
            f"({preloads.min():.2f} to {preloads.max():.2f} N). The "
            f"gain changes with it by {effect}; this effect is removed."
        )

    def _range_sentence(self) -> str:
        """Return what a part of the range hides; empty for the whole range."""
        highest = self.circuit.highest_Hz
        if highest >= WHOLE_RANGE_TO_HZ:
            return ""
        return (
            f"The range ends at {highest:g} Hz: notches above it act within it and are not in the "
            "model. Corner, delay and what lies near the end may be off by more than their "
            "intervals; measure to 20 kHz (--highest) to judge them. "
        )

    def _misfit_sentence(self) -> str:
        fit = self.fit
        quality = f"χ² = {fit.chi_square:.0f} for {fit.degrees} d.o.f."
        delay = f"Delay of the film after the load: {fit.delay}."
        if fit.probability >= MISFIT_PROBABILITY:
            return f"Joint fit: {quality} (good fit). {self._range_sentence()}{delay}"
        if not fit.residuals_are_random:
            return (
                f"The model does not fit ({quality}; the residuals are not random): the intervals "
                f"of b, slopes, corner and notches mean nothing. {self._range_sentence()}{delay}"
            )
        return (
            f"Poor fit ({quality}). A model error of {fit.gain_error_dB:.2g} dB and "
            f"{fit.phase_error_deg:.2g}° per point has been added to the intervals; they are "
            f"valid only if the residuals look random. Check the residual panel. {delay}"
        )


def analyse(
    frequencies: ArrayLike,
    responses: ArrayLike,
    covariances: ArrayLike,
    *,
    degrees: ArrayLike | None = None,
    preloads: ArrayLike | None = None,
    loads: ArrayLike | None = None,
    load_distortion: ArrayLike | None = None,
    film_distortion: ArrayLike | None = None,
    preload_errors: ArrayLike | None = None,
    given: CircuitSettings = SKIN_STRIP,
    bounds: Bounds = DEFAULT_BOUNDS,
) -> SweepAnalysis:
    """Analyse the points of a sweep: frequencies in Hz, responses in V/N, covariances (n, 2, 2).

    Points may be in any order. ``degrees`` (n,) are the degrees of freedom of each covariance and
    ``preloads`` (n,) the static forces in N, with ``preload_errors`` (see
    :meth:`ResponseCurve.of`). ``bounds`` belong to the verdicts. ``loads`` (n,) are peak
    loads in N; if there are several at a frequency, an effect of the load is fitted with that of
    the preload, and the level is that at their geometric mean. Distortions (n,) are fractions.
    ``given`` is the circuit to compare with, Table 1 by default.

    Raises CurveError for points that cannot be analysed: those at fewer than `FEWEST_FREQUENCIES`
    frequencies, those that :meth:`ResponseCurve.of` and :func:`fit_with_drops` refuse, and those
    that neither first order nor the alternative model fits.
    """
    different = np.unique(np.asarray(frequencies, dtype=float)).size
    if different < FEWEST_FREQUENCIES:
        raise CurveError(
            f"{counted(different, 'frequency', 'frequencies')}, {FEWEST_FREQUENCIES} are needed",
            "measure more points",
        )
    points = (frequencies, responses, covariances)
    linearity = (
        None if loads is None else load_linearity(*points, loads, degrees, preloads, preload_errors)
    )
    several_loads = None if linearity is None else loads
    curve = ResponseCurve.of(*points, degrees, preloads, preload_errors, several_loads)
    fit = fit_with_drops(curve)
    if fit.preload_effect is not None:
        curve = curve.with_preload_errors(fit.preload_effect.value / DB_PER_RELATIVE)
        fit = fit_film(curve, fit.model)
    found = SweepAnalysis(
        curve=curve,
        fit=fit,
        slopes=slopes(curve, fit),
        plain=plain_fit(curve, fit.model),
        circuit=compare_circuit(curve, fit.level, fit.corner, given),
        linearity=linearity,
        distortion=None
        if load_distortion is None or film_distortion is None
        else distortion_summary(frequencies, load_distortion, film_distortion),
        bounds=bounds,
    )
    if fit.gain_error > LARGEST_MODEL_ERROR and found.stress_jerk.verdict != "supported":
        raise CurveError(
            "no first-order circuit with notches fits these points: they scatter about the "
            f"best one by {fit.gain_error:.0%}",
            "check the measured gain and phase first",
        )
    return found


def _put_in(value: float | None, unit: str) -> str:
    """Return the true value in the simulation as a remark; nothing on a real bench."""
    return "" if value is None else f" (true value in the simulation: {value:g} {unit})"


def _linearity_as_dict(linearity: LoadLinearity | None, bounds: Bounds) -> dict[str, Any] | None:
    if linearity is None:
        return None
    columns = {
        "frequency_Hz": linearity.frequencies,
        "slope_dB_decade": linearity.slopes,
        "slope_error_dB_decade": linearity.slope_errors,
        "worst_deviation_dB": linearity.worst_deviations,
    }
    return {
        "by_frequency": {name: column.tolist() for name, column in columns.items()},
        "slope": linearity.slope.as_dict(),
        "largest_difference": linearity.largest_difference.as_dict(),
        "differing_loads_N": list(linearity.differing_loads_N),
        "verdict": asdict(linearity.verdict(bounds)),
        "model_error_dB": linearity.model_error_dB,
        "worst_deviation_dB": linearity.worst_deviation_dB,
        "worst_frequency_Hz": linearity.worst_frequency_Hz,
        "chi_square": linearity.chi_square,
        "degrees": linearity.degrees,
        "probability": linearity.probability,
    }


def _plain(value: Any) -> Any:
    """Return lists and dicts of plain values, with NaN and infinities as None."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
