"""The analysis of a complete sweep of a film: chapter 3 of the paper, from arrays to sentences.

Numbers in: frequencies, complex responses with their covariances, loads and distortions. Numbers
out: :class:`SweepAnalysis`. What each means:

- ``level`` is ``b`` of the paper's equation (2): the low-frequency asymptote at 1 Hz of a circuit
  of 20 dB/decade and one pole, fitted together with all drops (`rig.analysis.film_model`);
- ``slope`` is the exponent of that rise, set free up to 2 kHz in the same model: pole and drops are
  divided out, so that a first-order film has 20 dB/decade whatever the grid;
- ``plain`` is the paper's own fit, gain = 20 log10 f + b by unweighted least squares over the
  points from 2 to 2000 Hz outside the drops. Pole and drops' tails pull it, the more the more
  points there are near 2 kHz; the straight line of free slope beside it likewise.

Intervals hold noise and, where there is one, the model error. The load cell's calibration error
adds to ``b`` and is not in them.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.circuit_fit import CircuitComparison, compare_circuit
from rig.analysis.drops import fit_with_drops, refinement
from rig.analysis.estimate import Estimate
from rig.analysis.film_fit import DropEstimate, FilmFit, fit_film
from rig.analysis.film_model import FIRST_ORDER_SLOPE, SLOPE_BAND_HZ, FilmModel
from rig.analysis.linearity import (
    DistortionSummary,
    LoadLinearity,
    distortion_summary,
    load_linearity,
)
from rig.analysis.response import Reals
from rig.analysis.response_curve import CurveError, ResponseCurve
from rig.analysis.stress_jerk import StressJerkTest, stress_jerk_test
from rig.model.pvdf import SKIN_STRIP, CircuitSettings

__all__ = [
    "CurveError",
    "PlainFit",
    "ResponseCurve",
    "SweepAnalysis",
    "analyse",
    "outside_drops",
    "plain_fit",
    "refinement",
]

OUTSIDE_DROPS_DB = 0.5
"""A point is outside the drops where the fitted drops together take less than this from it."""


@dataclass(frozen=True)
class PlainFit:
    """Equation (2) as the paper fits it; depends on the grid."""

    level_dB: float
    """b of gain = 20 log10 f + b, dB re 1 V/N."""
    rms_dB: float
    """Of the gains about that line."""
    slope_dB_decade: float
    """Of the straight line of free slope through the same points."""
    points: int


@dataclass(frozen=True, eq=False)
class SweepAnalysis:
    """All that a sweep says about a film."""

    points: int
    fit: FilmFit
    """The joint fit: level, corner, drops, misfit."""
    slope: Estimate
    """dB/decade."""
    plain: PlainFit | None
    """None with fewer than two points outside the drops from 2 to 2000 Hz."""
    stress_jerk: StressJerkTest
    circuit: CircuitComparison
    linearity: LoadLinearity | None
    """None where there is one load only."""
    distortion: DistortionSummary | None

    @property
    def level(self) -> Estimate:
        """b, dB re 1 V/N."""
        return self.fit.level

    @property
    def corner(self) -> Estimate:
        """Hz."""
        return self.fit.corner

    @property
    def drops(self) -> tuple[DropEstimate, ...]:
        """By ascending frequency."""
        return self.fit.drops

    def sentences(self) -> list[str]:
        """What a person wants to read, in the paper's order."""
        lines = [f"{self.points} points. {self._slope_sentence()}", self._level_sentence()]
        lines += [
            f"Drop at {drop.frequency}{self._beyond(drop)}, "
            f"{drop.depth} deep, pole Q {drop.pole_Q}."
            for drop in self.drops
        ] or ["No drop was found."]
        lines.append(self.stress_jerk.sentence())
        lines += self.circuit.sentences()
        lines += [part.sentence() for part in (self.linearity, self.distortion) if part is not None]
        lines.append(self._misfit_sentence())
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON and HDF5 attributes; what is not finite becomes None."""
        whole = {
            "points": self.points,
            "level": self.level.as_dict(),
            "corner": self.corner.as_dict(),
            "slope": self.slope.as_dict(),
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
            "model_error_dB": self.fit.model_error_dB,
            "stress_jerk": {**asdict(self.stress_jerk), "verdict": self.stress_jerk.verdict},
            "circuit": {
                "film_corner_Hz": self.circuit.film_corner_Hz,
                "circuit_corner_Hz": self.circuit.circuit_corner_Hz,
                "offsets": {n: e.as_dict() for n, e in self.circuit.offsets.items()},
                "separability": asdict(self.circuit.separability),
            },
            "linearity": _linearity_as_dict(self.linearity),
            "distortion": asdict(self.distortion) if self.distortion else None,
        }
        plain: dict[str, Any] = _plain(whole)
        return plain

    def _beyond(self, drop: DropEstimate) -> str:
        beyond = drop.frequency.value > self.circuit.highest_Hz
        return ", beyond the measured range and seen by its flank" if beyond else ""

    def _slope_sentence(self) -> str:
        low, high = SLOPE_BAND_HZ
        first = "holds" if self.slope.covers(FIRST_ORDER_SLOPE) else "does not hold"
        return (
            f"The gain rises by {self.slope} from {low:g} to {high:g} Hz, pole and drops divided "
            f"out: {FIRST_ORDER_SLOPE:g} dB/decade (stress rate) {first} within the interval."
        )

    def _level_sentence(self) -> str:
        text = f"b = {self.level} re 1 V/N at 1 Hz (asymptote)"
        if self.plain is None:
            return text + "."
        return (
            f"{text}; the paper's plain eq. (2) over {self.plain.points} points outside the drops "
            f"gives {self.plain.level_dB:.2f} dB (rms {self.plain.rms_dB:.2f} dB, depends on the "
            f"grid; straight line of free slope {self.plain.slope_dB_decade:.2f} dB/decade)."
        )

    def _misfit_sentence(self) -> str:
        delay = f"Delay of film after load: {self.fit.delay}."
        text = f"Chi-square of the joint fit {self.fit.chi_square:.0f} of {self.fit.degrees}"
        if not self.fit.model_error:
            return f"{text}: noise explains the residuals. {delay}"
        return (
            f"{text}: more than noise explains. The intervals contain a model error of "
            f"{self.fit.model_error_dB:.2g} dB at every point and hold if it is scatter: look at "
            f"the residuals. {delay}"
        )


def analyse(
    frequencies: ArrayLike,
    responses: ArrayLike,
    covariances: ArrayLike,
    *,
    loads: ArrayLike | None = None,
    load_distortion: ArrayLike | None = None,
    film_distortion: ArrayLike | None = None,
    given: CircuitSettings = SKIN_STRIP,
) -> SweepAnalysis:
    """Analyse a sweep's points, in any order: Hz, V/N, (n, 2, 2) of real and imaginary part.

    ``loads`` (n,) in N, peak; distortions (n,) as fractions; ``given`` is the circuit to compare
    with, Table 1 by default. Raises CurveError for what cannot be analysed.
    """
    curve = ResponseCurve.of(frequencies, responses, covariances)
    fit = fit_with_drops(curve)
    return SweepAnalysis(
        points=len(curve),
        fit=fit,
        slope=fit_film(curve, replace(fit.model, slope_dB_decade=FIRST_ORDER_SLOPE)).slope,
        plain=plain_fit(curve, fit.model),
        stress_jerk=stress_jerk_test(curve, fit),
        circuit=compare_circuit(curve, fit.level, fit.corner, given),
        linearity=None
        if loads is None
        else load_linearity(frequencies, responses, covariances, loads),
        distortion=None
        if load_distortion is None or film_distortion is None
        else distortion_summary(frequencies, load_distortion, film_distortion),
    )


def outside_drops(frequencies: Reals, model: FilmModel) -> NDArray[np.bool_]:
    """True for the frequencies (n,) at which the drops take less than 0.5 dB."""
    outside: NDArray[np.bool_] = np.abs(model.loss_dB(frequencies)) < OUTSIDE_DROPS_DB
    return outside


def plain_fit(curve: ResponseCurve, model: FilmModel) -> PlainFit | None:
    """Equation (2) over 2 to 2000 Hz, drops left out, every point counting the same."""
    f = curve.frequencies
    chosen = (f >= SLOPE_BAND_HZ[0]) & (f <= SLOPE_BAND_HZ[1]) & outside_drops(f, model)
    decades, gains = np.log10(f[chosen]), curve.gains_dB[chosen]
    if np.unique(decades).size < 2:
        return None
    offsets = gains - FIRST_ORDER_SLOPE * decades
    return PlainFit(
        level_dB=float(offsets.mean()),
        rms_dB=float(offsets.std()),
        slope_dB_decade=float(np.polyfit(decades, gains, 1)[0]),
        points=int(chosen.sum()),
    )


def _linearity_as_dict(linearity: LoadLinearity | None) -> dict[str, Any] | None:
    if linearity is None:
        return None
    arrays = ("frequencies", "slopes", "slope_errors", "worst_deviations")
    return {
        **{name: getattr(linearity, name).tolist() for name in arrays},
        "slope": linearity.slope.as_dict(),
        "worst_deviation_dB": linearity.worst_deviation_dB,
        "worst_frequency_Hz": linearity.worst_frequency_Hz,
        "chi_square": linearity.chi_square,
        "degrees": linearity.degrees,
        "probability": linearity.probability,
    }


def _plain(value: Any) -> Any:
    """Lists and dicts of plain values, NaN and infinities as None."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
