"""Calibration with known weights: means of steady readings, and straight lines through them.

A *reading* is the mean of some seconds of a sensor's output under a known force, with its standard
error. Every channel of a sensor is a straight line in the force,

    reading = zero + B force

fitted by weighted least squares. The calibration matrix is the inverse of B.

Weights put on again do not repeat to the last digit, and zeros drift. If the readings of a channel
lie further from its line than their own errors explain, one additional error, the same for all
readings of the channel, is added such that chi-square equals its degrees of freedom (Mandel and
Paule 1970). Intervals then use Student's t with these degrees of freedom, otherwise the 1.96 of the
normal distribution. An error common to all weights (their tolerance) scales every result and is
added at the end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.estimate import COVERAGE_95, Estimate
from rig.core.errors import ExitCode, RigError

Reals = NDArray[np.float64]
Vector = tuple[float, float, float]
"""Force along x, y and z, in N."""

BLOCKS = 10
"""Number of blocks of a reading whose scatter gives its standard error."""
CLEAR_TREND = 5.0
"""Standard errors from which a trend is significant."""
LARGEST_CONDITION = 20.0
"""Largest condition number of B, its channels scaled to their own largest entry. Beyond it two axes
cannot be distinguished."""
LARGEST_RESIDUAL = 0.01
"""Largest distance of a reading from the fit, as a share of the largest force."""
CLEAR_SENSITIVITY = 10.0
"""Standard errors that the sensitivity of a sensor must exceed."""

_ROUNDS = 60


class WeighingError(RigError):
    """Raised when readings under weights do not determine a calibration."""

    code = ExitCode.FINISHED_WITH_FAILURES


@dataclass(frozen=True, eq=False)
class Mean:
    """Mean of a steady output, one value per channel, (k,)."""

    value: Reals
    """Mean of the output."""
    standard_error: Reals
    """Standard error of `value`, in its unit."""
    trend: Reals
    """Change of the output from the beginning of the reading to its end."""
    trend_error: Reals
    """Standard error of the trend."""
    samples: int
    """Number of samples."""

    def drifts(self, tolerated: float | Reals) -> NDArray[np.bool_]:
        """Return which channels changed during the reading, significantly and by more than is
        tolerated.

        Shape (k,), one value per channel; `tolerated` is in the unit of the samples.
        """
        clear: NDArray[np.bool_] = np.abs(self.trend) > np.maximum(
            CLEAR_TREND * self.trend_error, tolerated
        )
        return clear


def mean_of(samples: ArrayLike, resolution: float = 0.0) -> Mean:
    """Return the mean of samples (n,) or (n, k), with a standard error from the scatter of ten
    blocks.

    Correlated noise, for example from the mains, is thus included correctly. ``resolution`` is the
    step of the converter. If the samples scatter by less than half a step, the error of the
    converter, step / sqrt(12), is common to all of them and is not reduced by averaging.

    Raises WeighingError for fewer than two samples per block.
    """
    values = np.asarray(samples, dtype=np.float64)
    values = values.reshape(len(values), -1)
    per_block = len(values) // BLOCKS
    if per_block < 2:
        raise WeighingError(
            f"a reading of {len(values)} samples is too short: {2 * BLOCKS} are needed",
            "measure for longer",
        )
    used = values[len(values) - per_block * BLOCKS :]
    blocks = used.reshape(BLOCKS, per_block, -1).mean(axis=1)
    place = (np.arange(BLOCKS) + 0.5) / BLOCKS - 0.5
    spread = float(place @ place)
    trend = place @ blocks / spread
    about = blocks - blocks.mean(axis=0) - place[:, None] * trend
    scatter = np.sqrt(np.square(about).sum(axis=0) / (BLOCKS - 2))
    common = np.where(used.std(axis=0) < resolution / 2, resolution / math.sqrt(12), 0.0)
    return Mean(
        value=blocks.mean(axis=0),
        standard_error=np.hypot(blocks.std(axis=0, ddof=1) / math.sqrt(BLOCKS), common),
        trend=trend,
        trend_error=np.hypot(scatter / math.sqrt(spread), common),
        samples=len(used),
    )


@dataclass(frozen=True, eq=False)
class Line:
    """Straight line of one channel in the force."""

    coefficients: Reals
    """Zero, then one coefficient per axis."""
    covariance: Reals
    """Covariance of the coefficients."""
    residuals: Reals
    """Residuals of the readings, (n,), in the unit of the readings."""
    excess_error: float
    """Scatter of the readings beyond their own errors, in the unit of the readings."""
    chi_square: float
    """Chi-square with the readings' own errors alone."""
    degrees: int
    """Degrees of freedom of the fit."""

    @property
    def coverage(self) -> float:
        """Half-width of the 95 % interval of a coefficient, in standard errors."""
        if not self.excess_error:
            return COVERAGE_95
        from scipy.special import stdtrit

        return float(stdtrit(self.degrees, 0.975))


