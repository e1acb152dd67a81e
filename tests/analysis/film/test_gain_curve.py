"""What a user reads in the analysis of a sweep: right numbers, honest intervals, no invention."""

import json
import math

import numpy as np
import pytest
from recorded_film import PLAN, judge, line_slope, record, recorded_sweep

from rig.analysis.film.frequency_plan import refine_Hz, scan_frequencies_Hz
from rig.analysis.film.gain_curve import CurveError, ResponseCurve, analyse
from rig.analysis.film.model import FilmModel, Notch
from rig.analysis.film.truth import FilmTruth
from rig.analysis.verdict import Bounds
from rig.physics import pvdf
from rig.physics.pvdf import SWEEP_FILM
from rig.physics.vibrator import VibratorSettings, drawn_film, true_response

SEEDS = range(301, 313)
DEFAULT_FILM = (VibratorSettings(), SWEEP_FILM)
SCAN = np.array(scan_frequencies_Hz(PLAN))


@pytest.fixture(scope="module")
def judged():
    return [judge(seed) for seed in SEEDS]


def default_sweep():
    """Frequencies, responses and covariances of the default film."""
    return recorded_sweep(DEFAULT_FILM, np.random.default_rng(1))[:3]


@pytest.fixture(scope="module")
def default_film():
    return analyse(*default_sweep())


def curve_of(response, frequencies=SCAN, error_dB=0.05, seed=0, scatter=0.0):
    """Any response (a function of Hz) with equal relative errors; scatter of the gain beside."""
    random = np.random.default_rng(seed)
    frequencies = np.asarray(frequencies)
    relative = error_dB * math.log(10) / 20
    truth = response(frequencies)
    noise = random.standard_normal((2, truth.size))
    moved = truth * np.exp(relative * (noise[0] + 1j * noise[1]))
    moved *= 1 + scatter * random.standard_normal(truth.size)
    variances = np.square(relative * np.abs(truth))
    return frequencies, moved, variances[:, None, None] * np.eye(2)


@pytest.mark.thorough
def test_every_quantity_of_drawn_films_is_near_the_truth(judged):
    for film in judged:
        errors = {name: e.value - truth for name, (e, truth) in film.estimates.items()}
        corner, truth = film.estimates["corner"]
        assert abs(errors["b"]) < 0.1
        assert abs(errors["slope 2-2000 Hz"]) < 0.1
        assert abs(errors["asymptotic slope"]) < 0.1
        assert corner.value == pytest.approx(truth, rel=0.05)


@pytest.mark.thorough
def test_intervals_of_drawn_films_cover_the_truth(judged):
    """Fewer than 8 of 12 has a chance below 1e-4 where 95 % is right."""
    for quantity in judged[0].estimates:
        covered = sum(
            film.estimates[quantity][0].covers(film.estimates[quantity][1]) for film in judged
        )
        assert covered >= 8, quantity
    every = [e.covers(truth) for film in judged for e, truth in film.estimates.values()]
    assert 0.90 <= np.mean(every) <= 0.99


@pytest.mark.thorough
def test_every_drop_is_found_and_none_invented(judged):
    assert [(film.seed, film.missed, film.invented) for film in judged] == [
        (seed, (), ()) for seed in SEEDS
    ]


@pytest.mark.thorough
def test_the_withdrawn_claim_is_refuted_on_first_order_films(judged):
    assert {film.analysis.stress_jerk.verdict for film in judged} == {"refuted"}


@pytest.mark.parametrize(
    ("break_Hz", "corner_Hz"),
    [(1200.0, 6631.0), pytest.param(700.0, 20e3, marks=pytest.mark.thorough)],
)
def test_the_withdrawn_claim_is_supported_where_it_is_true(break_Hz, corner_Hz):
    film = FilmModel(
        -78.0,
        1 / corner_Hz,
        (Notch(480.0, 10.0, 12.0), Notch(2500.0, 9.0, 11.0)),
        break_Hz=break_Hz,
    )
    test = analyse(*curve_of(film.response)).stress_jerk
    assert test.verdict == "supported"
    assert test.break_Hz == pytest.approx(break_Hz, rel=0.02)


