"""Verdicts on "the gain does not depend on the load" (data2, paper 3.2), and whether the errors of
single points are right: films of the World under five loads, linear and with 0.1 dB/decade.

`test_films` feeds the analysis with the World's own responses, noise and preloads, without the
wire: the errors of its points are right by construction, so it judges verdicts and intervals.
`test_sweeps_through_the_wire` makes whole sweeps: there the points' errors are judged too, by their
chi-square against the World's film, which the sweep does not know.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_load_dependence.py``;
`RIG_REPEATS=2` for two films of each kind through the wire.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from measured import heading, repeats, row

from rig.analysis.film.frequency_plan import scan_frequencies_Hz
from rig.analysis.film.gain_curve import analyse
from rig.analysis.film.linearity import load_linearity
from rig.analysis.response.curve import points_of
from rig.analysis.verdict import Bounds
from rig.files.runfile.reader import RunFile
from rig.physics.film_clamp import FilmClampSettings, load_gain, preload_gain
from rig.physics.vibrator import drawn_film, true_response

sys.path.insert(0, str(Path(__file__).parents[1] / "analysis"))
from recorded_film import PLAN, beside_truth, print_estimates, record

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]

FILMS, ANALYSED, SWEPT = 200, 20, repeats(5)
LOADS_N = (0.2, 0.5, 1.0, 3.0, 10.0)
DEPENDENCES = (0.0, 0.1)
"""Changes of the gain that the World has, in dB/decade of load."""
PRELOAD_STEPS_N, PRELOAD_ERROR_N = 0.05, 0.001
BOUNDS = Bounds()
COVERAGE = (0.90, 0.98)
SPREAD = (0.9, 1.1)


def five_loads(seed, dependence_dB):
    """Arguments of an analysis: one drawn film under all loads, the preload wandering in steps."""
    random = np.random.default_rng([seed, 35])
    clamp = FilmClampSettings(gain_per_load_decade_dB=dependence_dB)
    scan = np.array(scan_frequencies_Hz(PLAN))
    columns = []
    for load_N in LOADS_N:
        response, covariance, degrees = record(drawn_film(seed), scan, random, load_N)
        preload = 25 + PRELOAD_STEPS_N * random.standard_normal(scan.size)
        factor = preload_gain(clamp, preload) * load_gain(clamp, np.full(scan.size, load_N))
        seen = preload + PRELOAD_ERROR_N * random.standard_normal(scan.size)
        covariance = covariance * factor[:, None, None] ** 2
        loads = np.full(scan.size, load_N)
        columns.append((scan, response * factor, covariance, degrees, seen, loads))
    frequency, response, covariance, degrees, preload, load = (
        np.concatenate(parts) for parts in zip(*columns, strict=True)
    )
    errors = np.full(preload.size, PRELOAD_ERROR_N)
    return (frequency, response, covariance), load, degrees, preload, errors


def right_answer(dependence_dB):
    """What a verdict has to say."""
    return "holds" if abs(dependence_dB) < BOUNDS.slope_dB_decade else "does not hold"


@pytest.mark.parametrize("dependence_dB", DEPENDENCES)
def test_films(dependence_dB):
    heading(f"{FILMS} films under five loads, no wire, World with {dependence_dB:g} dB/decade")
    found = []
    for seed in range(1, 1 + FILMS):
        points, load, *rest = five_loads(seed, dependence_dB)
        found.append(load_linearity(*points, load, *rest))
    right = [f.verdict(BOUNDS).answer == right_answer(dependence_dB) for f in found]
    decades = math.log10(LOADS_N[-1] / LOADS_N[0])
    covered = {
        "slope over load": [f.slope.covers(dependence_dB) for f in found],
        "effect of the preload": [f.preload_effect.covers(0.02) for f in found],
    }
    if dependence_dB:
        covered["gain under 10 N less 0.2 N"] = [
            f.largest_difference.covers(dependence_dB * decades) for f in found
        ]
    print(f"verdict right in {sum(right)} of {FILMS} films")
    for name, hits in covered.items():
        print(f"{name}: covered in {sum(hits)} of {FILMS}")
    row("chi-square by degree of freedom", [f.chi_square / f.degrees for f in found], "", 3)
    assert all(right)
    for name, hits in covered.items():
        assert COVERAGE[0] <= np.mean(hits) <= COVERAGE[1], name


def test_intervals_of_films_under_five_loads():
    """Every interval that a sweep with five loads states, together: a film has 15 of them."""
    heading(f"intervals of {ANALYSED} films under five loads, no wire")
    judged = []
    for seed in range(1, 1 + ANALYSED):
        points, load, degrees, preloads, errors = five_loads(seed, 0.0)
        analysis = analyse(
            *points, degrees=degrees, preloads=preloads, preload_errors=errors, loads=load
        )
        # The film's own level is that at 25 N; the analysis states it at the mean preload.
        judged.append(beside_truth(seed, analysis))
    covered = [estimate.covers(truth) for j in judged for estimate, truth in j.estimates.values()]
    print_estimates(judged)
    print(f"all intervals: {sum(covered)} of {len(covered)} cover the truth")
    assert {j.analysis.slopes.verdict(BOUNDS).answer for j in judged} == {"holds"}
    assert COVERAGE[0] <= np.mean(covered) <= COVERAGE[1]


@pytest.mark.parametrize("mains_mV", [0.1, 0.0])
@pytest.mark.parametrize("dependence_dB", DEPENDENCES)
def test_sweeps_through_the_wire(rig, dependence_dB, mains_mV):
    heading(f"rig sweep --loads 0.2,0.5,1,3,10, {dependence_dB:g} dB/decade, mains {mains_mV:g} mV")
    world = rig.world(
        f"[clamp]\ngain_per_load_decade_dB = {dependence_dB}\n"
        f"[film_input]\nmains_amplitude_mV = {mains_mV}\n"
        f"[load_cell_input]\nmains_amplitude_mV = {mains_mV}\n"
    )
    answers, of_points, of_loads, of_fits = [], [], [], []
    for seed in range(SWEPT):
        ended = rig.sweep("--seed", str(seed), "--world", world, "--loads", "0.2,0.5,1,3,10")
        assert ended.code == 0, ended.stderr
        file = rig.folder / ended.object["file"]
        model = ended.object["summary"]["model"]
        answers.append(model["linearity"]["verdict"]["answer"])
        of_loads.append(model["linearity"]["chi_square"] / model["linearity"]["degrees"])
        of_fits.append(model["chi_square"] / model["degrees"])
        with RunFile.open(file) as run:
            of_points.append(np.square(normalised(run, seed, dependence_dB)).mean())
        file.unlink()
    right = sum(answer == right_answer(dependence_dB) for answer in answers)
    print(f"verdict right in {right} of {SWEPT} sweeps")
    row("chi-square by point against the World", of_points, "", 3)
    row("chi-square by degree, gain over load", of_loads, "", 3)
    if not dependence_dB:  # One film cannot fit five gains.
        row("chi-square by degree, joint fit", of_fits, "", 3)
    assert right == SWEPT
    for values in (of_points, of_loads):
        assert SPREAD[0] <= np.mean(values) <= SPREAD[1]


def normalised(run, seed, dependence_dB):
    """Differences of gain and phase from the World's film, in stated standard errors, (2 n,)."""
    column = run.column
    clamp = FilmClampSettings(gain_per_load_decade_dB=dependence_dB)
    frequency, response, _ = points_of(column)
    truth = true_response(frequency, *drawn_film(seed)) * preload_gain(clamp, column("preload"))
    ratio = response / (truth * load_gain(clamp, column("load_amplitude")))
    by_preload = clamp.gain_per_newton_dB * column("preload_error")
    gain = 20 * np.log10(np.abs(ratio)) / np.hypot(column("gain_error"), by_preload)
    return np.concatenate([gain, np.degrees(np.angle(ratio)) / column("phase_error")])
