"""The dialogue of weighing, step by step: instruction, answer, reading, repetition.

The person is asked on stderr and answers on stdin. On a simulated bench the bench itself puts the
weights on.
"""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rig.cli.outcome import say
from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.run.streams.scales import RejectedError, Scale

if TYPE_CHECKING:
    from rig.analysis.weighing import Mean
    from rig.core.clock import Clock

Vector = tuple[float, float, float]

LOOK_EVERY_S = 0.02
TRIES_ALONE = 3
"""Number of rejected readings of one step after which weighing without a person ends."""


class QuitError(RigError):
    """Raised when the person at the terminal quits."""

    code = ExitCode.SIGINT


class WeighingOperator:
    """Asks the person at stdin to put the weights on; on a simulated bench the bench does it."""

    def __init__(self, check_stop: Callable[[], None], present: bool):
        self._check_stop = check_stop
        self.present = present
        self._typed = b""

    def asked(self, text: str, repeatable: bool) -> bool:
        """Ask to continue; return False to repeat the previous reading. Raises QuitError for q."""
        if not self.present:
            say(text)
            return True
        choices = "Enter" + (", r repeats the previous reading" if repeatable else "") + ", q quits"
        while True:
            say(f"{text} [{choices}]")
            answer = self._line().strip().lower()
            if answer == "q":
                raise QuitError("stopped with q")
            if answer == "" or (answer == "r" and repeatable):
                return answer == ""
            say(f"{answer!r} is not an answer")

    def _line(self) -> str:
        """Return the next line of stdin, checking for stop signals every 20 ms."""
        while b"\n" not in self._typed:
            self._check_stop()
            if not select.select([sys.stdin], [], [], LOOK_EVERY_S)[0]:
                continue
            typed = os.read(sys.stdin.fileno(), 1024)
            if not typed:
                raise QuitError("stopped: the input ended")
            self._typed += typed
        line, self._typed = self._typed.split(b"\n", 1)
        return line.decode(errors="replace")


def weigh(
    forces_N: Sequence[Vector], scale: Scale, person: WeighingOperator, clock: Clock
) -> list[Mean]:  # fmt: skip
    """Return a reading under each of the known forces, in this order; the latest one may be
    repeated.

    Raises QuitError where the person quits. Without a person it raises ConfigurationError where the
    weights cannot be put on by the bench itself, and RejectedError after several bad readings. The
    message of each says that the readings so far are not kept.
    """
    means: list[Mean] = []
    try:
        return _weigh(forces_N, scale, person, clock, means)
    except RigError as error:
        if means:
            error.message += f"; the readings taken so far ({len(means)}) are not kept"
        raise


def _weigh(
    forces_N: Sequence[Vector],
    scale: Scale,
    person: WeighingOperator,
    clock: Clock,
    means: list[Mean],
) -> list[Mean]:
    """Return `means` once it has a reading under each of the forces."""
    largest_N = max(abs(value) for force in forces_N for value in force)
    rejected = 0
    while True:
        done = len(means)
        if done == len(forces_N):
            if person.asked("all readings are done; next: fit, and write the record", done > 0):
                return means
            means.pop()
            continue
        instruction = f"{done + 1}/{len(forces_N)}: {instruction_for(forces_N[done])}"
        if not person.asked(instruction, done > 0):
            means.pop()
            continue
        if not clock.act("weigh", force_N=list(forces_N[done])) and not person.present:
            raise ConfigurationError(
                "no person is there to put the weights on", "run it at a terminal"
            )
        try:
            mean = scale.read(largest_N)
        except RejectedError as error:
            rejected += 1
            if not person.present and rejected >= TRIES_ALONE:
                raise
            say(f"reading rejected: {error.one_line()}; the same step again")
            continue
        rejected = 0
        means.append(mean)
        say(f"  {scale.in_words(mean)}")


def instruction_for(force_N: Vector) -> str:
    """Return the instruction which weight to put on the sensor."""
    for axis, value in zip("xyz", force_N, strict=True):
        if value:
            return f"put {abs(value):g} N on {'+' if value > 0 else '-'}{axis}"
    return "take all weights off"
