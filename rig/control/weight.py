"""Finds out since when a weight rests on the contact that carries it. Numbers only."""

from __future__ import annotations

from collections import deque

RESTING_S = 0.2
"""Time over which a weight is judged to rest."""
CARRIED = 0.95
"""Share of the weight that a contact carries at least, on average, for the weight to rest."""
AT_REST = 0.25
"""Share of its largest speed at which a weight is not yet taken to fall. A weight that slides
without end takes the whole of it: the stage follows what is missing of the force."""


class RestingWeight:
    """Since when a weight of `load_N`, which falls with `largest_mm_s` at most, has rested; one
    `add` per tick.

    >>> weight = RestingWeight(load_N=3.0, largest_mm_s=1.0)
    >>> for tick in range(40):
    ...     weight.add(0.01 * tick, force_N=3.0, travel_mm=0.05)
    >>> weight.rested_s
    0.39
    >>> weight.add(0.40, force_N=1.0, travel_mm=0.5)
    >>> weight.rested_s
    0.0
    """

    def __init__(self, load_N: float, largest_mm_s: float):
        self.load_N, self.largest_mm_s = load_N, largest_mm_s
        self._latest: deque[tuple[float, float, float]] = deque()
        self._since_s: float | None = None
        self.rested_s = 0.0
        """Time in s for which the weight has rested without a break until now."""

    def add(self, at_s: float, force_N: float, travel_mm: float) -> None:
        """Judge the weight at `at_s` by the tangential force and the way of x."""
        self._latest.append((at_s, force_N, travel_mm))
        while len(self._latest) > 1 and at_s - self._latest[1][0] >= RESTING_S:
            self._latest.popleft()
        first_s, _, first_mm = self._latest[0]
        span_s = at_s - first_s
        mean_N = sum(force for _, force, _ in self._latest) / len(self._latest)
        rests = (
            span_s >= RESTING_S
            and mean_N >= CARRIED * self.load_N
            and abs(travel_mm - first_mm) <= AT_REST * self.largest_mm_s * span_s
        )
        if not rests:
            self._since_s = None
        elif self._since_s is None:
            self._since_s = first_s
        self.rested_s = 0.0 if self._since_s is None else at_s - self._since_s
