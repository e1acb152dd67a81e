"""Whole batches on virtual time: nothing lasts beyond `stop_by`, by the clock of the zone."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from nights import ask, folder_of, write_night

pytestmark = pytest.mark.thorough


def zone_that_changes(instant: datetime) -> str:
    """A POSIX zone whose clock goes from UTC to UTC+1 at this instant, and back in 90 days."""
    back = instant + timedelta(days=90, hours=1)
    first, last = (f"{day.timetuple().tm_yday - 1}/{day:%H:%M:%S}" for day in (instant, back))
    return f"WINTER0SUMMER-1,{first},{last}"


def night(stop_by: str) -> str:
    return f"""
[batch]
name = "night"
stop_by = {stop_by}
figures = false
detect = false

[simulation]
world = "world.toml"

[[experiment]]
procedure = "sweep"
settings = {{ frequencies_Hz = [200] }}
repeat = 2
rest_s = 3600
"""


def test_stop_by_is_kept_in_a_night_in_which_the_clock_changes(rig: Any) -> None:
    """1.5 hours are 2.5 on the clock: one run with its rest fits, two do not."""
    now = datetime.now(UTC)
    rig.env["TZ"] = zone_that_changes(now + timedelta(hours=1))
    by_the_clock = now + timedelta(hours=2.5)
    write_night(rig, night(f"{by_the_clock:%H:%M:%S}"))
    ended = rig.run("batch", "run", "night.toml")
    assert ended.code == 6, ended.stderr
    batch = folder_of(rig.results)
    assert ask(batch, "SELECT state, count(*) FROM run GROUP BY state") == [
        ("done", 1),
        ("queued", 1),
    ]
    assert f"stop_by is {by_the_clock:%H:%M:%S}" in ended.stderr
    again = rig.run("batch", "resume")
    assert again.code == 0, again.stderr
    assert ask(batch, "SELECT state, count(*) FROM run GROUP BY state") == [("done", 2)]
