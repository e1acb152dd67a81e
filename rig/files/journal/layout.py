"""Declares as data how the readings of a procedure become plots.

A layout travels in the journal's header, so that compiling a run needs no procedure's code and a
lab's own procedure gets the same files as a built-in one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, StringConstraints, TypeAdapter, model_serializer

from rig.core.settings import UNIT_BY_SUFFIX, unit_of

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,62}\Z")
_DEFINITION = re.compile(r"NX[A-Za-z0-9_]{1,60}\Z")

TRUTH = "simulated_truth"
"""Key that every reading may have, and name of its group in the run file: the simulated bench's own
record of the point, as JSON text."""

RESERVED_GROUPS = frozenset(
    {
        *("definition", "title", "start_time", "end_time", "duration", "program_name"),
        *("identifier_experiment", "identifier_collection", "user", "sample", "parameters"),
        *("configuration", "journal_header", "notes", "outcome", "events", "instrument"),
        *(TRUTH, "simulated_world", "origin", "results"),
        *("points", "attempts", "waveforms", "discarded", "between_points", "blocks"),
    }
)
"""Names inside ``/entry`` that a plot may not take."""

Short = Annotated[str, StringConstraints(max_length=1000)]
"""Text that may become an HDF5 attribute (these end at 64 KiB)."""

MOST_PARTS = 256
"""Columns, plots, instruments, streams and the like: each costs groups of the run file."""
Names = Annotated[tuple[Short, ...], Field(max_length=MOST_PARTS)]

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, slots=True)
class Column:
    """One quantity of the readings: its key, its name and unit in files, and what it means.

    Declared once, in the short form::

        Column("creep", "um", "Travel of z during the hold")

    Then ``creep_um`` is its key in the reading (`key`), ``creep`` its name in the run file and
    "Travel of z during the hold (um)" what viewers show (`long_name`). Give `key` or `long_name`
    only where they differ from that. `meaning` is one sentence without the unit; it is written to
    the run file as the dataset's ``description``. `units` is "" or "1" for a pure number.

    A number column becomes float64, with NaN where a reading lacks the key; a text column
    (``kind="text"``) becomes UTF-8, with "" there.

    Raises ValueError for a name or key that is not letters, digits and underscores, and for a key
    that does not end with its unit. Columns of older journals have no `meaning` and a key of any
    form.
    """

    name: str
    units: Short = ""
    meaning: Short = ""
    kind: Literal["number", "text"] = "number"
    _: KW_ONLY
    # In a journal's header the key is called "source".
    key: Annotated[str, Field(validation_alias="source")] = ""
    long_name: Short = ""
    origin: Short = ""
    """Where its numbers come from, if not measured: ``set``, ``calibrated``, or in words."""

    __pydantic_config__ = _STRICT

    def __post_init__(self) -> None:
        if not _NAME.match(self.name):
            raise ValueError(f"column {self.name!r}: a name is letters, digits and underscores")
        if self.name in {"id", "attempt"}:
            raise ValueError(f"column {self.name!r}: the table of points has that name already")
        if self.kind not in ("number", "text"):
            raise ValueError(f"column {self.name!r}: kind {self.kind!r} is not number or text")
        if self.meaning:
            self._complete()
        if self.kind == "number" and not self.long_name:
            raise ValueError(f"column {self.name!r}: no meaning and no long_name")
        if not self.key:
            raise ValueError(f"column {self.name!r}: no meaning and no key")

    def _complete(self) -> None:
        """Derive what was left out, and check the key against the unit."""
        suffix = unit_suffix(self.units)
        if not self.key:
            object.__setattr__(self, "key", f"{self.name}_{suffix}" if suffix else self.name)
        if not self.long_name:
            shown = f"{self.meaning} ({self.units})" if suffix else self.meaning
            object.__setattr__(self, "long_name", shown)
        if not _NAME.match(self.key):
            raise ValueError(f"column {self.name!r}: key {self.key!r} is not a usable name")
        if suffix and f"_{self.key}".endswith(f"_{suffix}"):
            return
        carried = unit_of(self.key)
        if suffix or (carried and self.kind == "number"):
            has = f"ends with the unit {carried}" if carried else "has no unit"
            unit = f"_{suffix}" if suffix else "no unit"
            raise ValueError(
                f"column {self.name!r}: key {self.key!r} {has}, but {unit} belongs at its end "
                f"(units {self.units!r})"
            )

    @model_serializer
    def _as_stored(self) -> dict[str, Any]:
        """Keys and their order are those of the first version, so that an old header reads and
        writes back to the same text (`rig verify` compares them)."""
        stored: dict[str, Any] = {
            "name": self.name,
            "source": self.key,
            "units": self.units,
            "long_name": self.long_name,
            "kind": self.kind,
        }
        for later in ("meaning", "origin"):
            if text := getattr(self, later):
                stored[later] = text
        return stored


def without_values(columns: Iterable[Column]) -> dict[str, str | float | None]:
    """Return the part of a reading that has no value in `columns`: None for a number, "" for a
    text. For results that do not apply to every point."""
    return {column.key: None if column.kind == "number" else "" for column in columns}


def unit_suffix(units: str) -> str:
    """Return the ending of a key that carries this unit: ``N/mm`` gives ``N_mm``, ``%`` gives
    ``percent``, and a pure number ("" or "1") gives "".
    """
    if units in ("", "1"):
        return ""
    known = {unit: suffix for suffix, unit in UNIT_BY_SUFFIX.items()}
    words = re.findall(r"[A-Za-z0-9]+", units.replace("%", "percent").replace("^", ""))
    return known.get(units) or "_".join(words)


@dataclass(frozen=True, slots=True)
class Plot:
    """One NXdata group: the signal over its axes, all named columns of the layout.

    The first axis is the plot's dimension. Points are sorted by the axes in turn, so that neither a
    resumed nor a shuffled run scrambles the curve. ``log_axes`` names the signal or axes that are
    drawn logarithmically.
    """

    group: str
    signal: str
    axes: Names
    errors: str | None = None
    auxiliary: Names = ()
    log_axes: Names = ()
    title: Short = ""

    __pydantic_config__ = _STRICT

    def __post_init__(self) -> None:
        if not _NAME.match(self.group) or self.group in RESERVED_GROUPS:
            raise ValueError(f"plot {self.group!r}: not a usable group name")
        if not self.axes:
            raise ValueError(f"plot {self.group!r}: no axis")
        names = self.datasets()
        if len(set(names)) != len(names) or "title" in names:
            raise ValueError(f"plot {self.group!r}: two datasets of one name: {sorted(names)}")
        strangers = set(self.log_axes) - {self.signal, *self.axes}
        if strangers:
            raise ValueError(f"plot {self.group!r}: log_axes names {sorted(strangers)}")

    def datasets(self) -> tuple[str, ...]:
        """Return the names of the group's datasets besides its title."""
        errors = (self.errors_name,) if self.errors else ()
        return (self.signal, *self.axes, *self.auxiliary, *errors)

    def sources(self) -> dict[str, str]:
        """Return the names of the group's datasets besides its title, each with its column's name.

        The standard errors have the name that viewers expect, whatever the name of their column.
        """
        sources = {name: name for name in (self.signal, *self.axes, *self.auxiliary)}
        if self.errors:
            sources[self.errors_name] = self.errors
        return sources

    @property
    def errors_name(self) -> str:
        """The name under which viewers find the signal's standard errors."""
        return f"{self.signal}_errors"


