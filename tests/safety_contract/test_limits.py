"""Values outside a limit are refused before anything moves: value, unit, limit, device, point."""

from __future__ import annotations

import re

import pytest
from tiers import mostly_thorough

REFUSED = {
    "load beyond the load cell": (
        ("--load", "21N", "--preload", "30N"),
        4,
        "point 20Hz-21N: load_cell load 21 N is outside 0 to 20 N of the load cell",
    ),
    "load and preload beyond the force sensor": (
        ("--load", "19N"),
        4,
        "point 20Hz-19N: force_sensor force 44 N is outside -40 to 40 N of the force_sensor GSV-8",
    ),
    "load and preload, with the options they come from": (
        ("--load", "19N"),
        4,
        "(from --preload 25 N and --load 19 N); choose a value inside",
    ),
    "load that could lift the indentor off": (
        ("--load", "8N", "--preload", "10N"),
        4,
        "--load 8 N (peak) is not below 0.8 of --preload 10 N",
    ),
    "frequency beyond the generator": (
        ("--frequencies", "3e7"),
        4,
        "point 30000000Hz-1N: generator frequency 3e+07 Hz is outside 1e-06 to 2e+07 Hz",
    ),
    "drive beyond the generator": (
        ("--first-amplitude", "12V"),
        4,
        "point 20Hz-1N: generator amplitude 12 V is outside 0.001 to 10 V of the generator 33512B",
    ),
    "rate beyond the DAQ": (
        ("--rate", "800e3"),
        4,
        "800000 S/s a channel for 2 channels is outside 3 to 500000 S/s .from --rate 800000 1/s",
    ),
    "not ascending": (("--frequencies", "200,20"), 2, "20 follows 200"),
    "none": (("--frequencies", ""), 2, "--frequencies '': the list is empty"),
    "none but commas": (("--frequencies", " , "), 2, "the list is empty"),
    "no loads": (("--loads", ""), 2, "--loads '': the list is empty"),
    "twice": (("--frequencies", "20,20"), 2, "give each value once"),
    "NaN": (("--frequencies", "20,nan"), 2, "finite number"),
    "below zero": (("--frequencies=-5",), 2, "-5 is not above 0"),
    "not a number": (("--frequencies", "twenty"), 2, "--frequencies twenty"),
    "wrong unit": (("--load", "3V"), 2, "--load 3V: 'V' does not convert to N"),
    "rate too low": (("--rate", "40"), 2, "--rate 40 1/s is too slow for 20 Hz"),
}
REFUSED_BY_DEFAULT = (
    "load and preload beyond the force sensor",
    "drive beyond the generator",
)


@pytest.mark.parametrize("case", mostly_thorough(REFUSED, REFUSED_BY_DEFAULT))
def test_refused_before_anything_is_switched_on(rig, case):
    arguments, code, words = REFUSED[case]
    given = arguments if "--frequencies" in arguments[0] else ("--frequencies", "20", *arguments)
    ended = rig.sweep(*given)

    assert ended.code == code, ended.stderr
    (error,) = ended.errors
    assert re.search(words, error) or words in error, error
    done = {entry["what"] for entry in rig.log()} if rig.world_log.exists() else set()
    assert not {"ch1.on", "enabled", "homing", "move"} & done
    assert not list(rig.results.rglob("*.h5"))
    assert not list(rig.results.rglob("*.rigj"))


def test_an_unknown_option_is_a_usage_error(rig):
    ended = rig.sweep("--loudness", "11")

    assert ended.code == 2
    assert "--loudness" in ended.stderr


TRIPPED = {
    "load cell": (300, "load_cell_sensitivity_V_N = 0.15\n", "18N", "limit of 20 N of the load", 0),
    "force sensor": (20, "", "26N", "force along z of .* N is over the limit of 40 N", 4),
}
"""The load cell's own limit is met by one that shows more than there is. What it saw teaches the
retake, which is then right; a force sensor that trips tells nothing of the drive."""


@pytest.mark.thorough
@pytest.mark.parametrize("sensor", TRIPPED)
def test_a_load_over_the_limit_trips_and_is_retried_once(rig, sensor):
    """A first drive that is far too strong."""
    frequency, world, preload, words, code = TRIPPED[sensor]
    ended = rig.sweep(
        *("--frequencies", f"{frequency},600", "--preload", preload, "--first-amplitude", "10V"),
        *("--world", rig.world(world)),
    )

    assert ended.code == code, ended.stderr
    assert re.search(words, ended.stderr)
    assert rig.outputs() == [True, False, True, False]
    assert ended.object["points_done"] == (2 if code == 0 else 0)
    if code:
        (error,) = ended.errors
        assert re.search(words, error), error
    assert f"retaking point {frequency}Hz-1N once" in ended.stderr


@pytest.mark.thorough
def test_a_drive_that_the_sweep_computes_beyond_the_generator_is_refused_with_its_point(rig):
    """The load cell shows a hundredth of the load: the drive is raised until the guarded generator
    refuses it. At 3 kHz the force sensor feels nothing of that."""
    asked = ("--frequencies", "3000", "--first-amplitude", "1V")
    blunt = rig.world("load_cell_sensitivity_V_N = 0.003\n")
    ended = rig.sweep(*asked, "--world", blunt)

    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    reported = (
        r"error: point 3000Hz-1N: a load of 1 N \(--load, --loads\) needs what the generator "
        r"cannot give: amplitude [0-9.]+ V is outside 0.001 to 10 V of the generator"
    )
    assert re.match(reported, error), error
    assert "check that the load cell shows the load" in error
    driven = [e["value"] for e in rig.log() if e["what"] == "ch1.amplitude_Vpp"]
    assert max(driven) <= 20.0
    assert rig.outputs() == [True, False]
