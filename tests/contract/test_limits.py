"""Values outside a limit are refused before anything moves: value, unit, limit, device, point."""

from __future__ import annotations

import re

import pytest

REFUSED = {
    "amplitude beyond the generator": (
        ("--amplitude", "12V"),
        4,
        "point 20Hz: generator amplitude 12 V is outside 0.001 to 10 V of the generator 33512B",
    ),
    "frequency beyond the generator": (
        ("--frequencies", "3e7"),
        4,
        "point 30000000Hz: generator frequency 3e+07 Hz is outside 1e-06 to 2e+07 Hz",
    ),
    "rate beyond the DAQ": (
        ("--rate", "800e3"),
        4,
        "800000 S/s a channel for 2 channels is outside 3 to 500000 S/s",
    ),
    "range the DAQ has not": (("--film-range", "3V"), 4, "a range of 3 V does not exist"),
    "not ascending": (("--frequencies", "200,20"), 2, "20 Hz follows 200 Hz"),
    "twice": (("--frequencies", "20,20"), 2, "give each frequency once"),
    "NaN": (("--frequencies", "20,nan"), 2, "finite number"),
    "none": (("--frequencies", ""), 2, "there is no frequency"),
    "below zero": (("--frequencies=-5",), 2, "greater than 0|not above 0 Hz"),
    "not a number": (("--frequencies", "twenty"), 2, "--frequencies twenty"),
    "wrong unit": (("--amplitude", "3N"), 2, "--amplitude 3N: 'N' does not convert to V"),
    "rate too low": (("--rate", "40"), 2, "cannot carry"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_before_anything_is_switched_on(rig, case):
    arguments, code, words = REFUSED[case]
    given = arguments if "--frequencies" in arguments[0] else ("--frequencies", "20", *arguments)
    ended = rig.sweep(*given)

    assert ended.code == code, ended.stderr
    (error,) = ended.errors
    assert re.search(words, error) or words in error, error
    assert True not in (rig.outputs() if rig.world_log.exists() else [])
    assert not list(rig.results.rglob("*.h5"))
    assert not list(rig.results.rglob("*.rigj"))


def test_an_unknown_option_is_a_usage_error(rig):
    ended = rig.sweep("--loudness", "11")

    assert ended.code == 2
    assert "--loudness" in ended.stderr


def test_a_load_over_the_limit_trips_is_retried_once_and_ends_the_run(rig):
    ended = rig.sweep("--frequencies", "20,100,210", "--amplitude", "9V", "--load-range", "5V")

    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    assert "over the limit of 20 N" in error
    assert rig.outputs() == [True, False, True, False]
    assert ended.object["points_done"] == 1
    assert "retaking point 100Hz once" in ended.stderr
