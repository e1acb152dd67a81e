"""The window of a batch: not before, and by when it is over, in local time.

A time of day or a date without an offset is local time by the rules of this computer's time zone
(``TZ``, else /etc/localtime), on the day on which it applies: 07:00 in the morning after a change
to or from summer time is 07:00 on the clock. A time that the clock leaves out at such a change is
taken an hour earlier; of one that it shows twice, the first is meant.
"""

from __future__ import annotations

from datetime import datetime, time, timedelta

from rig.batch.plan.settings import BatchSettings

SPARE_SIGMAS = 2.0
"""A run is begun if it ends before `stop_by` with this many standard deviations to spare."""


def window(batch: BatchSettings, begun: datetime) -> tuple[datetime | None, datetime | None]:
    """Return when a batch that was begun then may use the bench: not before, and by when it is
    over. A time of day is the next one; that of the end, the next after the beginning, which is
    `begun` where `not_before` is a date that has passed."""
    first = _next(batch.not_before, begun)
    return first, _next(batch.stop_by, begun if first is None else max(first, begun))


def fault_of(batch: BatchSettings, now: datetime) -> str:
    """Return why no run of a batch that is begun now could use its window; empty where one could.
    A `stop_by` with a date may have passed: a file of an earlier night, used again."""
    first, last = window(batch, now)
    if last is None:
        return ""
    if last <= now:
        return f"has passed: it is {_shown(now)}"
    if first is not None and last <= first:
        return f"is not after not_before, {_shown(first)}"
    return ""


def does_not_fit(
    now: datetime, stop_by: datetime | None, estimate_s: float, spread_s: float
) -> str:
    """Return why a run is not begun any more; empty where it would be over in time."""
    if stop_by is None:
        return ""
    over = now + timedelta(seconds=estimate_s + SPARE_SIGMAS * spread_s)
    if over <= stop_by:
        return ""
    day = "" if over.astimezone().date() == stop_by.astimezone().date() else "%Y-%m-%d "
    return (
        f"the next run would last until {over.astimezone():{day}%H:%M:%S}, "
        f"stop_by is {stop_by.astimezone():{day}%H:%M:%S}"
    )


def how_to_continue(batch: BatchSettings) -> str:
    """Return how the runs are taken for which there was no time before `stop_by`, as an
    instruction without a capital."""
    if isinstance(batch.stop_by, datetime):
        return (
            "begin a new batch with the runs that are left: rig batch resume does not change a "
            "stop_by with a date"
        )
    return "continue with rig batch resume"


def _shown(instant: datetime) -> str:
    return f"{instant.astimezone():%Y-%m-%d %H:%M:%S}"


def _next(instant: datetime | time | None, after: datetime) -> datetime | None:
    if instant is None:
        return None
    if isinstance(instant, datetime):
        return instant if instant.tzinfo else instant.astimezone()
    today = after.astimezone().date()
    days = (datetime.combine(today + timedelta(days=k), instant).astimezone() for k in range(3))
    return next(day for day in days if day > after)
