"""Numbers with units, as people write and read them: ``200ms`` for a field in seconds."""

from __future__ import annotations

import importlib
import re
import sys
import typing
from datetime import timedelta
from typing import Any

from rig.core import unreadable_packages

_QUANTITY = re.compile(r"^\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*$")
_SYMBOL = r"[A-Za-zµμΩ°%][A-Za-zµμΩ°%0-9]*"
_FACTOR = rf"(?:1|sqrt\({_SYMBOL}\)|{_SYMBOL})(?:\s*(?:\^|\*\*)\s*-?\d)?"
_UNIT = re.compile(rf"{_FACTOR}(?:(?:\s*[*/·]\s*|\s+){_FACTOR})*")
"""Units as people write them: ``mm/s^2``, ``V s/N``, ``V/sqrt(Hz)``. An exponent has one digit,
because pint computes ``mm**9999999**9999999`` for minutes."""
_LONGEST_UNIT = 40
"""Characters of a unit; every unit of a field has fewer than 10."""

_COMMON_SYMBOLS = frozenset(
    {
        *("%", "percent", "count", "bit", "dB", "decade", "deg", "rad", "sqrt", "K", "degC"),
        *("us", "ms", "s", "min", "h", "um", "mm", "m", "mN", "N", "kN", "Pa", "kPa", "MPa"),
        *("uV", "mV", "V", "uA", "mA", "A", "W", "Hz", "kHz", "pF", "nF", "uF", "F", "pC", "C"),
        *("ohm", "kohm", "Ω", "g", "kg"),
    }
)


def duration(seconds: float) -> str:
    """Return a duration as text: ``12.3 s``, ``0:02:05``."""
    return f"{seconds:.1f} s" if seconds < 60 else str(timedelta(seconds=round(seconds)))


def time_span(seconds: float) -> str:
    """Return a duration in words: ``4.6 s``, ``14 s``, ``2 min 40 s``, ``7 h 5 min``."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    if (whole := round(seconds)) < 3600:
        larger, smaller = divmod(whole, 60)
        units = ("min", "s")
    else:
        larger, smaller = divmod(round(seconds / 60), 60)
        units = ("h", "min")
    parts = [(larger, units[0]), (smaller, units[1])]
    return " ".join(f"{number} {unit}" for number, unit in parts if number)


def counted(number: int, one: str, several: str = "") -> str:
    """Return a number with its noun: ``1 run``, ``3 runs``. The plural is `several`, or has an
    s."""
    return f"{number} {one if number == 1 else several or one + 's'}"


def parse(text: str, annotation: Any, unit: str | None) -> Any:
    """Return the value of a text for a field of this type. Raises ValueError, which names the
    fault."""
    arguments = typing.get_args(annotation)
    if typing.get_origin(annotation) is tuple:
        items = text.split(",")
        if not any(item.strip() for item in items):
            raise ValueError("the list is empty; leave the option out for its default")
        if not all(item.strip() for item in items):
            raise ValueError("a value is missing between two commas or at an end")
        values = []
        for item in items:
            try:
                values.append(parse(item, arguments[0], unit))
            except ValueError as error:
                if len(items) == 1:
                    raise
                # The message may be a sentence of its own, which begins with the unit.
                between = ": " if str(error).startswith("'") else " "
                raise ValueError(f"{item.strip()!r}{between}{error}") from error
        return tuple(values)
    if type(None) in arguments:
        if text.strip().lower() == "none":
            return None
        return parse(text, next(a for a in arguments if a is not type(None)), unit)
    # A choice may be a number, which is given as text like any other.
    if typing.get_origin(annotation) is typing.Literal:
        return next((choice for choice in arguments if str(choice) == text.strip()), text)
    if annotation is float:
        return quantity(text, unit)
    return text


def is_unit(text: str) -> bool:
    """Return whether a text is a unit as files and figures carry it: ``V s/N``, ``mm/s^2``, ``%``,
    or "" for a number without one."""
    if not text:
        return True
    if not _follows_grammar(text):
        return False
    if all(symbol in _COMMON_SYMBOLS for symbol in re.findall(_SYMBOL, text)):
        return True
    pint = _pint()
    try:
        pint.Unit(text)
    except Exception:  # noqa: BLE001 - pint raises what it likes: a KeyError for "1*T**0"
        return False
    return True


def _pint() -> Any:
    """Return the module pint, which is slow to import and needed for rare units only."""
    if "pint" not in sys.modules:
        unreadable_packages.tolerate_in_backport()  # dask, where it is installed, looks there
    return importlib.import_module("pint")


def quantity(text: str, unit: str | None) -> float:
    """Return the number in `unit` that a text, with or without a unit, states.

    Raises ValueError if the text is not a number, or its unit does not convert to `unit`.
    """
    match = _QUANTITY.match(text)
    if match is None:
        try:
            # NaN and infinity pass here: the settings classes refuse them and name the field.
            return float(text)
        except ValueError:
            raise ValueError(f"is not a number{f' in {unit}' if unit else ''}") from None
    number, written = float(match[1]), match[2]
    if written in ("", unit):
        return number
    if written.startswith(","):
        raise ValueError(_about_comma(match[1], written))
    if unit is None:
        raise ValueError(f"takes a bare number, not {written!r}")
    if not _follows_grammar(written):
        shown = written if len(written) <= _LONGEST_UNIT else written[:_LONGEST_UNIT] + "..."
        raise ValueError(f"{shown!r} is not a unit; write it as {unit}")
    pint = _pint()
    try:
        return float(pint.Quantity(number, written).to(unit).magnitude)
    except Exception as error:
        raise ValueError(f"{written!r} does not convert to {unit}") from error


def _about_comma(whole: str, rest: str) -> str:
    """Return what is wrong with a number that a comma follows: 1,5 or 1,000 or a list."""
    ends = r"(?![0-9.,;])"
    # 1,000 may be a thousand as well as one.
    if "." not in whole and re.match(rf"(?:,[0-9]{{3}})+{ends}", rest):
        return "a comma is not a decimal point: write the number without a comma"
    decimals = re.match(rf",([0-9]+(?:[eE][+-]?[0-9]+)?){ends}", rest)
    if "." not in whole and decimals is not None:
        return f"a comma is not a decimal point: write {whole}.{decimals[1]}"
    return "takes one number, not a list"


def _follows_grammar(text: str) -> bool:
    return len(text) <= _LONGEST_UNIT and _UNIT.fullmatch(text) is not None
