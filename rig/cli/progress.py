"""Progress of long computations on stderr, in plain lines."""

from __future__ import annotations

import math
import time

from rig.cli.outcome import say

PROGRESS_S = 10.0
"""Time between two reports of the trials on the simulated bench."""


class TenthsProgress:
    """Reports on stderr after each tenth how many of the things of a command are done.

    `what` names the things, `total` is their number where it is known before.
    """

    def __init__(self, command: str, what: str, total: int | None = None):
        self._command, self._what, self._total = command, what, total

    def __call__(self, number: int, total: int | None = None) -> None:
        total = self._total if total is None else total
        assert total is not None
        if number * 10 // total != (number - 1) * 10 // total:
            say(f"{self._command}: {number} of {total} {self._what}")


class WireProgress:
    """Reports progress on stderr every ten seconds, with the time left at the pace so far."""

    def __init__(self, command: str, jobs: int):
        self.number, self._command = 0, command
        self._begun_s = self._said_s = time.monotonic()
        say(f"{command}: making trials on the simulated bench, {jobs} at a time")

    def __call__(self, number: int, total: int, made: int) -> None:
        self.number, now_s = number, time.monotonic()
        if now_s - self._said_s < PROGRESS_S and number < total:
            return
        self._said_s = now_s
        left = ""
        if made and number < total:
            left_s = (now_s - self._begun_s) / made * (total - number)
            left = f", about {math.ceil(left_s / 60)} min left"
        say(f"{self._command}: {number} of {total} trials, {made} of them made now{left}")
