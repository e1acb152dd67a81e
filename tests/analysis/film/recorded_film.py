"""Sweeps of drawn films as a bench would have recorded them, and how an analysis of one is judged.

The true response, measured on the two-plan grid - the scan, then what the scan's own analysis asks
for - with the noise of the front end: records of whole cycles, four at least, as long as the gain's
standard error asks for; load held at 1 N peak; errors stated from each record's own residual, so
that they scatter as real ones do.

The truth of each quantity is that of the film alone: ``b``, corner, drops as drawn; 20 dB/decade as
asymptotic slope; and as slope over 2 to 2000 Hz that of the least-squares line through the true
gain without drops, over log f on a dense even grid, which depends on no grid of measurement.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from rig.analysis.estimate import Estimate
from rig.analysis.film.frequency_plan import (
    FrequencyPlanSettings,
    refine_Hz,
    scan_frequencies_Hz,
)
from rig.analysis.film.gain_curve import ResponseCurve, SweepAnalysis, analyse
from rig.analysis.response.complex_response import DB_PER_RELATIVE
from rig.physics import pvdf
from rig.physics.front_end import FrontEndSettings, noise_rms
from rig.physics.vibrator import drawn_film, true_response

PLAN = FrequencyPlanSettings()
FRONT_END = FrontEndSettings()
TARGET_DB = 0.05
LONGEST_S = 20.0
LEAST_CYCLES = 4
CELL_V_N = 0.1
FITTED_PER_RECORD = 20
"""Parameters of a record's fit: tone, offset, harmonics, mains lines."""
DROP_NAMES = ("500 Hz", "2400 Hz", "9000 Hz")


def record(film, frequencies, random, load_N=1.0):
    """Responses (n,) V/N, stated covariances (n, 2, 2), degrees of freedom behind these (n,)."""
    frequencies = np.asarray(frequencies)
    truth = true_response(frequencies, *film)
    rate = np.clip(20 * frequencies, 50e3, 500e3)
    noise_V = np.array([noise_rms(FRONT_END, each) for each in rate])
    noise_N = noise_V / CELL_V_N
    relative = np.hypot(noise_V / np.abs(truth), noise_N) / load_N
    needed = 2 * np.square(relative / (TARGET_DB / DB_PER_RELATIVE)) / rate
    cycles = np.ceil(np.maximum(LEAST_CYCLES, np.minimum(needed, LONGEST_S) * frequencies))
    samples = np.round(cycles / frequencies * rate)

    degrees = samples - FITTED_PER_RECORD

    def phasor_error(noise):
        pair = random.standard_normal((2, frequencies.size))
        stated = noise * np.sqrt(random.chisquare(degrees) / degrees)
        return noise * np.sqrt(2 / samples) * (pair[0] + 1j * pair[1]), stated**2 * 2 / samples

    film_error, film_variance = phasor_error(noise_V)
    cell_error, cell_variance = phasor_error(noise_N)
    load = load_N + cell_error
    responses = (truth * load_N + film_error) / load
    size = np.abs(load) ** 2
    variances = film_variance / size + np.abs(responses) ** 2 * cell_variance / size
    return responses, variances[:, None, None] * np.eye(2), degrees


def recorded_sweep(film, random, plan=PLAN):
    """Both plans of one run, the scan and what it led to: the arguments of an analysis."""
    scan = np.array(scan_frequencies_Hz(plan))
    first = record(film, scan, random)
    more = np.array(refine_Hz(plan, ResponseCurve.of(scan, *first)))
    if not more.size:
        return scan, *first
    both = zip((scan, *first), (more, *record(film, more, random)), strict=True)
    return tuple(np.concatenate(pair) for pair in both)


