"""Writes values in words, for a terminal: a value, a table of values, what a file contains."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

LONGEST_LIST = 8
"""Longest list whose numbers are shown one by one."""
LONGEST_LINE = 80
"""Length in characters of several texts from which each is shown in a line of its own."""


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


def value_lines(values: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    """Yield names and values, one per line, and tables indented below their names. `indent` stands
    before each line."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield f"{indent}{name}:"
            yield from value_lines(value, indent + "  ")
        elif _is_text_list(value):
            yield f"{indent}{name}:"
            for line in value:
                yield f"{indent}  {line}"
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            for number, one in enumerate(value, 1):
                yield f"{indent}{name} {number}:"
                yield from value_lines(one, indent + "  ")
        else:
            yield f"{indent}{name}: {in_words(value)}"


def _is_text_list(value: Any) -> bool:
    """Return whether the value is several texts, of which each gets a line of its own."""
    return (
        isinstance(value, list | tuple)
        and len(value) > 1
        and all(isinstance(one, str) for one in value)
        and sum(map(len, value)) > LONGEST_LINE
    )


def contents_in_words(
    contents: Mapping[str, Mapping[str, Mapping[str, Any]]],
) -> dict[str, dict[str, str]]:
    """Return a line for each column and stream of a run, such as
    ``Travel of z during the hold (um)`` and ``F_n, F_t, F_y in N, 1000 Hz (…)``."""

    def column(one: Mapping[str, Any]) -> str:
        return f"{one['meaning']} ({one['unit']})" if one["unit"] else one["meaning"]

    def stream(one: Mapping[str, Any]) -> str:
        said = ", ".join(one["channels"]) + (f" in {one['unit']}" if one["unit"] else "")
        if not one["recorded"]:
            said += ", not recorded"
        elif one["rate_Hz"] is not None:
            said += f", {in_words(one['rate_Hz'])} Hz"
        elif one["times"]:
            said += f", at the times of {one['times']}"
        return f"{said} ({one['meaning']})" if one["meaning"] else said

    return {
        "columns": {name: column(one) for name, one in contents["columns"].items()},
        "streams": {name: stream(one) for name, one in contents["streams"].items()},
    }


def with_results_in_words(said: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a model's file with a line for each result, such as
    ``8501 over time: -0.4 to 4.01 N (normal force)``."""

    def line(one: Mapping[str, Any]) -> str:
        if "shape" in one:
            sizes, axes = zip(
                *(part.split(" ", 1) for part in one["shape"].split(", ")), strict=True
            )
            many = f"{' x '.join(sizes)} over {' and '.join(axes)}"
            value = f"{many}: {in_words(one['lowest'])} to {in_words(one['highest'])}"
        else:
            values = one["value"] if "value" in one else one["values"]
            value = "; ".join(map(in_words, values if isinstance(values, list) else [values]))
        return f"{value} {one.get('unit', '')}".rstrip() + f" ({one['meaning']})"

    return said | {"results": {name: line(one) for name, one in said["results"].items()}}