def fit_line(forces: ArrayLike, readings: ArrayLike, standard_errors: ArrayLike) -> Line:
    """Fit readings (n,) over forces (n, axes) in N by weighted least squares.

    Raises WeighingError for values that are not finite, errors that are not positive, and forces
    that leave a coefficient undetermined or no degree of freedom.
    """
    forces = np.asarray(forces, dtype=np.float64)
    design = np.column_stack([np.ones(len(forces)), forces])
    values, errors = np.asarray(readings, float), np.asarray(standard_errors, float)
    degrees = len(design) - design.shape[1]
    if not (np.isfinite(design).all() and np.isfinite(values).all() and np.isfinite(errors).all()):
        raise WeighingError("a force or a reading is not a finite number")
    if not (errors > 0).all():
        raise WeighingError("a reading has no standard error", "check whether the channel is alive")
    if degrees < 1 or np.linalg.matrix_rank(design) < design.shape[1]:
        raise WeighingError(
            f"{len(design)} readings do not determine zero and {design.shape[1] - 1} "
            "sensitivities with a degree of freedom left to check them",
            "use more different weights on every axis",
        )
    coefficients, covariance = _least_squares(design, values, errors)
    residuals = values - design @ coefficients
    chi_square = float(np.square(residuals / errors).sum())
    excess = _excess(design, values, errors, degrees) if chi_square > degrees else 0.0
    if excess:
        coefficients, covariance = _least_squares(design, values, np.hypot(errors, excess))
        residuals = values - design @ coefficients
    return Line(coefficients, covariance, residuals, excess, chi_square, degrees)


@dataclass(frozen=True, eq=False)
class WeighingFit:
    """Residuals of the fit of a sensor to known forces."""

    residuals: Reals
    """Force computed from the readings minus the known force, in N, (n,) or (n, axes)."""
    coverage: float
    """Half-width of the 95 % intervals in standard errors; the largest of all channels."""

    @property
    def residual_rms(self) -> float:
        """Root mean square of the residuals over all axes and readings, in N."""
        return math.sqrt(float(np.square(self.residuals).mean()))

    @property
    def largest_residual(self) -> float:
        """Largest residual, in N."""
        return float(np.abs(self.residuals).max())


@dataclass(frozen=True, eq=False)
class ForceFit(WeighingFit):
    """Zero and calibration matrix of a three-axis sensor: force = matrix (reading - zero)."""

    zero: Reals
    """Zero of each channel, in mV/V, (3,)."""
    zero_error: Reals
    """Standard errors of the zeros, in mV/V, (3,)."""
    matrix: Reals
    """Calibration matrix, in N/(mV/V), (3, 3)."""
    matrix_error: Reals
    """Standard errors of the matrix, (3, 3)."""
    crosstalk_percent: float
    """Largest force that appears along another axis if each bridge is read for itself, in
    percent."""

    def half_widths(self) -> Reals:
        """Return the half-widths of the 95 % intervals of the matrix, (3, 3)."""
        half: Reals = self.coverage * self.matrix_error
        return half

    def coefficients(self, forces: Sequence[Vector], means: Sequence[Mean]) -> dict[str, Any]:
        """Return the entries of the sensor's calibration record, by field name."""
        return {
            "coverage": self.coverage,
            "zero_mV_V": self.zero.tolist(),
            "zero_standard_error_mV_V": self.zero_error.tolist(),
            "matrix_N_mV_V": self.matrix.tolist(),
            "matrix_standard_error_N_mV_V": self.matrix_error.tolist(),
            "residual_rms_N": self.residual_rms,
            "largest_residual_N": self.largest_residual,
            "crosstalk_percent": self.crosstalk_percent,
            "readings": [
                {
                    "force_N": force,
                    "reading_mV_V": mean.value.tolist(),
                    "standard_error_mV_V": mean.standard_error.tolist(),
                    "samples": mean.samples,
                }
                for force, mean in zip(forces, means, strict=True)
            ],
        }


