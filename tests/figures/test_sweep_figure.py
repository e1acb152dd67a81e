"""The figure of what a sweep measured: loads apart, numbers on every axis."""

import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from recorded import SWEEP, unpack
from tiers import mostly_thorough

from rig.figures.circumstances import in_one_line
from rig.figures.style import wrapped
from rig.figures.sweep import (
    PAPER,
    draw_circuit_readings,
    draw_fitted_gain,
    draw_load_linearity,
    draw_measured,
)
from rig.files.runfile.reader import RunFile


def run_of(frequencies, loads=(1.0,), deviation=0.002):
    """What the figure asks of a run file, for a film of 20 dB/decade."""
    f, wanted = (a.ravel() for a in np.meshgrid(np.asarray(frequencies, float), loads))
    columns = {
        "frequency": f,
        "gain": 20 * np.log10(f) - 77,
        "gain_error": np.full(f.size, 0.01),
        "phase": np.full(f.size, 90.0),
        "phase_error": np.full(f.size, 0.1),
        "load_set": wanted,
        "load_amplitude": wanted * (1 + deviation),
    }
    return SimpleNamespace(
        column=columns.__getitem__,
        settings={"load_tolerance_percent": 1.0, "load_N": 1.0, "preload_N": 25.0},
        header=SimpleNamespace(
            bench_toml='name = "b"\nfilm.name = "f1"',
            marked="SIMULATED {}".format,
            sample=SimpleNamespace(name="s1"),
            start_time="2026-11-25T10:00:00+00:00",
        ),
        path=Path("run.h5"),
    )


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def numbers(figure):
    """Tick labels that are seen on the frequency axis."""
    FigureCanvasAgg(figure).draw()
    axis = figure.axes[-1].xaxis
    low, high = axis.get_view_interval()
    return [
        tick.label1.get_text()
        for minor in (False, True)
        for tick in (axis.get_minor_ticks() if minor else axis.get_major_ticks())
        if tick.label1.get_text() and low <= tick.get_loc() <= high
    ]


@pytest.mark.parametrize(
    "frequencies",
    mostly_thorough(
        [(300, 600), (1000,), (20, 300), (5000, 20000), (310, 330), (2, 20000)],
        default=[(1000,), (310, 330)],
    ),
)
def test_every_frequency_axis_has_several_numbers(frequencies):
    assert len(numbers(draw_measured(run_of(frequencies)))) >= 3


def test_loads_are_distinguished_by_colour_and_legend():
    figure = draw_measured(run_of((20, 200, 2000), loads=(0.5, 1.0, 2.0)))
    gain, _, load = figure.axes
    assert legend(gain)[-3:] == ["0.5 N peak load", "1 N peak load", "2 N peak load"]
    sizes = [line.get_markersize() for line in load.get_lines()]
    assert sizes == sorted(sizes, reverse=True), "a later load hides an earlier one"
    assert len({line.get_color() for line in load.get_lines()}) == 3


def test_a_single_point_has_no_reference_and_no_picture_of_its_noise():
    gain = draw_measured(run_of((1000,))).axes[0]
    assert legend(gain) == ["1 N peak load"]
    low, high = gain.get_ylim()
    assert high - low >= 1.0


def test_the_load_is_shown_as_its_error_with_the_tolerance():
    load = draw_measured(run_of((20, 200), deviation=0.004)).axes[2]
    np.testing.assert_allclose(load.get_lines()[0].get_ydata(), 0.4)
    assert "± 1 % allowed" in load.get_title(loc="left")
    assert load.get_ylim() == pytest.approx((-1.3, 1.3))


def test_a_sweep_stopped_above_the_reference_draws_without_a_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = draw_measured(run_of((20000, 17000)))
    assert legend(figure.axes[0]) == ["1 N peak load"]


def test_a_long_name_in_a_heading_is_wrapped_between_its_words():
    name = "sample " + "a long name of a sample " * 5
    lines = wrapped(in_one_line(["25 N preload", name.strip(), "bench b"]), 6.0, 200.0)
    assert len(lines) > 3
    assert {word for line in lines for word in line.split(" ")} <= set(
        f"25 N preload, {name.strip()}, bench b".split(" ")
    )


def test_the_title_names_the_film_and_the_load_and_the_lines_below_it_the_rest():
    figure = draw_measured(run_of((100, 1000)))
    assert figure.get_suptitle() == "SIMULATED sweep of film f1 at 1 N peak load"
    (below,) = figure.texts[1:] if figure.texts[0] is figure._suptitle else figure.texts
    assert (
        below.get_text()
        == f"25 N preload, sample s1, bench b, 2026-11-25 10:00+00:00\nrun.h5\n{PAPER}"
    )


def test_the_line_of_eq_2_lies_on_the_points_where_it_holds():
    """A corner at 1454 Hz and a notch at 400 Hz bend the curve down; the line must not follow."""
    f = np.geomspace(2, 20000, 60)
    run = run_of(f)
    gain = run.column("gain")
    gain -= 10 * np.log10(1 + (f / 1454) ** 2) + 15 * np.exp(-(np.log(f / 400) ** 2) / 0.02)
    axes = draw_measured(run).axes[0]
    line = next(line for line in axes.get_lines() if "eq. (2)" in str(line.get_label()))
    assert line.get_label() == "paper, eq. (2), fitted up to 200 Hz"
    hertz, drawn = line.get_data()
    assert hertz[-1] <= 1000
    slow = f < 100
    np.testing.assert_allclose(
        np.interp(np.log10(f[slow]), np.log10(hertz), drawn), gain[slow], atol=0.05
    )


def test_a_sweep_whose_results_have_no_fit_has_none_in_its_figures(tmp_path):
    """Found in a review: the figures fitted 8 frequencies, the results only 12."""
    with RunFile.open(unpack(tmp_path) / SWEEP) as run:
        assert np.unique(run.column("frequency")).size == 10
        for draw in (draw_fitted_gain, draw_circuit_readings, draw_load_linearity):
            assert draw(run) == {}
