"""The pictures of an analysed sweep say what was found, and that simulated data are simulated."""

import matplotlib as mpl
import numpy as np
import pytest
from legible import faults
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from rig.analysis.film.gain_curve import ResponseCurve, analyse
from rig.analysis.film.model import FilmModel, Notch
from rig.figures.gain_curve import draw_gain, draw_linearity, draw_readings
from rig.figures.style import STYLE, save

FILM = FilmModel(-72.0, 1 / 2000, (Notch(500.0, 10.0, 12.0), Notch(2400.0, 10.0, 10.0)))
SINGLE_LOAD = np.geomspace(2, 20000, 200)
LOADS = (0.2, 1.0, 10.0)


def measured(model, loads=(1.0,)):
    random = np.random.default_rng(1)
    f, load = (a.ravel() for a in np.meshgrid(SINGLE_LOAD, loads))
    truth = model.response(f)
    noise = random.standard_normal((2, f.size))
    responses = truth * (1 + 0.003 * (noise[0] + 1j * noise[1]))
    covariances = np.square(0.003 * abs(truth))[:, None, None] * np.eye(2)
    analysis = analyse(f, responses, covariances, loads=load)
    return ResponseCurve.of(f, responses, covariances), analysis


def texts(figure):
    found = [text.get_text() for text in figure.texts]
    found += [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    for axes in figure.axes:
        found += [text.get_text() for text in axes.texts]
        found += (
            [text.get_text() for text in axes.get_legend().get_texts()] if axes.get_legend() else []
        )
        found += [axes.get_xlabel(), axes.get_ylabel(), axes.get_title()]
    return "\n".join(found)


@pytest.fixture(scope="module")
def film():
    return measured(FILM)


def test_the_gain_figure_names_level_corner_slope_and_every_drop(film):
    written = texts(draw_gain(*film, title="Sweep"))
    for expected in (
        "b = −72.0",
        "corner 20",
        "2 notches",
        "slope 2 to 2000 Hz: 19.5",
        "eq. (2): 20 dB/decade, b = −72.0",
    ):
        assert expected in written
    for drop in film[1].drops:
        assert f"{drop.depth.value:.1f} dB" in written
    assert "Gain (dB re 1 V/N)" in written
    assert "Frequency (Hz)" in written


def test_eq_2_is_drawn_up_to_the_corner_with_the_level_of_the_fit(film):
    curve, analysis = film
    axes = draw_gain(curve, analysis).axes[0]
    line = next(line for line in axes.get_lines() if "eq. (2)" in str(line.get_label()))
    hertz, drawn = line.get_data()
    assert hertz[-1] == pytest.approx(analysis.corner.value)
    slow = curve.frequencies < 50
    at = 20 * np.log10(curve.frequencies[slow]) + drawn[0] - 20 * np.log10(hertz[0])
    assert np.abs(at - curve.gains_dB[slow]).mean() < 0.05


def test_the_labels_of_neighbouring_drops_do_not_touch():
    near = FilmModel(-72.0, 1 / 2000, (Notch(900.0, 8.0, 15.0), Notch(2400.0, 8.0, 15.0)))
    figure = draw_gain(*measured(near))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    # Of an annotation itself the extent includes its arrow.
    first, second = (Text.get_window_extent(label, renderer) for label in figure.axes[0].texts)
    assert not first.overlaps(second)


def test_the_labels_of_drops_lie_inside_the_axes():
    deep = FilmModel(-72.0, 1 / 2000, (Notch(20.0, 5.0, 35.0),))
    figure = draw_gain(*measured(deep))
    FigureCanvasAgg(figure).draw()
    axes = figure.axes[0]
    frame = axes.get_window_extent()
    for label in axes.texts:
        assert label.get_window_extent().y0 >= frame.y0


def test_the_readings_figure_shows_all_three_their_offsets_and_both_corners(film):
    written = texts(draw_readings(*film))
    for expected in (
        "eq. (4) as printed, +89.3 dB",
        "eq. (4) with units corrected, +6.0 dB",
        "circuit analysis, +17.3 dB",
        "6631 Hz",
        "corner, measured",
        "eq. (4) as printed (adds",
        "eq. (4) with units corrected (1/A4",
        "analysis of the circuit",
    ):
        assert expected in written


def test_the_labels_of_both_corners_are_inside_the_frame(film):
    figure = draw_readings(*film)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    shifted = figure.axes[1]
    ends = [text.get_window_extent(canvas.get_renderer()).x1 for text in shifted.texts]
    assert len(ends) == 2
    assert max(ends) <= shifted.bbox.x1


def test_a_film_without_corner_and_drops_is_drawn_too():
    curve, analysis = measured(FilmModel(-78.0, 0.0))
    assert "0 notches" in texts(draw_gain(curve, analysis))
    assert "6631 Hz" in texts(draw_readings(curve, analysis))


def residuals_of(figure):
    panel = figure.axes[1]
    return panel, panel.get_lines()[0].get_ydata()


def test_residuals_are_in_the_standard_errors_of_the_points(film):
    """Found in a review: the scatter about the fit was added to them, so that every fit looked
    good."""
    curve, analysis = film
    panel, shown = residuals_of(draw_gain(curve, analysis))
    expected = 20 * np.log10(np.abs(analysis.fit.model.response(curve.frequencies)))
    np.testing.assert_allclose(shown, (curve.gains_dB - expected) / curve.gain_errors_dB, atol=1e-9)
    assert panel.get_ylabel() == "Residual (s.e.)"
    assert panel.get_title(loc="left").endswith("shaded: ± 2 standard errors of a point")


def test_a_bad_fit_looks_bad_and_its_model_error_is_named():
    f = np.geomspace(20, 8000, 13)
    truth = FILM.response(f) * np.where(np.arange(13) == 6, 0.3, 1.0)
    points = f, truth, np.square(0.0003 * abs(truth))[:, None, None] * np.eye(2)
    analysis = analyse(*points)
    assert analysis.fit.gain_error_dB > 1
    figure = draw_gain(analysis.curve, analysis)
    panel, shown = residuals_of(figure)
    assert np.abs(shown).max() > 1000
    assert panel.get_ylim()[1] > np.abs(shown).max()
    title = panel.get_title(loc="left")
    assert title.endswith(f"; model error {analysis.fit.gain_error_dB:.2g} dB")
    with mpl.rc_context(STYLE):
        assert faults(figure) == []


def test_residuals_are_without_the_effects_that_the_fit_leaves_free():
    """A gain that depends on the preload fits, and its residuals have to say so."""
    random = np.random.default_rng(4)
    preloads = 25 + random.standard_normal(SINGLE_LOAD.size)
    truth = FILM.response(SINGLE_LOAD) * (1 + 0.02 * (preloads - 25))
    noise = random.standard_normal((2, truth.size))
    responses = truth * (1 + 0.003 * (noise[0] + 1j * noise[1]))
    covariances = np.square(0.003 * abs(truth))[:, None, None] * np.eye(2)
    analysis = analyse(SINGLE_LOAD, responses, covariances, preloads=preloads)
    _, shown = residuals_of(draw_gain(analysis.curve, analysis))
    assert np.sqrt(np.mean(np.square(shown))) == pytest.approx(1, abs=0.15)


def test_the_linearity_figure_says_the_mean():
    _, analysis = measured(FILM, LOADS)
    assert "of load" in texts(draw_linearity(analysis.linearity))


def test_simulated_data_say_so_in_the_picture(film, tmp_path):
    figure = draw_gain(*film)
    assert [path.suffix for path in save(figure, tmp_path / "run.h5", True)] == [".png", ".svg"]
    assert "SIMULATED" in texts(figure)
