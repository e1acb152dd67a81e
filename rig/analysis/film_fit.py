"""Weighted least squares of a film model to a measured response, with stated errors.

Residuals are complex differences, whitened with each point's own 2 x 2 covariance: at known normal
errors this is maximum likelihood, and the parameter covariance (J^T J)^-1 is its Cramer-Rao bound.

The measured covariances hold noise only. Where the fit misses the points by more than noise can
explain (chi-square beyond its 99.9 % quantile), a *model error* is added: one relative error, the
same for real and imaginary part at all points, as large as it takes for chi-square to equal its
degrees of freedom. All intervals then contain it, and the fit says how large it was. It describes
what the model leaves out only as scatter; it is not a licence for a wrong model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rig.analysis.estimate import Estimate
from rig.analysis.film_model import FilmModel
from rig.analysis.response import DB_PER_RELATIVE, Reals
from rig.analysis.response_curve import CurveError, ResponseCurve

MISFIT_PROBABILITY = 1e-3
"""A chi-square rarer than this is not noise alone."""
BREAK_BAND_HZ = (500.0, 2000.0)
"""Where a break from 20 to 40 dB/decade is looked for, about the 1.2 kHz once claimed."""
LARGEST_MODEL_ERROR = 10.0
"""Relative; where the search for the model error ends."""

_TOLERANCE = 1e-11


@dataclass(frozen=True, eq=False)
class DropEstimate:
    """A drop with its intervals."""

    frequency: Estimate
    """Hz; where the drop is deepest."""
    depth: Estimate
    """dB."""
    pole_Q: Estimate


@dataclass(frozen=True, eq=False)
class FilmFit:
    """A fitted model; parameters in the order of ``model.vector``."""

    model: FilmModel
    covariance: Reals
    """Of the parameters, (m, m), with the model error in it."""
    chi_square: float
    """Weighted with the measured covariances alone."""
    degrees: int
    """2 n - m."""
    model_error: float
    """Relative error added to the measured ones; 0 where noise explains the residuals."""
    deviance: float
    """-2 ln(likelihood) less a constant of the data: chi-square plus ln det of all covariances."""

    @property
    def model_error_dB(self) -> float:  # noqa: N802
        """The model error as an error of the gain."""
        return DB_PER_RELATIVE * self.model_error

    @property
    def aic(self) -> float:
        """Akaike's criterion; the model error counts as a parameter where there is one."""
        return self.deviance + 2 * (len(self.covariance) + (self.model_error > 0))

    @property
    def level(self) -> Estimate:
        """b in dB re 1 V/N."""
        return Estimate.normal(self.model.level_dB, self._errors[0], "dB")

    @property
    def corner(self) -> Estimate:
        """Frequency of the pole in Hz."""
        return Estimate.of_inverse(self.model.inverse_corner_s, self._errors[1], "Hz")

    @property
    def delay(self) -> Estimate:
        """Of the film's channel after the load's, us."""
        return Estimate.normal(1e6 * self.model.delay_s, 1e6 * self._errors[2], "us")

    @property
    def slope(self) -> Estimate:
        """The free exponent in dB/decade. Raises CurveError for a model without one."""
        if self.model.slope_dB_decade is None:
            raise CurveError("the slope of this model was not free")
        return Estimate.normal(self.model.slope_dB_decade, self._errors[3], "dB/decade")

    @property
    def drops(self) -> tuple[DropEstimate, ...]:
        """The notches, by ascending frequency."""
        found = []
        for k, notch in enumerate(self.model.notches):
            at = self.model.first_notch + 3 * k
            frequency_error, quality_error, depth_error = self._errors[at : at + 3]
            found.append(
                DropEstimate(
                    Estimate.of_logarithm(math.log(notch.frequency_Hz), frequency_error, "Hz"),
                    Estimate.normal(notch.depth_dB, depth_error, "dB"),
                    Estimate.of_logarithm(math.log(notch.pole_Q), quality_error, ""),
                )
            )
        return tuple(sorted(found, key=lambda drop: drop.frequency.value))

    @cached_property
    def _errors(self) -> list[float]:
        return [math.sqrt(max(float(v), 0.0)) for v in np.diag(self.covariance)]


