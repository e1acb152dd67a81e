"""Watches the interlock contacts of a bench while a command uses it.

In real time each instrument with contacts is read by a thread of its own, so that one that does not
answer delays no other, and a further thread judges: what is open, and what has not been read for
too long. When a person's contact opens, that thread runs the emergency actions of everything that
is armed, records the latch, and keeps the reason, which the procedure's next wait raises. In
virtual time all of it is done in each slice of a wait.

The states are those of `rig.control.interlock`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial

from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.interlocks import InterlockSettings, by_role
from rig.bench.plan import BenchPlan
from rig.control.interlock import STEADY_S, Contact, ContactEvent, InterlockState
from rig.core.clock import WallClock
from rig.core.errors import ExitCode, InstrumentError, RigError
from rig.core.threads import start_thread
from rig.instruments.roles import ReadsInputs
from rig.run.holds import Holds
from rig.run.interlock_store import InterlockStore

READ_EVERY_S = 0.02
"""Interval between two readings of the contacts of one instrument, where its driver's
``INPUTS_EVERY_S`` is not longer."""
FRESH_S = 0.6
"""Longest wait for a reading that is newer than a failure: longer than it takes a contact that is
not read to count as open."""
AGAIN_S = 1.0
"""Time after which an instrument that did not answer is read again in virtual time."""
PROOF_S = 120.0
"""Time that a person has to open a contact for a proof test, and again to close it."""
CLOSE_S = 2 * STEADY_S
"""Time within which a contact that is to be reset has to be seen closed."""
LOOK_EVERY_S = 0.05
RESET = "rig interlocks reset"


_AT_REST = (InterlockState.CLOSED, InterlockState.RELEASED)


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
        self._holds, self._act, self._store, self._note = holds, act, store, note
        self._declared = {one.name: one for one in bench.settings.interlock}
        self._looks_only = looks_only
        self._contacts: dict[str, Contact] = {}
        self._by_role = by_role(bench.settings.interlock)
        self._failed: dict[str, str] = {}
        """Reason why an instrument's inputs could not be read the last time, by role."""
        self._reasons: dict[str, str] = {}
        """Reason why each latched contact is latched, in words."""
        self._unread: set[str] = set()
        """Contacts that count as open because they could not be read."""
        self._proving: str | None = None
        """Contact whose proof test is under way: it is opened on purpose."""
        self._told: set[str] = set()
        """Latched contacts that have been raised or returned."""
        self._news: list[tuple[str, str]] = []
        """Events that the procedure's thread has not recorded yet: level and message."""
        self._unkept: list[RigError] = []
        self._lock = threading.RLock()
        """Held while the state of a contact changes, and until what follows from it is done."""
        self._changed = threading.Condition()
        self._turns = 0
        self._opened = threading.Event()
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []
        self._read_at_s: dict[str, float] = {}
        self._every_s = {
            part.role: max(READ_EVERY_S, getattr(part.driver, "INPUTS_EVERY_S", 0.0))
            for part in bench.plan.instruments
        }
        """Interval between two readings, by role."""
        self._failed_at_s = float("-inf")
        self._reading = self._begun = False

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
        be written. What a contact hinders is raised by `check`.
        """
        if not self._declared:
            return
        if not self._looks_only:
            self._store.check_writable()
        now_s = self._clock.now()
        for name, declared in self._declared.items():
            latched = self._store.get(name)
            if latched.opened is not None:
                self._reasons[name] = f"{latched.why} ({latched.opened})"
            self._contacts[name] = Contact(
                name, declared.kind, now_s, latched=latched.opened is not None
            )
        for role in self._by_role:
            self._read(role)
        self._begun = True
        if self._clock.is_virtual:
            return
        for role in self._by_role:
            self._start(f"interlocks {role}", partial(self._keep_reading, role))
        self._start("interlocks", self._keep_judging)

    def end(self) -> None:
        """End the watch; does nothing if it was not begun."""
        self._ending.set()
        self._opened.set()
        for thread in self._threads:
            thread.join(FRESH_S)
        self._begun = False

    # --- in the procedure's thread --------------------------------------------------------------

    def poll(self) -> None:
        """Called in every slice of a wait, in any phase: look at the contacts, and let what follows
        from an open one happen. Raises nothing."""
        if not self._begun or self._reading:
            return
        if self._clock.is_virtual:
            self._read_all(when_due=True)
        self._judge()
        self._tell()

    def check(self) -> None:
        """Raise InterlockError, every time, as long as a person's contact is latched."""
        with self._lock:
            for name, contact in self._contacts.items():
                if contact.latched and name != self._proving:
                    raise self._error(name)

    def news(self) -> InterlockError | None:
        """Return, once, what `check` raises, unless it has raised it before."""
        with self._lock:
            for name, contact in self._contacts.items():
                if contact.latched and name not in self._told:
                    return self._error(name)
        return None

    def settle(self) -> None:
        """Wait until every contact has been read after this call, or counts as open: before a
        failure is handled it has to be known whether a contact has caused it."""
        if not self._begun:
            return
        if self._clock.is_virtual:
            self._read_all()
        else:
            with self._changed:
                awaited = self._turns + 2 * len(self._by_role)
                self._changed.wait_for(lambda: self._turns >= awaited, FRESH_S)
        self._judge()
        self._tell()

    def reset(self, name: str) -> None:
        """End the latch of a contact, here and in its record. Nothing may be armed.

        Raises InterlockError if the contact is open or has not been closed for `STEADY_S`, RigError
        if the record cannot be written.
        """
        if not self._await(name, lambda contact: contact.state is InterlockState.RELEASED, CLOSE_S):
            raise InterlockError(f"interlock {name} is {self.level(name)}", "close it first")
        self._store.reset(name)
        with self._lock:
            self._contacts[name].reset()

    def prove(self, name: str, say: Callable[[str], None]) -> None:
        """Have a person open and close a contact, and record that both were seen. Nothing may be
        armed. `say` shows what the person is to do.

        Raises InterlockError if the contact is latched, or does not open or close in time.
        """
        if self._store.get(name).opened is not None:
            raise self._error(name)
        self._proving = name
        try:
            if not self._await_closed(name):
                say(f"interlock {name} is {self.level(name)}: close it first")
            self._require_closed(name)
            say(f"proof test of interlock {name}: open it (within {PROOF_S:g} s)")
            if not self._await(name, lambda contact: contact.hinders and contact.readable, PROOF_S):
                raise InterlockError(
                    f"interlock {name} was not seen to open within {PROOF_S:g} s",
                    "the contact may be welded or bridged: repair it, then start again",
                )
            say(f"interlock {name} is seen to be open: close it (within {PROOF_S:g} s)")
            self._require_closed(name)
        finally:
            self._proving = None
        self._store.prove(name)
        self._note("info", "interlock", f"interlock {name} was seen to open and to close")
        say(f"interlock {name} opens and closes: recorded")

    def _await_closed(self, name: str, seconds: float = 0.0) -> bool:
        """Wait until a contact is closed; return whether it is in time. During its proof test only:
        the opening before was meant, and is forgotten."""
        if not self._await(name, lambda contact: contact.state in _AT_REST, seconds):
            return False
        with self._lock:
            if self._contacts[name].latched:
                self._contacts[name].reset()
        return True

    def _require_closed(self, name: str) -> None:
        if not self._await_closed(name, PROOF_S):
            raise InterlockError(
                f"interlock {name} was not seen to close within {PROOF_S:g} s",
                "close it, look at its wire and its switch, then start again",
            )

    def _await(self, name: str, seen: Callable[[Contact], bool], seconds: float) -> bool:
        """Wait until a contact is as it should be; return whether it is in time."""
        end_s = self._clock.now() + seconds
        while not seen(self._contacts[name]):
            if self._clock.now() > end_s:
                return False
            self._clock.sleep(LOOK_EVERY_S)
        return True

    def level(self, name: str) -> str:
        """Return in words how a contact stands."""
        contact = self._contacts[name]
        if not contact.readable:
            return f"not readable ({self._failed.get(self._declared[name].role, 'no answer')})"
        return "closed" if contact.state in _AT_REST else "open"

    def failures(self) -> list[RigError]:
        """Return, once, why latches could not be recorded."""
        failures, self._unkept = self._unkept, []
        return failures

    # --- reading and judging --------------------------------------------------------------------

    def _start(self, name: str, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work, name=name, daemon=True)
        start_thread(thread)
        self._threads.append(thread)

    def _keep_reading(self, role: str) -> None:
        with self._clock.in_background():
            while not self._ending.wait(self._every_s[role]):
                self._try_to_read(role)
                with self._changed:
                    self._turns += 1
                    self._changed.notify_all()

    def _keep_judging(self) -> None:
        with self._clock.in_background():
            while not self._ending.is_set():
                self._opened.wait(READ_EVERY_S)
                self._opened.clear()
                self._judge()

    def _read_all(self, when_due: bool = False) -> None:
        self._reading = True  # A link's time-out lets bench time pass, and this is called again.
        try:
            now_s = self._clock.now()
            for role in self._by_role:
                age_s = now_s - self._read_at_s.get(role, float("-inf"))
                if when_due and age_s < self._every_s[role]:
                    continue
                self._read_at_s[role] = now_s
                if self._worth_reading(role, now_s):
                    self._try_to_read(role)
        finally:
            self._reading = False

    def _worth_reading(self, role: str, now_s: float) -> bool:
        """Return whether to read an instrument in virtual time, where one that does not answer
        holds up everything else: not if all its contacts are latched, which ends the run, and not
        too soon after it did not answer."""
        contacts = (self._contacts[one.name] for one in self._by_role[role])
        if self._proving is None and all(contact.latched for contact in contacts):
            return False
        return role not in self._failed or now_s >= self._failed_at_s + AGAIN_S

    def _try_to_read(self, role: str) -> None:
        try:
            self._read(role)
            self._failed.pop(role, None)
        except RigError as error:
            self._failed[role] = error.one_line()
            self._failed_at_s = self._clock.now()
        except Exception as error:  # noqa: BLE001 - a driver's bug must not end the watch
            self._failed[role] = f"{type(error).__name__}: {error}"

    def _read(self, role: str) -> None:
        """Read the contacts of one instrument. Raises InstrumentError."""
        instrument = self._bench.instruments[role]
        if not isinstance(instrument, ReadsInputs):
            raise InstrumentError(role, "read inputs", "its driver does not read inputs")
        declared = self._by_role[role]
        levels = instrument.inputs_high([one.line for one in declared])
        for one in declared:
            self._take_in(one, levels[one.line])

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
                self._store.latch(name, why)
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
        cause = self._failed.get(declared.role, f"{declared.role} does not answer in time")
        return f"{what} cannot be read {at}, which counts as open: {cause}"

    def _tell(self) -> None:
        """Record what has happened; from the procedure's thread."""
        with self._lock:
            news, self._news = self._news, []
        for level, message in news:
            self._note(level, "interlock", message)

    def _error(self, name: str) -> InterlockError:
        self._told.add(name)
        what = self._reasons.get(name, f"interlock {name} (person) opened")
        hint = "check the bench and close it"
        if name in self._unread:
            hint = f"check {self._declared[name].role}, which reads it, and that it is closed"
        if self._store.lasting:
            hint += f", then there: {RESET} --bench {self._bench.plan.source}"
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
            clock.sleep(CLOSE_S)
        yield watch
