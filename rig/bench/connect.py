"""Connecting: every instrument of a plan, or one report of all failures."""

from __future__ import annotations

from collections.abc import Callable

from rig.bench.connected import Bench, close_all
from rig.bench.limits import GuardedGenerator
from rig.bench.link_worker import LinkWorkers
from rig.bench.plan import BenchPlan, longest_call_s
from rig.core.clock import Clock
from rig.core.errors import (
    RigError,
    SeveralFailuresError,
)
from rig.instruments.roles import (
    Instrument,
)


def connect(plan: BenchPlan, clock: Clock, before_each: Callable[[], None] = lambda: None) -> Bench:
    """Connect to every instrument; where some fail, all failures are told and none stays open.

    What `before_each` raises, before an instrument is connected, ends it at once. Each instrument
    has its worker as soon as it is connected: a drive is fed while the next one takes its time.
    """
    instruments: dict[str, Instrument] = {}
    failures: list[RigError] = []
    links = LinkWorkers(clock)
    unregister = clock.each_slice(links.look)
    try:
        for part in plan.instruments:
            before_each()
            try:
                instrument = part.driver.connect(part.settings, clock)
            except RigError as error:
                failures.append(error)
                continue
            guarded = GuardedGenerator(instrument) if part.role == "generator" else instrument  # type: ignore[arg-type]
            instruments[part.role] = guarded
            feed = getattr(instrument, "keep_alive", None)
            links.add(part.role, feed, longest_call_s(part.settings))
        if failures:
            raise failures[0] if len(failures) == 1 else SeveralFailuresError(failures)
    except BaseException:
        unregister()
        links.close()
        close_all(instruments)
        raise
    return Bench(plan, clock, instruments, links)
