"""Reads the interlock contacts of a bench's instruments, again and again.

In real time each instrument is read by a thread of its own, so that one that does not answer delays
no other. In virtual time the procedure's thread reads them in its waits.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial

from rig.bench.connected import Bench
from rig.bench.interlocks import InterlockSettings, by_role
from rig.core.errors import InstrumentError, RigError
from rig.core.threads import start_thread
from rig.instruments.roles import ReadsInputs

READ_EVERY_S = 0.02
"""Interval between two readings of the contacts of one instrument, where its driver's
``INPUTS_EVERY_S`` is not longer."""
FRESH_S = 0.6
"""Longest wait for a reading that is newer than a failure: longer than it takes a contact that is
not read to count as open."""
AGAIN_S = 1.0
"""Time after which an instrument that did not answer is read again in virtual time."""

AreNeeded = Callable[[Sequence[InterlockSettings]], bool]
"""Tells whether any contact of one instrument is needed."""


class ContactReadings:
    """Reads all contacts; `take_in` is called with each contact and whether its line is high."""

    def __init__(self, bench: Bench, take_in: Callable[[InterlockSettings, bool], None]):
        self._bench, self._clock, self._take_in = bench, bench.clock, take_in
        self._by_role = by_role(bench.settings.interlock)
        self._every_s = {
            part.role: max(READ_EVERY_S, getattr(part.driver, "INPUTS_EVERY_S", 0.0))
            for part in bench.plan.instruments
        }
        """Interval between two readings, by role."""
        self._read_at_s: dict[str, float] = {}
        self._failed: dict[str, str] = {}
        """Reason why an instrument's inputs could not be read the last time, by role."""
        self._failed_at_s = float("-inf")
        self.under_way = False
        """True while `read` is at work. A link's time-out lets bench time pass, in which others
        are called."""
        self._changed = threading.Condition()
        self._read = dict.fromkeys(self._by_role, 0)
        """Number of readings by each thread that did not fail, by role."""
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []

    def begin(self) -> None:
        """Read every contact once; in real time, go on reading. Raises InstrumentError if one
        cannot be read."""
        for role in self._by_role:
            self._read_instrument(role)
        if self._clock.is_virtual:
            return
        for role in self._by_role:
            work = partial(self._keep_reading, role)
            thread = threading.Thread(target=work, name=f"interlocks {role}", daemon=True)
            start_thread(thread)
            self._threads.append(thread)

    def end(self) -> None:
        """End the threads."""
        self._ending.set()
        for thread in self._threads:
            thread.join(FRESH_S)

    def failure(self, role: str) -> str | None:
        """Return why an instrument's contacts could not be read the last time; None if they
        were."""
        return self._failed.get(role)

    def read(self, are_needed: AreNeeded, all_now: bool) -> None:
        """Read the instruments whose turn it is, or with `all_now` all; in virtual time only, where
        one that does not answer holds up everything else. Left out are those of whose contacts none
        is needed, and one that has not answered, for `AGAIN_S`."""
        self.under_way = True
        try:
            now_s = self._clock.now()
            for role, contacts in self._by_role.items():
                age_s = now_s - self._read_at_s.get(role, float("-inf"))
                if not all_now and age_s < self._every_s[role]:
                    continue
                self._read_at_s[role] = now_s
                is_silent = role in self._failed and now_s < self._failed_at_s + AGAIN_S
                if are_needed(contacts) and not is_silent:
                    self._try_to_read(role)
        finally:
            self.under_way = False

    def await_new(self, are_needed: AreNeeded) -> None:
        """Wait until every instrument has been read after this call, `FRESH_S` at most; in real
        time only. Left out are those of whose contacts none is needed.

        The first reading to come may have begun before the call. One that fails does not count.
        """
        with self._changed:
            awaited = {
                role: self._read[role] + 2
                for role, contacts in self._by_role.items()
                if are_needed(contacts)
            }
            self._changed.wait_for(
                lambda: all(self._read[role] >= number for role, number in awaited.items()), FRESH_S
            )

    def _keep_reading(self, role: str) -> None:
        with self._clock.in_background():
            while not self._ending.wait(self._every_s[role]):
                if self._try_to_read(role):
                    with self._changed:
                        self._read[role] += 1
                        self._changed.notify_all()

    def _try_to_read(self, role: str) -> bool:
        """Read the contacts of one instrument; return whether they could be read."""
        try:
            self._read_instrument(role)
            self._failed.pop(role, None)
            return True
        except RigError as error:
            self._failed[role] = error.one_line()
            self._failed_at_s = self._clock.now()
        except Exception as error:  # noqa: BLE001 - a driver's bug must not end the watch
            self._failed[role] = f"{type(error).__name__}: {error}"
        return False

    def _read_instrument(self, role: str) -> None:
        """Read the contacts of one instrument. Raises InstrumentError."""
        instrument = self._bench.instruments[role]
        if not isinstance(instrument, ReadsInputs):
            raise InstrumentError(role, "read inputs", "its driver does not read inputs")
        declared = self._by_role[role]
        levels = instrument.inputs_high([one.line for one in declared])
        for one in declared:
            self._take_in(one, levels[one.line])
