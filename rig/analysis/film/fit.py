"""Weighted least-squares fit of a film model to a measured response, with standard errors.

Residuals are differences of gain and phase, whitened with the 2 x 2 covariance of each point. To
first order in the errors this is maximum likelihood, and the parameter covariance (J^T J)^-1 is its
Cramer-Rao bound. (Complex differences would do as well for a model that fits. For one that does
not, a large allowance for the phase would let its gain take any value.)

The measured covariances contain noise only. If the points lie further from the fit than that, a
*model error* is added: one relative error of the gain and one of the phase, the same at all points,
each as large as needed for its part of chi-square to equal its degrees of freedom (Mandel and Paule
1970, the rule of interlaboratory comparisons; none if chi-square is smaller). Gain and phase have
separate model errors, because what drifts in a clamp - preload, temperature - changes the gain
alone. All intervals include the model error, and the fit states its size. It describes what the
model omits as scatter only; it does not justify a wrong model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rig.analysis.chi_square import probability_above
from rig.analysis.estimate import COVERAGE_95, Estimate
from rig.analysis.film.model import FilmModel
from rig.analysis.response.complex_response import DB_PER_RELATIVE, Reals
from rig.analysis.response.curve import CurveError, ResponseCurve
from rig.analysis.scatter import NO_SCATTER, explaining_error

MISFIT_PROBABILITY = 1e-3
"""A chi-square with a probability below this is not explained by noise alone."""
CLEAR_CORRELATION = 4.0
"""Correlation of successive residuals, in its standard errors, above which they are not random."""
BREAK_BAND_HZ = (500.0, 2000.0)
"""Band in which a break from 20 to 40 dB/decade is searched, around the 1.2 kHz of the earlier
claim."""

_MOST_ROUNDS = 12
_SAME_ERROR = 0.01
"""Relative change of a model error below which it has converged."""
_MOST_STEPS = 100
_NO_PROGRESS = 1e-7
"""Change of chi-square at which the fit has converged: the parameters are then within 3e-4 of their
standard errors."""
_LEAST_DAMPING = 1e-9
_STUCK = 1e12
_UNDETERMINED = 1e-12
_PROFILE_STEPS = 12


@dataclass(frozen=True, eq=False)
class DropEstimate:
    """A notch of a film's gain as it was fitted: each number with its interval."""

    frequency: Estimate
    """Frequency at which it is deepest, in Hz."""
    depth: Estimate
    """Depth, in dB."""
    pole_Q: Estimate
    """Quality factor of its poles."""


