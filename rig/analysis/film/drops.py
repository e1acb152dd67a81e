"""Finds notches (drops) in a film's response and fits them together with its first-order trend.

A notch is linear in what it removes: N = 1 - a B with a = 1 - 10^(-depth/20) and the band-pass B =
(j x / Q) / (1 - x^2 + j x / Q). For a given frequency and Q the best ``a`` and the chi-square it
saves are therefore a projection (a matched filter), and all frequencies and Qs can be tried. The
best candidate joins the model, everything is fitted again together, and the search is repeated
until no candidate is significant. No notch is therefore averaged into the trend or into another
notch.

Protection against invented notches: for the search every point is given an error of at least 3 % in
addition to its own, so that the search judges shape, in dB, and not the last digit of a precise
point. A candidate must save six standard errors squared. After the fit a notch must be at least 1
dB deep with a Q of at least 2, its depth must be five standard errors from zero and its frequency
known to 2 %, and it must still be needed when the frequency nearest to it is left out: a single odd
point is not a notch. A notch slightly beyond the highest frequency is fitted too if its flank is
visible, because it affects the corner.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rig.analysis.film.fit import FilmFit, chi_square, fit_film, minimised
from rig.analysis.film.model import FilmModel, Notch, in_order, without
from rig.analysis.response.complex_response import Reals
from rig.analysis.response.curve import CurveError, ResponseCurve

SMALLEST_DEPTH_DB = 1.0
"""Minimum depth of a notch, in dB."""
SMALLEST_Q = 2.0
"""Minimum Q of a notch. Anything broader belongs to the trend."""
MOST_DROPS = 12
"""Maximum number of notches that are searched for."""
SEARCH_ERROR = 0.03
"""Relative error added to every point in the search: 0.26 dB."""
CLEAR_DROP = 36.0
"""Chi-square that a candidate must save: six standard errors."""
CLEAR_WITHOUT_NEAREST = 18.0
"""Chi-square that the fitted notch must save without the frequency nearest to it."""
BEYOND_RANGE = 1.2
"""End of the search, as a multiple of the highest measured frequency."""
CLEAR_DEPTH = 5.0
"""Minimum depth of a notch in its standard errors."""
KNOWN_FREQUENCY = 0.02
"""Largest relative standard error of the frequency of a notch."""
LEAST_POINTS = 8
"""Minimum number of different frequencies of a response that can be fitted."""
LEAST_SPAN = 10.0
"""Minimum ratio of highest to lowest frequency of a response that can be fitted."""

_TRIED_Q = (2.0, 3.2, 5.0, 8.0, 12.5, 20.0, 32.0)
_TRIED_CORNERS = 120


def fit_with_drops(
    curve: ResponseCurve, break_Hz: float | None = None, most_drops: int = MOST_DROPS
) -> FilmFit:
    """Fit the circuit and all notches of a measured response together.

    With ``break_Hz`` the trend is that of a film with a break, searched from this frequency on. The
    caller has to check how well the model fits.

    Raises CurveError for fewer than 8 different frequencies or less than a decade of them.
    """
    _check_span(curve)
    fit = fit_film(curve, _searched(curve, break_Hz, most_drops))
    while fit.model.notches:
        unlikely = _least_likely(curve, fit)
        if unlikely is None:
            break
        fit = fit_film(curve, without(fit.model, unlikely))
    return fit


def _check_span(curve: ResponseCurve) -> None:
    different = np.unique(curve.frequencies)
    if different.size < LEAST_POINTS:
        raise CurveError(
            f"{different.size} different frequencies show no trend: {LEAST_POINTS} are needed",
            "measure more points",
        )
    if different[-1] < LEAST_SPAN * different[0]:
        raise CurveError(
            f"frequencies from {different[0]:g} to {different[-1]:g} Hz show no trend: "
            "a decade is needed",
            "measure over a wider range",
        )


def _searched(curve: ResponseCurve, break_Hz: float | None, most_drops: int) -> FilmModel:
    """Return the circuit with every significant notch."""
    tolerant = curve.with_relative_error(SEARCH_ERROR, SEARCH_ERROR)
    model = _first_trend(tolerant, break_Hz)
    candidates = _Candidates.over(tolerant)
    for _ in range(most_drops):
        candidate = _best_candidate(tolerant, model, candidates)
        if candidate is None:
            break
        model = minimised(tolerant, replace(model, notches=(*model.notches, candidate)))
    return replace(model, notches=in_order(model.notches))


def _first_trend(curve: ResponseCurve, break_Hz: float | None) -> FilmModel:
    """Return level and corner that notches do not affect: the least sum of ln(1 + (distance /
    0.1)^2)."""
    f = curve.frequencies
    rise = 1.0 if break_Hz is None else 1 + 1j * f / break_Hz
    best, best_cost = FilmModel(0.0, 0.0), np.inf
    corners = np.geomspace(f[0], 10 * f[-1], _TRIED_CORNERS)
    for inverse in (*(1 / corners), 0.0):
        shape = curve.responses * (1 + 1j * f * inverse) / (1j * f * rise)
        polarity = 1.0 if np.median(shape.real / np.abs(shape)) >= 0 else -1.0
        level = float(np.median(np.log(np.abs(shape))))
        distance = np.abs(np.log(polarity * shape) - level)
        cost = float(np.log1p(np.square(distance / 0.1)).sum())
        if cost < best_cost:
            best_cost = cost
            best = FilmModel(
                level * 20 / np.log(10), float(inverse), polarity=polarity, break_Hz=break_Hz
            )
    return best


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Candidate notches: centres (m,) in Hz, Qs (m,), and -B of each in standard errors (m, 2
    n)."""

    centres: Reals
    qualities: Reals
    filters: Reals

    @classmethod
    def over(cls, curve: ResponseCurve) -> _Candidates:
        """Return candidates half a half-width apart for each Q, up to slightly beyond the
        curve."""
        f = curve.frequencies
        lowest, highest = float(f[0]), BEYOND_RANGE * float(f[-1])
        counts = [1 + int(np.ceil(np.log(highest / lowest) * 4 * q)) for q in _TRIED_Q]
        centres = np.concatenate([np.geomspace(lowest, highest, count) for count in counts])
        qualities = np.repeat(_TRIED_Q, counts)
        x = f / centres[:, None]
        width = 1j * x / qualities[:, None]
        return cls(centres, qualities, curve.whitened(-width / (1 - x**2 + width)))


