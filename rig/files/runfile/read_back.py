"""Checks that a run file holds all that its journal holds, to the last sample.

The file is read from the disk; the journal is not read again: its texts and points are known from
`read_journal`, its samples from the digests that `SampleWalk` took of them. This check is what
lets the journal of a complete run be deleted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.files.errors import in_words
from rig.files.hdf5.nexus import CHUNK_ROWS, plain_text
from rig.files.hdf5.safe_reading import DAMAGE, text_of, texts_of, whole
from rig.files.journal.format import to_json
from rig.files.journal.layout import Plot
from rig.files.journal.reader import JournalContents, ending
from rig.files.runfile.sample_groups import (
    channel_attributes,
    channel_names,
    segment_attributes,
    segment_paths,
)
from rig.files.runfile.sample_walk import SampleWalk, channel_digests
from rig.files.runfile.table import PointTable, point_table
from rig.files.runfile.write_results import result_differences

if TYPE_CHECKING:
    import h5py
    from numpy.typing import NDArray


def differences(walk: SampleWalk, file: Path) -> list[str]:
    """Return what the file lacks of the journal or has otherwise, one sentence each.

    The list is empty if the file holds everything. `walk` is a walk over the journal's samples that
    has come to its end. Reads every sample of the file; a damaged file is a finding, not an error.
    """
    import h5py

    contents = walk.contents
    try:
        with h5py.File(file) as opened:
            entry = opened["entry"]
            found = list(_text_differences(entry, contents))
            found += result_differences(entry, contents.results)
            found += _table_differences(entry, contents, point_table(contents))
            found += _sample_differences(entry, walk)
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
    for name, source in plot.sources().items():
        if not _same(whole(entry[f"{plot.group}/{name}"]), table.numbers(source)[order]):
            yield f"{plot.group}/{name} differs"


def _sample_differences(entry: h5py.Group, walk: SampleWalk) -> Iterator[str]:
    """Yield every sample, every channel's scale and every block's place in time."""
    contents = walk.contents
    for number, path in enumerate(segment_paths(contents)):
        data, segment = entry[path], contents.segments[number]
        stream = contents.header.streams[segment.stream]
        yield from _attribute_differences(data, segment_attributes(contents, number))
        for k, name in enumerate(channel_names(stream.channels)):
            field = data[name]
            yield from _attribute_differences(field, channel_attributes(segment.state, k))
            if field.shape != (segment.rows,) or field.dtype != stream.dtype:
                yield (
                    f"{field.name}: {field.shape} samples of {field.dtype}, the journal has "
                    f"{segment.rows} of {stream.dtype}"
                )
                continue
            yield from _piece_differences(field, [piece[k] for piece in walk.digests[number]])
    for number, stream in enumerate(contents.header.streams):
        for name, values in walk.blocks.arrays(number).items():
            if not _same(whole(entry[f"blocks/{stream.name}/{name}"]), values):
                yield f"blocks/{stream.name}/{name} differs"


def _piece_differences(field: h5py.Dataset, expected: Sequence[bytes]) -> Iterator[str]:
    """Read a channel in the pieces in which the journal's walk made digests of it."""
    if len(expected) != -(-len(field) // CHUNK_ROWS):
        # Rows without a digest would pass unseen, and the journal would be deleted.
        yield f"{field.name}: the journal was not read to its end"
    for number, digest in enumerate(expected):
        first = number * CHUNK_ROWS
        if channel_digests(field[first : first + CHUNK_ROWS][:, None]) != [digest]:
            yield f"{field.name} differs at rows from {first}"


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