def fit_film(curve: ResponseCurve, start: FilmModel) -> FilmFit:
    """Fit all parameters of ``start`` to the curve, adding a model error where needed.

    Raises CurveError where there are no more measured numbers than parameters.
    """
    from scipy.stats import chi2

    model = minimised(curve, start)
    degrees = 2 * len(curve) - len(start.vector)
    plain = chi_square(curve, model)
    error = 0.0
    if plain > chi2.isf(MISFIT_PROBABILITY, degrees):
        for _ in range(3):
            error = _explaining_error(curve, model, degrees)
            model = minimised(curve.with_relative_error(error), model)
    weighted = curve.with_relative_error(error)
    jacobian = weighted.whitened(model.jacobian(curve.frequencies))
    return FilmFit(
        model=model,
        covariance=_inverse(jacobian @ jacobian.T),
        chi_square=chi_square(curve, model),
        degrees=degrees,
        model_error=error,
        deviance=chi_square(weighted, model) + _log_determinant(weighted),
    )


def minimised(curve: ResponseCurve, start: FilmModel) -> FilmModel:
    """The model of least chi-square near ``start``, under the curve's covariances as they are."""
    from scipy.optimize import least_squares

    measured = curve.whitened(curve.responses)
    first = start.vector
    if len(first) >= 2 * len(curve):
        raise CurveError(
            f"{len(curve)} points cannot determine {len(first)} parameters", "measure more points"
        )

    def residuals(vector: Reals) -> Reals:
        model = start.moved_to(vector)
        return curve.whitened(model.response(curve.frequencies)) - measured

    def jacobian(vector: Reals) -> Reals:
        model = start.moved_to(vector)
        return curve.whitened(model.jacobian(curve.frequencies)).T

    low, high = _bounds(curve, start)
    found = least_squares(
        residuals,
        np.clip(first, low, high),
        jac=jacobian,
        bounds=(low, high),
        x_scale="jac",
        ftol=_TOLERANCE,
        xtol=_TOLERANCE,
        gtol=_TOLERANCE,
        max_nfev=300,
    )
    return start.moved_to(found.x)


def chi_square(curve: ResponseCurve, model: FilmModel) -> float:
    """Sum of squared whitened residuals."""
    residual = curve.whitened(curve.responses - model.response(curve.frequencies))
    return float(residual @ residual)


def _explaining_error(curve: ResponseCurve, model: FilmModel, degrees: int) -> float:
    """The relative error that brings chi-square down to its degrees of freedom, by bisection."""
    low, high = 0.0, LARGEST_MODEL_ERROR
    for _ in range(60):
        middle = (low + high) / 2
        if chi_square(curve.with_relative_error(middle), model) > degrees:
            low = middle
        else:
            high = middle
    return high


def _bounds(curve: ResponseCurve, model: FilmModel) -> tuple[Reals, Reals]:
    """Far limits that keep a search out of nonsense; the break alone has a stated band."""
    low, high = np.full(len(model.vector), -np.inf), np.full(len(model.vector), np.inf)
    if model.break_Hz is not None:
        at = model.first_notch - 1
        low[at], high[at] = (math.log(edge) for edge in BREAK_BAND_HZ)
    first, last = (math.log(curve.frequencies[k]) for k in (0, -1))
    for k in range(model.first_notch, len(low), 3):
        low[k : k + 3] = first - 0.2, math.log(0.5), -60.0
        high[k : k + 3] = last + 0.2, math.log(1000.0), 80.0
    return low, high


def _inverse(normal: Reals) -> Reals:
    """Of the normal matrix, scaled to unit diagonal first; what is undetermined gets no bound."""
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    inverse: Reals = np.linalg.pinv(normal / np.outer(scale, scale), hermitian=True, rcond=1e-14)
    inverse /= np.outer(scale, scale)
    return inverse


def _log_determinant(curve: ResponseCurve) -> float:
    return float(np.linalg.slogdet(curve.covariances)[1].sum())
