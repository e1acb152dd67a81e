"""The samples of a run file: where each segment of the journal goes, and its bytes.

Every segment becomes one NXdata group with one dataset of raw counts a channel. Samples pass in
pieces of whole chunks, so that each chunk is compressed once and memory holds one piece a stream.
The same walk writes them and compares them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rig.files.hdf5.nexus import (
    CHUNK_ROWS,
    UniqueNames,
    array_field,
    empty_field,
    group,
    label,
    plain_text,
    set_attributes,
    text_field,
)
from rig.files.journal.format import Block
from rig.files.journal.reader import JournalContents
from rig.files.journal.segments import Grouping, Segment
from rig.files.journal.values import RunHeader, StreamState

if TYPE_CHECKING:
    import h5py
    from numpy.typing import NDArray

PLACES = {
    "kept": "waveforms",
    "discarded": "discarded",
    "unfinished": "discarded",
    "between": "between_points",
}
"""Group of a segment, by what became of its attempt."""

Piece = Callable[[int, int, "NDArray[Any]"], None]
"""Takes (segment, first row, rows of shape (n, channels))."""


def segment_paths(contents: JournalContents) -> list[str]:
    """Path inside ``/entry`` of each segment of the journal, in order; all different."""
    names = {place: UniqueNames() for place in set(PLACES.values())}
    parts: dict[tuple[int | None, int], int] = {}
    paths = []
    for segment in contents.segments:
        key = (segment.attempt, segment.stream)
        parts[key] = parts.get(key, 0) + 1
        place = PLACES[status_of(contents, segment)]
        name = _name(contents, segment, parts[key])
        paths.append(f"{place}/{names[place].name(name)}")
    return paths


def status_of(contents: JournalContents, segment: Segment) -> str:
    """kept, discarded, unfinished, or between (no point was open)."""
    return "between" if segment.attempt is None else contents.attempts[segment.attempt].status


def _name(contents: JournalContents, segment: Segment, part: int) -> str:
    if segment.attempt is None:
        name = contents.header.streams[segment.stream].name
    else:
        name = contents.attempts[segment.attempt].id
        if len(contents.header.streams) > 1:
            name += f"_{contents.header.streams[segment.stream].name}"
    return name if part == 1 else f"{name}_part{part}"


def walk_samples(contents: JournalContents, piece: Piece) -> BlockTable:
    """Hand over all samples of the journal in pieces of at most CHUNK_ROWS rows.

    Pieces of a segment begin at multiples of CHUNK_ROWS. Gives the map of blocks to time.
    """
    table = BlockTable(len(contents.header.streams))
    grouping = Grouping(contents.header)
    gathering: dict[int, _Gathering] = {}
    for record in contents.records():
        index = grouping.follow(record)
        if index is None or not isinstance(record, Block):
            continue
        gathered = gathering.get(record.stream)
        if gathered is None or gathered.segment != index:
            if gathered:
                gathered.flush(piece)
            gathered = gathering[record.stream] = _Gathering(index)
        rows = rows_of(record, contents.header)
        table.add(record, index, len(rows))
        gathered.add(rows, piece)
    for gathered in gathering.values():
        gathered.flush(piece)
    return table


def rows_of(block: Block, header: RunHeader) -> NDArray[Any]:
    """A block's rows, shape (n, channels)."""
    import numpy as np

    stream = header.streams[block.stream]
    return np.frombuffer(block.data, stream.dtype).reshape(-1, len(stream.channels))


class BlockTable:
    """A row a block, for each stream: segment, first index, host time, rows."""

    def __init__(self, streams: int) -> None:
        from array import array

        self.columns = [
            {"segment": array("q"), "first_index": array("q"), "rows": array("q")}
            for _ in range(streams)
        ]
        self.host_times = [array("d") for _ in range(streams)]

    def add(self, block: Block, segment: int, rows: int) -> None:
        """The next block."""
        columns = self.columns[block.stream]
        columns["segment"].append(segment)
        columns["first_index"].append(block.first_index)
        columns["rows"].append(rows)
        self.host_times[block.stream].append(block.host_time)

    def arrays(self, stream: int) -> dict[str, NDArray[Any]]:
        """The columns of a stream: int64, and float64 s since start for ``host_time``."""
        import numpy as np

        arrays = {name: np.array(v, np.int64) for name, v in self.columns[stream].items()}
        return arrays | {"host_time": np.array(self.host_times[stream], np.float64)}


