"""Weighted least squares of a film model to a measured response, with stated errors.

Residuals are differences of gain and phase, whitened with each point's own 2 x 2 covariance: to
first order in the errors this is maximum likelihood, and the parameter covariance (J^T J)^-1 is its
Cramer-Rao bound. (Complex differences would do as well for a model that fits. For one that does
not, a large allowance for the phase would let its gain be anything.)

The measured covariances hold noise only. Where the points lie further from the fit than that, a
*model error* is added: one relative error of the gain and one of the phase, the same at all points,
each as large as it takes for its part's chi-square to equal its degrees of freedom (Mandel and
Paule 1970, the rule of interlaboratory comparisons; none where chi-square is smaller). Gain and
phase have one each, because what drifts in a clamp - preload, temperature - changes the gain alone.
All intervals contain the model error, and the fit says how large it was. It describes what the
model leaves out only as scatter; it is not a licence for a wrong model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rig.analysis.estimate import COVERAGE_95, Estimate
from rig.analysis.film.model import FilmModel
from rig.analysis.response.complex_response import DB_PER_RELATIVE, Reals
from rig.analysis.response.curve import CurveError, ResponseCurve

MISFIT_PROBABILITY = 1e-3
"""A chi-square rarer than this is not noise alone."""
BREAK_BAND_HZ = (500.0, 2000.0)
"""Where a break from 20 to 40 dB/decade is looked for, about the 1.2 kHz once claimed."""

_LARGEST_ERROR = 100.0
"""Relative; where the search for a model error ends."""
_MOST_ROUNDS = 12
_SAME_ERROR = 0.01
"""Relative change of a model error that is none."""
_NO_ERROR = 1e-7
"""A model error below this is none."""
_MOST_STEPS = 100
_NO_PROGRESS = 1e-7
"""In chi-square: parameters are then within 3e-4 of their standard errors."""
_LEAST_DAMPING = 1e-9
_STUCK = 1e12
_UNDETERMINED = 1e-12
_PROFILE_STEPS = 12


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
    weighted: ResponseCurve
    """The points, the model errors in their covariances."""
    covariance: Reals
    """Of the parameters, (m, m), with the model error in it."""
    chi_square: float
    """Weighted with the measured covariances alone."""
    degrees: int
    """2 n - m, and one less where an effect of the preload was free."""
    gain_error: float
    """Model error of the gain, a fraction; 0 where noise explains the residuals."""
    phase_error: float
    """Model error of the phase, rad; 0 where noise explains the residuals."""
    deviance: float
    """-2 ln(likelihood) less a constant of the data: chi-square plus ln det of all covariances."""

    @property
    def gain_error_dB(self) -> float:  # noqa: N802
        """The model error of the gain in dB."""
        return DB_PER_RELATIVE * self.gain_error

    @property
    def phase_error_deg(self) -> float:
        """The model error of the phase in degrees."""
        return math.degrees(self.phase_error)

    @property
    def probability(self) -> float:
        """Of a chi-square this large from noise alone."""
        from scipy.special import chdtrc

        return float(chdtrc(self.degrees, self.chi_square))

    @property
    def aic(self) -> float:
        """Akaike's criterion; a model error counts as a parameter where there is one."""
        errors = (self.gain_error > 0) + (self.phase_error > 0)
        return self.deviance + 2 * (len(self.covariance) + errors)

    @property
    def level(self) -> Estimate:
        """b in dB re 1 V/N."""
        return Estimate.normal(self.model.level_dB, self._errors[0], "dB")

    @cached_property
    def corner(self) -> Estimate:
        """Frequency of the pole in Hz.

        A pole beyond the measured range turns the phase as a delay does and bends the gain only in
        second order, so that no covariance describes it: its interval is then where chi-square,
        all else refitted, rises by less than 3.84.
        """
        inverse, highest = self.model.inverse_corner_s, self.weighted.frequencies[-1]
        if inverse * highest > 1:
            return Estimate.of_inverse(inverse, self._errors[1], "Hz")
        return self._corner_by_profile(max(inverse, 0.0), float(highest))

    @property
    def delay(self) -> Estimate:
        """Of the film's channel after the load's, us."""
        return Estimate.normal(1e6 * self.model.delay_s, 1e6 * self._errors[2], "us")

    @cached_property
    def preload_effect(self) -> Estimate | None:
        """Change of the gain with the preload about its mean, dB/N; None where that is not known.
        It was free in the fit: all other intervals hold what not knowing it costs."""
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

    def _corner_by_profile(self, inverse: float, highest: float) -> Estimate:
        best = chi_square(self.weighted, self.model)

        def tolerable(tried: float) -> bool:
            held = minimised(self.weighted, self.model, inverse_corner_s=tried)
            return chi_square(self.weighted, held) - best < COVERAGE_95**2

        def edge(inside: float, outside: float) -> float:
            """Where the interval ends; ``outside`` itself if it is tolerable too."""
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
    """Fit all parameters of ``start`` to the curve, adding model errors where needed.

    The model error is found first, then the parameters, in turn until it stays the same: so that a
    start far from the points, or a model that never comes near them, is no harder to fit. Raises
    CurveError where there are no more measured numbers than parameters.
    """
    model, errors = start, _explaining_errors(curve, start)
    for _ in range(_MOST_ROUNDS):
        model = minimised(curve.with_relative_error(*errors), model)
        before, errors = errors, _explaining_errors(curve, model)
        if np.allclose(before, errors, rtol=_SAME_ERROR, atol=_NO_ERROR):
            break
    weighted = curve.with_relative_error(*errors)
    jacobian = weighted.whitened(model.log_jacobian(curve.frequencies))
    return FilmFit(
        model=model,
        weighted=weighted,
        covariance=_inverse(jacobian @ jacobian.T),
        chi_square=chi_square(curve, model),
        degrees=2 * len(curve) - len(start.vector) - (curve.preloads_N is not None),
        gain_error=errors[0],
        phase_error=errors[1],
        deviance=chi_square(weighted, model) + _log_determinant(weighted),
    )


