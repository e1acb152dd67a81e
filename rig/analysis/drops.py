"""Drops in a film's response: found against a first-order trend, and where to measure them again.

A notch is linear in what it takes away: N = 1 - a B with a = 1 - 10^(-depth/20) and the band-pass
B = (j x / Q) / (1 - x^2 + j x / Q). For a given frequency and Q the best ``a`` and the chi-square
it saves are therefore a projection (a matched filter), and all frequencies and Qs can be tried. The
best candidate joins the model, everything is fitted again together, and the search goes on until
nothing more stands out. So no drop is ever averaged into the trend, nor into another drop.

Against invented drops: every point is given an error of at least 3 % beside its own, so that the
search judges shape, in dB, and not the last digit of a precise point; a candidate must save six
standard errors squared and end as a notch of at least 1 dB with a Q of at least 2, its depth five
standard errors from zero, its frequency known to 2 %, and still needed when the one frequency that
is nearest to it is left out: a single odd point is not a drop. A drop somewhat beyond the highest
frequency is fitted too where its flank shows, for the corner's sake.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rig.analysis.film_fit import FilmFit, chi_square, fit_film, minimised
from rig.analysis.film_model import FilmModel, Notch, in_order, without
from rig.analysis.response import Complexes, Reals
from rig.analysis.response_curve import CurveError, ResponseCurve

SMALLEST_DEPTH_DB = 1.0
"""Anything shallower is not called a drop."""
SMALLEST_Q = 2.0
"""Anything broader is trend."""
MOST_DROPS = 12
SEARCH_ERROR = 0.03
"""Relative error every point has in the search, at least: 0.26 dB."""
CLEAR_DROP = 36.0
"""Chi-square a candidate must save: six standard errors."""
CLEAR_WITHOUT_NEAREST = 18.0
"""What the fitted notch must save without the frequency nearest to it."""
BEYOND_RANGE = 1.2
"""Over the highest frequency: as far as drops are looked for."""
CLEAR_DEPTH = 5.0
"""Standard errors of the fitted depth."""
KNOWN_FREQUENCY = 0.02
"""Relative standard error of a drop's frequency, at most."""
POINTS_PER_HALF_WIDTH = 6
LARGEST_MODEL_ERROR = 0.5
"""Relative; a model that is off by half has not been fitted."""
LEAST_POINTS = 8
LEAST_SPAN = 10.0
"""Highest over lowest frequency of a response that has a trend."""

_TRIED_Q = (2.0, 3.2, 5.0, 8.0, 12.5, 20.0, 32.0)
_TRIED_CORNERS = 120


def fit_with_drops(curve: ResponseCurve, break_Hz: float | None = None) -> FilmFit:
    """Circuit and all drops of a measured response, fitted together.

    With ``break_Hz`` the trend is that of a film with a break, which is looked for from there on.
    Raises CurveError for fewer than 8 different frequencies, less than a decade of them, or points
    that no such model comes near.
    """
    _check_span(curve)
    fit = fit_film(curve, _searched(curve, break_Hz))
    while fit.model.notches:
        unlikely = _least_likely(curve, fit)
        if unlikely is None:
            break
        fit = fit_film(curve, without(fit.model, unlikely))
    if fit.model_error > LARGEST_MODEL_ERROR:
        raise CurveError(
            "no first-order circuit with drops comes near these points: they scatter about the "
            f"best one by {fit.model_error:.0%}",
            "look at the measured gain and phase before anything else",
        )
    return fit


def refinement(curve: ResponseCurve, per_half_width: int = POINTS_PER_HALF_WIDTH) -> Reals:
    """Frequencies in Hz to measure after a scan: so many within each half-width of each drop.

    For every drop the scan shows: its centre and ``per_half_width`` frequencies on either side, out
    to where half of its poles' power is left (about f / (2 Q)). Evenly spaced in the detuning
    Q (x - 1/x); within the scanned range; less those within a quarter of a step of one scanned or
    already chosen. Ascending, rounded to five figures, so that it is the same on every machine.
    """
    if per_half_width < 1:
        raise CurveError(f"{per_half_width} points in a half-width: at least one is needed")
    chosen: list[float] = []
    taken = list(np.log(curve.frequencies))
    for notch in fit_with_drops(curve).model.notches:
        detuning = np.arange(-per_half_width, per_half_width + 1) / per_half_width
        steps = np.arcsinh(detuning / (2 * notch.pole_Q))
        near = 0.25 * float(steps[-1] - steps[-2])
        for step in steps:
            frequency = float(f"{notch.frequency_Hz * np.exp(step):.5g}")
            inside = curve.frequencies[0] <= frequency <= curve.frequencies[-1]
            if inside and np.abs(np.log(frequency) - taken).min() > near:
                chosen.append(frequency)
                taken.append(float(np.log(frequency)))
    return np.array(sorted(chosen))


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


