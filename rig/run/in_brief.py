"""The single values of a summary, each in a line for a screen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rig.analysis.estimate import with_error

MEAN, DEVIATION = "mean_", "standard_deviation_"


def single_values(summary: Mapping[str, Any], put_in: Mapping[str, Any]) -> list[str]:
    """Return a line for each number and text of a summary, without its tables: a mean with its
    standard deviation, and beside it what a simulated World put in.

    >>> summary = {"mean_creep_um": 3.14159, "standard_deviation_creep_um": 0.012, "table": {}}
    >>> single_values(summary, {"mean_creep_um": 3.0})
    ['mean_creep_um: 3.142 ± 0.012 (World: 3)']
    """
    lines: list[str] = []
    for name, value in summary.items():
        of = name.replace(DEVIATION, MEAN, 1)
        if isinstance(value, Mapping) or (of != name and of in summary):
            continue  # A table, or a deviation that stands beside its mean.
        if isinstance(value, list | tuple) and all(isinstance(one, str) for one in value):
            lines += value
            continue
        deviation = summary.get(DEVIATION + name.removeprefix(MEAN))
        world = put_in.get(name)
        lines.append(
            f"{name}: {_in_words(value) if deviation is None else _scattered(value, deviation)}"
            + ("" if world is None else f" (World: {_in_words(world)})")
        )
    return lines


def _scattered(mean: Any, deviation: Any) -> str:
    """Return a mean with the standard deviation of what it is the mean of."""
    if not isinstance(mean, float) or not isinstance(deviation, float):  # by another version
        return _in_words(mean)
    return with_error(mean, deviation).removeprefix("+")


def _in_words(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, list | tuple):
        return "; ".join(map(_in_words, value)) or "none"
    return "none" if value is None else str(value)