@dataclass(frozen=True, eq=False)
class FilmFit:
    """A fitted model. Parameters are in the order of ``model.vector``."""

    model: FilmModel
    """The model with the fitted parameters."""
    weighted: ResponseCurve
    """The points, with the model errors included in their covariances."""
    covariance: Reals
    """Covariance of the parameters, (m, m), including the model error."""
    chi_square: float
    """Chi-square with the measured covariances alone."""
    degrees: int
    """Degrees of freedom: 2 n - m, and one less each if an effect of the preload and of the load
    was fitted."""
    gain_error: float
    """Relative model error of the gain; 0 if noise explains the residuals."""
    phase_error: float
    """Model error of the phase in rad; 0 if noise explains the residuals."""
    deviance: float
    """-2 ln(likelihood) up to a constant of the data: chi-square plus ln det of all covariances."""

    @property
    def gain_error_dB(self) -> float:  # noqa: N802
        """Model error of the gain, in dB."""
        return DB_PER_RELATIVE * self.gain_error

    @property
    def phase_error_deg(self) -> float:
        """Model error of the phase, in degrees."""
        return math.degrees(self.phase_error)

    @property
    def probability(self) -> float:
        """Probability of a chi-square at least this large from noise alone."""
        return probability_above(self.chi_square, self.degrees)

    @cached_property
    def residuals_are_random(self) -> bool:
        """False if neighbours over frequency lie off the fit to the same side: the model omits
        something, and no error of single points describes that.

        The test is the correlation of successive residuals of gain or phase (Durbin and Watson
        1950). It speaks only where noise does not explain the residuals.
        """
        if self.probability >= MISFIT_PROBABILITY:
            return True
        curve = self.weighted
        residual = curve.whitened(curve.log_ratio(self.model.response(curve.frequencies)))
        parts = residual.reshape(2, -1)
        together = (parts[:, 1:] * parts[:, :-1]).sum(axis=1) / np.square(parts).sum(axis=1)
        return bool((together * math.sqrt(parts.shape[1]) < CLEAR_CORRELATION).all())

    @property
    def aic(self) -> float:
        """Akaike's criterion. Each model error above zero counts as a parameter."""
        errors = (self.gain_error > 0) + (self.phase_error > 0)
        return self.deviance + 2 * (len(self.covariance) + errors)

    @property
    def level(self) -> Estimate:
        """Level b in dB re 1 V/N at 1 Hz."""
        return Estimate.normal(self.model.level_dB, self._errors[0], "dB")

    @cached_property
    def corner(self) -> Estimate:
        """Frequency of the pole, in Hz.

        A pole beyond the measured range turns the phase as a delay does and bends the gain only in
        second order, so that no covariance describes it. Its interval is then where chi-square,
        with everything else fitted again, rises by less than 3.84.
        """
        inverse, highest = self.model.inverse_corner_s, self.weighted.frequencies[-1]
        if inverse * highest > 1:
            return Estimate.of_inverse(inverse, self._errors[1], "Hz")
        return self._corner_by_profile(max(inverse, 0.0), float(highest))

    @property
    def delay(self) -> Estimate:
        """Delay of the film's channel after that of the load, in us."""
        return Estimate.normal(1e6 * self.model.delay_s, 1e6 * self._errors[2], "us")

    @cached_property
    def preload_effect(self) -> Estimate | None:
        """Change of the gain with the preload about its mean, in dB/N; None if the preloads are
        unknown.

        It is free in the fit, so all other intervals include the cost of not knowing it.
        """
        curve, model = self.weighted, self.model
        if curve.preload_excess is None:
            return None
        bare = replace(curve, preloads_N=None)
        push = bare.whitened(curve.preload_excess)
        explained = np.linalg.qr(bare.whitened(model.log_jacobian(curve.frequencies)).T)[0]
        own = float(np.linalg.norm(push - explained @ (explained.T @ push)))
        found = curve.preload_effect(curve.log_ratio(model.response(curve.frequencies)))
        error = math.inf if own <= _UNDETERMINED * np.linalg.norm(push) else 1 / own
        return Estimate.normal(DB_PER_RELATIVE * found, DB_PER_RELATIVE * error, "dB/N")

    @property
    def slope(self) -> Estimate:
        """Fitted exponent, in dB/decade. Raises CurveError for a model without one."""
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

    def _corner_by_profile(self, inverse: float, highest: float) -> Estimate:
        best = chi_square(self.weighted, self.model)

        def tolerable(tried: float) -> bool:
            held = minimised(self.weighted, self.model, inverse_corner_s=tried)
            return chi_square(self.weighted, held) - best < COVERAGE_95**2

        def edge(inside: float, outside: float) -> float:
            """Return the end of the interval; ``outside`` itself if it is tolerable too."""
            if tolerable(outside):
                return outside
            for _ in range(_PROFILE_STEPS):
                middle = (inside + outside) / 2
                inside, outside = (middle, outside) if tolerable(middle) else (inside, middle)
            return inside

        largest, smallest = edge(inverse, inverse + 10 / highest), edge(inverse, 0.0)
        value, low, high = (
            1 / each if each > 0 else math.inf for each in (inverse, largest, smallest)
        )
        error = (high - low) / (2 * COVERAGE_95) if math.isfinite(high) else math.inf
        return Estimate(value, error, low, high, "Hz")

    @cached_property
    def _errors(self) -> list[float]:
        return [math.sqrt(max(float(v), 0.0)) for v in np.diag(self.covariance)]


def fit_film(curve: ResponseCurve, start: FilmModel) -> FilmFit:
    """Fit all parameters of ``start`` to the curve and add model errors where they are needed.

    The model errors are determined first, then the parameters, in turn until they no longer change.
    A start far from the points, or a model that never comes near them, is then no harder to fit.

    Raises CurveError if there are not more measured numbers than parameters.
    """
    model, errors = start, _explaining_errors(curve, start)
    for _ in range(_MOST_ROUNDS):
        model = minimised(curve.with_relative_error(*errors), model)
        before, errors = errors, _explaining_errors(curve, model)
        if np.allclose(before, errors, rtol=_SAME_ERROR, atol=NO_SCATTER):
            break
    weighted = curve.with_relative_error(*errors)
    jacobian = weighted.whitened(model.log_jacobian(curve.frequencies))
    return FilmFit(
        model=model,
        weighted=weighted,
        covariance=_inverse(jacobian @ jacobian.T),
        chi_square=chi_square(curve, model),
        degrees=2 * len(curve) - len(start.vector) - len(curve.unknown_effects),
        gain_error=errors[0],
        phase_error=errors[1],
        deviance=chi_square(weighted, model) + _log_determinant(weighted),
    )