@dataclass(frozen=True, slots=True)
class Trace:
    """One NXdata group of samples over time: channels of a stream, of the first kept point.

    The samples are those under ``waveforms``, linked; every other point's are there too.
    """

    group: str
    stream: str
    signal: str
    auxiliary: Names = ()
    title: Short = ""

    __pydantic_config__ = _STRICT

    def __post_init__(self) -> None:
        if not _NAME.match(self.group) or self.group in RESERVED_GROUPS:
            raise ValueError(f"trace {self.group!r}: not a usable group name")
        for name in (self.stream, *self.channels()):
            if not _NAME.match(name):
                raise ValueError(f"trace {self.group!r}: {name!r} is not a usable name")
        if len(set(self.channels())) != 1 + len(self.auxiliary):
            raise ValueError(f"trace {self.group!r}: two channels of one name")

    def channels(self) -> tuple[str, ...]:
        """Return the channels that are shown, the signal first."""
        return (self.signal, *self.auxiliary)


@dataclass(frozen=True, slots=True)
class Layout:
    """All plots of a procedure's file, and the columns they are made of.

    ``definition`` names the NXDL file ("NXrig_sweep") and ``version`` its version; ``default`` is
    the plot or trace shown at the first click. A plot's axes give the order of the table of points.
    """

    definition: str
    version: Short
    columns: Annotated[tuple[Column, ...], Field(max_length=MOST_PARTS)]
    plots: Annotated[tuple[Plot, ...], Field(max_length=MOST_PARTS)]
    default: str = "data"
    traces: Annotated[tuple[Trace, ...], Field(max_length=MOST_PARTS)] = ()

    __pydantic_config__ = _STRICT

    def __post_init__(self) -> None:
        if not _DEFINITION.match(self.definition):
            raise ValueError(f"definition {self.definition!r}: expected a name such as NXrig_sweep")
        names = [column.name for column in self.columns]
        groups = [plot.group for plot in self.plots] + [trace.group for trace in self.traces]
        for what, given in (("columns", names), ("plots or traces", groups)):
            if twice := [name for name in given if given.count(name) > 1]:
                raise ValueError(f"two {what} have the name {twice[0]!r}")
        if self.default not in groups:
            raise ValueError(f"default {self.default!r} is not a plot or trace: {groups}")
        numbers = {column.name for column in self.columns if column.kind == "number"}
        for plot in self.plots:
            used = {plot.signal, *plot.axes, *plot.auxiliary} | {plot.errors or plot.signal}
            if used - numbers:
                raise ValueError(f"plot {plot.group!r}: no number columns {sorted(used - numbers)}")

    @property
    def order(self) -> tuple[str, ...]:
        """The columns by which the table of points is sorted: the axes of the default plot."""
        shown = [plot for plot in self.plots if plot.group == self.default] or self.plots
        return shown[0].axes if shown else ()

    def column(self, name: str) -> Column:
        """Return the column of that name. Raises KeyError if there is none."""
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(name)

    def plot(self, group: str) -> Plot:
        """Return the plot of that group. Raises KeyError if there is none."""
        for plot in self.plots:
            if plot.group == group:
                return plot
        raise KeyError(group)

    def to_json(self) -> dict[str, Any]:
        """Return the layout as JSON-able values, as it stands in the journal's header."""
        plain: dict[str, Any] = TypeAdapter(Layout).dump_python(self, mode="json")
        return plain

    @classmethod
    def from_json(cls, value: Any) -> Layout:
        """Return the layout of JSON values. ValueError (pydantic's) if they are not a layout."""
        return TypeAdapter(cls).validate_python(value)