def line_slope(circuit):
    """Slope in dB/decade of the line through the circuit's gain over log f, 2 to 2000 Hz."""
    # Middles of equal steps: a grid with both ends gives these too much weight, 1.2e-4 dB/decade,
    # which is half a standard error of a sweep under five loads.
    f = 2.0 * 1000.0 ** ((np.arange(20_000) + 0.5) / 20_000)
    return float(np.polyfit(np.log10(f), 20 * np.log10(np.abs(pvdf.circuit(f, circuit))), 1)[0])


@dataclass(frozen=True)
class Judged:
    """A film's analysis beside the truth."""

    seed: int
    analysis: SweepAnalysis
    estimates: dict[str, tuple[Estimate, float]]
    """Quantity: what was stated, and the truth."""
    missed: tuple[float, ...]
    """True drops in Hz that were not found within 2 %."""
    invented: tuple[float, ...]
    """Found drops in Hz that no true drop is near to."""
    seconds: float
    """Of the analysis of all points."""


def judge(seed, noise_seed=1):
    """Draw, record, analyse, compare."""
    *points, degrees = recorded_sweep(drawn_film(seed), np.random.default_rng([seed, noise_seed]))
    start = time.perf_counter()
    analysis = analyse(*points, degrees=degrees)
    analysis.sentences()  # all of it: some is computed when it is asked for
    return beside_truth(seed, analysis, time.perf_counter() - start)


def beside_truth(seed, analysis, seconds=math.nan):
    """Hold the analysis of a drawn film's sweep against the film as it was drawn."""
    mechanics, circuit = drawn_film(seed)
    estimates = {
        "b": (analysis.level, pvdf.level_at_one_hertz(circuit)),
        "slope 2-2000 Hz": (analysis.slopes.slope, line_slope(circuit)),
        "asymptotic slope": (analysis.slopes.asymptotic, 20.0),
        "corner": (analysis.corner, pvdf.corner_frequency(circuit)),
        "circuit level": (analysis.circuit.rate_sensitivity, rate_sensitivity(circuit)),
        "circuit pole": (
            analysis.circuit.time_constant,
            1e6 / (2 * math.pi * pvdf.corner_frequency(circuit)),
        ),
    }
    missed, left = [], list(analysis.drops)
    for name, drop in zip(DROP_NAMES, mechanics.drops, strict=True):
        near = [d for d in left if abs(d.frequency.value / drop.frequency_Hz - 1) < 0.02]
        if not near:
            missed.append(drop.frequency_Hz)
            continue
        left.remove(near[0])
        estimates[f"drop {name}, frequency"] = (near[0].frequency, drop.frequency_Hz)
        estimates[f"drop {name}, depth"] = (near[0].depth, drop.depth_dB)
        estimates[f"drop {name}, Q"] = (near[0].pole_Q, drop.pole_Q)
    invented = tuple(d.frequency.value for d in left)
    return Judged(seed, analysis, estimates, tuple(missed), invented, seconds)


def print_estimates(judged):
    """A line a quantity; gives its pairs of estimate and truth, and how many are covered."""
    print(
        f"{'quantity':26s} {'covered':>11s} {'largest error':>22s} {'error/stated: mean, rms':>26s}"
    )
    found = {}
    for quantity in dict.fromkeys(name for each in judged for name in each.estimates):
        pairs = [j.estimates[quantity] for j in judged if quantity in j.estimates]
        errors = np.array([estimate.value - truth for estimate, truth in pairs])
        scores = errors / np.array([estimate.standard_error for estimate, _ in pairs])
        covered = sum(estimate.covers(truth) for estimate, truth in pairs)
        spread = np.sqrt(np.square(scores).mean())
        print(
            f"{quantity:26s} {covered:4d} of {len(pairs)} {np.abs(errors).max():15.3g} "
            f"{pairs[0][0].unit:12s} {scores.mean():+13.2f}, {spread:.3f}"
        )
        found[quantity] = pairs, covered
    return found


def rate_sensitivity(circuit):
    """d(voltage) / d(load rate) at low frequency, uV s/N."""
    return 1e6 * 10 ** (pvdf.level_at_one_hertz(circuit) / 20) / (2 * math.pi)