def fit_force(
    forces: ArrayLike,
    readings: ArrayLike,
    standard_errors: ArrayLike,
    tolerance: float = 0.0,
) -> ForceFit:
    """Fit a three-axis sensor: forces (n, 3) in N, readings and standard errors (n, 3) in mV/V.

    ``tolerance`` is the limit of the relative error common to all weights.

    Raises the errors of :func:`fit_line`, and WeighingError if the channels do not distinguish
    three directions.
    """
    forces, readings = np.asarray(forces, float), np.asarray(readings, float)
    errors = np.asarray(standard_errors, float)
    lines = [fit_line(forces, readings[:, k], errors[:, k]) for k in range(3)]
    zero = np.array([line.coefficients[0] for line in lines])
    response = np.array([line.coefficients[1:] for line in lines])
    _require_three_directions(response, lines)
    matrix = np.linalg.inv(response)
    variance = np.zeros((3, 3))
    for k, line in enumerate(lines):
        # dM = -M dB M; the errors of the channels are independent.
        own = np.einsum("lj,lm,mj->j", matrix, line.covariance[1:, 1:], matrix)
        variance += np.outer(np.square(matrix[:, k]), own)
    variance += np.square(_standard(tolerance) * matrix)
    crosstalk = np.abs(response / np.diag(response)[:, None]) - np.eye(3)
    return ForceFit(
        zero=zero,
        zero_error=np.sqrt([line.covariance[0, 0] for line in lines]),
        matrix=matrix,
        matrix_error=np.sqrt(variance),
        residuals=(readings - zero) @ matrix.T - forces,
        crosstalk_percent=100 * float(crosstalk.max()),
        coverage=max(line.coverage for line in lines),
    )


@dataclass(frozen=True, eq=False)
class CellFit(WeighingFit):
    """Zero and sensitivity of a load cell."""

    zero: Estimate
    """Output without load, in V."""
    sensitivity: Estimate
    """Sensitivity, in V/N."""

    def coefficients(self, loads: Sequence[float], means: Sequence[Mean]) -> dict[str, Any]:
        """Return the entries of the cell's calibration record, by field name."""
        return {
            "coverage": self.coverage,
            "zero_V": self.zero.as_dict(),
            "sensitivity_V_N": self.sensitivity.as_dict(),
            "residual_rms_N": self.residual_rms,
            "largest_residual_N": self.largest_residual,
            "readings": [
                {
                    "load_N": load,
                    "reading_V": float(mean.value[0]),
                    "standard_error_V": float(mean.standard_error[0]),
                    "samples": mean.samples,
                }
                for load, mean in zip(loads, means, strict=True)
            ],
        }


def fit_load_cell(
    loads: ArrayLike, readings: ArrayLike, standard_errors: ArrayLike, tolerance: float = 0.0
) -> CellFit:
    """Fit a load cell: loads (n,) in N, readings and standard errors (n,) in V.

    ``tolerance`` is the limit of the relative error common to all weights.

    Raises the errors of :func:`fit_line`, and WeighingError if the output does not follow the load.
    """
    loads, readings = np.asarray(loads, float), np.asarray(readings, float)
    line = fit_line(loads[:, None], readings, standard_errors)
    zero, sensitivity = (float(value) for value in line.coefficients)
    errors = np.sqrt(np.diag(line.covariance))
    if abs(sensitivity) < CLEAR_SENSITIVITY * errors[1]:
        raise WeighingError(
            f"the output does not follow the load: {sensitivity:.3g} V/N with a standard error of "
            f"{errors[1]:.2g} V/N",
            "check whether the cell is wired to the channel and carried the weights",
        )
    error = math.hypot(float(errors[1]), _standard(tolerance) * sensitivity)
    return CellFit(
        zero=_estimate(zero, float(errors[0]), line.coverage, "V"),
        sensitivity=_estimate(sensitivity, error, line.coverage, "V/N"),
        residuals=(readings - zero) / sensitivity - loads,
        coverage=line.coverage,
    )


