"""Writes values in words, for a terminal."""

from __future__ import annotations

from typing import Any

LONGEST_LIST = 8
"""Longest list whose numbers are shown one by one."""


def in_words(value: Any) -> str:
    """Return a value as it is shown: ``yes``, ``0.25``, ``1; 2; 3``, ``none``; of a long list the
    number of values and its ends."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        shown = [in_words(item) for item in value]
        if len(shown) > LONGEST_LIST and not isinstance(value[0], str):
            return f"{len(shown)} values, {shown[0]} to {shown[-1]}"
        return "; ".join(shown) or "none"
    return "none" if value is None else str(value)