def test_the_default_film_has_the_slope_of_the_circuit_table(default_film):
    assert line_slope(SWEEP_FILM) == pytest.approx(19.565, abs=0.001)
    assert default_film.slopes.slope.covers(line_slope(SWEEP_FILM))
    assert default_film.slopes.asymptotic.covers(20.0)


def test_the_plain_fit_lies_below_b_and_depends_on_the_grid(default_film):
    dense = np.concatenate([SCAN, np.geomspace(1000, 2000, 60)])
    more = analyse(*curve_of(lambda f: true_response(f, *DEFAULT_FILM), dense))
    assert -0.9 < default_film.plain.level_dB - default_film.level.value < -0.3
    assert more.plain.level_dB < default_film.plain.level_dB - 0.1
    assert more.level.value == pytest.approx(default_film.level.value, abs=0.02)


def test_the_corner_is_said_to_contradict_table_1(default_film):
    text = "\n".join(default_film.sentences())
    assert "6631 Hz for the film alone" in text
    assert "3.32 times the measured one" in text
    assert "20 dB/decade (stress rate): holds" in text
    assert "The paper applied -24 dB" in text


def test_the_order_of_the_points_does_not_matter(default_film):
    points = default_sweep()
    order = np.random.default_rng(5).permutation(len(points[0]))
    shuffled = analyse(*(values[order] for values in points))
    assert shuffled.as_dict() == default_film.as_dict()


def test_a_film_without_drops_has_none():
    analysis = analyse(*curve_of(FilmModel(-78.0, 1 / 2000).response))
    assert analysis.drops == ()
    assert "No notch was found." in analysis.sentences()


def test_one_odd_point_is_no_drop():
    frequencies, responses, covariances = curve_of(FilmModel(-78.0, 1 / 2000).response)
    responses[90] *= 0.4
    assert analyse(frequencies, responses, covariances).drops == ()


def test_a_scan_without_refinement_already_finds_the_drops():
    film = drawn_film(321)
    analysis = analyse(SCAN, *record(film, SCAN, np.random.default_rng(2))[:2])
    found = [drop.frequency.value for drop in analysis.drops]
    assert found == pytest.approx([drop.frequency_Hz for drop in film[0].drops], rel=0.02)


def test_a_film_connected_the_other_way_round_and_late_reads_the_same(default_film):
    frequencies, responses, covariances = default_sweep()
    turned = -responses * np.exp(-2j * np.pi * frequencies * 3e-6)
    analysis = analyse(frequencies, turned, covariances)
    assert analysis.fit.model.polarity == -1
    assert analysis.fit.delay.value == pytest.approx(3.0, abs=0.05)
    assert analysis.level.value == pytest.approx(default_film.level.value, abs=0.002)
    assert analysis.corner.value == pytest.approx(default_film.corner.value, rel=1e-3)


def test_errors_known_from_few_samples_count_less():
    points = default_sweep()
    known, estimated = analyse(*points), analyse(*points, degrees=np.full(len(points[0]), 8.0))
    assert estimated.fit.chi_square == pytest.approx(known.fit.chi_square / 1.5, rel=0.01)
    with pytest.raises(CurveError, match="degrees: the value at 2 Hz is below 1"):
        analyse(*points, degrees=np.zeros(len(points[0])))


def test_scatter_of_the_gain_alone_widens_the_intervals_and_is_stated():
    response = lambda f: true_response(f, *DEFAULT_FILM)  # noqa: E731
    frequencies = np.concatenate([SCAN, SCAN[SCAN < 200], np.geomspace(380, 620, 25)])
    calm = analyse(*curve_of(response, frequencies, error_dB=0.005))
    restless = analyse(*curve_of(response, frequencies, error_dB=0.005, scatter=0.01))
    assert calm.fit.gain_error_dB < 0.005
    assert restless.fit.gain_error_dB == pytest.approx(0.0869, rel=0.2)
    assert restless.fit.phase_error_deg < 0.1
    assert restless.level.standard_error > 5 * calm.level.standard_error
    assert "Poor fit" in restless.sentences()[-1]
    assert restless.level.covers(pvdf.level_at_one_hertz(SWEEP_FILM))


