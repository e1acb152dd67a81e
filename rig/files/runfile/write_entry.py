"""Writes everything in ``/entry`` except the samples: operator, times, instruments, settings and
outcome.

Writes the NeXus tree of a journal's contents into an open HDF5 file; decides nothing about files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from rig.core.errors import ConfigurationError
from rig.core.settings import unit_of
from rig.files.hdf5.nexus import (
    UniqueNames,
    array_field,
    group,
    number_field,
    plain_text,
    share_scale,
    text_field,
    texts_field,
    write_note,
    write_values,
)
from rig.files.journal.format import to_json
from rig.files.journal.layout import TRUTH
from rig.files.journal.reader import JournalContents, ending
from rig.files.journal.values import (
    SIMULATED,
    End,
    InstrumentRecord,
    Origin,
    PersonOrSample,
    RunHeader,
)
from rig.files.runfile.table import PointTable
from rig.files.runfile.write_plots import write_plot
from rig.files.runfile.write_results import write_results

if TYPE_CHECKING:
    import h5py

WORLD = "simulated_world"
"""Name of the group with the parameters of the World."""


def write_root(file: h5py.File, contents: JournalContents, name: str) -> h5py.Group:
    """Write the root's attributes and return the new, empty entry. Nothing in it depends on the
    time at which this is done: the same journal gives the same bytes.
    """
    import h5py

    program = contents.header.program
    file.attrs["NX_class"] = "NXroot"
    file.attrs["default"] = "entry"
    file.attrs["file_name"] = name
    origin = contents.header.origin
    file.attrs["file_time"] = origin.imported_at if origin else ending(contents).end_time
    file.attrs["creator"] = program.name
    file.attrs["creator_version"] = program.version
    file.attrs["HDF5_Version"] = h5py.version.hdf5_version
    file.attrs["h5py_version"] = h5py.version.version
    return group(file, "entry", "NXentry")


def write_entry(entry: h5py.Group, contents: JournalContents, table: PointTable) -> None:
    """Write everything in the entry except the samples."""
    header, end = contents.header, ending(contents)
    entry.attrs["default"] = header.layout.default
    text_field(entry, "definition", header.layout.definition).attrs["version"] = plain_text(
        header.layout.version
    )
    text_field(entry, "title", header.marked(header.title))
    for name, time in (("start_time", header.start_time), ("end_time", end.end_time)):
        if time is not None:
            text_field(entry, name, time)
    number_field(entry, "duration", round(end.duration_s), "s")
    text_field(entry, "identifier_experiment", header.run_uuid)
    if header.collection is not None:
        text_field(entry, "identifier_collection", header.collection)
    program = text_field(entry, "program_name", header.program.name)
    program.attrs["version"] = plain_text(header.program.version)
    program.attrs["configuration"] = plain_text(header.program.configuration)
    for name in ("procedure_package", "procedure_version"):
        if text := getattr(header, name):
            program.attrs[name] = plain_text(text)
    _write_named(group(entry, "user", "NXuser"), header.user)
    _write_named(group(entry, "sample", "NXsample"), header.sample)
    _write_parameters(group(entry, "parameters", "NXparameters"), header)
    write_note(entry, "configuration", "application/toml", header.bench_file, header.bench_toml)
    write_note(entry, "journal_header", "application/json", "header.json", to_json(header))
    if header.accepted:
        entry.attrs["accepted"] = plain_text(header.accepted)
    if header.notes:
        write_note(entry, "notes", "text/plain", "", header.notes)
    if header.origin is not None:
        _write_origin(group(entry, "origin", "NXcollection"), header.origin)
    _write_outcome(group(entry, "outcome", "NXcollection"), contents, table, end)
    _write_events(group(entry, "events", "NXcollection"), contents)
    _write_instrument(group(entry, "instrument", "NXinstrument"), header)
    _write_attempts(group(entry, "attempts", "NXcollection"), contents)
    _write_points(group(entry, "points", "NXcollection"), contents, table)
    _write_truth(entry, contents, table)
    _write_world(entry, header)
    write_results(entry, contents.results)
    for plot in header.layout.plots:
        title = header.marked(plot.title or header.title)
        write_plot(entry, plot, header.layout, table, title)


def _write_named(made: h5py.Group, named: PersonOrSample) -> None:
    text_field(made, "name", named.name)
    if named.details():
        write_values(group(made, "details", "NXparameters"), named.details(), {})


def _write_parameters(made: h5py.Group, header: RunHeader) -> None:
    units = {**dict(_units_of(header.settings)), **header.setting_units}
    write_values(made, header.settings, units)


def _write_origin(made: h5py.Group, origin: Origin) -> None:
    for name in ("file_name", "sha256", "format", "imported_at", "head"):
        text_field(made, name, getattr(origin, name))
    number_field(made, "bytes", origin.bytes, "1")
    write_values(group(made, "options", "NXparameters"), origin.options, {})


def _write_outcome(
    made: h5py.Group, contents: JournalContents, table: PointTable, end: End
) -> None:
    header = contents.header
    text_field(made, "status", end.status)
    text_field(made, "reason", end.reason)
    number_field(made, "attempt", end.attempt, "1")
    planned = len(header.points) if end.points_planned is None else end.points_planned
    number_field(made, "points_planned", max(planned, len(table.ids)), "1")
    number_field(made, "points_done", len(table.ids), "1")
    number_field(made, "exit", end.exit, "1")
    number_field(made, "duration", end.duration_s, "s")
    if header.origin is None:
        number_field(made, "simulated", header.simulated)
    else:
        number_field(made, "imported", True)
    number_field(made, "seed", header.seed, "1")
    text_field(made, "fingerprint", header.fingerprint)
    texts_field(made, "warnings", [*end.warnings, *table.warnings])


def _write_events(made: h5py.Group, contents: JournalContents) -> None:
    import numpy as np

    times = np.array([event.time for event in contents.events], np.float64)
    field = array_field(made, "time", times, "s", "Time (s)")
    if contents.header.start_time is not None:
        field.attrs["start"] = contents.header.start_time
    for name in ("level", "code", "message"):
        texts_field(made, name, [getattr(event, name) for event in contents.events])
    share_scale(made, "time")


def _write_instrument(made: h5py.Group, header: RunHeader) -> None:
    names = UniqueNames("calibrations")
    for instrument in header.instruments:
        part = group(made, names.name(instrument.name), _class_of(instrument))
        text_field(part, "name", instrument.name)
        fabrication = group(part, "fabrication", "NXfabrication")
        mark = f"{SIMULATED} " if instrument.simulated else ""
        text_field(fabrication, "vendor", f"{mark}{instrument.vendor}")
        text_field(fabrication, "model", f"{mark}{instrument.model}")
        text_field(fabrication, "serial_number", instrument.serial_number)
        details = group(part, "details", "NXcollection")
        for name in ("role", "firmware", "driver"):
            text_field(details, name, getattr(instrument, name))
        for name in ("driver_package", "driver_version"):
            if text := getattr(instrument, name):
                text_field(details, name, text)
        number_field(details, "simulated", instrument.simulated)
    calibrations = group(made, "calibrations", "NXcollection")
    names = UniqueNames()
    for number, calibration in enumerate(header.calibrations):
        name = next((calibration[k] for k in ("sensor", "name", "kind") if k in calibration), "")
        part = group(
            calibrations, names.name(str(name) or f"calibration_{number}"), "NXcalibration"
        )
        text_field(part, "description", f"calibration of {name}" if name else "calibration")
        if "date" in calibration:
            text_field(part, "last_process", calibration["date"])
        number_field(part, "applied", True)
        parameters = group(part, "calibration_parameters", "NXparameters")
        write_values(parameters, calibration, {})


def _class_of(instrument: InstrumentRecord) -> str:
    role = instrument.role.lower()
    if "stage" in role:
        return "NXpositioner"
    return "NXactuator" if "generator" in role or "shaker" in role else "NXsensor"


def _write_attempts(made: h5py.Group, contents: JournalContents) -> None:
    """Write every attempt at a point, with the journal's own words."""
    for name in ("id", "status", "reason", "begin", "result"):
        texts_field(made, name, [getattr(attempt, name) for attempt in contents.attempts])