def _best_candidate(
    curve: ResponseCurve, model: FilmModel, candidates: _Candidates
) -> Notch | None:
    """Return the notch that saves most chi-square, or None if none is significant."""
    f = curve.frequencies
    taken = curve.responses / model.response(f) - 1
    basis = np.linalg.qr(curve.whitened(model.log_jacobian(f)).T)[0]
    residual = curve.whitened(taken)
    residual -= basis @ (basis.T @ residual)
    filters = candidates.filters
    whole = np.square(filters).sum(axis=1)
    # The floor avoids a division by zero for candidates that the model already explains completely.
    power = np.maximum(whole - np.square(filters @ basis).sum(axis=1), 1e-9 * whole + 1e-300)
    amount = (filters @ residual) / power
    saved = np.where(amount > 0, amount**2 * power, 0.0)
    best = int(np.argmax(saved))
    if saved[best] < CLEAR_DROP:
        return None
    # At most 20 dB deep to begin with: noise may give an amount of 1 or more, which has no depth in
    # dB.
    remaining = 1 - min(float(amount[best]), 0.9)
    return Notch(
        float(candidates.centres[best]),
        float(candidates.qualities[best]),
        -20 * float(np.log10(remaining)),
    )


def _least_likely(curve: ResponseCurve, fit: FilmFit) -> int | None:
    """Return the index of the shallowest notch that is not a real one, or None."""
    doubtful = [
        k
        for k in range(len(fit.model.notches))
        if not (_is_distinct(curve, fit, k) and _stands_without_nearest(curve, fit, k))
    ]
    return min(doubtful, key=lambda k: fit.model.notches[k].depth_dB) if doubtful else None


def _is_distinct(curve: ResponseCurve, fit: FilmFit, index: int) -> bool:
    """Return whether a notch is deep, narrow and well enough known."""
    notch, at = fit.model.notches[index], fit.model.first_notch + 3 * index
    variances = np.maximum(np.diag(fit.covariance)[at : at + 3], 0.0)
    frequency_error, _, depth_error = np.sqrt(variances)
    return bool(
        notch.depth_dB >= max(SMALLEST_DEPTH_DB, CLEAR_DEPTH * depth_error)
        and notch.pole_Q >= SMALLEST_Q
        and curve.frequencies[0] <= notch.frequency_Hz <= BEYOND_RANGE * curve.frequencies[-1]
        and frequency_error <= KNOWN_FREQUENCY
    )


def _stands_without_nearest(curve: ResponseCurve, fit: FilmFit, index: int) -> bool:
    """Return whether more than the one frequency nearest to a notch requires it."""
    f = curve.frequencies
    nearest = f[np.argmin(np.abs(np.log(f / fit.model.notches[index].frequency_Hz)))]
    rest = curve.with_relative_error(fit.gain_error, fit.phase_error).at(f != nearest)
    if len(rest) * 2 <= len(fit.model.vector):
        return False
    with_it = chi_square(rest, minimised(rest, fit.model))
    without_it = chi_square(rest, minimised(rest, without(fit.model, index)))
    return without_it - with_it >= CLEAR_WITHOUT_NEAREST
