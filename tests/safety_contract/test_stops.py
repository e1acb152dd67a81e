"""A stop in every state, whatever its cause: never towards contact, and nothing that was stopped is
recorded as done."""

from __future__ import annotations

import itertools

import pytest
from stops import CAUSES, NOTHING_FOLLOWS, SIGNALS, STATES, stopped
from tiers import mostly_nightly

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

NOISE_mm = 0.01
"""By how much an axis at rest may stand deeper than before: the drive's window and the film's
creep."""
CASES = [case for case in itertools.product(STATES, CAUSES) if case != NOTHING_FOLLOWS]
THOROUGH = [
    ("approach", "SIGTERM"),
    *(("homing", "interlock"), ("travel", "force limit"), ("held", "SIGTERM")),
    *(("slide", "force limit"), ("sweep, recording", "Ctrl-C")),
]
"""Each cause, and each state in which z or x moves or presses; the other pairs are nightly. For a
roll that is stopped see test_roll_trial, for a paused run test_signals and test_real_time."""


@pytest.mark.stages("festo", because="the states' moments are those of these stages")
@pytest.mark.parametrize(
    "case",
    mostly_nightly(CASES, THOROUGH),
    ids=" by ".join,
)
def test_a_stop_never_moves_towards_contact_and_is_never_recorded_as_done(rig, case):
    name, cause = case
    rig.usual_ways = name != "slide"  # the moments of others are counted from the begin of a way
    ended, stop = stopped(rig, STATES[name], cause)
    if cause != "force limit":  # after a trip the point is taken once more
        code = 128 + SIGNALS[cause] if cause in SIGNALS else 4
        assert ended.code == code, ended.stderr
        assert stop.deepest_mm <= NOISE_mm
        assert ended.object["outcome"] != "complete"
    if name.startswith("sweep"):
        assert rig.outputs()[-1] is False
    reported = [line.split()[1] for line in ended.stderr.splitlines() if line[:1].isdigit()]
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.point_ids() == reported
        assert (run.outcome.status == "complete") == (ended.code == 0)
