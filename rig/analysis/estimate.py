"""An estimate: a value with its standard error and 95 % interval."""

from __future__ import annotations

import math
from dataclasses import dataclass

COVERAGE_95 = 1.959964
"""Half-width of the 95 % interval of a normal estimate, in standard errors."""


MOST_DIGITS = 12
"""Maximum number of digits that are printed after the decimal point."""


def decimals(half_width: float) -> int:
    """Return the digits after the decimal point up to the second figure of a half-width, which has
    to be finite and above 0.

    >>> decimals(0.123), decimals(45.0)
    (2, 0)
    """
    return min(max(1 - math.floor(math.log10(half_width)), 0), MOST_DIGITS)


def with_error(value: float, half_width: float) -> str:
    """Return a value and its half-width as text, to the second figure of the half-width.

    >>> with_error(12.3456, 0.123)
    '+12.35 ± 0.12'
    """
    if not (math.isfinite(half_width) and half_width > 0):
        return f"{value:+.6g}"
    digits = decimals(half_width)
    return f"{value:+.{digits}f} ± {half_width:.{digits}f}"


@dataclass(frozen=True)
class Estimate:
    """A quantity with its standard error and the interval that covers the truth in 95 % of the
    cases.

    >>> gain = Estimate.normal(-12.34, 0.05, "dB")
    >>> str(gain)
    '-12.340 dB (95 %: -12.438 to -12.242)'
    >>> gain.covers(-12.3)
    True
    """

    value: float
    """Best estimate."""
    standard_error: float
    """Standard error of the value; infinite if unknown."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end of the 95 % interval; may be infinite."""
    unit: str
    """Unit of all four numbers."""

    @classmethod
    def normal(cls, value: float, standard_error: float, unit: str) -> Estimate:
        """Return the estimate of a quantity with a normal error."""
        half = COVERAGE_95 * standard_error
        return cls(value, standard_error, value - half, value + half, unit)

    @classmethod
    def of_logarithm(cls, logarithm: float, standard_error: float, unit: str) -> Estimate:
        """Return the estimate of a quantity whose natural logarithm has a normal error.

        The interval is asymmetric and never reaches below zero.
        """
        value = math.exp(logarithm)
        half = COVERAGE_95 * standard_error
        # math.exp overflows above 709.
        low, high = math.exp(logarithm - half), math.exp(min(logarithm + half, 700.0))
        return cls(value, value * standard_error, low, high, unit)

    @classmethod
    def of_inverse(cls, inverse: float, standard_error: float, unit: str) -> Estimate:
        """Return the estimate of a quantity whose inverse has a normal error.

        The interval has no upper end if the inverse may be zero. If ``inverse`` is zero or
        negative, the value is infinite and only the lower end is meaningful.
        """
        half = COVERAGE_95 * standard_error
        value = 1 / inverse if inverse > 0 else math.inf
        error = standard_error / inverse**2 if inverse > 0 else math.inf
        low = 1 / (inverse + half) if inverse + half > 0 else math.inf
        high = 1 / (inverse - half) if inverse - half > 0 else math.inf
        return cls(value, error, low, high, unit)

    def covers(self, truth: float) -> bool:
        """Return whether the 95 % interval contains ``truth``."""
        return self.low <= truth <= self.high

    def as_dict(self) -> dict[str, float | str | None]:
        """Return plain values for JSON; numbers that are not finite become None."""
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
        """Return value, unit and interval, to two figures of the interval's half-width."""
        half = COVERAGE_95 * self.standard_error
        if not math.isfinite(half) or half <= 0:
            return f"{self.value:.6g} {self.unit} (95 %: {self.low:.6g} to {self.high:.6g})".strip()
        digits = decimals(half)
        low, value, high = (f"{number:.{digits}f}" for number in (self.low, self.value, self.high))
        return f"{value} {self.unit} (95 %: {low} to {high})".replace("  (", " (")
