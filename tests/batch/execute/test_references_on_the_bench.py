"""References taken on the simulated bench by the real command line, and what is said of them."""

from __future__ import annotations

from typing import Any

import pytest

from procedures.roll_trial import RollTrial
from procedures.slip_trial import SlipTrial
from procedures.sweep import Sweep
from rig.batch.execute.drift import ReferenceRun, judge, part_names, zero_drift
from rig.bench.settings import BenchSettings

PARTS = part_names(BenchSettings(name="b", fixture={"mounted": "plate"}, film={"name": "F12"}))
PROCEDURES = {one.name: one for one in (Sweep, SlipTrial, RollTrial)}


def taken(rig: Any, procedure: str, number: int, world: str, *settings: str) -> ReferenceRun:
    """A run in a World that is otherwise than usual; its seed is its number's."""
    file = rig.world(world)
    options = ("--world", file, "--seed", "3", "--json", "--no-figures")
    done = rig.run(procedure, *options, *settings)
    assert done.code == 0, done.stderr
    return ReferenceRun(number, done.object["summary"])


@pytest.mark.thorough
def test_a_film_that_gives_half_is_named_and_a_zero_that_moved_is_reported(rig: Any) -> None:
    frequencies = ("--frequencies", "200Hz")
    first = taken(rig, "sweep", 1, "", *frequencies)
    again = taken(rig, "sweep", 11, "", *frequencies)
    world = "film_gain = 0.5\nforce_sensor_zero_mV_V = [0.012, -0.007, 0.041]\n"
    torn = taken(rig, "sweep", 21, world, *frequencies)
    assert judge([first], again, Sweep.drift, PARTS) == []
    (found,) = judge([first, again], torn, Sweep.drift, PARTS)
    assert "film 'F12' in the clamp: gain near 200 Hz moved by -6.0" in found.text
    assert found.text.endswith("since run 1: worn or torn")
    zeros = [run.summary["force_zero_N"] for run in (first, again, torn)]
    assert zero_drift(zeros[0], zeros[1], 0.01) == []
    (moved,) = zero_drift(zeros[0], zeros[2], 1.0)
    assert "zero along z moved by +1.6" in moved.text


@pytest.mark.parametrize(
    ("procedure", "short"),
    [
        pytest.param(
            "slip-trial",
            ("--distance", "0.3", "--rest", "100ms"),
            marks=pytest.mark.thorough,
            id="slip-trial",
        ),
        pytest.param("roll-trial", ("--angle", "4"), marks=pytest.mark.nightly, id="roll-trial"),
    ],
)
def test_strips_that_both_give_half_speak_of_their_amplifiers(
    rig: Any, procedure: str, short: tuple[str, ...]
) -> None:
    first = taken(rig, procedure, 1, "", *short)
    less = taken(rig, procedure, 11, "[transducer.circuit]\ngain = 500.0\n", *short)
    watched = PROCEDURES[procedure].drift
    assert first.summary.keys() >= watched.keys()
    (found,) = judge([first], less, watched, PARTS)
    assert found.text.count("moved by -6.0") == 2
    assert "amplifier, load cell or force sensor rather than a film" in found.text