def _write_points(made: h5py.Group, contents: JournalContents, table: PointTable) -> None:
    """Write the readings of the recorded points, in the order of the default plot."""
    import numpy as np

    texts_field(made, "id", table.ids)
    array_field(made, "attempt", np.array(table.attempts, np.int64), "1")
    for column in contents.header.layout.columns:
        values = table.columns[column.name]
        if isinstance(values, list):
            field = texts_field(made, column.name, values)
            field.attrs["long_name"] = plain_text(column.long_name)
        else:
            units = column.units or "1"
            field = array_field(made, column.name, values, units, column.long_name)
            if column.origin:
                field.attrs["origin"] = plain_text(column.origin)
        if column.meaning:
            field.attrs["description"] = plain_text(column.meaning)


def _write_truth(entry: h5py.Group, contents: JournalContents, table: PointTable) -> None:
    """Write what really happened in the simulated World at each point, which no measurement
    shows."""
    from rig.files.journal.format import from_json

    truths = {
        name: text
        for name, attempt in zip(table.ids, table.attempts, strict=True)
        if (text := contents.reading(attempt).get(TRUTH))
    }
    if not truths:
        return
    made = group(entry, TRUTH, "NXcollection")
    text_field(made, "description", "SIMULATED: known to the World only, never measured")
    names = UniqueNames("description")
    for name, text in truths.items():
        found = from_json(str(text))
        values = found if isinstance(found, Mapping) else {"value": found}
        part = group(made, names.name(name), "NXparameters")
        write_values(part, values, dict(_units_of(values)))


def _write_world(entry: h5py.Group, header: RunHeader) -> None:
    """Write the parameters of a simulated bench, defaults included, if its bench file states
    them."""
    from rig.core.toml_files import parse_toml

    if not header.simulated:
        return
    try:
        simulation = parse_toml(header.bench_toml, header.bench_file).get("simulation")
    except ConfigurationError:  # a journal that was written by hand: it is saved as it is
        return
    world = simulation.get("world") if isinstance(simulation, dict) else None
    if not isinstance(world, dict):
        return
    plain = json.loads(json.dumps(world, default=str))  # TOML has dates, HDF5 has none
    made = group(entry, WORLD, "NXparameters")
    write_values(made, plain, dict(_units_of(plain)))


def _units_of(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the dotted name and the unit of each value whose name ends with one, and 1 for other
    numbers, which are counts and ratios: names carry their units."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _units_of(value, f"{prefix}{key}.")
        elif (unit := unit_of(key)) is not None:
            yield f"{prefix}{key}", unit
        elif _is_number(value):
            yield f"{prefix}{key}", "1"


def _is_number(value: Any) -> bool:
    """Return whether a value is a number, or a list of numbers; a flag is none."""
    if isinstance(value, (list, tuple)):
        return bool(value) and all(map(_is_number, value))
    return type(value) in (int, float)
