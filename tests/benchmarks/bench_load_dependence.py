"""Verdicts on "the gain does not depend on the load" (data2, paper 3.2), and whether the errors of
single points are right: films of the World under five loads, linear and with 0.1 dB/decade.

`test_films` feeds the analysis with the World's own responses, noise and preloads, without the
wire: the errors of its points are right by construction, so it judges verdicts and intervals.
`test_sweeps_through_the_wire` makes whole sweeps: there the points' errors are judged too, by their
chi-square against the World's film, which the sweep does not know.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_load_dependence.py``;
`RIG_REPEATS=2` for two films of each kind through the wire, which take some minutes each.
`RIG_REGISTER=FILE` keeps what each of them gave, so that an interrupted call continues.

`test_points_drawn_again` takes the plans and stated errors of whole sweeps of simulated films, from
the folder `RIG_SWEEPS`, and draws their points anew around the World's curve: it judges the
analysis of exactly such sweeps, apart from how their points were measured.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from measured import heading, repeats, row
from recorded_film import PLAN, beside_truth, print_estimates, record
from scipy.stats import binom

from rig.analysis.film.frequency_plan import scan_frequencies_Hz
from rig.analysis.film.gain_curve import analyse
from rig.analysis.film.linearity import load_linearity
from rig.analysis.film.truth import FilmTruth
from rig.analysis.response.curve import likely_preloads, points_of
from rig.analysis.verdict import Bounds
from rig.files.runfile.reader import RunFile
from rig.physics.film_clamp import FilmClampSettings, load_gain, preload_gain
from rig.physics.vibrator import drawn_film, true_response

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]

REGISTER = Path(os.environ["RIG_REGISTER"]) if "RIG_REGISTER" in os.environ else None
SWEEPS = (
    sorted(Path(os.environ["RIG_SWEEPS"]).rglob("*_sweep_*.h5"))
    if "RIG_SWEEPS" in os.environ
    else []
)
FILMS, ANALYSED, SWEPT, DRAWN = 200, 20, repeats(5), repeats(6)
LOADS_N = (0.2, 0.5, 1.0, 3.0, 10.0)
DEPENDENCES = (0.0, 0.1)
"""Changes of the gain that the World has, in dB/decade of load."""
PRELOAD_STEPS_N, PRELOAD_ERROR_N = 0.05, 0.001
BOUNDS = Bounds()
COVERAGE = (0.90, 0.98)
SPREAD = (0.9, 1.1)
CHANCE = 1e-3


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


@pytest.mark.parametrize("dependence_dB", DEPENDENCES)
def test_intervals_of_films_under_five_loads(dependence_dB):
    """Every interval that a sweep with five loads states, together: a film has 15 of them."""
    heading(f"intervals of {ANALYSED} films under five loads, no wire, {dependence_dB:g} dB/decade")
    judged = []
    for seed in range(1, 1 + ANALYSED):
        points, load, degrees, preloads, errors = five_loads(seed, dependence_dB)
        analysis = analyse(
            *points, degrees=degrees, preloads=preloads, preload_errors=errors, loads=load
        )
        judged.append(beside_truth(seed, analysis))
        # The film's own level is that at 25 N and 1 N; the analysis states it at the means.
        for name in ("b", "circuit level"):
            del judged[-1].estimates[name]
        judged[-1].estimates["effect of the preload"] = analysis.fit.preload_effect, 0.02
    covered = [estimate.covers(truth) for j in judged for estimate, truth in j.estimates.values()]
    print_estimates(judged)
    print(f"all intervals: {sum(covered)} of {len(covered)} cover the truth")
    assert {j.analysis.slopes.verdict(BOUNDS).answer for j in judged} == {"holds"}
    assert COVERAGE[0] <= np.mean(covered) <= COVERAGE[1]


@pytest.mark.skipif(not SWEEPS, reason="RIG_SWEEPS names no folder with run files of sweeps")
def test_points_drawn_again():
    heading(f"points of {len(SWEEPS)} sweeps drawn again, {DRAWN} times each")
    judged = []
    for file in SWEEPS:
        with RunFile.open(file) as run:
            seed, dependence_dB = run.outcome.seed, world_s_dependence_dB(run)
            judged += [drawn_again(run, seed, dependence_dB, draw) for draw in range(DRAWN)]
    print_estimates(judged)
    row(
        "chi-square by degree",
        [j.analysis.fit.chi_square / j.analysis.fit.degrees for j in judged],
        "",
        3,
    )
    for name in judged[0].estimates:
        found = [j.estimates[name] for j in judged if name in j.estimates]
        hits = [estimate.covers(truth) for estimate, truth in found]
        # Below 90 % by more than chance: with few draws chance is large.
        assert binom.cdf(sum(hits), len(hits), COVERAGE[0]) > CHANCE, name


def world_s_dependence_dB(run):  # noqa: N802
    """The change of the gain by decade of load that the World of a sweep had."""
    reported = next(r["simulated_truth"] for r in run.readings() if r.get("simulated_truth"))
    return FilmTruth.of(str(reported)).gain_per_load_decade_dB


def drawn_again(run, seed, dependence_dB, draw):
    """The analysis of the World's own responses at the points of a sweep, with noise of their
    stated errors, and preloads that differ from the measured ones by what these leave open."""
    column, random = run.column, np.random.default_rng([seed, draw, 36])
    frequency, _, covariance = points_of(column)
    preload, uncertain, load = map(column, ("preload", "preload_error", "load_amplitude"))
    clamp = FilmClampSettings(gain_per_load_decade_dB=dependence_dB)
    likely, left = likely_preloads(preload, uncertain)
    truth = true_response(frequency, *drawn_film(seed)) * load_gain(clamp, load)
    truth = truth * preload_gain(clamp, likely + left * random.standard_normal(load.size))
    noise = np.linalg.cholesky(covariance) @ random.standard_normal((load.size, 2, 1))
    # Stated errors scatter, since each is estimated from the residual of its record.
    scatter = random.chisquare(column("degrees")) / column("degrees")
    found = analyse(
        frequency,
        truth + noise[:, 0, 0] + 1j * noise[:, 1, 0],
        covariance * scatter[:, None, None],
        degrees=column("degrees"),
        preloads=preload,
        preload_errors=uncertain,
        loads=load,
    )
    judged = beside_truth(seed, found)
    shift_dB = level_shift_dB(column, clamp)
    for name, factor in (("b", None), ("circuit level", 10 ** (shift_dB / 20))):
        estimate, value = judged.estimates[name]
        judged.estimates[name] = estimate, value + shift_dB if factor is None else value * factor
    judged.estimates["effect of the preload"] = found.fit.preload_effect, clamp.gain_per_newton_dB
    judged.estimates["slope over load"] = found.linearity.slope, dependence_dB
    return judged


def level_shift_dB(column, clamp):  # noqa: N802
    """What the level at the mean preload and load of a sweep has more than that of the film, which
    is at the nominal preload and 1 N."""
    by_preload = clamp.gain_per_newton_dB * (column("preload").mean() - clamp.nominal_preload_N)
    decades = float(np.log10(column("load_amplitude")).mean())
    return by_preload + clamp.gain_per_load_decade_dB * decades


@pytest.mark.parametrize("mains_mV", [0.1, 0.0])
@pytest.mark.parametrize("dependence_dB", DEPENDENCES)
def test_sweeps_through_the_wire(rig, dependence_dB, mains_mV):
    heading(f"rig sweep --loads 0.2,0.5,1,3,10, {dependence_dB:g} dB/decade, mains {mains_mV:g} mV")
    world = rig.world(
        f"[clamp]\ngain_per_load_decade_dB = {dependence_dB}\n"
        f"[film_input]\nmains_amplitude_mV = {mains_mV}\n"
        f"[load_cell_input]\nmains_amplitude_mV = {mains_mV}\n"
    )
    kind = [dependence_dB, mains_mV]
    known = {one["seed"]: one for one in register() if one["kind"] == kind}
    for seed in range(SWEPT):
        if seed in known:
            continue
        ended = rig.sweep("--seed", str(seed), "--world", world, "--loads", "0.2,0.5,1,3,10")
        assert ended.code == 0, ended.stderr
        file = rig.folder / ended.object["file"]
        with RunFile.open(file) as run:
            known[seed] = {"kind": kind, **judged_sweep(run, seed, dependence_dB)}
        file.unlink()
        if REGISTER is not None:
            with REGISTER.open("a") as kept:
                kept.write(json.dumps(known[seed]) + "\n")
    report([known[seed] for seed in range(SWEPT)], dependence_dB)


def register():
    """Sweeps that an earlier, interrupted call has judged."""
    if REGISTER is None or not REGISTER.exists():
        return []
    return [json.loads(line) for line in REGISTER.read_text().splitlines()]


def judged_sweep(run, seed, dependence_dB):
    """What a sweep says and how that compares with the World, as JSON keeps it."""
    column = run.column
    found = analyse(
        *points_of(column),
        degrees=column("degrees"),
        preloads=column("preload"),
        preload_errors=column("preload_error"),
        loads=column("load_amplitude"),
    )
    clamp = FilmClampSettings(gain_per_load_decade_dB=dependence_dB)
    linearity = found.linearity
    low_N, high_N = sorted(linearity.differing_loads_N)
    estimates = {
        "slope over load": (linearity.slope, dependence_dB),
        "largest difference": (
            linearity.largest_difference,
            dependence_dB * math.log10(high_N / low_N),
        ),
        "effect of the preload": (found.fit.preload_effect, clamp.gain_per_newton_dB),
    }
    beside = beside_truth(seed, found)
    assert not beside.invented
    assert not beside.missed
    estimates |= beside.estimates
    shift_dB = level_shift_dB(column, clamp)
    for name, factor in (("b", None), ("circuit level", 10 ** (shift_dB / 20))):
        estimate, truth = estimates[name]
        estimates[name] = estimate, truth + shift_dB if factor is None else truth * factor
    misses = normalised(run, seed, dependence_dB)
    return {
        "seed": seed,
        "answer": linearity.verdict(BOUNDS).answer,
        "first_order": found.slopes.verdict(BOUNDS).answer,
        "covered": {name: bool(one.covers(truth)) for name, (one, truth) in estimates.items()},
        "scores": {
            name: (one.value - truth) / one.standard_error
            for name, (one, truth) in estimates.items()
        },
        "points": [float(np.square(misses).mean()), misses.size],
        "loads": [linearity.chi_square / linearity.degrees, linearity.degrees],
        "fit": [found.fit.chi_square / found.fit.degrees, found.fit.degrees],
    }


def report(sweeps, dependence_dB):
    """Print verdicts, coverage and chi-squares, each with the spread that chance alone gives, and
    judge them."""
    right = sum(one["answer"] == right_answer(dependence_dB) for one in sweeps)
    print(f"verdict right in {right} of {len(sweeps)} sweeps")
    covered = [(name, hit) for one in sweeps for name, hit in one["covered"].items()]
    for name in dict.fromkeys(name for name, _ in covered):
        hits = [hit for of, hit in covered if of == name]
        scores = np.array([one["scores"][name] for one in sweeps])
        print(
            f"{name}: covered in {sum(hits)} of {len(hits)}; error/stated: mean "
            f"{scores.mean():+.2f}, rms {np.sqrt(np.square(scores).mean()):.2f}"
        )
    print(f"all intervals: {sum(hit for _, hit in covered)} of {len(covered)}")
    kinds = {"points": "by point against the World", "loads": "by degree, gain over load"}
    kinds |= {"fit": "by degree, joint fit"}
    for kind, name in kinds.items():
        values, degrees = np.array([one[kind] for one in sweeps]).T
        chance = math.sqrt(2 / degrees.mean())
        row(f"chi-square {name} (chance: 1 +- {chance:.3f})", values, "", 3)
        assert SPREAD[0] <= values.mean() <= SPREAD[1]
    assert right == len(sweeps)


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
