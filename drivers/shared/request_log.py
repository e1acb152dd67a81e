"""Whose silence a drive's communication time-out was: this program's, or the connection's.

A drive that reports its communication time-out has received no request for that long. Either none
was sent, because the procedure hung, waited for another instrument beyond its bound or the computer
stood still; or they were sent and did not arrive.
"""

from __future__ import annotations

from rig.core.clock import Clock, suspended_s

REMEMBERED_S = 30.0
"""Age in s up to which a pause explains a time-out that is read now."""


class RequestLog:
    """The pauses between the requests to a drive, or to all drives of a line, by bench time."""

    def __init__(self, clock: Clock):
        self._clock = clock
        self._latest_s: float | None = None
        self._pause: tuple[float, float] = (0.0, 0.0)
        """The longest pause that is remembered, and when it ended."""

    def note(self) -> None:
        """Note that a request is being sent."""
        now_s = self._clock.now()
        if not self._clock.is_virtual:
            now_s += suspended_s()  # the drive's time-out runs on meanwhile
        pause_s = 0.0 if self._latest_s is None else now_s - self._latest_s
        longest_s, ended_s = self._pause
        if pause_s >= longest_s or now_s - ended_s > REMEMBERED_S:
            self._pause = pause_s, now_s
        self._latest_s = now_s

    def whose_silence(self, timeout_s: float) -> str:
        """Return, for the end of a sentence on the drive's time-out, whose silence it was."""
        pause_s, ended_s = self._pause
        if pause_s < timeout_s:
            return (
                f"requests were sent every {pause_s:.2g} s or more often and did not reach it: the "
                "connection was silent"
            )
        if (what := self._what_hung(ended_s - pause_s, ended_s)) is not None:
            return f"this program sent it nothing for {pause_s:.2g} s: it waited for {what}"
        waited = self._clock.overdue
        # A wait much shorter than the pause did not cause it, or the computer was suspended.
        if waited is None or waited[1] < 0.5 * pause_s:
            why = "the procedure hung, or the computer stood still or was suspended"
        else:
            instrument, waited_s = waited
            why = f"the procedure waited for {instrument}, without an answer for {waited_s:.2g} s"
        return f"this program sent it nothing for {pause_s:.2g} s: {why}"

    def _what_hung(self, begun_s: float, ended_s: float) -> str | None:
        """Return what has kept the procedure from its next wait in a pause; None if that is not
        known."""
        if self._clock.hung is None:
            return None
        what, found_s = self._clock.hung
        if not self._clock.is_virtual:
            found_s += suspended_s()
        return what if begun_s <= found_s <= ended_s else None
