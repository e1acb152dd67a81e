"""Common parts of the figures of pressed trials."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import recorded_trials as trials
from matplotlib.figure import Figure
from recorded import FAST_SLIDE, ROLL, TWO_SLIDES, unpack

from procedures.pressed.record.reading import _held_force
from procedures.pressed.record.squeeze import Squeeze
from procedures.pressed.record.trial_record import TrialRecord
from rig.figures.circumstances import statements
from rig.figures.pressed import draw_force_error, scale_to
from rig.figures.series import _plot, draw_series
from rig.files.runfile.reader import RunFile


def test_an_axis_is_scaled_by_the_values_that_are_given_and_not_by_what_is_drawn() -> None:
    axes = Figure().subplots()
    axes.plot([0, 1, 2], [-100.0, 1.0, 3.0])
    scale_to(axes, [np.array([1.0, np.nan]), np.array([3.0])])
    low, high = axes.get_ylim()
    assert -0.5 < low < 1.0
    assert 3.0 < high < 4.5
    scale_to(axes, [np.array([np.nan])])
    assert axes.get_ylim() == (low, high)


@pytest.mark.parametrize(
    ("settings", "said", "unsaid"),
    [
        (
            {"path_times_s": [0, 0.6, 1.2], "path_positions_mm": [0, 0.3, 0],
             "force_times_s": [0, 1], "force_shares": [1, 1.3]},
            ["x from start 0, 0.3, 0 mm at 0, 0.6, 1.2 s", "F_n times 1, 1.3 at 0, 1 s"],
            "x rests",
        ),
        ({"path_times_s": [], "path_positions_mm": []}, ["x rests"], "from start"),
        (
            {"profile_times_s": [0, 1, 2], "profile_angles_deg": [0, 3, 0], "angle_deg": 3.5},
            ["angle 0, 3, 0 deg at 0, 1, 2 s"],
            "3.5 deg",
        ),
        (
            {"loading": "ramp", "ramp_N_s": 2.0, "ramp_to_N": 10.0, "hold_at_N": 3.0,
             "speed_mm_s": 2.0},
            ["ramp 2 N/s to 3 N, at most 2 mm/s"],
            "to 10 N",
        ),
        (
            {"loading": "ramp", "ramp_N_s": 2.0, "ramp_to_N": 10.0, "hold_at_N": None,
             "speed_mm_s": 2.0},
            ["ramp 2 N/s to 10 N, at most 2 mm/s"],
            "to 3 N",
        ),
        ({"loading": "slide", "ramp_N_s": 2.0, "speed_mm_s": 2.0}, ["2 mm/s"], "ramp"),
    ],
)  # fmt: skip
def test_the_heading_says_which_way_and_how_fast_a_trial_went(tmp_path, settings, said, unsaid):
    file = trials.write_trials(
        tmp_path / "one.rigj", {"trial-1": trials.slipping()}, settings=settings
    )
    with RunFile.open(file) as run:
        found = statements(run)
    for one in said:
        assert one in found
    assert not any(unsaid in one for one in found)


def test_the_heading_says_what_the_head_of_a_simulated_bench_is(tmp_path: Path) -> None:
    folder = unpack(tmp_path)
    with RunFile.open(folder / ROLL) as run:
        assert "object: semi-spherical-object (simulated: cylinder, 30 mm radius)" in statements(
            run
        )
    with RunFile.open(folder / FAST_SLIDE) as run:
        assert "object: plate" in statements(run)


def test_a_series_states_means_to_the_digits_of_their_scatter() -> None:
    over_trials, distribution = Figure().subplots(1, 2)
    values, valid = np.array([0.7912, 0.8511, 1.1004]), np.zeros(3, bool)
    _plot(over_trials, distribution, values, valid, "k", "peak")
    assert over_trials.get_lines()[0].get_label() == "peak: 0.91 ± 0.16"
    _plot(over_trials, distribution, values[:1], valid[:1], "k", "peak")
    assert over_trials.get_lines()[-2].get_label() == "peak: 0.7912"


def test_a_quantity_that_no_trial_has_gets_no_panel(tmp_path: Path) -> None:
    """Weights that did not slide away have no friction: its axes were drawn empty."""
    unpack(tmp_path)
    with RunFile.open(tmp_path / TWO_SLIDES) as run:
        whole = draw_series(run)[""]
        column = run.column
        run.column = lambda name: (  # type: ignore[method-assign]
            [float("nan")] * 2 if name.endswith("_friction") else column(name)
        )
        without = draw_series(run)[""]
    labels = [axes.get_ylabel() for axes in whole.axes if axes.get_ylabel()]
    assert labels[0] == "Friction"
    assert [axes.get_ylabel() for axes in without.axes if axes.get_ylabel()] == labels[1:]


@pytest.mark.parametrize("squeezed", [False, True])
def test_the_error_of_the_force_is_drawn_as_it_is_judged(squeezed: bool) -> None:
    """Found in a review: the curve went to -17 %, and the stored peak was 2.1 %."""
    record = TrialRecord(1, 100.0, 1000.0, 4.0)
    force_N = 4 + 0.02 * np.random.default_rng(1).standard_normal(2000)
    if squeezed:
        force_N[1500:] += 1
        force_N[1500:1520] -= np.linspace(1, 0, 20)
        record.set_points = [(1.5, 5.0)]
        record.squeezes = [Squeeze(1.498, 1.5, 4.0, 5.0)]
    record.force = [np.column_stack([force_N, np.zeros((2000, 2))])]
    record.frames, record.motion_from_s, record.motion_to_s = 2000, 1.0, 1.9
    stored = _held_force(record, record.forces_N())
    columns: dict[str, list[object]] = {
        "set_normal_force": [4.0],
        "squeeze_record": [json.dumps([asdict(one) for one in record.squeezes])],
    }
    run = SimpleNamespace(columns=lambda: list(columns), column=columns.__getitem__, settings={})
    force = SimpleNamespace(counts={"F_n": force_N}, rate_Hz=1000.0, values={"F_n": force_N}.get)
    axes = Figure().subplots()
    draw_force_error(axes, run, 0, force, (1.0, 1.9))  # type: ignore[arg-type]
    *unjudged, curve = axes.get_lines()
    error = curve.get_ydata()
    peak, rms = np.nanmax(np.abs(error)), np.sqrt(np.nanmean(np.square(error)))
    assert peak == pytest.approx(stored["force_error_peak_percent"])
    assert rms == pytest.approx(stored["force_error_rms_percent"])
    assert [line.get_label() for line in unjudged] == ["squeeze, not judged"] * squeezed
    for line in unjudged:
        assert np.min(line.get_ydata()) < -10
