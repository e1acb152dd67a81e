"""Words that drives with a communication time-out wait for, said from the slices of a wait."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rig.errors import InstrumentError


class KeepAlives:
    """Feeds the communication time-outs of the drives, by role, before every slice of a wait.

    What a drive says then ends the wait. While the bench is made safe it does not: a drive that
    does not answer is fed no more, so that it stops by itself and keeps no other from being brought
    to rest; its own off tells.
    """

    def __init__(self) -> None:
        self._feeds: dict[str, Callable[[], None]] = {}
        self._making_safe = False
        self._given_up: set[str] = set()

    def add(self, role: str, feed: Callable[[], None]) -> None:
        """Talk to this drive, too."""
        self._feeds[role] = feed

    def feed(self) -> None:
        """Talk to every drive."""
        for role, feed in tuple(self._feeds.items()):
            if role in self._given_up:
                continue
            try:
                feed()
            except InstrumentError:
                if not self._making_safe:
                    raise
                self._given_up.add(role)

    @contextlib.contextmanager
    def while_making_safe(self) -> Iterator[None]:
        """Within it no drive ends another one's wait."""
        self._making_safe = True
        try:
            yield
        finally:
            self._making_safe = False
            self._given_up.clear()