def minimised(
    curve: ResponseCurve, start: FilmModel, inverse_corner_s: float | None = None
) -> FilmModel:
    """Return the model of least chi-square near ``start``, with the covariances of the curve as
    they are.

    Levenberg-Marquardt, with each parameter scaled by its own derivative; steps end at the bounds.
    If ``inverse_corner_s`` is given the pole stays there.

    Raises CurveError if there are not more measured numbers than parameters.
    """
    vector = start.vector
    if len(vector) >= 2 * len(curve):
        raise CurveError(
            f"{len(curve)} points cannot determine {len(vector)} parameters", "measure more points"
        )
    low, high = _bounds(curve, start)
    if inverse_corner_s is not None:
        low[1] = high[1] = inverse_corner_s
    model = start.moved_to(np.clip(vector, low, high))
    least, damping = chi_square(curve, model), 1e-3
    for _ in range(_MOST_STEPS):
        normal, gradient, scale = _linearised(curve, model, low, high)
        before = least
        while damping < _STUCK:
            step = np.linalg.solve(normal + damping * np.eye(len(scale)), gradient) / scale
            tried = start.moved_to(np.clip(model.vector + step, low, high))
            found = chi_square(curve, tried)
            if found < least:
                model, least, damping = tried, found, max(damping / 10, _LEAST_DAMPING)
                break
            damping *= 5
        if before - least < _NO_PROGRESS:
            break
    return model


def _linearised(
    curve: ResponseCurve, model: FilmModel, low: Reals, high: Reals
) -> tuple[Reals, Reals, Reals]:
    """Return the normal matrix with unit diagonal, the gradient and the scale. Parameters at a
    bound stay there."""
    derivatives = curve.whitened(model.log_jacobian(curve.frequencies))
    residual = curve.whitened(curve.log_ratio(model.response(curve.frequencies)))
    push = derivatives @ residual
    vector = model.vector
    derivatives[((vector <= low) & (push < 0)) | ((vector >= high) & (push > 0))] = 0.0
    normal = derivatives @ derivatives.T
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    return normal / np.outer(scale, scale), derivatives @ residual / scale, scale


def chi_square(curve: ResponseCurve, model: FilmModel) -> float:
    """Return the sum of squared whitened residuals of the curve from the model, a number without a
    unit."""
    residual = curve.whitened(curve.log_ratio(model.response(curve.frequencies)))
    return float(residual @ residual)


def _explaining_errors(curve: ResponseCurve, model: FilmModel) -> tuple[float, float]:
    """Return the model errors of gain (relative) and phase (rad), each from its own part of the
    residuals.

    Each part gets half of the degrees of freedom: a pole or a notch affects both alike.
    """
    residual = curve.freed(curve.log_ratio(model.response(curve.frequencies)))
    degrees = len(curve) - len(model.vector) / 2
    variances = curve.relative_covariances
    return (
        explaining_error(residual.real, variances[:, 0, 0], degrees),
        explaining_error(residual.imag, variances[:, 1, 1], degrees),
    )


def _bounds(curve: ResponseCurve, model: FilmModel) -> tuple[Reals, Reals]:
    """Return wide limits that exclude meaningless parameters; only the break has a physical
    band."""
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
    """Return the inverse of the normal matrix; what is undetermined becomes huge.

    It is scaled to a unit diagonal first. Without a corner, for example, pole and delay look alike:
    their errors are then 1e6 times those of either alone, and not zero as a pseudo-inverse would
    give.
    """
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    sizes, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    inverse: Reals = (vectors / np.maximum(sizes, _UNDETERMINED * sizes[-1])) @ vectors.T
    inverse /= np.outer(scale, scale)
    return inverse


def _log_determinant(curve: ResponseCurve) -> float:
    return float(np.linalg.slogdet(curve.relative_covariances)[1].sum())
