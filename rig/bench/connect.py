"""Connect to every instrument of a bench plan, or report all failures together.

In real time instruments are connected at the same time, since a connection over a slow link takes
many answers. Those that share a link, such as two drives on one serial line, are connected one
after the other. In virtual time, which stops while an instrument answers, all are: a run there is
repeatable to the byte.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rig.bench.addresses import addresses_of
from rig.bench.connected import Bench, close_all
from rig.bench.foreign import connect_foreign, foreign
from rig.bench.limits import GuardedGenerator
from rig.bench.link_worker import LinkWorkers
from rig.bench.plan import BenchPlan, InstrumentPlan, longest_call_s
from rig.core.clock import WAIT_SLICE_S, Clock
from rig.core.errors import (
    InstrumentError,
    RigError,
    SeveralFailuresError,
)
from rig.core.text import in_shell, listed
from rig.core.threads import start_thread
from rig.instruments.roles import (
    Instrument,
)

REPORT_EVERY_S = 3.0
"""Time in s after which a message names the instruments that are still being connected."""
GIVE_UP_S = 10.0
"""Time in s that a connection under way is waited for when nothing more is to be connected."""


def connect(
    plan: BenchPlan,
    clock: Clock,
    check: Callable[[], None] = lambda: None,
    show_line: Callable[[str], None] = lambda text: None,
) -> Bench:
    """Connect to every instrument; if some fail, report all failures and leave none connected.

    `check` is called before each instrument and while instruments are being connected; an exception
    from it ends the connecting. `show_line` is called with a line about the progress where
    connecting takes long. Each instrument gets its link worker as soon as it is connected, so that
    a drive's keep-alive runs while the next instrument is still connecting.
    """
    links = LinkWorkers(clock)
    connecting = _Connecting(plan, clock, links)
    unregister = clock.each_slice(links.poll)
    try:
        if clock.is_virtual:
            for part in plan.instruments:
                check()
                connecting.one(part)
        else:
            _at_once(connecting, clock, check, show_line)
        connecting.raise_failures()
    except BaseException:
        unregister()
        connecting.give_up()
        raise
    return Bench(plan, clock, connecting.instruments(), links)


def _at_once(
    connecting: _Connecting,
    clock: Clock,
    check: Callable[[], None],
    show_line: Callable[[str], None],
) -> None:
    """Connect all links at the same time and wait until that is over."""
    check()
    begun_s = reported_s = time.monotonic()
    connecting.start()
    while waiting := connecting.missing():
        check()
        now_s = time.monotonic()
        if now_s - reported_s >= REPORT_EVERY_S:
            reported_s = now_s
            show_line(f"connecting for {now_s - begun_s:.0f} s: waiting for {', '.join(waiting)}")
        clock.sleep(WAIT_SLICE_S)


class _Connecting:
    """The instruments of a plan on their way to being connected; any thread may connect one."""

    def __init__(self, plan: BenchPlan, clock: Clock, links: LinkWorkers):
        self._plan, self._clock, self._links = plan, clock, links
        self._lock = threading.Lock()
        """Held where a connection is taken note of, or given up."""
        self._instruments: dict[str, Instrument] = {}
        self._failures: dict[str, BaseException] = {}
        self._threads: list[threading.Thread] = []
        self._given_up = False

    def instruments(self) -> dict[str, Instrument]:
        """Return what is connected, in the order of the plan."""
        return {part.role: self._instruments[part.role] for part in self._plan.instruments}

    def missing(self) -> list[str]:
        """Return the roles of the instruments whose connecting is not over."""
        done = {*self._instruments, *self._failures}
        return [part.role for part in self._plan.instruments if part.role not in done]

    def raise_failures(self) -> None:
        """Raise what connecting has raised, in the order of the plan."""
        roles = [part.role for part in self._plan.instruments if part.role in self._failures]
        failures = [self._failures[role] for role in roles]
        for failure in failures:
            if not isinstance(failure, RigError):
                raise failure
        known = [failure for failure in failures if isinstance(failure, RigError)]
        nothing_answers = not self._instruments and all(
            isinstance(one, InstrumentError) for one in known
        )
        if (
            known
            and nothing_answers
            and (file := self._plan.file) is not None
            and self._plan.settings.simulation is not None
        ):
            raise _unconnected_simulation(self._plan, file, known[0])
        if known:
            raise known[0] if len(known) == 1 else SeveralFailuresError(known)

    def start(self) -> None:
        """Start a thread for each link. Raises RigError if one cannot be started."""
        for parts in by_link(self._plan.instruments):
            name = f"connect {parts[0].role}"
            thread = threading.Thread(target=self._connect_all, args=(parts,), name=name)
            thread.daemon = True
            start_thread(thread)
            self._threads.append(thread)

    def one(self, part: InstrumentPlan) -> None:
        """Connect one instrument and start its link worker; a RigError is taken note of."""
        try:
            instrument = self._connected(part)
        except RigError as error:
            self._failures[part.role] = error
            return
        guarded = GuardedGenerator(instrument) if part.role == "generator" else instrument  # type: ignore[arg-type]
        with self._lock:
            if self._given_up:
                close_all({part.role: guarded})
                return
            feed = getattr(instrument, "keep_alive", None)
            try:
                self._links.add(part.role, feed, longest_call_s(part.settings))
            except BaseException:
                close_all({part.role: guarded})
                raise
            self._instruments[part.role] = guarded

    def _connected(self, part: InstrumentPlan) -> Instrument:
        entry = foreign(part)
        if entry is None:
            return part.driver.connect(part.settings, self._clock)
        return connect_foreign(part, entry, lambda: part.driver.connect(part.settings, self._clock))

    def give_up(self) -> None:
        """Connect nothing more, and close what is connected. A connection that is under way closes
        itself as soon as it stands; it is waited for, but not for ever."""
        with self._lock:
            self._given_up = True
        give_up_s = time.monotonic() + GIVE_UP_S
        for thread in self._threads:
            thread.join(max(0.0, give_up_s - time.monotonic()))
        self._links.close()
        close_all(self._instruments)

    def _connect_all(self, parts: Sequence[InstrumentPlan]) -> None:
        with self._clock.in_background():
            for part in parts:
                if self._given_up:
                    return
                try:
                    self.one(part)
                except BaseException as error:  # noqa: BLE001 - raised by raise_failures()
                    self._failures[part.role] = error


def _unconnected_simulation(plan: BenchPlan, file: Path, first: RigError) -> RigError:
    """Return the failure where none of the instruments of `plan`, perhaps a part of the simulated
    bench of a bench file, can be connected; cables and switches, which the instruments' own errors
    name, have no part in it. `rig simulate` replaces the file, hence the warning."""
    roles = listed(part.role for part in plan.instruments)
    return RigError(
        f"{roles} of the simulated bench of {file} cannot be connected ({first.message})",
        f"if it has ended, start one again with rig simulate --fixture {plan.mounted[0]} --write "
        f"{in_shell(file)} and the other options that it had; this replaces the file, with what "
        "was added to it, such as [calibrations]. A command that is given no bench file starts a "
        "simulated bench of its own",
        code=first.code,
    )


def by_link(parts: Sequence[InstrumentPlan]) -> list[list[InstrumentPlan]]:
    """Return the instruments in groups; those that share an address are in one."""
    groups: list[tuple[set[str], list[InstrumentPlan]]] = []
    for part in parts:
        addresses, members = set(addresses_of(part.settings)), [part]
        for group in [group for group in groups if group[0] & addresses]:
            addresses, members = addresses | group[0], group[1] + members
            groups.remove(group)
        groups.append((addresses, members))
    return [members for _, members in groups]
