"""Connect to every instrument of a bench plan, or report all failures together."""

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
    """Connect to every instrument; if some fail, report all failures and leave none connected.

    `before_each` is called before each instrument; an exception from it ends the connecting at
    once. Each instrument gets its link worker as soon as it is connected, so that a drive's
    keep-alive runs while the next instrument is still connecting.
    """
    instruments: dict[str, Instrument] = {}
    failures: list[RigError] = []
    links = LinkWorkers(clock)
    unregister = clock.each_slice(links.poll)
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
