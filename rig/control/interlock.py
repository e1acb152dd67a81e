"""The states of an interlock contact: a pure state machine, without clock, thread, input or output.

A contact is a switch that is closed while all is well: a door's, an e-stop's second contact, a
light curtain's relay. What follows when it opens depends on its class:

process   a condition of the process, such as an air pressure. While it is open the run is on
          hold; when it has been closed for `STEADY_S` the run arms again by itself.
person    a person may be within reach. It latches. Before anything moves again, the contact has
          to be closed, a person has to reset it at the bench, and a command has to be started
          there. Neither a batch nor a page nor another client can do that.

The level is judged, not its change: `blocks_motion` is the state as it is now. A contact
that cannot be read for `UNREAD_S` counts as open.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Literal

ContactClass = Literal["person", "process"]

STEADY_S = 0.5
"""Time for which a contact has to read closed without a break before it counts as closed again: a
bouncing one does not."""
UNREAD_S = 0.5
"""Time without a reading after which a contact counts as open."""


class InterlockState(Enum):
    """The state of an interlock's contact, latching included."""

    CLOSED = "closed"
    """All is well."""
    OPEN = "open"
    """A contact of the process: open, or not yet closed for long enough."""
    OPENED = "opened"
    """A contact of a person: latched, and open or not yet closed for long enough."""
    RELEASED = "closed again, not reset"
    """A contact of a person: latched, and closed again."""


class ContactEvent(Enum):
    """What can change the state of a contact."""

    OPENS = "opens"
    CLOSES = "closes"
    """The contact has been closed for `STEADY_S`."""
    RESET = "reset"
    """A person at the bench resets it."""


Transitions = Mapping[tuple[InterlockState, ContactEvent], InterlockState]

TRANSITIONS: Mapping[ContactClass, Transitions] = {
    "process": {
        (InterlockState.CLOSED, ContactEvent.OPENS): InterlockState.OPEN,
        (InterlockState.OPEN, ContactEvent.CLOSES): InterlockState.CLOSED,
    },
    "person": {
        (InterlockState.CLOSED, ContactEvent.OPENS): InterlockState.OPENED,
        (InterlockState.OPENED, ContactEvent.CLOSES): InterlockState.RELEASED,
        (InterlockState.RELEASED, ContactEvent.OPENS): InterlockState.OPENED,
        (InterlockState.RELEASED, ContactEvent.RESET): InterlockState.CLOSED,
    },
}
"""The state that follows, by class, state and event. An event that is not listed changes nothing;
`Contact.reset` raises for one that is not listed, so that an open contact is never reset."""

LATCHED = frozenset({InterlockState.OPENED, InterlockState.RELEASED})


class Contact:
    """One contact, as its readings and the time show it. Times are in seconds of any one clock."""

    def __init__(self, name: str, kind: ContactClass, now_s: float, latched: bool = False):
        """Begin with a closed contact that was read just now, or with one that an earlier opening
        has `latched` and that has not been read yet."""
        self.name, self.kind = name, kind
        self.state = InterlockState.OPENED if latched else InterlockState.CLOSED
        self.readable = True
        """False if it counts as open because it has not been read for `UNREAD_S`."""
        self._read_s = now_s
        self._closed_since_s: float | None = None if latched else now_s

    @property
    def blocks_motion(self) -> bool:
        """True if nothing may move because of this contact."""
        return self.state is not InterlockState.CLOSED

    @property
    def latched(self) -> bool:
        """True if only a reset by a person ends what this contact has begun."""
        return self.state in LATCHED

    def read(self, closed: bool, now_s: float) -> ContactEvent | None:
        """Take in a reading; return the event that it is, if it changes the state."""
        self._read_s, self.readable = now_s, True
        if not closed:
            self._closed_since_s = None
            return self._happens(ContactEvent.OPENS)
        if self._closed_since_s is None:
            self._closed_since_s = now_s
        if now_s - self._closed_since_s >= STEADY_S:
            return self._happens(ContactEvent.CLOSES)
        return None

    def judge(self, now_s: float) -> ContactEvent | None:
        """Look at the age of the latest reading; return OPENS if the contact counts as open from
        now on because it could not be read."""
        if now_s - self._read_s <= UNREAD_S:
            return None
        self.readable = False
        self._closed_since_s = None
        return self._happens(ContactEvent.OPENS)

    def reset(self) -> None:
        """End the latch. Raises ValueError if the contact is not latched, or is open."""
        state = TRANSITIONS[self.kind].get((self.state, ContactEvent.RESET))
        if state is None:
            raise ValueError(f"a contact that is {self.state.value} cannot be reset")
        self.state = state

    def _happens(self, event: ContactEvent) -> ContactEvent | None:
        state = TRANSITIONS[self.kind].get((self.state, event))
        if state is None:
            return None
        self.state = state
        return event