class _Gathering:
    """Rows of a segment until they fill a chunk."""

    def __init__(self, segment: int) -> None:
        self.segment = segment
        self._rows: list[NDArray[Any]] = []
        self._held = 0
        self._done = 0

    def add(self, rows: NDArray[Any], piece: Piece) -> None:
        while self._held + len(rows) >= CHUNK_ROWS:
            taken = CHUNK_ROWS - self._held
            self._hold(rows[:taken])
            self.flush(piece)
            rows = rows[taken:]
        if len(rows):
            self._hold(rows)

    def _hold(self, rows: NDArray[Any]) -> None:
        self._rows.append(rows)
        self._held += len(rows)

    def flush(self, piece: Piece) -> None:
        import numpy as np

        if self._held:
            rows = self._rows[0] if len(self._rows) == 1 else np.concatenate(self._rows)
            piece(self.segment, self._done, rows)
            self._done += self._held
            self._rows, self._held = [], 0


def write_traces(entry: h5py.Group, contents: JournalContents) -> None:
    """The layout's traces: groups that link the samples of the first kept point, where there is
    one."""
    paths = segment_paths(contents)
    for trace in contents.header.layout.traces:
        number = _shown(contents, trace.stream)
        if number is None:
            continue
        samples, segment = entry[paths[number]], contents.segments[number]
        made = group(entry, trace.group, "NXdata")
        axis = str(samples.attrs["axes"][0])
        set_attributes(made, {"signal": trace.signal})
        made.attrs["axes"] = [axis]
        if trace.auxiliary:
            made.attrs["auxiliary_signals"] = list(trace.auxiliary)
        assert segment.attempt is not None
        point = contents.attempts[segment.attempt].id
        title = f"{trace.title or trace.group}: {point}"
        text_field(made, "title", contents.header.marked(title))
        for name in (axis, *trace.channels()):
            made[name] = samples[name]


def _shown(contents: JournalContents, stream: str) -> int | None:
    """The segment of the first planned point that was kept."""
    rank = {point_id: n for n, point_id in enumerate(contents.header.points)}
    kept = [
        (rank.get(contents.attempts[segment.attempt].id, len(rank)), number)
        for number, segment in enumerate(contents.segments)
        if segment.attempt is not None
        and contents.header.streams[segment.stream].name == stream
        and contents.attempts[segment.attempt].status == "kept"
    ]
    return min(kept)[1] if kept else None


