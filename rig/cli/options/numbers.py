"""Parsers of options that refuse in plain words, where typer's own show a library's."""

from __future__ import annotations

import math
from collections.abc import Callable

import typer

from rig.core.errors import ConfigurationError

LARGEST_SEED = 2**63 - 1
"""Largest seed that a journal holds."""


def whole_number(least: int, most: int | None = None) -> Callable[[object], int]:
    """Return the parser of an option that takes a whole number from `least` to `most`."""

    def parse(given: object) -> int:
        try:
            value = int(str(given))
        except ValueError:
            raise _refused(given, "a whole number", least, most) from None
        if not least <= value <= (math.inf if most is None else most):
            raise _refused(given, "a whole number", least, most)
        return value

    return parse


def real_number(least: float, most: float | None = None) -> Callable[[object], float]:
    """Return the parser of an option that takes a number from `least` (-inf: any) to `most`."""

    def parse(given: object) -> float:
        try:
            value = float(str(given))
        except ValueError:
            value = math.nan
        if not least <= value <= (math.inf if most is None else most):
            raise _refused(given, "a number", least, most)
        return value

    return parse


def one_of(*names: str) -> Callable[[object], str]:
    """Return the parser of an option that takes one of the names."""

    def parse(given: object) -> str:
        if given not in names:
            raise typer.BadParameter(f"{given}: must be one of {', '.join(names)}")
        return str(given)

    return parse


def number_in(text: str, unit: str, option: str, *, above: float = -math.inf) -> float:
    """Return the number in an option's text, with or without its unit, in that unit.

    Raises ConfigurationError, which names the option as it was given, for any other text and for a
    number that is not finite or not above a bound.
    """
    from rig.core.units import quantity

    try:
        number = quantity(text, unit)
    except ValueError as error:
        raise ConfigurationError(f"{option} {text}: {error}", f"write it in {unit}") from error
    if not math.isfinite(number):
        raise ConfigurationError(f"{option} {text}: must be a finite number in {unit}")
    if not number > above:
        raise ConfigurationError(f"{option} {text}: must be above {above:g} {unit}")
    return number


def _refused(given: object, what: str, least: float, most: float | None) -> typer.BadParameter:
    within = f", at least {least}" if most is None else f", {least} to {most}"
    return typer.BadParameter(f"{given}: must be {what}{within if least > -math.inf else ''}")
