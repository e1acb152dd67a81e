"""A value with its standard error and 95 % interval: what an analysis states about a quantity."""

from __future__ import annotations

import math
from dataclasses import dataclass

COVERAGE_95 = 1.959964
"""Standard errors on either side of a normal estimate that hold 95 % of the cases."""


MOST_DIGITS = 12
"""After the point."""


def with_error(value: float, half_width: float) -> str:
    """A value to the second figure of its half-width, never a half-width of zero."""
    if not (math.isfinite(half_width) and half_width > 0):
        return f"{value:+.6g}"
    digits = min(max(1 - math.floor(math.log10(half_width)), 0), MOST_DIGITS)
    return f"{value:+.{digits}f} ± {half_width:.{digits}f}"


@dataclass(frozen=True)
class Estimate:
    """A quantity in ``unit``: value, standard error, and the interval that covers it in 95 %."""

    value: float
    standard_error: float
    low: float
    high: float
    unit: str

    @classmethod
    def normal(cls, value: float, standard_error: float, unit: str) -> Estimate:
        """An estimate whose error is normal on its own scale."""
        half = COVERAGE_95 * standard_error
        return cls(value, standard_error, value - half, value + half, unit)

    @classmethod
    def of_logarithm(cls, logarithm: float, standard_error: float, unit: str) -> Estimate:
        """exp of a natural logarithm with a normal error: the interval is skew, never negative."""
        value = math.exp(logarithm)
        half = COVERAGE_95 * standard_error
        low, high = math.exp(logarithm - half), math.exp(min(logarithm + half, 700.0))
        return cls(value, value * standard_error, low, high, unit)

    @classmethod
    def of_inverse(cls, inverse: float, standard_error: float, unit: str) -> Estimate:
        """1 over a quantity with a normal error; no upper end where that one may be zero.

        An ``inverse`` of zero or less has an infinite value: then only the lower end counts.
        """
        half = COVERAGE_95 * standard_error
        value = 1 / inverse if inverse > 0 else math.inf
        error = standard_error / inverse**2 if inverse > 0 else math.inf
        low = 1 / (inverse + half) if inverse + half > 0 else math.inf
        high = 1 / (inverse - half) if inverse - half > 0 else math.inf
        return cls(value, error, low, high, unit)

    def covers(self, truth: float) -> bool:
        """Whether the 95 % interval holds ``truth``."""
        return self.low <= truth <= self.high

    def as_dict(self) -> dict[str, float | str | None]:
        """Plain values for JSON; what is not finite becomes None."""
        numbers = {
            "value": self.value,
            "standard_error": self.standard_error,
            "low": self.low,
            "high": self.high,
        }
        plain = {
            name: number if math.isfinite(number) else None for name, number in numbers.items()
        }
        return {**plain, "unit": self.unit}

    def __str__(self) -> str:
        """Value, interval and unit, to two figures of the interval's half-width."""
        half = COVERAGE_95 * self.standard_error
        if not math.isfinite(half) or half <= 0:
            return f"{self.value:.6g} {self.unit} (95 %: {self.low:.6g} to {self.high:.6g})".strip()
        digits = min(max(0, 1 - math.floor(math.log10(half))), MOST_DIGITS)
        low, value, high = (f"{number:.{digits}f}" for number in (self.low, self.value, self.high))
        return f"{value} {self.unit} (95 %: {low} to {high})".replace("  (", " (")
