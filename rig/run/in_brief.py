"""The single values of a summary, each in a line for a screen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rig.analysis.estimate import with_error
from rig.core.settings import name_without_unit, unit_of

PUT_IN = "put into the simulation"
"""What a value of a simulation is called where the procedure, which knows more, is not known."""
MEAN, DEVIATION = "mean_", "standard_deviation_"


def single_values(
    summary: Mapping[str, Any],
    put_in: Mapping[str, Any],
    labels: Mapping[str, str] | None = None,
    put_in_label: str = PUT_IN,
    digits: int = 5,
    of_one_trial: bool = False,
) -> list[str]:
    """Return a line for each number and text of a summary, without its tables: label, value and
    unit; a mean with its standard deviation, and the value of a simulation as `put_in_label`.
    `labels` are those of `Procedure.summary_labels`; numbers without a deviation have this many
    significant `digits`. What is the mean `of_one_trial` is not called a mean.

    >>> summary = {"mean_creep_um": 3.14159, "standard_deviation_creep_um": 0.012, "table": {}}
    >>> single_values(summary, {"mean_creep_um": 3.0})
    ['creep: 3.142 ± 0.012 um (put into the simulation: 3)']
    """
    lines: list[str] = []
    for name, value in summary.items():
        of = name.replace(DEVIATION, MEAN, 1)
        if isinstance(value, Mapping) or (of != name and of in summary):
            continue  # A table, or a deviation that stands with its mean.
        if isinstance(value, list | tuple) and all(isinstance(one, str) for one in value):
            lines += value
            continue
        deviation = summary.get(DEVIATION + name.removeprefix(MEAN))
        true = put_in.get(name)
        shown = _in_words(value, digits) if deviation is None else _scattered(value, deviation)
        is_mean = deviation is None and not of_one_trial
        mean_of = name if is_mean else name.removeprefix(MEAN)
        label, unit = _label_and_unit(name, mean_of, labels or {})
        lines.append(
            f"{label}: {shown}{unit}"
            + ("" if true is None else f" ({put_in_label}: {_in_words(true, digits)})")
        )
    return lines


def _label_and_unit(name: str, said: str, labels: Mapping[str, str]) -> tuple[str, str]:
    """Return what a value is called, by its label or else by the words of its name, and its unit
    with a space before it."""
    words = name_without_unit(said).replace("_", " ")
    label, _, stated = labels.get(name, words).partition(";")
    unit = stated.strip() or {None: "", "percent": "%"}.get(unit_of(name), unit_of(name))
    return label, f" {unit}" if unit else ""


def _scattered(mean: Any, deviation: Any) -> str:
    """Return a mean with the standard deviation of what it is the mean of."""
    if not isinstance(mean, float) or not isinstance(deviation, float):  # by another version
        return _in_words(mean)
    return with_error(mean, deviation).removeprefix("+")


def _in_words(value: Any, digits: int = 5) -> str:
    if isinstance(value, float):
        # Not 1.23e+03 for 1234.
        return f"{value:.0f}" if 10**digits <= abs(value) < 1e5 else f"{value:.{digits}g}"
    if isinstance(value, list | tuple):
        return "; ".join(_in_words(one, digits) for one in value) or "none"
    return "none" if value is None else str(value)
