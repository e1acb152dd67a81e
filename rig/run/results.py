"""The results of a run: the procedure's summary, with what the run file states with it, and how
stored results compare with those of the present program."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rig.core.settings import unit_of
from rig.files.journal.format import from_json, to_json
from rig.files.journal.values import Results
from rig.files.runfile.result_fields import ESTIMATE
from rig.run.checked_procedure import CheckedProcedure
from rig.run.job import present_program
from rig.run.points import Reading

if TYPE_CHECKING:
    from rig.run.procedure import Procedure


def results_of(procedure: Procedure, readings: Sequence[Reading], simulated: bool) -> Results:
    """Return what this program computes from the readings of a run.

    Raises what the procedure's hooks raise, as `CheckedProcedure` has it.
    """
    checked = CheckedProcedure(procedure)
    summary = checked.summarise(readings)
    put_in = checked.put_in(readings, summary) if simulated else {}
    labels = procedure.summary_labels
    return Results.model_validate(
        {
            "program": present_program(),
            "method": procedure.method,
            "values": from_json(to_json(dict(summary))),
            "origins": dict(procedure.summary_origins),
            "put_in": from_json(to_json(dict(put_in))),
            "labels": {name: label.partition(";")[0] for name, label in labels.items()},
        }
    )


@dataclass(frozen=True)
class Difference:
    """A value of the results that this program finds otherwise than the file has it."""

    stored: Any
    recomputed: Any
    unit: str = ""


SAME = 1e-6
"""Relative difference up to which two numbers are equal: processors and libraries differ by
less."""
SAME_IN_ERRORS = 0.01
"""Difference up to which two estimates are equal, in standard errors."""


def differences(stored: Any, now: Any, name: str = "", unit: str = "") -> dict[str, Difference]:
    """Return what differs between two summaries, by dotted name; an estimate is one value."""
    if _is_estimate(stored) and _is_estimate(now):
        error = abs(float(stored["standard_error"] or 0.0))
        if all(_close(stored[k], now[k], SAME_IN_ERRORS * error) for k in ("value", "low", "high")):
            return {}
        return {name: Difference(stored["value"], now["value"], str(stored["unit"]))}
    if isinstance(stored, Mapping) and isinstance(now, Mapping):
        found: dict[str, Difference] = {}
        for key in dict.fromkeys((*stored, *now)):
            inner = f"{name}.{key}" if name else str(key)
            found |= differences(stored.get(key), now.get(key), inner, unit_of(str(key)) or "")
        return found
    if isinstance(stored, list) and isinstance(now, list) and len(stored) == len(now):
        found = {}
        for number, (one, other) in enumerate(zip(stored, now, strict=True), 1):
            found |= differences(one, other, f"{name}.{number}", unit)
        return found
    return {} if _close(stored, now, 0.0) else {name: Difference(stored, now, unit)}


def _is_estimate(value: Any) -> bool:
    return isinstance(value, Mapping) and value.keys() == ESTIMATE


def _close(one: Any, other: Any, within: float) -> bool:
    """Return whether two values are equal, numbers but for what computers differ by."""
    if not isinstance(one, (int, float)) or not isinstance(other, (int, float)):
        return bool(one == other)
    try:
        if math.isnan(one) or math.isnan(other):
            return math.isnan(one) and math.isnan(other)
        return math.isclose(one, other, rel_tol=SAME, abs_tol=within)
    except OverflowError:  # a whole number beyond the floats, which older files may hold
        return one == other