@pytest.fixture(scope="module")
def crept():
    """16 films whose preload rises by 0.4 N a decade, in steps; 0.02 dB/N."""
    films = []
    for seed in range(1000, 1016):
        f, response, covariance, degrees = recorded_sweep(
            drawn_film(seed), np.random.default_rng(seed)
        )
        steps = np.sin(np.arange(len(f)))
        preloads = 25 + 0.4 * (np.log10(f) - np.log10(f).mean()) + 0.1 * steps
        response = response * 10 ** (0.02 * (preloads - 25) / 20)
        truth = line_slope(drawn_film(seed)[1])
        films.append(((f, response, covariance), degrees, preloads, truth))
    return films


@pytest.mark.thorough
def test_what_the_preload_does_to_the_gain_is_found_and_taken_out(crept):
    effects, slopes = [], []
    for points, degrees, preloads, truth in crept:
        analysis = analyse(*points, degrees=degrees, preloads=preloads)
        effects.append(analysis.fit.preload_effect)
        slopes.append((analysis.slopes.slope, truth))
    assert sum(effect.covers(0.02) for effect in effects) >= 13
    assert np.mean([e.value for e in effects]) == pytest.approx(0.02, abs=0.003)
    assert sum(slope.covers(truth) for slope, truth in slopes) >= 13
    assert "changes with it by" in " ".join(analysis.sentences())
    assert analysis.as_dict()["preload_effect"]["unit"] == "dB/N"


@pytest.mark.thorough
def test_without_the_preloads_it_would_pass_for_slope(crept):
    covered = 0
    for points, degrees, _, truth in crept:
        covered += analyse(*points, degrees=degrees).slopes.slope.covers(truth)
    assert covered <= 8


def test_a_preload_that_never_changed_is_no_parameter(default_film):
    points = default_sweep()
    plain = default_film
    same = analyse(*points, preloads=np.full(len(points[0]), 25.0))
    assert same.fit.preload_effect is None
    assert same.sentences() == plain.sentences()


def test_preloads_of_another_sweep_are_refused():
    with pytest.raises(CurveError, match="preloads: 3 values"):
        analyse(*default_sweep(), preloads=[25, 25, 24])


def test_a_film_that_does_not_saturate_has_no_corner_and_its_report_is_json():
    analysis = analyse(*curve_of(FilmModel(-78.0, 0.0).response, error_dB=0.1))
    assert analysis.corner.low > 20e3
    assert any("No corner was found up to 20000 Hz" in line for line in analysis.sentences())
    assert json.loads(json.dumps(analysis.as_dict(), allow_nan=False))["points"] == SCAN.size


def test_a_sweep_above_the_band_has_no_slope():
    frequencies = np.geomspace(1900, 20000, 60)
    analysis = analyse(*curve_of(FilmModel(-78.0, 1 / 4000).response, frequencies))
    assert analysis.slopes is None
    assert "No slope" in analysis.sentences()[0]


@pytest.mark.thorough
def test_points_that_follow_no_circuit_are_refused():
    random = np.random.default_rng(8)
    gains = 10 ** (random.uniform(-40, 20, SCAN.size) / 20)
    responses = gains * np.exp(2j * np.pi * random.random(SCAN.size))
    covariances = (0.01 * gains)[:, None, None] ** 2 * np.eye(2)
    with pytest.raises(CurveError, match="no first-order circuit with notches fits"):
        analyse(SCAN, responses, covariances)


@pytest.mark.parametrize(
    ("frequencies", "message"),
    [
        (np.repeat(np.geomspace(2, 2000, 11), 3), "^11 frequencies, 12 are needed$"),
        (np.linspace(100, 900, 30), "a decade is needed"),
    ],
)
def test_too_few_points_are_refused(frequencies, message):
    with pytest.raises(CurveError, match=message):
        analyse(*curve_of(FilmModel(-78.0, 1 / 2000).response, frequencies))


