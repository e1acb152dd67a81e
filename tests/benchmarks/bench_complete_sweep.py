"""The complete sweep of 20 drawn films through the whole wire, with both kinds of DAQ.

Against what physics allows: time of the points over their floor, load, preload. Against the truth:
normalised residuals, (measured - true) / stated standard error, which have mean 0 and spread 1
everywhere if estimate and error are right; and the film's model with its intervals.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_complete_sweep.py``;
`RIG_REPEATS=3` for three films.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict

import numpy as np
import pytest
from measured import heading, repeats, row, target
from recorded_film import beside_truth, print_estimates

from rig.analysis.film.gain_curve import analyse
from rig.analysis.response.curve import points_of
from rig.files.runfile.reader import RunFile
from rig.physics.film_clamp import FilmClampSettings, preload_gain
from rig.physics.front_end import FrontEndSettings
from rig.physics.vibrator import drawn_film, true_response, vibrator_line

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]

SEEDS = range(repeats(20))
TARGET_DB = 0.05
DB = 20 / math.log(10)
QUANTITIES = ("real", "imag", "gain")
BANDS_HZ = ((2, 20), (20, 200), (200, 2000), (2000, 20001))
SPREAD = (0.9, 1.1)
UNLIKELY = 3.5
"""Standard errors: of a few dozen means, one beyond is not chance."""


def floor_s(run, seed):
    """Least time of each point: ring-down to 1 % of the slowest response, and the larger of a cycle
    and the time in which the World's noise lets the gain be known to the target. (n,) s."""
    mechanics, circuit = drawn_film(seed)
    slowest_s = 1 / np.min(np.abs(vibrator_line(mechanics, circuit).poles.real))
    f, load_N = run.column("frequency"), run.column("load_set")
    density = FrontEndSettings().noise_density_V_sqrtHz
    film_V = np.abs(true_response(f, mechanics, circuit)) * load_N
    cell_V = mechanics.cell_sensitivity_V_N * load_N
    known_s = (DB / TARGET_DB * density) ** 2 * (1 / film_V**2 + 1 / cell_V**2)
    return slowest_s * math.log(100) + np.maximum(1 / f, known_s)


def time_and_load(run, seed):
    """What a sweep took and how it held its loads."""
    load, largest, wanted = map(run.column, ("load_amplitude", "largest_load", "load_set"))
    reported = [m.decode() for m in run.entry["events/message"][()] if b"overshoot" in m]
    return {
        "ratio": run.column("taken").sum() / floor_s(run, seed).sum(),
        "whole": run.outcome.duration,
        "deviation": 100 * np.abs(load / wanted - 1).max(),
        "overshoot": 100 * (largest / wanted - 1).max(),
        "preload overshoot": float(re.search(r"overshoot ([\d.]+) %", reported[0])[1]),
        "preload held after": float(re.search(r"held ([\d.]+) s", reported[0])[1]),
    }


def residuals(run, seed):
    """Normalised residuals (n, 3) in the order of QUANTITIES; the truth is that of the film at the
    preload which the point had."""
    column = run.column
    truth = true_response(column("frequency"), *drawn_film(seed))
    truth = truth * preload_gain(FilmClampSettings(), column("preload"))
    pairs = (
        (column("response_real") - truth.real, np.sqrt(column("response_var_real"))),
        (column("response_imag") - truth.imag, np.sqrt(column("response_var_imag"))),
        (column("gain") - 20 * np.log10(np.abs(truth)), column("gain_error")),
    )
    return np.stack([error / stated for error, stated in pairs], axis=1)


def mean_and_spread(values):
    """Mean in its own standard errors, and root mean square about the mean."""
    flat = np.ravel(values)
    return float(flat.mean() * math.sqrt(flat.size) / flat.std()), float(flat.std())


def is_wrong(mean, spread, count):
    """Whether a mean or a spread of so many residuals cannot be chance."""
    chance = UNLIKELY / math.sqrt(2 * count)
    low, high = min(SPREAD[0], 1 - chance), max(SPREAD[1], 1 + chance)
    return abs(mean) > UNLIKELY or not low <= spread <= high


def print_residuals(frequency, values):
    """Mean and spread by band; what is no chance."""
    failures = []
    print(f"{'normalised residuals':20s} " + " ".join(f"{q:>24s}" for q in QUANTITIES))
    bands = [("whole sweep", (0.0, math.inf))]
    bands += [(f"{low} to {high:.5g} Hz", (low, high)) for low, high in BANDS_HZ]
    for name, (low, high) in bands:
        chosen = (frequency >= low) & (frequency < high)
        cells = []
        for k, quantity in enumerate(QUANTITIES):
            mean, spread = mean_and_spread(values[chosen, k])
            cells.append(f"mean {mean:+5.2f} se, spread {spread:.3f}")
            if is_wrong(mean, spread, int(chosen.sum())):
                failures.append(f"{name} {quantity}: mean {mean:+.2f} se, spread {spread:.3f}")
        print(f"{name:20s} " + " ".join(cells))
    return failures


@pytest.mark.parametrize("daq", ["U2331A", "U2542A"])
def test_films_through_the_wire(rig, daq):
    heading(f"rig sweep --seed S --world (daq_model = {daq}), S = 0..{SEEDS[-1]}")
    world = rig.world(f'daq_model = "{daq}"\n')
    figures, judged, frequencies, scores, spreads = defaultdict(list), [], [], [], []
    for seed in SEEDS:
        ended = rig.sweep("--seed", str(seed), "--world", world)
        assert ended.code == 0, ended.stderr
        file = rig.folder / ended.object["file"]
        with RunFile.open(file) as run:
            for name, value in time_and_load(run, seed).items():
                figures[name].append(value)
            frequencies.append(run.column("frequency"))
            scores.append(residuals(run, seed))
            spreads.append(scores[-1][:, 2].std())
            analysis = analyse(
                *points_of(run.column),
                degrees=run.column("degrees"),
                preloads=run.column("preload"),
            )
            judged.append(beside_truth(seed, analysis))
        file.unlink()

    target("points against their floor, seed 0", figures["ratio"][0], 1.25, "")
    row("points against their floor", figures["ratio"], "", 2)
    row("whole bench time, preload and parking included", figures["whole"], "s", 1)
    target("load of a kept point off by", row("largest", figures["deviation"], "%", 2), 1, "%")
    row("largest overshoot of the load anywhere", figures["overshoot"], "%", 1)
    target("preload", row("overshoot", figures["preload overshoot"], "%", 1), 5, "%")
    row("contact to held preload", figures["preload held after"], "s", 2)
    row("spread of a sweep's residuals of the gain", spreads, "", 2)
    failures = print_residuals(np.concatenate(frequencies), np.concatenate(scores))
    print_estimates(judged)
    failures += [f"seed {j.seed}: missed {j.missed}" for j in judged if j.missed]
    failures += [f"seed {j.seed}: invented {j.invented}" for j in judged if j.invented]
    assert max(figures["deviation"]) <= 1
    assert not failures, "\n".join(failures)
