"""What the World's account of a trial says, up to the end of the record."""

import json

import numpy as np
import pytest

from rig.evaluation.simulated_truth import label_of, quiet_of, slips_of, times_of

BEGUN_US = 10_000_000


def account(slide=11.0, first=11.1, whole=11.5, gross=11.7, lifts=(10.2,)) -> dict:
    def us(at):
        return None if at is None else round(1e6 * at)

    known = {
        "ridge": 2, "record_begun_us": BEGUN_US, "slide_us": us(slide), "gross_slip_us": us(gross),
        "first_slip_us": [None, us(first)], "whole_slip_us": [None, us(whole)],
        "ridge_lift_off_us": [us(at) for at in lifts],
    }  # fmt: skip
    return {"simulated_truth": json.dumps(known)}


def test_a_slip_after_the_record_has_not_happened():
    times = times_of(account(whole=13.2, gross=13.3), record_s=3.0)
    assert times["ridge_slip_s"] is None
    assert times["gross_slip_s"] is None
    assert label_of(times, "slip-trial", 1.4) == "partial slip"
    longer = times_of(account(whole=13.2, gross=13.3), record_s=4.0)
    assert longer["ridge_slip_s"] == pytest.approx(3.2)
    assert label_of(longer, "slip-trial", 1.4) == "slip"


def test_lift_offs_before_the_motion_and_after_the_record_are_left_out():
    assert times_of(account(lifts=(10.2, 14.0)), 3.0)["lift_off_s"] is None
    assert times_of(account(lifts=(10.2, 12.0)), 3.0)["lift_off_s"] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("given", "procedure", "ends_s", "label"),
    [
        ({}, "slip-trial", 1.9, "slip in a slide"),
        ({}, "slip-trial", None, "slip in a slide"),
        ({}, "slip-trial", 1.52, "slip"),
        ({"whole": None, "gross": None}, "path-trial", 1.2, "partial slip"),
        ({"first": None, "whole": None, "gross": None}, "path-trial", 1.2, "hold"),
        ({"lifts": (11.55,)}, "path-trial", 1.2, "lift-off"),
        ({"lifts": (12.5,)}, "path-trial", 1.2, "slip"),
        ({"whole": None, "lifts": (12.5,)}, "path-trial", 1.2, "lift-off"),
        ({}, "roll-trial", 1.9, "slip in a roll"),
        ({"whole": None}, "roll-trial", 1.9, "roll"),
        ({"lifts": (12.5,)}, "roll-trial", 1.9, "lift-off"),
    ],
)
def test_a_label_says_what_slipped_and_whether_the_motion_went_on(given, procedure, ends_s, label):
    assert label_of(times_of(account(**given), 3.0), procedure, ends_s) == label


def test_the_motion_begins_with_the_object_or_with_the_procedure_whichever_is_first():
    reading = account(slide=None, first=None, whole=None, gross=None) | {"motion_from_s": 0.8}
    assert times_of(reading, 3.0)["motion_s"] == 0.8
    assert times_of(account() | {"slide_from_s": 0.99}, 3.0)["motion_s"] == 0.99


def test_quiet_is_the_rest_before_the_motion_and_what_follows_one_without_a_slip():
    reading = account(whole=None, gross=None) | {"motion_from_s": 1.0}
    settings = {"rest_s": 0.5, "force_times_s": (0.0, 0.4)}
    quiet = quiet_of(times_of(reading, 3.0), settings, reading, 1.2, 3.0)
    assert quiet == (pytest.approx((0.52, 1.0)), pytest.approx((1.65, 3.0)))
    slipped = account() | {"motion_from_s": 1.0}
    assert len(quiet_of(times_of(slipped, 3.0), settings, slipped, 1.2, 3.0)) == 1


def test_a_file_of_a_real_bench_has_no_account():
    assert times_of({"trial": 1}, 3.0) == {}


def test_every_slip_of_the_ridge_up_to_the_end_of_the_record_is_read():
    known = json.loads(account()["simulated_truth"])
    known["ridge_slip_begins_us"] = [11_500_000, 12_000_000, 14_000_000]
    known["ridge_slip_ends_us"] = [11_600_000]
    reading = {"simulated_truth": json.dumps(known)}
    assert np.array(slips_of(reading, 3.0)) == pytest.approx(np.array([[1.5, 1.6], [2.0, 3.0]]))
    assert slips_of({}, 3.0) == ()