def test_refinement_lies_within_the_half_widths():
    film = drawn_film(322)
    scanned = ResponseCurve.of(SCAN, *record(film, SCAN, np.random.default_rng(3)))
    more = np.array(refine_Hz(PLAN, scanned))
    together = np.sort(np.concatenate([SCAN, more]))
    left = np.ones(more.size, bool)
    for drop in film[0].drops:
        x = together / drop.frequency_Hz
        detuning = drop.pole_Q * (x - 1 / x)
        assert (np.abs(detuning[detuning < 0]) < 1.03).sum() >= 6
        assert (detuning[detuning > 0] < 1.03).sum() >= 6
        x = more / drop.frequency_Hz
        left &= np.abs(drop.pole_Q * (x - 1 / x)) > 1.05
    assert not left.any()


def test_twenty_decibels_are_not_refused_for_a_difference_without_meaning():
    """The exponent is 19.99934 dB/decade with an error of 0.00026, as of seed 5 with five loads."""
    film = FilmModel(-78.0, 1 / 2000, slope_dB_decade=19.99934)
    found = analyse(*curve_of(film.response, error_dB=0.0005))
    assert not found.slopes.asymptotic.covers(20.0)
    assert found.slopes.verdict(found.bounds).answer == "holds"
    tight = Bounds(slope_dB_decade=1e-5)
    assert found.slopes.verdict(tight).answer == "does not hold"


def test_a_film_of_another_slope_is_distinguished_from_one_of_twenty():
    film = FilmModel(-78.0, 1 / 2000, slope_dB_decade=19.9)
    text = analyse(*curve_of(film.response)).sentences()[0]
    assert "20 dB/decade (stress rate): does not hold" in text


def test_a_part_of_the_range_says_what_it_cannot_judge():
    """The notches at 2.4 and 9 kHz act below 2 kHz and are not in the model."""
    part = np.concatenate([SCAN[(SCAN >= 20) & (SCAN <= 2000)], np.geomspace(400, 620, 25)])
    response = lambda f: true_response(f, *DEFAULT_FILM)  # noqa: E731
    found = analyse(*curve_of(response, part, error_dB=0.002))
    assert not found.fit.residuals_are_random
    text = " ".join(found.sentences())
    assert "20 dB/decade (stress rate): cannot be decided by these data" in text
    assert "The range ends at 2000 Hz: notches above it act within it" in text


def test_a_simulated_film_is_recovered_and_not_measured():
    """A number that the World put in is not a result of the measurement."""
    truth = FilmTruth.of(
        json.dumps(
            {
                "film": {
                    "level_dB": -77.19,
                    "corner_Hz": 1999.0,
                    "drops_Hz": [500.0, 2400.0, 9000.0],
                    "gain_per_newton_dB": 0.02,
                    "gain_per_load_decade_dB": 0.0,
                }
            }
        )
    )
    found = analyse(*default_sweep())
    text = "\n".join(found.sentences(truth))
    assert "(true value in the simulation: 500.00 Hz)" in text
    assert "(true value in the simulation: 1999.00 Hz)" in text
    assert "(true value in the simulation: 20 dB/decade)" in text
    assert "Level b found: " in text
    assert "measured at" not in text
    plain = "\n".join(found.sentences())
    assert "World" not in plain
    assert "Notch measured at" in plain
    assert FilmTruth.of(None) is None
    assert FilmTruth.of('{"touch_down_us": []}') is None


def test_a_part_of_the_range_says_so_even_if_the_model_fits():
    """A notch just above the end moves the corner by more than its interval."""
    part = np.concatenate([SCAN[SCAN <= 3000], np.geomspace(400, 620, 25)])
    found = analyse(*curve_of(lambda f: true_response(f, *DEFAULT_FILM), part))
    assert "The range ends at" in found.sentences()[-1]


def test_the_whole_range_says_nothing_of_its_end(default_film):
    assert "The range ends" not in " ".join(default_film.sentences())
