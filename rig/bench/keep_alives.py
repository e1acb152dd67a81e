"""Words that drives with a communication time-out wait for, said from the slices of a wait."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping

from rig.core.clock import Clock
from rig.core.errors import InstrumentError

FEED_EVERY_S = 0.05
"""Wall time between two looks of a thread whether its drive has to be fed."""


class KeepAlives:
    """Feeds the communication time-outs of the drives, by role, before every slice of a wait.

    What a drive says then ends the wait. While the bench is made safe it does not: a drive that
    does not answer is fed no more, so that it stops by itself and keeps no other from being brought
    to rest; its own off tells. And in real time a thread for each drive feeds it then: an off that
    waits for a silent drive would else let the others meet their time-outs, the skin still pressed.
    """

    def __init__(self) -> None:
        self._feeds: dict[str, Callable[[], None]] = {}
        self._making_safe = False
        self._by_threads = False
        self._given_up: set[str] = set()
        self._left: dict[str, Callable[[], bool]] = {}
        """By role, whether somebody else talks to the drive just now."""

    def add(self, role: str, feed: Callable[[], None]) -> None:
        """Talk to this drive, too."""
        self._feeds[role] = feed

    def feed(self) -> None:
        """Talk to every drive that nobody else talks to."""
        for role in () if self._by_threads else tuple(self._feeds):
            if role not in self._left or not self._left[role]():
                self._feed(role)

    @contextlib.contextmanager
    def left_to(self, others: Mapping[str, Callable[[], bool]]) -> Iterator[None]:
        """Within it the drives of these roles are not talked to while somebody else does: a silent
        one would be waited for here as well, and the others starve meanwhile."""
        self._left = dict(others)
        try:
            yield
        finally:
            self._left = {}

    def _feed(self, role: str) -> None:
        given_up = self._given_up  # of this clean-up: one that ends meanwhile leaves it behind
        if role in given_up:
            return
        try:
            self._feeds[role]()
        except InstrumentError:
            if not self._making_safe:
                raise
            given_up.add(role)

    @contextlib.contextmanager
    def while_making_safe(self, clock: Clock) -> Iterator[None]:
        """Within it no drive ends another one's wait; in real time threads feed them, which end by
        themselves, at the latest with a drive's time-out."""
        self._making_safe, over = True, threading.Event()
        self._by_threads = not clock.stands
        for role in self._feeds if self._by_threads else ():
            given = (role, clock, over)
            threading.Thread(
                target=self._feed_until, args=given, name=f"feed {role}", daemon=True
            ).start()
        try:
            yield
        finally:
            over.set()
            self._making_safe = self._by_threads = False
            self._given_up = set()

    def _feed_until(self, role: str, clock: Clock, over: threading.Event) -> None:
        with clock.aside(), contextlib.suppress(Exception):  # its own off tells
            while not over.wait(FEED_EVERY_S):
                self._feed(role)
