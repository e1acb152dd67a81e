"""Rolls through the wire: both patterns of Figure 19, rms above 100 Hz, angle, force, axis.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_roll_trial.py``; `RIG_REPEATS=5`
for five rolls of a pattern instead of 25. The noise of the strips is low.
"""

from __future__ import annotations

import numpy as np
import pytest
from measured import heading, repeats, row

from rig.files.runfile.reader import RunFile

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]

ROLLS = repeats(25)
QUIET = "strip_input = { noise_density_V_sqrtHz = 1e-7, mains_amplitude_mV = 0.0 }\n"
BODIES = {
    "cylinder": '{ shape = "cylinder", radius_mm = 30.0 }',
    "sphere": '{ shape = "sphere", radius_mm = 30.0, slices = 5 }',
}
FIGURE_19 = {"b": "-5", "a": "-6.5"}


def rolled(rig, world, *given):
    """Columns of a run in such a World."""
    ended = rig.run("roll-trial", "--json", "--no-figures", "--world", rig.world(world), *given)
    assert ended.code in (0, 5), ended.stderr
    with RunFile.open(rig.only("*.h5")) as run:
        return {name: run.column(name) for name in run.columns()}, ended


def head(body, offset_mm):
    return f"head = {{ body = {BODIES[body]}, axis_offset_mm = {offset_mm} }}\n"


@pytest.mark.parametrize("pattern", FIGURE_19)
def test_rolls_of_a_pattern(rig, pattern):
    given = ("--start", FIGURE_19[pattern], "-n", str(ROLLS))
    heading(f"rig roll-trial {' '.join(given)}: cylinder, Figure 19 {pattern}")
    columns, ended = rolled(rig, QUIET + head("cylinder", 0.3), *given)
    stays = columns["ridge_lifted"] == 0
    print(f"{ROLLS} rolls, {int((~stays).sum())} in which the ridge lifted off")
    for name in ("peak_1", "peak_2", "largest_tangential", "force_error_rms", "force_error_peak"):
        row(name, columns[name][stays], "")
    row("above 100 Hz in the roll, rms", columns["high_roll_rms"][stays], "mV", 3)
    row("above 100 Hz at rest, rms", columns["high_rest_rms"][stays], "mV", 3)
    row("angle error", columns["angle_error"], "deg")
    assert columns["high_roll_rms"][stays].max() < 0.5
    assert columns["angle_error"].max() < 0.02
    assert columns["force_error_rms"].max() < 3
    assert ended.code == 0


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("alignment", ["compensate", "none"])
def test_an_axis_that_is_2_mm_off(rig, body, alignment):
    heading(f"rig roll-trial --alignment {alignment}: {body}, axis 2 mm off")
    columns, _ = rolled(rig, head(body, 2.0), "--alignment", alignment, "-n", "3")
    offset, error = columns["axis_offset"], columns["axis_offset_error"]
    print(f"offset measured {offset[0]:.2f} mm, standard error {error[0]:.2f} mm")
    for name in ("largest_tangential", "force_error_rms", "high_roll_rms"):
        row(name, columns[name], "")
    assert np.isfinite(columns["largest_tangential"]).all()


@pytest.mark.parametrize("pattern", FIGURE_19)
def test_the_head_itself(rig, pattern):
    heading(f"rig roll-trial --start {FIGURE_19[pattern]}: sphere, Figure 19 {pattern}")
    columns, _ = rolled(rig, QUIET + head("sphere", 0.3), "--start", FIGURE_19[pattern], "-n", "3")
    for name in ("peak_1", "peak_2", "high_roll_rms", "largest_tangential", "force_error_rms"):
        row(name, columns[name], "")
