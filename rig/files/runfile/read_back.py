"""Whether a run file holds all that its journal holds; reads both to the last sample."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.files.errors import in_words
from rig.files.hdf5.nexus import plain_text, plot_sources
from rig.files.hdf5.safe_reading import DAMAGE, text_of, texts_of, whole
from rig.files.journal.format import to_json
from rig.files.journal.layout import Plot
from rig.files.journal.reader import JournalContents
from rig.files.runfile.table import PointTable, point_table
from rig.files.runfile.write_entry import ending
from rig.files.runfile.write_samples import (
    channel_attributes,
    channel_names,
    segment_attributes,
    segment_paths,
    walk_samples,
)

if TYPE_CHECKING:
    import h5py
    from numpy.typing import NDArray


def differences(contents: JournalContents, file: Path) -> list[str]:
    """What of the journal the file lacks or has otherwise; empty if it holds everything."""
    import h5py

    try:
        with h5py.File(file) as opened:
            entry = opened["entry"]
            found = list(_text_differences(entry, contents))
            found += _table_differences(entry, contents, point_table(contents))
            found += _sample_differences(entry, contents)
            return found
    except DAMAGE as error:
        return [in_words(error)]


def _text_differences(entry: h5py.Group, contents: JournalContents) -> Iterator[str]:
    header, end = contents.header, ending(contents)
    expected = {
        "journal_header/data": to_json(header),
        "configuration/data": header.bench_toml,
        "identifier_experiment": header.run_uuid,
        "outcome/status": end.status,
        "outcome/reason": end.reason,
    }
    if end.end_time is not None:
        expected["end_time"] = end.end_time
    for path, text in expected.items():
        if text_of(entry[path]) != plain_text(text):
            yield f"{path} differs"
    for name in ("id", "status", "reason", "begin", "result"):
        yield from _list(entry, f"attempts/{name}", [getattr(a, name) for a in contents.attempts])
    for name in ("level", "code", "message"):
        yield from _list(entry, f"events/{name}", [getattr(e, name) for e in contents.events])
    if whole(entry["events/time"]).tolist() != [event.time for event in contents.events]:
        yield "events/time differs"


def _list(entry: h5py.Group, path: str, texts: Sequence[str]) -> Iterator[str]:
    found = texts_of(entry[path])
    if found != [plain_text(text) for text in texts]:
        yield f"{path} differs"


def _table_differences(
    entry: h5py.Group, contents: JournalContents, table: PointTable
) -> Iterator[str]:
    yield from _list(entry, "points/id", table.ids)
    for name, values in table.columns.items():
        if isinstance(values, list):
            yield from _list(entry, f"points/{name}", values)
        elif not _same(whole(entry[f"points/{name}"]), values):
            yield f"points/{name} differs"
    for plot in contents.header.layout.plots:
        yield from _plot_differences(entry, plot, table)


def _plot_differences(entry: h5py.Group, plot: Plot, table: PointTable) -> Iterator[str]:
    order = table.order(plot.axes)
    for name, source in plot_sources(plot).items():
        if not _same(whole(entry[f"{plot.group}/{name}"]), table.numbers(source)[order]):
            yield f"{plot.group}/{name} differs"


def _sample_differences(entry: h5py.Group, contents: JournalContents) -> list[str]:
    """Compare every sample, every channel's scale and every block's place in time."""
    paths = segment_paths(contents)
    streams = contents.header.streams
    found: list[str] = []
    read = [0] * len(paths)

    def compare(number: int, first: int, rows: NDArray[Any]) -> None:
        data = entry[paths[number]]
        stream = streams[contents.segments[number].stream]
        for k, name in enumerate(channel_names(stream.channels)):
            if not _same(data[name][first : first + len(rows)], rows[:, k]):
                found.append(f"{paths[number]}/{name} differs at rows from {first}")
        read[number] += len(rows)

    blocks = walk_samples(contents, compare)
    for number, path in enumerate(paths):
        found += _segment_differences(entry[path], contents, number, read[number])
    for number, stream in enumerate(streams):
        for name, values in blocks.arrays(number).items():
            if not _same(whole(entry[f"blocks/{stream.name}/{name}"]), values):
                found.append(f"blocks/{stream.name}/{name} differs")
    return found


def _segment_differences(
    data: h5py.Group, contents: JournalContents, number: int, rows: int
) -> Iterator[str]:
    segment = contents.segments[number]
    yield from _attribute_differences(data, segment_attributes(contents, number))
    for k, name in enumerate(channel_names(contents.header.streams[segment.stream].channels)):
        field = data[name]
        if field.shape != (rows,):
            yield f"{field.name}: {field.shape} samples, the journal has {rows}"
        yield from _attribute_differences(field, channel_attributes(segment.state, k))


def _attribute_differences(
    item: h5py.Group | h5py.Dataset, expected: dict[str, Any]
) -> Iterator[str]:
    attributes = item.attrs
    for key, value in expected.items():
        if attributes.get(key) != value:
            yield f"{item.name}: attribute {key} differs"


def _same(found: NDArray[Any], expected: NDArray[Any]) -> bool:
    """Equal bit for bit, but for the payload of a NaN."""
    import numpy as np

    return (
        found.shape == expected.shape
        and found.dtype == expected.dtype
        and bool(np.array_equal(found, expected, equal_nan=found.dtype.kind == "f"))
    )
