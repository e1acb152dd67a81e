"""The grid of a sweep: what a scan measures, and what stays out."""

import numpy as np
import pytest
from pydantic import ValidationError

from rig.analysis.film.frequency_plan import (
    FrequencyPlanSettings,
    expected_refinement_Hz,
    refine_Hz,
    scan_frequencies_Hz,
)
from rig.analysis.film.gain_curve import CurveError, ResponseCurve
from rig.analysis.film.model import FilmModel, Notch

PLAN = FrequencyPlanSettings()


def scanned(model, plan=PLAN):
    f = np.array(scan_frequencies_Hz(plan))
    response = model.response(f)
    return ResponseCurve.of(
        f, response, np.square(0.003 * abs(response))[:, None, None] * np.eye(2)
    )


def test_ten_a_decade_then_sixty_from_2_to_20000_hertz():
    f = np.array(scan_frequencies_Hz(PLAN))
    assert (f[0], f[-1]) == (2.0, 20000.0)
    assert ((f >= 2) & (f < 20)).sum() == ((f >= 20) & (f < 200)).sum() == 10
    assert ((f >= 2000) & (f < 20000)).sum() == 60
    assert f.size == 141


def test_frequencies_ascend_and_keep_away_from_the_mains():
    for mains in (50.0, 60.0):
        f = np.array(scan_frequencies_Hz(FrequencyPlanSettings(mains_Hz=mains)))
        lines = mains * np.arange(1, 6)
        assert (np.diff(f) > 0).all()
        distance = np.abs(f[:, None] / lines - 1).min(axis=1)
        half_a_fine_step = (10 ** (1 / 60) - 1) / 2
        assert distance[f < 200].min() >= 0.06 - 1e-5
        assert distance.min() >= half_a_fine_step - 1e-5


@pytest.mark.parametrize(
    ("low", "high"), [(2, 100), (300, 400), (2, 2.1), (150, 20000), (149, 20000), (3, 250)]
)
def test_any_range_ends_within_its_bounds(low, high):
    f = scan_frequencies_Hz(FrequencyPlanSettings(lowest_Hz=low, highest_Hz=high))
    away = 1.001 * FrequencyPlanSettings().mains_distance  # from a mains line at an end
    assert (1 - away) * high <= f[-1] <= high
    assert low <= f[0] <= (1 + away) * low * (150 / 149 if low == 149 else 1)
    assert len(set(f)) == len(f)


def test_a_range_upside_down_is_refused():
    with pytest.raises(ValidationError, match="lowest_Hz 200 Hz is not below highest_Hz 100 Hz"):
        FrequencyPlanSettings(lowest_Hz=200, highest_Hz=100)


def test_each_drop_gets_its_centre_and_six_on_either_side():
    notch = Notch(1203.7, 12.0, 11.0)
    curve = scanned(FilmModel(-78.0, 1 / 2000, (notch,)))
    more = np.array(refine_Hz(PLAN, curve))
    edges = notch.frequency_Hz * np.exp(np.arcsinh(np.array([-1, 1]) / (2 * notch.pole_Q)))
    assert more == pytest.approx(np.sort(more))
    assert more.min() > edges[0] * 0.999
    assert more.max() < edges[1] * 1.001
    near = curve.frequencies[(curve.frequencies > edges[0]) & (curve.frequencies < edges[1])]
    assert 13 - near.size <= more.size <= 13
    assert np.abs(np.log(more[:, None] / near)).min() > 1e-3


def test_more_points_for_those_who_ask():
    curve = scanned(FilmModel(-78.0, 1 / 2000, (Notch(1203.7, 12.0, 11.0),)))
    dense = refine_Hz(FrequencyPlanSettings(points_per_half_width=12), curve)
    assert len(dense) >= 20


def test_no_drop_no_refinement():
    assert refine_Hz(PLAN, scanned(FilmModel(-78.0, 1 / 2000))) == ()


def test_a_drop_at_the_end_is_refined_within_the_range():
    curve = scanned(FilmModel(-78.0, 1 / 2000, (Notch(19700.0, 6.0, 14.0),)))
    more = refine_Hz(PLAN, curve)
    assert 4 <= len(more) <= 8
    assert max(more) <= 20000


def test_a_scan_too_narrow_for_a_trend_is_refused():
    plan = FrequencyPlanSettings(lowest_Hz=300, highest_Hz=900)
    with pytest.raises(CurveError, match="a decade is needed"):
        refine_Hz(plan, scanned(FilmModel(-78.0, 1 / 2000), plan))


def test_as_many_further_points_are_expected_as_the_papers_notches_need():
    assert len(expected_refinement_Hz(PLAN)) == pytest.approx(34, abs=2)
    of_one = FrequencyPlanSettings(lowest_Hz=1000.0, highest_Hz=4000.0)
    assert all(1000 < f < 4000 for f in expected_refinement_Hz(of_one))
    assert expected_refinement_Hz(of_one)
    none = FrequencyPlanSettings(lowest_Hz=10.0, highest_Hz=100.0)
    assert expected_refinement_Hz(none) == ()