def refuse_outlier(forces: ArrayLike, residuals: Reals) -> None:
    """Raise WeighingError if a reading lies off the fit by more than 1 % of the largest force.

    Such a distance is not scatter: another weight, axis or direction was used than was asked for.
    Forces and residuals are (n,) or (n, axes), in N.
    """
    known = np.asarray(forces, float).reshape(len(residuals), -1)
    off = np.abs(residuals.reshape(len(residuals), -1)).max(axis=1)
    worst = int(np.argmax(off))
    if off[worst] <= LARGEST_RESIDUAL * float(np.abs(known).max()):
        return
    asked = ", ".join(f"{value:g}" for value in known[worst])
    raise WeighingError(
        f"reading {worst + 1}, with {asked} N put on, lies {off[worst]:.3g} N off the fit of all "
        "readings",
        "a wrong weight was used, or it was in a wrong place; calibrate again",
    )


def sequence(axes: Sequence[Vector], weights_N: Sequence[float]) -> list[Vector]:
    """Return the known forces of a calibration in order: none, then each axis with increasing
    weights and none again, so that a drift of the zero shows.

    >>> sequence([(0.0, 0.0, 1.0)], [2.0, 1.0])
    [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 2.0), (0.0, 0.0, 0.0)]
    """
    forces: list[Vector] = [(0.0, 0.0, 0.0)]
    for x, y, z in axes:
        forces += [(x * weight, y * weight, z * weight) for weight in sorted(weights_N)]
        forces.append((0.0, 0.0, 0.0))
    return forces


def _estimate(value: float, error: float, coverage: float, unit: str) -> Estimate:
    return Estimate(value, error, value - coverage * error, value + coverage * error, unit)


def _standard(tolerance: float) -> float:
    """Return the standard error of a quantity that lies anywhere within ± tolerance."""
    return tolerance / math.sqrt(3)


def _least_squares(design: Reals, values: Reals, errors: Reals) -> tuple[Reals, Reals]:
    # Columns are scaled to their largest entry: forces and the constant differ by orders of
    # magnitude, which would make the normal matrix ill-conditioned.
    scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
    weighted = design / scale / errors[:, None]
    covariance = np.linalg.inv(weighted.T @ weighted)
    coefficients = covariance @ weighted.T @ (values / errors)
    return coefficients / scale, covariance / np.outer(scale, scale)


def _excess(design: Reals, values: Reals, errors: Reals, degrees: int) -> float:
    """Return the common additional error that reduces chi-square to its degrees of freedom."""

    def chi_square(excess: float) -> float:
        total = np.hypot(errors, excess)
        coefficients, _ = _least_squares(design, values, total)
        return float(np.square((values - design @ coefficients) / total).sum())

    low, high = 0.0, float(np.ptp(values)) + float(errors.max())
    for _ in range(_ROUNDS):
        middle = (low + high) / 2
        low, high = (middle, high) if chi_square(middle) > degrees else (low, middle)
    return high


def _require_three_directions(response: Reals, lines: Sequence[Line]) -> None:
    for k, (axis, line) in enumerate(zip("xyz", lines, strict=True)):
        own, error = response[k, k], math.sqrt(float(line.covariance[k + 1, k + 1]))
        if abs(own) < CLEAR_SENSITIVITY * error:
            raise WeighingError(
                f"channel {axis} does not follow the weights on its axis: {own:.3g} mV/V per N "
                f"with a standard error of {error:.2g}",
                "check whether the bridge is connected and the weights were on",
            )
        if (strongest := "xyz"[int(np.argmax(np.abs(response[k])))]) != axis:
            raise WeighingError(
                f"channel {axis} answers more to weights on {strongest} than to those on {axis}",
                "channels or weights are crossed: wire x, y, z to channels 1, 2, 3 and put every "
                "weight on the axis that is asked for",
            )
    if np.linalg.cond(response / np.abs(response).max(axis=1, keepdims=True)) > LARGEST_CONDITION:
        raise WeighingError(
            "the three channels do not distinguish three directions",
            "check whether every weight was put on the axis that was asked for",
        )
