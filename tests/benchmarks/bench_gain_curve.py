"""Drawn films, recorded, analysed and held against the truth: errors, coverage, drops, cost.

Films of the seeds 1 to 200; what an analysis is tuned on are other seeds (1000 and above). The
truth of each quantity is defined in tests/analysis/film/recorded_film.py. Prints the table and
judges it: b within 0.1 dB, slopes within 0.1 dB/decade, corner within 5 %, every drop found within
2 % and none invented, and every 95 % interval right as often as chance allows: in 183 to 197 of
200.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_gain_curve.py``; `RIG_REPEATS=50`
for fewer films.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from measured import heading, repeats, row, target
from recorded_film import judge, print_estimates

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

SEEDS = range(1, 1 + repeats(200))
COVERAGE = 0.95
LARGEST_DEVIATION = 7 / math.sqrt(200 * COVERAGE * (1 - COVERAGE))
"""Of the number of right intervals from its expectation, in standard deviations."""
LARGEST_ERROR = {
    "b": 0.1,
    "slope 2-2000 Hz": 0.1,
    "asymptotic slope": 0.1,
}
LARGEST_RELATIVE_ERROR = {"corner": 0.05, "frequency": 0.02}


def allowed(quantity, truth):
    """Largest error of a quantity, or none is set."""
    if quantity in LARGEST_ERROR:
        return LARGEST_ERROR[quantity]
    for name, relative in LARGEST_RELATIVE_ERROR.items():
        if quantity.endswith(name):
            return relative * truth
    return np.inf


def covered_by_chance(covered):
    """Whether so many right intervals of all the films are no surprise."""
    expected = COVERAGE * len(SEEDS)
    spread = math.sqrt(expected * (1 - COVERAGE))
    return abs(covered - expected) <= LARGEST_DEVIATION * spread


def test_films():
    heading(f"analysis of {len(SEEDS)} drawn films, two plans, 1 N, 0.05 dB")
    judged = [judge(seed) for seed in SEEDS]
    failures = [f"seed {j.seed}: missed {j.missed}" for j in judged if j.missed]
    failures += [f"seed {j.seed}: invented {j.invented}" for j in judged if j.invented]
    for quantity, (pairs, covered) in print_estimates(judged).items():
        if not covered_by_chance(covered):
            failures.append(f"{quantity}: covered in {covered} of {len(pairs)}")
        if any(abs(e.value - truth) > allowed(quantity, truth) for e, truth in pairs):
            failures.append(f"{quantity}: an error is too large")
    found = sum(len(j.analysis.drops) for j in judged)
    missed, invented = (
        sum(len(getattr(j, kind)) for j in judged) for kind in ("missed", "invented")
    )
    print(f"drops: {found} found of {3 * len(judged)}, {missed} missed, {invented} invented")
    verdicts = [j.analysis.stress_jerk.verdict for j in judged]
    least = min(j.analysis.stress_jerk.aic_difference for j in judged)
    print(f"stress jerk: refuted in {verdicts.count('refuted')}, least AIC difference {least:.0f}")
    away = [j.analysis.plain.level_dB - j.analysis.level.value for j in judged]
    row("paper's plain eq. (2) less b", away, "dB")
    row("points of a sweep", [j.analysis.points for j in judged], "", 0)
    cost = row("analysis of a sweep", [j.seconds for j in judged], "s")
    target("median analysis", cost, 1.0, "s")
    assert not failures, "\n".join(failures)
