"""Computes the load on a film from its voltage, with its gain curve as a calibration.

    load = voltage / H(f),   H from the film's record: 20 dB/decade, one pole, notches

The notches depend on the mounting, and within one the result depends on its exact bottom. A load is
therefore stated only outside the notches, where they take less than 0.5 dB; their flanks are
divided out.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.estimate import Estimate
from rig.analysis.film.model import FilmModel, Notch
from rig.analysis.film.slope import OUTSIDE_DROPS_DB
from rig.analysis.response.complex_response import DB_PER_RELATIVE
from rig.analysis.response.sine_fit import scaled_covariance
from rig.core.errors import ExitCode, RigError
from rig.instruments.calibration import FilmCalibration

if TYPE_CHECKING:
    from rig.analysis.film.gain_curve import SweepAnalysis

Reals = NDArray[np.float64]


class FilmLoadError(RigError):
    """Raised when a load cannot be computed from a voltage with this record."""

    code = ExitCode.FINISHED_WITH_FAILURES


@dataclass(frozen=True, eq=False)
class FilmLoad:
    """A sinusoidal load on the film."""

    frequency_Hz: float
    """Frequency of the load, in Hz."""
    phasor: complex
    """Peak load in N, with its phase on the time axis of the voltage."""
    covariance: Reals
    """Covariance of (real, imaginary) part in N², (2, 2): voltage, calibration and its model
    error."""

    @property
    def amplitude(self) -> Estimate:
        """Peak load, in N."""
        return Estimate.normal(abs(self.phasor), self._error(1.0), "N")

    @property
    def phase_deg(self) -> Estimate:
        """Phase in degrees, in (-180, 180]."""
        error = math.degrees(self._error(1j) / abs(self.phasor))
        return Estimate.normal(math.degrees(cmath.phase(self.phasor)), error, "deg")

    def _error(self, turn: complex) -> float:
        """Return the standard error along the phasor (turn 1) or across it (1j)."""
        unit = turn * self.phasor / abs(self.phasor)
        direction = np.array([unit.real, unit.imag])
        return math.sqrt(max(float(direction @ self.covariance @ direction), 0.0))


def coefficients(analysis: SweepAnalysis, load_cell_error: float = 0.0) -> dict[str, Any]:
    """Return the entries of the film's calibration record, by field name, from the analysis of a
    sweep.

    ``load_cell_error`` is the relative standard error of the sensitivity of the load cell. It is
    common to all loads of the sweep and therefore adds to the error of b.
    """
    fit = analysis.fit
    covariance = fit.covariance.copy()
    covariance[0, 0] += (DB_PER_RELATIVE * load_cell_error) ** 2
    level = Estimate.normal(
        analysis.level.value, math.sqrt(float(covariance[0, 0])), analysis.level.unit
    )
    return {
        "b_dB": level.as_dict(),
        "corner_Hz": analysis.corner.as_dict(),
        "delay_us": fit.delay.as_dict(),
        "inverse_corner_s": fit.model.inverse_corner_s,
        "polarity": 1 if fit.model.polarity > 0 else -1,
        "drops": [
            {"frequency_Hz": n.frequency_Hz, "pole_Q": n.pole_Q, "depth_dB": n.depth_dB}
            for n in fit.model.notches
        ],
        "covariance": covariance.tolist(),
        "gain_model_error_dB": fit.gain_error_dB,
        "phase_model_error_deg": fit.phase_error_deg,
        "points": analysis.points,
    }


def load_from_voltage(
    record: FilmCalibration,
    frequency_Hz: float,
    voltage: complex,
    voltage_covariance: ArrayLike,
) -> FilmLoad:
    """Return the load phasor (N, peak) for a voltage phasor (V, peak) with its covariance (2, 2).

    Errors are first order; those of voltage and record are taken as independent.

    Raises FilmLoadError for a voltage of zero, outside the calibrated frequencies, and within a
    notch.
    """
    model = film_model(record)
    at = np.array([frequency_Hz])
    _refuse(record, model, frequency_Hz)
    if not voltage or not cmath.isfinite(voltage):
        raise FilmLoadError(
            f"the film's voltage at {frequency_Hz:g} Hz is {voltage}: it contains no load"
        )
    response = complex(model.response(at)[0])
    load = voltage / response
    slopes = model.log_jacobian(at)[:, 0]
    # Derivatives of ln H with respect to the parameters of the record.
    relative = np.stack([slopes.real, slopes.imag])
    of_response = relative @ np.array(record.covariance) @ relative.T
    of_response[0, 0] += (record.gain_model_error_dB / DB_PER_RELATIVE) ** 2
    of_response[1, 1] += math.radians(record.phase_model_error_deg) ** 2
    covariance = scaled_covariance(np.asarray(voltage_covariance, float), 1 / response)
    covariance = covariance + scaled_covariance(of_response, -load)
    return FilmLoad(frequency_Hz, load, covariance)


def film_model(record: FilmCalibration) -> FilmModel:
    """Return the response of the film as its calibration record states it."""
    return FilmModel(
        level_dB=record.b_dB.value if record.b_dB.value is not None else math.nan,
        inverse_corner_s=record.inverse_corner_s,
        notches=tuple(Notch(d.frequency_Hz, d.pole_Q, d.depth_dB) for d in record.drops),
        delay_s=1e-6 * (record.delay_us.value or 0.0),
        polarity=float(record.polarity),
    )


def _refuse(record: FilmCalibration, model: FilmModel, frequency_Hz: float) -> None:
    low, high = record.lowest_frequency_Hz, record.highest_frequency_Hz
    if not low <= frequency_Hz <= high:
        raise FilmLoadError(
            f"{frequency_Hz:g} Hz is outside the calibrated {low:g} to {high:g} Hz of film "
            f"{record.sensor!r}"
        )
    loss = float(model.loss_dB(np.array([frequency_Hz]))[0])
    if abs(loss) >= OUTSIDE_DROPS_DB:
        nearest = min(record.drops, key=lambda d: abs(math.log(d.frequency_Hz / frequency_Hz)))
        raise FilmLoadError(
            f"{frequency_Hz:g} Hz lies in the drop at {nearest.frequency_Hz:.4g} Hz of film "
            f"{record.sensor!r}, which takes {loss:.1f} dB there",
            f"a load is stated where the drops take less than {OUTSIDE_DROPS_DB:g} dB",
        )
