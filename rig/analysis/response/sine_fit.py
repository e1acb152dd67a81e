"""Least-squares sine fit at a known frequency, with mains lines and harmonics fitted at the same
time.

This is the three-parameter fit of IEEE Std 1057 (sine, cosine, offset), extended by known
interfering frequencies and the tone's own harmonics as further regressors. Convention: a tone is
x(t) = Re(phasor exp(2 pi j f t)), with t = 0 at the first sample of the record, in seconds; phasors
have the unit of the samples. Sums of sines over an even grid have closed forms, so the normal
equations cost nothing: the samples are read once for the projection and once for the residual.

Which lines are fitted: an interfering line is included if the variance of the tone then grows by at
most a tenth over that of the fit with tone and offset alone (for one line: about 0.8 of a beat, |f1
- f2| * n / rate). Otherwise it is left out. If the record does not even contain one full beat
between it and the tone, the line is listed in ``unresolved_Hz``: its share of the phasor cannot be
known. Beyond one beat, a line that is left out leaks at most 0.22 of its amplitude, less in
proportion to the beats.

The mains is never exactly at its nominal frequency, and within a few beats of the tone that
matters: at 51 Hz, 1 s of mains off by 0.02 Hz leaks 2 % of the line into the tone. The frequency of
the nearest line is then found in the record itself, together with everything else, if the record
determines it better than the mains wanders.

Harmonics are measured if the record contains a full beat between them and every other line.
Saturation is not judged here, because only the caller knows the range of the converter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.errors import ExitCode, RigError

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

HARMONICS = (2, 3, 4, 5)
"""Orders whose amplitudes make up the harmonic distortion."""

FULL_BEAT = 1.0
"""Beats that a record must contain between two lines to distinguish them."""

LARGEST_INFLATION = 1.1
"""Largest factor by which further lines may inflate the variance of the tone."""

FEW_BEATS = 3.0
"""Distance from the tone in beats within which the true frequency of a line matters."""

MAINS_WANDER_HZ = 0.02
"""Usual deviation of the public mains from its nominal frequency."""

SMALLEST_RECORD = 16
"""Minimum number of samples of a record."""
N_BLOCKS = 8
"""Maximum number of parts of a record in which the tone is estimated separately."""

LONE, LONE_SHARE = 2, 0.25
"""Samples on either side of one that stands alone, and the share of its residual that they stay
below. Ringing has 5 samples or more in a period, so neighbours share it."""

_ROUNDING = 1e-6
_WORST_INFLATION = 1e6
_BLOCK = 256
_STACK = 16


class RecordError(RigError):
    """Raised when a tone cannot be estimated from a record."""

    code = ExitCode.INSTRUMENT


@dataclass(frozen=True, eq=False)
class SineFit:
    """A tone in a record with its errors. Amplitudes are peak values in the unit of the samples."""

    frequency_Hz: float
    """Frequency of the tone."""
    rate_Hz: float
    """Sampling rate of the record."""
    n: int
    """Number of samples."""
    phasor: complex
    """Complex amplitude of the tone at t = 0."""
    covariance: Reals
    """Covariance of the (real, imaginary) part of the phasor, (2, 2), assuming a white residual."""
    leakage: Reals
    """Covariance of what interfering lines that were not fitted leave in the phasor, (2, 2), for
    the largest amplitudes that they may have and an unknown phase."""
    offset: float
    """Constant part of the record."""
    residual_rms: float
    """Rms of the residual after all fitted lines, with n minus the fitted parameters as divisor."""
    harmonics: Complexes
    """Phasors of the orders in ``HARMONICS``; NaN where not measured."""
    block_phasors: Complexes
    """Phasors of the tone in up to eight successive parts of whole cycles, with the same phase
    reference."""
    fitted_Hz: tuple[float, ...]
    """Interfering lines that were fitted, each at the frequency at which it was found."""
    line_amplitudes: tuple[float, ...]
    """Peak amplitudes of these lines."""
    line_errors: tuple[float, ...]
    """Standard errors of these amplitudes."""
    left_out_Hz: tuple[float, ...]
    """Interfering lines for which the record is too short."""
    lone_residual: float = 0.0
    """Largest absolute residual of one sample, in the unit of the samples, if it stands alone as a
    misread sample does; 0 if its neighbours share it, as those of a transient do."""
    lone_at: int = -1
    """Number of that sample in the record; -1 for none. One of the first `LONE` has neighbours on
    one side only: where the record begins with a change, a quick transient looks the same."""

    @property
    def unresolved_Hz(self) -> tuple[float, ...]:  # noqa: N802
        """Lines within a beat of the tone that were left out: their amplitude is part of the
        phasor."""
        duration = _duration(self.n, self.rate_Hz)
        near = (line for line in self.left_out_Hz if abs(line - self.frequency_Hz) * duration < 1)
        return tuple(near)

    @property
    def amplitude(self) -> float:
        """Peak amplitude of the tone, in the unit of the samples."""
        return abs(self.phasor)

    @property
    def standard_error(self) -> float:
        """Standard error of the amplitude in the unit of the samples, first order: the error of the
        phasor along its own direction."""
        if not self.phasor:
            return math.sqrt(float(np.trace(self.covariance)) / 2)
        direction = np.array([self.phasor.real, self.phasor.imag]) / abs(self.phasor)
        return math.sqrt(float(direction @ self.covariance @ direction))

    @property
    def signal_to_noise_dB(self) -> float:  # noqa: N802
        """Power of the tone over power of the residual in the whole band up to half the rate, in
        dB."""
        if not self.residual_rms:
            return math.inf
        ratio = self.amplitude / (math.sqrt(2) * self.residual_rms)
        return 20 * math.log10(ratio) if ratio else -math.inf

    @property
    def harmonic_distortion(self) -> float:
        """Root sum of squares of the measured harmonics over the tone; NaN if none was measured, or
        without a tone. Noise adds to it."""
        measured = self.harmonics[np.isfinite(self.harmonics)]
        if not measured.size or not self.amplitude:
            return math.nan
        return float(np.linalg.norm(measured)) / self.amplitude


def fit_sine(
    samples: ArrayLike,
    rate: float,
    frequency: float,
    *,
    interference: Sequence[float] = (),
    bounds: Mapping[float, float] = MappingProxyType({}),
    delay_s: float = 0.0,
    largest_inflation: float = LARGEST_INFLATION,
) -> SineFit:
    """Fit the tone at ``frequency`` (Hz) in evenly spaced ``samples`` (n,) taken at ``rate``
    (1/s).

    ``interference`` lists lines to fit as well, if the record separates them (see
    :func:`mains_lines`). ``bounds`` gives the largest amplitude by line, in the unit of the
    samples; what such a line can leak into the tone, if it is not fitted, is stated as ``leakage``:
    a weak line that is not worth fitting is an error all the same. ``delay_s`` is how much later
    than t = 0 this channel took its first sample (multiplexer skew); the phasor refers to t = 0.
    ``largest_inflation`` limits the cost in variance of fitting further lines: a strong signal can
    afford a line close to it.

    Raises RecordError for samples that are not finite, fewer than 16 samples or one cycle, or a
    frequency that the rate cannot represent.

    >>> t = np.arange(1000) / 1000.0
    >>> fit = fit_sine(2.0 * np.cos(2 * np.pi * 20.0 * t), rate=1000.0, frequency=20.0)
    >>> round(fit.amplitude, 9)
    2.0
    """
    y = np.asarray(samples, dtype=float)
    _check(y, rate, frequency)
    disturbing = tuple(float(line) for line in interference)
    fitted, orders = _lines_to_fit(
        disturbing, float(frequency), float(rate), y.size, float(largest_inflation)
    )
    left_out = [line for line in disturbing if line not in fitted]
    frequencies = [frequency, *fitted, *(k * frequency for k in orders)]
    if y.size < 2 * len(frequencies) + 2:
        raise RecordError(
            f"{y.size} samples cannot carry {2 * len(frequencies) + 1} unknowns",
            "use a longer record",
        )
    solved = _solve(y, rate, frequencies)
    degrees = y.size - solved.solution.size
    covariance = solved.inverse
    if near := _nearest_line(frequencies[: 1 + len(fitted)], rate, y.size):
        solved, added = _follow(y, rate, solved, near)
        covariance = solved.inverse + added
        degrees -= int(added.any())
    lines, solution, residual = solved.lines, solved.solution, solved.residual
    phasors = solution[1::2] + 1j * solution[2::2]
    residual_rms = math.sqrt(float(np.square(residual).sum()) / degrees)
    lone_residual, lone_at = _lone(np.abs(residual))
    variances = np.diag(covariance)[3 : 3 + 2 * len(fitted)].reshape(-1, 2).mean(axis=1)
    turns = np.exp(-2j * np.pi * delay_s * lines.frequencies)
    unfitted = {line: size for line, size in bounds.items() if line not in fitted}
    harmonics = np.full(len(HARMONICS), complex(np.nan, np.nan))
    harmonics[[HARMONICS.index(k) for k in orders]] = (phasors * turns)[1 + len(fitted) :]
    return SineFit(
        frequency_Hz=float(frequency),
        rate_Hz=float(rate),
        n=y.size,
        phasor=complex(phasors[0] * turns[0]),
        covariance=scaled_covariance(residual_rms**2 * covariance[1:3, 1:3], complex(turns[0])),
        leakage=scaled_covariance(_leakage(lines, rate, unfitted), complex(turns[0])),
        offset=float(solution[0]),
        residual_rms=residual_rms,
        harmonics=harmonics,
        block_phasors=(phasors[0] + lines.block_changes(residual)) * turns[0],
        fitted_Hz=tuple(float(line) for line in lines.frequencies[1 : 1 + len(fitted)]),
        line_amplitudes=tuple(np.abs(phasors[1 : 1 + len(fitted)]).tolist()),
        line_errors=tuple((residual_rms * np.sqrt(variances)).tolist()),
        left_out_Hz=tuple(left_out),
        lone_residual=lone_residual,
        lone_at=lone_at,
    )


def _lone(sizes: Reals) -> tuple[float, int]:
    """Return the largest of the residuals' sizes (n,) and its number if its neighbours are much
    smaller, 0 and -1 if not; at the ends of a record those on one side."""
    at = int(sizes.argmax())
    around = np.concatenate((sizes[max(0, at - LONE) : at], sizes[at + 1 : at + 1 + LONE]))
    return (float(sizes[at]), at) if around.max() < LONE_SHARE * sizes[at] else (0.0, -1)


def mains_lines(fundamental: float = 50.0, count: int = 5) -> tuple[float, ...]:
    """Return the mains frequency and its next harmonics in Hz.

    >>> mains_lines(50.0, 3)
    (50.0, 100.0, 150.0)
    """
    return tuple(fundamental * order for order in range(1, count + 1))


def whole_cycles(frequency: float, rate: float, minimum_duration: float) -> int:
    """Return the samples of a record of whole cycles, at least ``minimum_duration`` (s) and one
    cycle long.

    Among records that are up to a few per cent longer, the one is chosen whose end is nearest to a
    sample; it is never more than half a sample off. A record has at least the 16 samples that a fit
    needs.

    Raises RecordError for a frequency that is not between 0 and half the rate.

    >>> whole_cycles(frequency=3.0, rate=1000.0, minimum_duration=0.5)
    667
    """
    if not 0 < frequency < rate / 2:
        raise RecordError(f"{frequency} Hz is not between 0 and half the rate of {rate} 1/s")
    shortest = max(minimum_duration, SMALLEST_RECORD / rate)
    first = max(1, math.ceil(shortest * frequency - _ROUNDING))
    cycles = first + np.arange(1 + min(50, first // 20))
    ends = cycles * (rate / frequency)
    misfits = np.abs(ends - np.round(ends))
    return round(float(ends[np.flatnonzero(misfits <= misfits.min() + _ROUNDING)[0]]))


def record_length(
    frequency: float,
    rate: float,
    minimum_duration: float,
    *,
    interference: Sequence[float] = (),
    maximum_duration: float,
) -> int:
    """Return the samples of a record of whole cycles that also separates ``interference`` from the
    tone.

    The record is extended to one full beat with every line for which this stays within
    ``maximum_duration`` (s). Nearer lines remain, and the fit lists them in ``unresolved_Hz``.
    """
    beats = [FULL_BEAT / abs(frequency - line) for line in interference if line != frequency]
    needed = [beat for beat in beats if beat <= maximum_duration]
    return whole_cycles(frequency, rate, max([minimum_duration, *needed]))


def inflation(frequency: float, rate: float, n: int, interference: Sequence[float]) -> float:
    """Return the variance of a tone's phasor where the lines of `interference` below half the rate
    are fitted as well, as a multiple of that without them. All frequencies are in Hz, `n` is the
    number of samples at the `rate`."""
    lines = [line for line in interference if 0 < line < rate / 2]
    normal = _normal_equations([frequency, *lines], rate, n)
    return _tone_variance(normal, range(1 + len(lines))) / _tone_variance(normal, [0])


class _Lines:
    """Spectral lines on the grid k / rate, k = 0..n-1, as tables of blocks in place of n sines
    each."""

    def __init__(self, frequencies: Sequence[float] | Reals, rate: float, n: int):
        self.frequencies = np.asarray(frequencies, dtype=float)
        self.n = n
        self._turns = self.frequencies / rate
        self._stacks = -(-n // (_BLOCK * _STACK))
        starts = self._turns * (_BLOCK * np.arange(self._stacks * _STACK))[:, None]
        self._starts = np.exp(2j * np.pi * (starts - np.floor(starts)))
        self._table = np.exp(2j * np.pi * self._turns[:, None] * np.arange(_BLOCK))

    def moments(self, y: Reals) -> Reals:
        """Return the inner products of the columns of the fit with ``y``."""
        padded = np.zeros(self._stacks * _STACK * _BLOCK)
        padded[: self.n] = y
        table = np.concatenate([self._table.real, self._table.imag]).T
        parts = padded.reshape(self._stacks, _STACK, _BLOCK) @ table
        parts = parts.reshape(-1, 2, len(self._turns))
        sums = ((parts[:, 0] + 1j * parts[:, 1]) * self._starts).sum(axis=0)
        return np.concatenate([[y.sum()], np.stack([sums.real, -sums.imag], axis=1).ravel()])

    def synthesise(self, phasors: Complexes) -> Reals:
        """Return the sum of Re(phasor exp(j w k)), (n,)."""
        left = self._starts * phasors
        rows = np.concatenate([left.real, left.imag], axis=1)
        table = np.concatenate([self._table.real, -self._table.imag])
        stacked = rows.reshape(self._stacks, _STACK, -1) @ table
        wave: Reals = stacked.reshape(-1)[: self.n]
        return wave

    def block_changes(self, residual: Reals) -> Complexes:
        """Return the changes of the first line's phasor in each part of whole cycles, (m,), m <=
        8, maybe 0."""
        cycles = math.floor(self._turns[0] * (self.n + 0.5))
        m = min(N_BLOCKS, cycles)
        edges = np.round(cycles * np.arange(m + 1) / m / self._turns[0]).astype(int)
        edges[-1] = min(edges[-1], self.n)
        wave = (self._starts[:, :1].conj() * self._table[0].conj()).reshape(-1)[: edges[-1]]
        parts = np.add.reduceat(residual[: edges[-1]] * wave, edges[:-1])
        changes: Complexes = 2 * parts / np.diff(edges)
        return changes


def _normal_equations(frequencies: Sequence[float] | Reals, rate: float, n: int) -> Reals:
    """Return the inner products of the columns 1, cos w_1 k, -sin w_1 k, cos w_2 k, ... in closed
    form."""
    turns = np.concatenate([[0.0], np.asarray(frequencies, dtype=float) / rate])
    total = _geometric(turns[:, None] + turns, n)
    beat = _geometric(turns[:, None] - turns, n)
    full = np.empty((2 * turns.size, 2 * turns.size))
    full[0::2, 0::2] = (total + beat).real / 2
    full[1::2, 1::2] = (beat - total).real / 2
    full[0::2, 1::2] = -(total - beat).imag / 2
    full[1::2, 0::2] = full[0::2, 1::2].T
    keep = [0, *range(2, 2 * turns.size)]
    return full.take(keep, 0).take(keep, 1)


def _geometric(turns: Reals, n: int) -> Complexes:
    """Return the sum over k < n of exp(2 pi j turns k)."""
    turns = turns - np.round(turns)
    flat = np.abs(turns) < 1e-15
    # Avoids 0 / 0 where turns is 0; these entries are n.
    safe = np.where(flat, 0.5, turns)
    size = np.where(flat, n, np.sin(np.pi * safe * n) / np.sin(np.pi * safe))
    value: Complexes = size * np.exp(1j * np.pi * turns * (n - 1))
    return value


@dataclass(frozen=True, eq=False)
class _Solved:
    """A linear fit: lines, inverse of the normal matrix, solution (offset, re, im, ...) and
    residual."""

    lines: _Lines
    inverse: Reals
    solution: Reals
    residual: Reals

    def coefficients(self, y: Reals) -> Reals:
        """Return the coefficients that the same fit finds in ``y``."""
        return np.asarray(self.inverse @ self.lines.moments(y), dtype=np.float64)

    def rest(self, y: Reals, coefficients: Reals) -> Reals:
        """Return the residual of ``y``."""
        phasors = coefficients[1::2] + 1j * coefficients[2::2]
        left: Reals = y - coefficients[0] - self.lines.synthesise(phasors)
        return left


@lru_cache(maxsize=32)
def _lines_on(frequencies: tuple[float, ...], rate: float, n: int) -> tuple[_Lines, Reals]:
    """Return the lines and the inverse of their normal matrix, which the channels of a record
    share."""
    inverse = np.linalg.inv(_normal_equations(frequencies, rate, n))
    return _Lines(frequencies, rate, n), np.asarray(inverse, dtype=np.float64)


def _solve(y: Reals, rate: float, frequencies: Sequence[float] | Reals) -> _Solved:
    lines, inverse = _lines_on(tuple(map(float, frequencies)), float(rate), y.size)
    bare = _Solved(lines, inverse, np.empty(0), y)
    solution = bare.coefficients(y)
    return _Solved(lines, inverse, solution, bare.rest(y, solution))


def _leakage(lines: _Lines, rate: float, unfitted: Mapping[float, float]) -> Reals:
    """Return the covariance that lines which are not in the fit cause in its first phasor, (2, 2),
    each with the given amplitude and any phase."""
    audible = {line: size for line, size in unfitted.items() if 0 < line < rate / 2 and size > 0}
    if not audible:
        return np.zeros((2, 2))
    fitted = lines.frequencies
    normal = _normal_equations([*fitted, *audible], rate, lines.n)
    m = 1 + 2 * fitted.size
    found = np.linalg.solve(normal[:m, :m], normal[:m, m:])[1:3]
    leakage: Reals = (found * np.repeat([size**2 / 2 for size in audible.values()], 2)) @ found.T
    return leakage


def _nearest_line(frequencies: Sequence[float], rate: float, n: int) -> int:
    """Return the index of the line within a few beats of the first one, or 0."""
    beats = [abs(line - frequencies[0]) * _duration(n, rate) for line in frequencies]
    near = min(range(1, len(beats)), key=beats.__getitem__, default=0)
    return near if beats[near] < FEW_BEATS else 0


def _follow(y: Reals, rate: float, nominal: _Solved, line: int) -> tuple[_Solved, Reals]:
    """Return the fit with one line at its own frequency, and what not knowing it adds to the
    inverse.

    This is Gauss-Newton: the residual is regressed on the derivative of the line with respect to
    its frequency, without the part that the other columns can explain. The nominal fit is returned
    if the record determines the frequency less well than the mains wanders, or finds a frequency
    that is not the mains.
    """
    solved = nominal
    t = (np.arange(y.size) - (y.size - 1) / 2) / rate
    for _ in range(3):
        phasors = np.zeros(solved.lines.frequencies.size, complex)
        phasors[line] = 2j * np.pi * complex(*solved.solution[2 * line + 1 : 2 * line + 3])
        derivative = t * solved.lines.synthesise(phasors)
        explained = solved.coefficients(derivative)
        cleared = solved.rest(derivative, explained)
        information = float(cleared @ cleared)
        noise = float(np.square(solved.residual).sum()) / y.size
        if noise >= MAINS_WANDER_HZ**2 * information:
            return nominal, np.zeros_like(nominal.inverse)
        frequencies = solved.lines.frequencies.copy()
        frequencies[line] += float(cleared @ solved.residual) / information
        if abs(frequencies[line] - nominal.lines.frequencies[line]) > 10 * MAINS_WANDER_HZ:
            return nominal, np.zeros_like(nominal.inverse)
        solved = _solve(y, rate, frequencies)
    return solved, np.outer(explained, explained) / information


def _check(y: Reals, rate: float, frequency: float) -> None:
    if y.ndim != 1:
        raise RecordError(f"a record is one row of samples, not an array of shape {y.shape}")
    if not (math.isfinite(rate) and math.isfinite(frequency) and rate > 0 and frequency > 0):
        raise RecordError(f"rate {rate} 1/s and frequency {frequency} Hz must be positive")
    if frequency >= rate / 2:
        raise RecordError(
            f"{frequency:g} Hz is not below half the rate of {rate:g} 1/s", "sample faster"
        )
    if y.size < SMALLEST_RECORD:
        raise RecordError(
            f"{y.size} samples are too short a record: {SMALLEST_RECORD} at least",
            "use a longer record",
        )
    cycles = frequency * _duration(y.size, rate)
    if cycles < FULL_BEAT:
        raise RecordError(
            f"{y.size} samples at {rate:g} 1/s are too short a record of {frequency:g} Hz: "
            f"{cycles:.2f} cycles, one needed",
            "use a longer record",
        )
    if (rate - 2 * frequency) * _duration(y.size, rate) < FULL_BEAT:
        raise RecordError(
            f"{y.size} samples cannot separate {frequency:g} Hz from its image at {rate:g} 1/s",
            "sample faster or longer",
        )
    if not np.isfinite(y).all():
        raise RecordError(f"{int((~np.isfinite(y)).sum())} of {y.size} samples are not finite")


def _duration(n: int, rate: float) -> float:
    """Return the length of a record in s, plus half a sample, because ends are rounded to
    samples."""
    return (n + 0.5) / rate


def _beats(frequencies: Sequence[float], rate: float, n: int) -> Reals:
    """Return the beats in the record between each two lines or their images; for a line itself,
    with its images."""
    f = np.array(frequencies)
    total, apart = f[:, None] + f, np.abs(f[:, None] - f)
    apart[apart == 0] = np.inf
    beats: Reals = np.minimum(np.minimum(total, rate - total), apart) * _duration(n, rate)
    return beats


@lru_cache(maxsize=256)
def _lines_to_fit(
    interference: tuple[float, ...],
    frequency: float,
    rate: float,
    n: int,
    largest_inflation: float,
) -> tuple[list[float], list[int]]:
    """Return the interfering lines and the harmonic orders that can be fitted together with the
    tone."""
    candidates = [line for line in interference if 0 < line < rate / 2]
    orders = [order for order in HARMONICS if order * frequency < rate / 2]
    frequencies = [frequency, *candidates, *(order * frequency for order in orders)]
    normal = _normal_equations(frequencies, rate, n)
    chosen = [0]
    present = bare = _tone_variance(normal, chosen)
    limit = largest_inflation * bare
    everything = list(range(len(frequencies)))
    beats = _beats(frequencies, rate, n)
    apart = beats[np.triu_indices(len(frequencies), 1)].min(initial=FULL_BEAT) >= FULL_BEAT
    # The common case: all lines can be fitted at once.
    if apart and _tone_variance(normal, everything) <= limit:
        return candidates, orders
    for index in range(1, len(frequencies)):
        if index > len(candidates):  # a harmonic
            if beats[index, [*chosen, index]].min() < FULL_BEAT:
                continue
            limit = max(LARGEST_INFLATION * bare, present * 1.01)
        with_it = _tone_variance(normal, [*chosen, index])
        if with_it <= limit:
            chosen.append(index)
            present = with_it
    fitted = [candidates[k - 1] for k in chosen if 0 < k <= len(candidates)]
    measured = [orders[k - 1 - len(candidates)] for k in chosen if k > len(candidates)]
    return fitted, measured


def _tone_variance(normal: Reals, chosen: Sequence[int]) -> float:
    """Return the variance of the tone (first line) at its worst phase for unit noise; infinite if
    undetermined."""
    columns = [0, *(column for k in chosen for column in (2 * k + 1, 2 * k + 2))]
    part = normal.take(columns, 0).take(columns, 1)
    try:
        inverse = np.linalg.inv(part)
    except np.linalg.LinAlgError:
        return math.inf
    inflation = inverse.diagonal() * part.diagonal()
    if not (inflation.min() > 0 and inflation.max() < _WORST_INFLATION):
        return math.inf
    (re, both), (_, im) = inverse[1:3, 1:3]
    return float((re + im) / 2 + math.hypot((re - im) / 2, both))


def scaled_covariance(covariance: Reals, factor: complex) -> Reals:
    """Return the covariance of (re, im) of a complex number after multiplication by ``factor``."""
    matrix = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    scaled: Reals = matrix @ covariance @ matrix.T
    return scaled
