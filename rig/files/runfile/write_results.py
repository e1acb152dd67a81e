"""Writing the results of a run, with the program and the method that made them, and reading them
back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rig.files.hdf5.nexus import (
    empty_field,
    group,
    number_field,
    set_attributes,
    text_field,
    texts_field,
    write_note,
)
from rig.files.hdf5.safe_reading import text_of, texts_of, whole
from rig.files.journal.format import to_json
from rig.files.journal.values import Results
from rig.files.runfile.result_fields import result_fields

if TYPE_CHECKING:
    import h5py

RESULTS = "results"
"""Name of the group in ``/entry``."""
VALUES = "values"
"""Name of the group of its fields."""
FAILURE = "failure"
"""Name of the note that says why there are no fields."""


def write_results(entry: h5py.Group, results: Results | None) -> None:
    """Write the results as an NXprocess; nothing where there are none."""
    if results is None:
        return
    made = group(entry, RESULTS, "NXprocess")
    text_field(made, "program", results.program.name).attrs["configuration"] = (
        results.program.configuration
    )
    text_field(made, "version", results.program.version)
    write_note(made, "method", "text/plain", "", results.method)
    write_note(made, "record", "application/json", "results.json", to_json(results))
    values = group(made, VALUES, "NXcollection")
    try:
        for field in result_fields(results):
            place = values
            for name in field.path[:-1]:
                place = place[name] if name in place else group(place, name, "NXcollection")
            set_attributes(_write(place, field.path[-1], field.value), field.attributes)
    except (RuntimeError, ValueError, TypeError, KeyError, OSError) as error:
        # Data come first: results that no field can hold do not cost the file. They are in the
        # record. A disk that is full is found by the next step.
        del made[VALUES]
        write_note(made, FAILURE, "text/plain", "", f"{type(error).__name__}: {error}")


def _write(place: h5py.Group, name: str, value: Any) -> h5py.Dataset:
    import numpy as np

    if isinstance(value, list):
        if isinstance(value[0], str):
            return texts_field(place, name, value)
        numbers = empty_field(place, name, (len(value),), np.float64)
        numbers[...] = np.array(value, np.float64)
        numbers.flush()  # see `array_field`
        return numbers
    if isinstance(value, str):
        return text_field(place, name, value)
    return number_field(place, name, value)


def result_differences(entry: h5py.Group, results: Results | None) -> Iterator[str]:
    """Yield what the file's results lack of the journal's, one sentence each."""
    if results is None:
        if RESULTS in entry:
            yield f"{RESULTS} is there, although the journal has none"
        return
    if text_of(entry[f"{RESULTS}/record/data"]) != to_json(results):
        yield f"{RESULTS}/record differs"
    if FAILURE in entry[RESULTS]:
        return
    for field in result_fields(results):
        path = "/".join((RESULTS, VALUES, *field.path))
        if not _same(_read(entry[path]), field.value):
            yield f"{path} differs"


def _read(field: h5py.Dataset) -> Any:
    if field.dtype.kind == "O":
        return texts_of(field) if field.shape else text_of(field)
    return whole(field).tolist()


def _same(found: Any, expected: Any) -> bool:
    """Return whether two values are equal; NaN equals NaN."""
    if isinstance(expected, list):
        return len(found) == len(expected) and all(map(_same, found, expected))
    if isinstance(expected, float) and math.isnan(expected):
        return isinstance(found, float) and math.isnan(found)
    return bool(found == expected)