class WaveformWriter:
    """Writes segments as NXdata groups; time axes of one rate and length are stored once."""

    def __init__(self, entry: h5py.Group, contents: JournalContents) -> None:
        self._entry = entry
        self._contents = contents
        self._paths = segment_paths(contents)
        self._axes: dict[tuple[float | None, int], h5py.Dataset] = {}
        self._places: dict[str, h5py.Group] = {}
        self._fields: dict[int, list[h5py.Dataset]] = {}
        """The fields of each stream's present segment."""

    def write(self, check: Callable[[], None]) -> None:
        """All samples, and the map of blocks to time; ``check`` is called after each piece."""

        def piece(number: int, first: int, rows: NDArray[Any]) -> None:
            self._piece(number, first, rows)
            check()

        table = walk_samples(self._contents, piece)
        for place, made in self._places.items():
            first = next(p for p in self._paths if p.startswith(f"{place}/"))
            made.attrs["default"] = first.removeprefix(f"{place}/")
        blocks = group(self._entry, "blocks", "NXcollection")
        for number, stream in enumerate(self._contents.header.streams):
            part = group(blocks, stream.name, "NXcollection")
            for name, values in table.arrays(number).items():
                field = array_field(part, name, values, "s" if name == "host_time" else "1")
                if name == "host_time" and self._contents.header.start_time is not None:
                    field.attrs["start"] = self._contents.header.start_time

    def _piece(self, number: int, first: int, rows: NDArray[Any]) -> None:
        stream = self._contents.segments[number].stream
        if first == 0:
            self._fields[stream] = self._make_group(number)
        end = first + len(rows)
        for k, field in enumerate(self._fields[stream]):
            field[first:end] = rows[:, k]
            if end == self._contents.segments[number].rows:
                field.flush()  # its place in the file is found now, not when it is let go

    def _make_group(self, number: int) -> list[h5py.Dataset]:
        """The group of a segment; gives its channels' fields, to be filled."""
        segment = self._contents.segments[number]
        stream = self._contents.header.streams[segment.stream]
        place, name = self._paths[number].split("/")
        if place not in self._places:
            self._places[place] = group(self._entry, place, "NXcollection")
        data = group(self._places[place], name, "NXdata")
        fields = []
        names = channel_names(stream.channels)
        units = stream.units or (segment.state.units if segment.state else "")
        axis = self._axis(data, segment)
        set_attributes(data, {"signal": names[0], "axes": [axis]})
        if names[1:]:
            set_attributes(data, {"auxiliary_signals": names[1:]})
        set_attributes(data, segment_attributes(self._contents, number))
        text_field(data, "title", self._title(segment, stream.name))
        for k, (dataset, channel) in enumerate(zip(names, stream.channels, strict=True)):
            field = empty_field(data, dataset, (segment.rows,), stream.dtype)
            label(field, units, f"{channel} ({units})")
            set_attributes(field, channel_attributes(segment.state, k))
            fields.append(field)
        return fields

    def _title(self, segment: Segment, stream: str) -> str:
        marked = self._contents.header.marked
        if segment.attempt is None:
            return marked(f"{stream} between points")
        attempt = self._contents.attempts[segment.attempt]
        status = "" if attempt.status == "kept" else f" ({attempt.status})"
        return marked(f"{attempt.id}{status}: {stream}")

    def _axis(self, data: h5py.Group, segment: Segment) -> str:
        import numpy as np

        rate = segment.state.rate_Hz if segment.state else None
        name = "time" if rate else "sample"
        key = (rate, segment.rows)
        if key in self._axes:
            data[name] = self._axes[key]
            return name
        axis = empty_field(data, name, (segment.rows,), np.float64 if rate else np.int64)
        for first in range(0, segment.rows, CHUNK_ROWS):
            index = np.arange(first, min(first + CHUNK_ROWS, segment.rows))
            axis[first : first + len(index)] = index / rate if rate else index
        axis.flush()
        label(axis, "s" if rate else "1", "Time (s)" if rate else "Sample")
        self._axes[key] = axis
        return name


def channel_names(channels: tuple[str, ...]) -> list[str]:
    """Dataset names of a stream's channels, all different."""
    names = UniqueNames("title", "time", "sample")
    return [names.name(channel) for channel in channels]


def segment_attributes(contents: JournalContents, number: int) -> dict[str, Any]:
    """What a segment's group says about where it comes from."""
    segment = contents.segments[number]
    attributes: dict[str, Any] = {
        "segment": number,
        "stream": contents.header.streams[segment.stream].name,
        "first_index": segment.first_index,
        "host_time": segment.host_time,
        "status": status_of(contents, segment),
    }
    if segment.attempt is not None:
        attributes["point"] = plain_text(contents.attempts[segment.attempt].id)
        attributes["attempt"] = segment.attempt
    return attributes


def channel_attributes(state: StreamState | None, channel: int) -> dict[str, Any]:
    """How a channel's counts read: value = scale × count + offset, in ``scaled_units``."""
    if state is None:
        return {}
    attributes: dict[str, Any] = {
        "scale": state.scale[channel],
        "offset": state.offset[channel],
        "scaled_units": state.units,
    }
    if state.rate_Hz is not None:
        attributes["rate_Hz"] = state.rate_Hz
    if state.delay_s:
        attributes["delay_s"] = state.delay_s[channel]
    if state.range:
        attributes["range"] = state.range[channel]
    return attributes