def _searched(curve: ResponseCurve, break_Hz: float | None) -> FilmModel:
    """The circuit with every drop that stands out."""
    tolerant = curve.with_relative_error(SEARCH_ERROR)
    model = _first_trend(tolerant, break_Hz)
    for _ in range(MOST_DROPS):
        candidate = _best_candidate(tolerant, model)
        if candidate is None:
            break
        model = minimised(tolerant, replace(model, notches=(*model.notches, candidate)))
    return replace(model, notches=in_order(model.notches))


def _first_trend(curve: ResponseCurve, break_Hz: float | None) -> FilmModel:
    """Level and corner that drops do not pull: least sum of ln(1 + (distance / 0.1)^2)."""
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


def _best_candidate(curve: ResponseCurve, model: FilmModel) -> Notch | None:
    """The notch that saves most chi-square, if it is a clear one."""
    f = curve.frequencies
    centres, qualities = _candidates(float(f[0]), BEYOND_RANGE * float(f[-1]))
    expected = model.response(f)
    filters = curve.whitened(-expected * _band_pass(f, centres, qualities))
    residual = curve.whitened(curve.responses - expected)
    basis = np.linalg.qr(curve.whitened(model.jacobian(f)).T)[0]
    filters -= (filters @ basis) @ basis.T
    residual -= basis @ (basis.T @ residual)
    power = np.square(filters).sum(axis=1)
    amount = (filters @ residual) / np.maximum(power, 1e-300)
    saved = np.where(amount > 0, amount**2 * power, 0.0)
    best = int(np.argmax(saved))
    if saved[best] < CLEAR_DROP:
        return None
    remaining = 1 - min(float(amount[best]), 0.9)
    return Notch(float(centres[best]), float(qualities[best]), -20 * float(np.log10(remaining)))


def _candidates(lowest: float, highest: float) -> tuple[Reals, Reals]:
    """Centres (Hz) half a half-width apart, for each Q."""
    centres, qualities = [], []
    for quality in _TRIED_Q:
        count = 1 + int(np.ceil(np.log(highest / lowest) * 4 * quality))
        centres.append(np.geomspace(lowest, highest, count))
        qualities.append(np.full(count, quality))
    return np.concatenate(centres), np.concatenate(qualities)


def _band_pass(f: Reals, centres: Reals, qualities: Reals) -> Complexes:
    """B for each candidate (m,) at each frequency (n,): (m, n)."""
    x = f / centres[:, None]
    width = 1j * x / qualities[:, None]
    passed: Complexes = width / (1 - x**2 + width)
    return passed


def _least_likely(curve: ResponseCurve, fit: FilmFit) -> int | None:
    """Index of the shallowest notch that is no drop, if there is one."""
    doubtful = [
        k
        for k in range(len(fit.model.notches))
        if not (_is_distinct(curve, fit, k) and _stands_without_nearest(curve, fit, k))
    ]
    return min(doubtful, key=lambda k: fit.model.notches[k].depth_dB) if doubtful else None


def _is_distinct(curve: ResponseCurve, fit: FilmFit, index: int) -> bool:
    """Whether a notch is deep, narrow and well enough known to be called a drop."""
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
    """Whether the notch is needed by more than the one frequency nearest to it."""
    f = curve.frequencies
    nearest = f[np.argmin(np.abs(np.log(f / fit.model.notches[index].frequency_Hz)))]
    rest = curve.with_relative_error(fit.model_error).at(f != nearest)
    if len(rest) * 2 <= len(fit.model.vector):
        return False
    with_it = chi_square(rest, minimised(rest, fit.model))
    without_it = chi_square(rest, minimised(rest, without(fit.model, index)))
    return without_it - with_it >= CLEAR_WITHOUT_NEAREST