def minimised(
    curve: ResponseCurve, start: FilmModel, inverse_corner_s: float | None = None
) -> FilmModel:
    """The model of least chi-square near ``start``, under the curve's covariances as they are.

    Levenberg-Marquardt, each parameter scaled by its own derivative; steps end at the bounds. The
    pole stays at ``inverse_corner_s`` if given.
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
    """Normal matrix of unit diagonal, gradient and scale; parameters held by a bound stay put."""
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
    """Sum of squared whitened residuals."""
    residual = curve.whitened(curve.log_ratio(model.response(curve.frequencies)))
    return float(residual @ residual)


def _explaining_errors(curve: ResponseCurve, model: FilmModel) -> tuple[float, float]:
    """Model errors of gain (a fraction) and phase (rad), each from its own part of the residuals.

    Of the degrees of freedom either part gets half: a pole or a notch shows as much in one as in
    the other.
    """
    residual = curve.freed(curve.log_ratio(model.response(curve.frequencies)))
    degrees = len(curve) - len(model.vector) / 2
    variances = curve.relative_covariances
    return (
        _mandel_paule(residual.real, variances[:, 0, 0], degrees),
        _mandel_paule(residual.imag, variances[:, 1, 1], degrees),
    )


def _mandel_paule(residuals: Reals, variances: Reals, degrees: float) -> float:
    """The further error that brings chi-square down to ``degrees``, by bisection; 0 if none."""
    squares = np.square(residuals)
    if (squares / variances).sum() <= degrees:
        return 0.0
    low, high = 0.0, _LARGEST_ERROR
    for _ in range(60):
        middle = (low + high) / 2
        if (squares / (variances + middle**2)).sum() > degrees:
            low = middle
        else:
            high = middle
    return high if high > _NO_ERROR else 0.0


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
    """Of the normal matrix, scaled to unit diagonal first; what is undetermined becomes huge.

    Without a corner, for one, pole and delay look alike: their errors are then 1e6 times those of
    either alone, not zero as a pseudo-inverse would have it.
    """
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    sizes, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    inverse: Reals = (vectors / np.maximum(sizes, _UNDETERMINED * sizes[-1])) @ vectors.T
    inverse /= np.outer(scale, scale)
    return inverse


def _log_determinant(curve: ResponseCurve) -> float:
    return float(np.linalg.slogdet(curve.relative_covariances)[1].sum())
