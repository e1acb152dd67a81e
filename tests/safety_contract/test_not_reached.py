"""A drive that no connection reaches any more: what stays pressed is said at once, with where z was
last seen and what the force sensor reads."""

from __future__ import annotations

import itertools
import re

import pytest
from tiers import mostly_nightly

WHILE_PRESSED = {
    "sweep": ("acquisition = 3\nafter_s = 0.05\n", ("--frequencies", "110,410")),
    "slip-trial": ('move = 2\nof = "stage_x"\nafter_s = 0.2\n', ("--distance", "1mm")),
    "roll-trial": ('move = 2\nof = "rotary"\nafter_s = 0.2\n', ("--angle", "2deg")),
}
PLACE_AND_FORCE = (
    r"stage_z has not answered for (\d\.\d) s and was last seen at 1\d\.\d+ mm, \d+\.\d s ago, and "
    r"force_sensor reads \d+(\.\d+)? N"
)
SAID_S = 2.0
"""Longest time from the last answer of z until it is said."""


def lost_for_ever(rig, procedure, kind):
    """The end of a trial whose z is lost while something is pressed."""
    moment, options = WHILE_PRESSED[procedure]
    plan = rig.fault(f'[[fault]]\ndevice = "stage_z"\nkind = "{kind}"\ncount = 0\n{moment}')
    return rig.run(
        procedure, "--json", "--no-figures", "--world-log", str(rig.world_log),
        "--fault", plan, *options,
    )  # fmt: skip


@pytest.mark.parametrize(
    "case",
    mostly_nightly(
        itertools.product(WHILE_PRESSED, ("silence", "close", "half-open")),
        [("slip-trial", "half-open"), ("sweep", "silence")],
    ),
    ids="-".join,
)
def test_what_stays_pressed_is_said_at_once_with_place_and_force(rig, case):
    procedure, kind = case
    ended = lost_for_ever(rig, procedure, kind)
    assert ended.code == 7, ended.stderr
    reported = next(line for line in ended.stderr.splitlines() if "not safe yet" in line)
    seen = re.search(PLACE_AND_FORCE, reported)
    assert seen, reported
    assert float(seen[1]) <= SAID_S
    assert ended.stderr.index("not safe yet") < ended.stderr.index("the guard "), "first"
    # On a line that z shares with x, x is not reached either, which is said after it.
    unsafe = next(line for line in ended.errors if line.startswith("error: NOT SAFE"))
    assert re.search(PLACE_AND_FORCE, unsafe), unsafe
