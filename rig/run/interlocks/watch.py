"""Watches the interlock contacts of a bench while a command uses it.

Contacts are read by `rig.run.interlocks.contact_readings`, in real time by a thread for each
instrument; a further thread judges what has not been read for too long. Where a person's contact
opens, the thread that finds it has the emergency actions of everything that is armed run, records
the latch, and keeps the reason, which the procedure's next wait raises. In virtual time all of it
is done in each slice of a wait.

The states are those of `rig.control.interlock`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.interlocks import InterlockSettings
from rig.bench.plan import BenchPlan
from rig.control.interlock import STEADY_S, Contact, ContactEvent, InterlockState
from rig.core.clock import WallClock
from rig.core.errors import ExitCode, RigError
from rig.core.text import in_shell
from rig.core.threads import start_thread
from rig.run.holds import Holds
from rig.run.interlocks.contact_readings import FRESH_S, ContactReadings
from rig.run.interlocks.store import InterlockStore

JUDGE_EVERY_S = 0.02
LOOK_EVERY_S = 0.05
RESET = "rig interlocks reset"
AT_REST = (InterlockState.CLOSED, InterlockState.RELEASED)
"""States of a contact that is closed."""


class InterlockError(RigError):
    """Raised if a person's contact is open or has not been reset; it ends the run, with the exit
    code of a limit."""

    code = ExitCode.LIMIT


class InterlockWatch:
    """Watches every contact of a bench from `begin` to `end`.

    `act` runs the emergency actions and returns those that failed, in words. `note` records an
    event; it is called from the procedure's thread only. With `looks_only` an opening is neither
    acted on nor recorded as a latch: for a command that moves nothing.
    """

    def __init__(
        self,
        bench: Bench,
        holds: Holds,
        act: Callable[[], list[str]],
        store: InterlockStore,
        note: Callable[[str, str, str], None] = lambda level, code, message: None,
        looks_only: bool = False,
    ):
        self._bench, self._clock = bench, bench.clock
        self._holds, self._act = holds, act
        self.store, self.note = store, note
        self._declared = {one.name: one for one in bench.settings.interlock}
        self._looks_only = looks_only
        self._contacts: dict[str, Contact] = {}
        self._readings = ContactReadings(bench, self._take_in)
        self._reasons: dict[str, str] = {}
        """Reason why each latched contact is latched, in words."""
        self._unread: set[str] = set()
        """Contacts that are treated as open because they could not be read."""
        self._proving: str | None = None
        """Contact whose proof test is under way: it is opened on purpose."""
        self._reported: set[str] = set()
        """Latched contacts that have been raised or returned."""
        self._news: list[tuple[str, str]] = []
        """Events that the procedure's thread has not recorded yet: level and message."""
        self._unkept: list[RigError] = []
        self._lock = threading.RLock()
        """Held while the state of a contact changes, and until what follows from it is done."""
        self._ending = threading.Event()
        self._judge_thread: threading.Thread | None = None
        self._begun = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the contacts in the order of the bench file."""
        return tuple(self._declared)

    def contact(self, name: str) -> Contact:
        """Return the present state of a contact."""
        return self._contacts[name]

    def begin(self) -> None:
        """Read every contact and begin to watch. Nothing may be armed before.

        Raises InstrumentError if a contact cannot be read, RigError if the record of a latch cannot
        be written. `check` raises the error if a contact blocks motion.
        """
        if not self._declared:
            return
        if not self._looks_only:
            self.store.check_writable()
        now_s = self._clock.now()
        for name, declared in self._declared.items():
            latched = self.store.get(name)
            if latched.opened is not None:
                self._reasons[name] = f"{latched.why} ({latched.opened})"
            self._contacts[name] = Contact(
                name, declared.kind, now_s, latched=latched.opened is not None
            )
        self._readings.begin()
        self._begun = True
        if not self._clock.is_virtual:
            judge = threading.Thread(target=self._keep_judging, name="interlocks", daemon=True)
            start_thread(judge)
            self._judge_thread = judge

    def end(self) -> None:
        """End the watch; does nothing if it was not begun."""
        self._ending.set()
        self._readings.end()
        if self._judge_thread is not None:
            self._judge_thread.join(FRESH_S)
        self._begun = False

    # --- in the procedure's thread --------------------------------------------------------------

    def poll(self) -> None:
        """Look at the contacts, and react to an open one. Raises nothing.

        Call it in every slice of a wait, in any phase.
        """
        if not self._begun or self._readings.under_way:
            return
        if self._clock.is_virtual:
            self._readings.read(self._are_needed, all_now=False)
        self._judge()
        self._report()

    def check(self) -> None:
        """Raise InterlockError, every time, as long as a person's contact is latched."""
        with self._lock:
            for name, contact in self._contacts.items():
                if contact.latched and name != self._proving:
                    raise self.error(name)

    def news(self) -> InterlockError | None:
        """Return, once, what `check` raises, unless it has raised it before."""
        with self._lock:
            for name, contact in self._contacts.items():
                if contact.latched and name not in self._reported:
                    return self.error(name)
        return None

    def settle(self) -> None:
        """Wait until every contact has been read after this call, however slowly its instrument is
        read, or is treated as open: before a failure is handled it has to be known whether a
        contact has caused it."""
        if not self._begun:
            return
        if self._clock.is_virtual:
            self._readings.read(self._are_needed, all_now=True)
        else:
            self._readings.await_new(self._are_needed)
        self._judge()
        self._report()

    # --- for a person's reset and proof test ----------------------------------------------------

    @contextmanager
    def proving(self, name: str) -> Iterator[None]:
        """Let a contact be opened on purpose within the block: nothing follows from it."""
        self._proving = name
        try:
            yield
        finally:
            self._proving = None

    def wait_for(self, name: str, seen: Callable[[Contact], bool], seconds: float) -> bool:
        """Wait until a contact is as it should be; return whether it is in time."""
        end_s = self._clock.now() + seconds
        while not seen(self._contacts[name]):
            if self._clock.now() > end_s:
                return False
            self._clock.sleep(LOOK_EVERY_S)
        return True

    def forget_opening(self, name: str) -> None:
        """End the latch of a contact that is closed; its record is not changed."""
        with self._lock:
            if self._contacts[name].latched:
                self._contacts[name].reset()

    def level(self, name: str) -> str:
        """Return in words how a contact stands."""
        contact = self._contacts[name]
        if not contact.readable:
            why = self._readings.failure(self._declared[name].role) or "no answer"
            return f"not readable ({why})"
        return "closed" if contact.state in AT_REST else "open"

    def failures(self) -> list[RigError]:
        """Return, once, why latches could not be recorded."""
        failures, self._unkept = self._unkept, []
        return failures

    # --- judging --------------------------------------------------------------------------------

    def _keep_judging(self) -> None:
        with self._clock.in_background():
            while not self._ending.wait(JUDGE_EVERY_S):
                self._judge()

    def _are_needed(self, contacts: Sequence[InterlockSettings]) -> bool:
        """Return whether contacts are to be read: not if all are latched, which ends the run."""
        return self._proving is not None or not all(
            self._contacts[one.name].latched for one in contacts
        )

    def _take_in(self, declared: InterlockSettings, high: bool) -> None:
        with self._lock:
            contact = self._contacts[declared.name]
            event = contact.read(declared.is_closed(high), self._clock.now())
            self._follow(declared, event)

    def _judge(self) -> None:
        with self._lock:
            for name, contact in self._contacts.items():
                self._follow(self._declared[name], contact.judge(self._clock.now()))

    def _follow(self, declared: InterlockSettings, event: ContactEvent | None) -> None:
        """Do what follows from an event of a contact; the lock is held."""
        if event is None:
            return
        contact, name = self._contacts[declared.name], declared.name
        if name == self._proving or self._looks_only:
            return
        if event is ContactEvent.OPENS:
            why = self._why(declared, contact)
            if declared.kind == "process":
                self._holds.begin(_hold(declared))
                self._news.append(("warning", why))
                return
            failures = self._act()
            if failures:
                why += f"; not stopped at once: {'; '.join(failures)}"
            self._reasons[name] = why
            if contact.readable:
                self._unread.discard(name)
            else:
                self._unread.add(name)
            self._news.append(("error", why))
            try:
                self.store.latch(name, why)
            except RigError as error:
                self._unkept.append(error)
        elif event is ContactEvent.CLOSES:
            if declared.kind == "process":
                self._holds.end(_hold(declared))
            self._news.append(("info", f"interlock {name} ({declared.kind}) is closed again"))

    def _why(self, declared: InterlockSettings, contact: Contact) -> str:
        what = f"interlock {declared.name} ({declared.kind})"
        at = f"at {self._clock.now():.3f} s of bench time"
        if contact.readable:
            return f"{what} opened {at}"
        cause = self._readings.failure(declared.role) or f"{declared.role} does not answer in time"
        return f"{what} cannot be read {at}, which is treated as open: {cause}"

    def _report(self) -> None:
        """Record what has happened; from the procedure's thread."""
        with self._lock:
            news, self._news = self._news, []
        for level, message in news:
            self.note(level, "interlock", message)

    def error(self, name: str) -> InterlockError:
        """Return what a latched contact means to a run, as the error that ends it."""
        self._reported.add(name)
        what = self._reasons.get(name, f"interlock {name} (person) opened")
        hint = "check the bench and close it"
        if name in self._unread:
            hint = f"check {self._declared[name].role}, which reads it, and that it is closed"
        if self.store.lasting:
            hint += f", then there: {RESET} --bench {in_shell(self._bench.plan.source)}"
        return InterlockError(what, f"{hint}; then start again")


def _hold(declared: InterlockSettings) -> str:
    return f"the interlock {declared.name} ({declared.kind}) is open"


@contextmanager
def watched(
    plan: BenchPlan,
    records: InterlockStore,
    in_each_wait: Callable[[], None] = lambda: None,
    looks_only: bool = False,
) -> Iterator[InterlockWatch]:
    """Connect to the instruments that read contacts, and to no other, and watch in real time within
    the block. Nothing is armed. The caller holds the bench's lock.

    The levels are known when the block begins. Raises RigError if an instrument cannot be
    connected to.
    """
    roles = {contact.role for contact in plan.settings.interlock}
    needed = tuple(part for part in plan.instruments if part.role in roles)
    clock = WallClock()
    with ExitStack() as at_the_end:
        bench = connect(replace(plan, instruments=needed), clock)
        at_the_end.callback(bench.close)
        watch = InterlockWatch(bench, Holds(), list, records, looks_only=looks_only)
        at_the_end.callback(watch.end)
        watch.begin()
        clock.each_slice(in_each_wait)
        if looks_only:
            clock.sleep(2 * STEADY_S)  # until it is known which contacts are closed
        yield watch
