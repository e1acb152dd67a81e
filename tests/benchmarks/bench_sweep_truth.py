"""The sweep against the truth, through the whole wire: unbiased, and its stated errors right.

20 films, each swept by the real command on the slaved simulated bench, with both kinds of DAQ. A
normalised residual is (measured - true) / stated standard error; if estimate and error are right,
residuals have mean 0 and spread 1 everywhere.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_sweep_truth.py``.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from measured import heading, row

from rig.model.vibrator import drawn_film, true_response
from rig.recording.runfile import RunFile

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

SEEDS = range(1, 21)
QUANTITIES = ("real", "imag", "gain")
BANDS_HZ = ((2, 20), (20, 200), (200, 2000), (2000, 20001))
SPREAD = (0.9, 1.1)
UNLIKELY = 3.5
"""Standard errors: of a few dozen means, one beyond is not chance."""


def residuals_of(file, seed):
    """Frequencies (n,), normalised residuals (n, 3) in the order of QUANTITIES, warnings."""
    with RunFile.open(file) as run:
        column = run.column
        frequency = column("frequency")
        truth = true_response(frequency, *drawn_film(seed))
        pairs = (
            (column("response_real") - truth.real, np.sqrt(column("response_var_real"))),
            (column("response_imag") - truth.imag, np.sqrt(column("response_var_imag"))),
            (column("gain") - 20 * np.log10(np.abs(truth)), column("gain_error")),
        )
        warnings = run.outcome.warnings
    return frequency, np.stack([error / stated for error, stated in pairs], axis=1), warnings


def mean_and_spread(values):
    """Mean in its own standard errors, and root mean square about the mean."""
    flat = np.ravel(values)
    return float(flat.mean() * math.sqrt(flat.size) / flat.std()), float(flat.std())


def is_wrong(mean, spread, count, whole):
    """Whether a mean or a spread is no chance; over the whole sweep the spread has hard bounds."""
    chance = 0.0 if whole else UNLIKELY / math.sqrt(2 * count)
    low, high = min(SPREAD[0], 1 - chance), max(SPREAD[1], 1 + chance)
    return abs(mean) > UNLIKELY or not low <= spread <= high


@pytest.mark.parametrize("daq", ["U2542A", "U2331A"])
def test_response_is_unbiased_and_its_errors_are_right(rig, daq):
    heading(f"rig sweep --seed S --world (daq_model = {daq}), S = 1..20")
    world = rig.world(f'daq_model = "{daq}"\n')
    residuals, walls, warned = [], [], set()
    for seed in SEEDS:
        ended = rig.sweep("--seed", str(seed), "--world", world)
        assert ended.code == 0, ended.stderr
        file = rig.folder / ended.object["file"]
        frequency, found, warnings = residuals_of(file, seed)
        residuals.append(found)
        warned.update(warnings)
        walls.append(ended.object["duration_s"])
        file.unlink()
    values = np.stack(residuals)  # (seeds, frequencies, quantities)
    print(
        f"{values.shape[0]} seeds x {values.shape[1]} frequencies; warnings of the runs: {warned}"
    )
    row("bench time of a sweep", walls, "s", 1)

    rows = [("whole sweep", np.ones(len(frequency), bool))]
    rows += [
        (f"{low} to {high:.5g} Hz", (frequency >= low) & (frequency < high))
        for low, high in BANDS_HZ
    ]
    failures = []
    print(f"{'normalised residuals':16s} " + " ".join(f"{q:>24s}" for q in QUANTITIES))
    for name, chosen in rows:
        cells = []
        for k, quantity in enumerate(QUANTITIES):
            mean, spread = mean_and_spread(values[:, chosen, k])
            cells.append(f"mean {mean:+5.2f} se, spread {spread:.3f}")
            count = values[:, chosen, k].size
            if is_wrong(mean, spread, count, whole=bool(chosen.all())):
                failures.append(
                    f"{daq} {name} {quantity}: mean {mean:+.2f} se, spread {spread:.3f}"
                )
        print(f"{name:20s} " + " ".join(cells))

    both = values[:, :, :2]
    count = both.shape[0] * 2
    means = values.mean(axis=0) * math.sqrt(values.shape[0])
    rms = np.sqrt(np.square(both).mean(axis=(0, 2)))
    print(f"largest mean over the seeds, in standard errors (of {len(frequency)} frequencies):")
    for k in np.argsort(-np.abs(means).max(axis=1))[:6]:
        print(
            f"  {frequency[k]:9.2f} Hz "
            + ", ".join(f"{q} {m:+.2f}" for q, m in zip(QUANTITIES, means[k], strict=True))
        )
    expected = 1 / math.sqrt(2 * count)
    print(f"largest and smallest rms of real and imaginary part (1 expected, +-{expected:.2f}):")
    order = np.argsort(rms)
    for k in (*order[::-1][:6], *order[:3]):
        print(f"  {frequency[k]:9.2f} Hz rms {rms[k]:.2f} = {(rms[k] - 1) / expected:+.1f} sigma")
    assert not failures, "\n".join(failures)
