"""Piecewise linear courses over time, and the moves of a stage that follow one.

Times in s from the beginning of the motion, positions in mm from where the trial begins.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass


@dataclass(frozen=True)
class Course:
    """Values at given times, ascending from 0, with linear interpolation; without any, constant."""

    times_s: tuple[float, ...]
    values: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        """Time of the last value, 0 without any."""
        return self.times_s[-1] if self.times_s else 0.0

    def at(self, time_s: float, otherwise: float) -> float:
        """Return the value at a time in s, in the course's unit: the first one before the course,
        the last one after it; `otherwise` for a course without values.

        >>> Course((0.0, 1.0, 2.0), (1.0, 3.0, 3.0)).at(0.5, 0.0)
        2.0
        """
        if not self.times_s:
            return otherwise
        after = bisect_right(self.times_s, time_s)
        if after in (0, len(self.times_s)):
            return self.values[min(after, len(self.times_s) - 1)]
        t0, t1 = self.times_s[after - 1 : after + 1]
        v0, v1 = self.values[after - 1 : after + 1]
        return v0 + (v1 - v0) * (time_s - t0) / (t1 - t0)


@dataclass(frozen=True)
class PathMove:
    """A move of a stage along a course: when it is due, to where and how fast."""

    at_s: float
    """Time at which it is due."""
    to_mm: float
    speed_mm_s: float


def moves_along(course: Course) -> tuple[PathMove, ...]:
    """Return the moves that make a stage follow a course: one at every corner after which it moves.

    Each goes to where the course next turns or rests, not only to the next corner: a stage stops at
    the target of a move, and a course that only changes its speed must not stop it. Where the
    course rests nothing is commanded; the stage stops there by itself.

    >>> [move.to_mm for move in moves_along(Course((0.0, 1.0, 2.0, 3.0), (0.0, 2.0, 3.0, 1.0)))]
    [3.0, 3.0, 1.0]
    """
    times, values = course.times_s, course.values
    moves = []
    for k in range(len(times) - 1):
        change = values[k + 1] - values[k]
        if not change:
            continue
        end = k + 1
        while end + 1 < len(values) and (values[end + 1] - values[end]) * change > 0:
            end += 1
        speed_mm_s = abs(change) / (times[k + 1] - times[k])
        moves.append(PathMove(times[k], values[end], speed_mm_s))
    return tuple(moves)
