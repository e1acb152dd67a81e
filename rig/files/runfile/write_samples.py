"""Writing samples: each piece of the journal's samples goes to its place in the run file.

Every segment becomes one NXdata group with one dataset of raw counts for each channel. A piece
passes here once, from `sample_walk` to its dataset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rig.files.hdf5.nexus import (
    CHUNK_ROWS,
    array_field,
    empty_field,
    group,
    label,
    set_attributes,
    share_scale,
    text_field,
)
from rig.files.journal.reader import JournalContents
from rig.files.journal.segments import Segment
from rig.files.runfile.sample_groups import (
    channel_attributes,
    channel_names,
    scaling_of_cf,
    segment_attributes,
    segment_paths,
    segments_of_times,
)
from rig.files.runfile.sample_walk import BlockTable, Piece

if TYPE_CHECKING:
    import h5py


GROUPS_OF_AN_AXIS = 60
"""Groups that share an axis. The list of datasets that use a dimension scale is an attribute, which
ends at 64 KiB, or 4000 datasets, and is written again with each of them; a group has 64 channels at
most."""


@dataclass
class _SharedAxis:
    """An axis, and how many groups have it."""

    dataset: h5py.Dataset
    groups: int = 1


class SampleWriter:
    """Writes pieces of samples into ``/entry``. Give it all pieces, then call `finish`."""

    def __init__(self, entry: h5py.Group, contents: JournalContents) -> None:
        self._entry = entry
        self._contents = contents
        self._paths = segment_paths(contents)
        self._places: dict[str, h5py.Group] = {}
        self._fields: dict[int, list[h5py.Dataset]] = {}
        """The datasets of each stream's present segment."""
        # Time axes of one rate and length are equal: they are stored once and hard-linked.
        self._axes: dict[tuple[float | None, int], _SharedAxis] = {}
        self._times_in = segments_of_times(contents)
        self._timed: dict[int, list[tuple[h5py.Group, list[h5py.Dataset]]]] = {}
        """Groups, with their channels, whose times are the rows of a segment, by that segment."""

    def write(self, piece: Piece) -> None:
        """Write one piece; the first of a segment makes its group."""
        segment = self._contents.segments[piece.segment]
        if piece.first == 0:
            self._fields[segment.stream] = self._make_group(piece.segment)
        end = piece.first + len(piece.rows)
        for k, field in enumerate(self._fields[segment.stream]):
            field[piece.first : end] = piece.rows[:, k]
            if end == segment.rows:
                # HDF5 chooses a chunk's place in the file when it leaves the cache. Without this
                # that happens when Python lets go of the dataset, and the same journal would not
                # give the same bytes.
                field.flush()

    def finish(self, blocks: BlockTable) -> None:
        """Write what follows from all pieces: default plots, the map of blocks to time, traces."""
        for place, made in self._places.items():
            first = next(p for p in self._paths if p.startswith(f"{place}/"))
            made.attrs["default"] = first.removeprefix(f"{place}/")
        self._write_times()
        self._write_blocks(blocks)
        self._write_traces()

    def _make_group(self, number: int) -> list[h5py.Dataset]:
        """Create the group of a segment; returns its channels' datasets, to be filled."""
        segment = self._contents.segments[number]
        stream = self._contents.header.streams[segment.stream]
        place, name = self._paths[number].split("/")
        if place not in self._places:
            self._places[place] = group(self._entry, place, "NXcollection")
        data = group(self._places[place], name, "NXdata")
        fields = []
        names = channel_names(stream.channels)
        units = stream.units or (segment.state.units if segment.state else "")
        timed_by = self._times_in.get(number)
        axis, scale = ("time", None) if timed_by is not None else self._axis(data, segment)
        set_attributes(data, {"signal": names[0], "axes": [axis]})
        if names[1:]:
            set_attributes(data, {"auxiliary_signals": names[1:]})
        set_attributes(data, segment_attributes(self._contents, number))
        text_field(data, "title", self._title(segment, stream.name))
        for k, (dataset, channel) in enumerate(zip(names, stream.channels, strict=True)):
            field = empty_field(data, dataset, (segment.rows,), stream.dtype)
            if scaling := scaling_of_cf(segment.state, k):  # its unit is that of scaled values
                assert segment.state is not None
                scaled = segment.state.units
                label(field, scaled, f"{channel} ({units} × scale_factor + add_offset = {scaled})")
            else:
                label(field, units, f"{channel} ({units})")
            set_attributes(field, channel_attributes(segment.state, k) | scaling)
            if scale is not None:
                field.dims[0].attach_scale(scale)
            fields.append(field)
        if timed_by is not None:
            self._timed.setdefault(timed_by, []).append((data, fields))
        return fields

    def _write_times(self) -> None:
        """Give those groups their times whose rows have no rate: rows of another stream."""
        for number, groups in self._timed.items():
            source = self._entry[self._paths[number]]
            channel = source[source.attrs["signal"]]
            scale, offset = channel.attrs.get("scale", 1.0), channel.attrs.get("offset", 0.0)
            values = channel[()] * scale + offset
            times: h5py.Dataset | None = None
            for data, fields in groups:
                if times is None:
                    times = array_field(data, "time", values, "s", "Time (s)")
                    times.make_scale("time")
                else:
                    data["time"] = times
                for field in fields:
                    field.dims[0].attach_scale(times)

    def _title(self, segment: Segment, stream: str) -> str:
        marked = self._contents.header.marked
        if segment.attempt is None:
            return marked(f"{stream} between points")
        attempt = self._contents.attempts[segment.attempt]
        status = "" if attempt.status == "kept" else f" ({attempt.status})"
        return marked(f"{attempt.id}{status}: {stream}")

    def _axis(self, data: h5py.Group, segment: Segment) -> tuple[str, h5py.Dataset]:
        """Give a group its axis, a dimension scale; its name is ``time``, or ``sample`` without a
        rate. Return both."""
        import numpy as np

        rate = segment.state.rate_Hz if segment.state else None
        name = "time" if rate else "sample"
        key = (rate, segment.rows)
        shared = self._axes.get(key)
        if shared is not None and shared.groups < GROUPS_OF_AN_AXIS:
            shared.groups += 1
            data[name] = shared.dataset
            return name, shared.dataset
        axis = empty_field(data, name, (segment.rows,), np.float64 if rate else np.int64)
        for first in range(0, segment.rows, CHUNK_ROWS):
            index = np.arange(first, min(first + CHUNK_ROWS, segment.rows))
            axis[first : first + len(index)] = index / rate if rate else index
        axis.flush()
        label(axis, "s" if rate else "1", "Time (s)" if rate else "Sample")
        axis.make_scale(name)
        self._axes[key] = _SharedAxis(axis)
        return name, axis

    def _write_blocks(self, table: BlockTable) -> None:
        header = self._contents.header
        blocks = group(self._entry, "blocks", "NXcollection")
        for number, stream in enumerate(header.streams):
            part = group(blocks, stream.name, "NXcollection")
            for name, values in table.arrays(number).items():
                field = array_field(part, name, values, "s" if name == "host_time" else "1")
                if name == "host_time" and header.start_time is not None:
                    field.attrs["start"] = header.start_time
            share_scale(part, "host_time")

    def _write_traces(self) -> None:
        """Make the layout's traces: groups that link the samples of the first kept point."""
        for trace in self._contents.header.layout.traces:
            number = self._shown(trace.stream)
            if number is None:
                continue
            samples, segment = self._entry[self._paths[number]], self._contents.segments[number]
            made = group(self._entry, trace.group, "NXdata")
            axis = str(samples.attrs["axes"][0])
            set_attributes(made, {"signal": trace.signal})
            made.attrs["axes"] = [axis]
            if trace.auxiliary:
                made.attrs["auxiliary_signals"] = list(trace.auxiliary)
            assert segment.attempt is not None
            point = self._contents.attempts[segment.attempt].id
            title = f"{trace.title or trace.group}: {point}"
            text_field(made, "title", self._contents.header.marked(title))
            for name in (axis, *trace.channels()):
                made[name] = samples[name]

    def _shown(self, stream: str) -> int | None:
        """Return the segment of that stream in the first planned point that was kept, or None."""
        contents = self._contents
        rank = {point_id: n for n, point_id in enumerate(contents.header.points)}
        kept = [
            (rank.get(contents.attempts[segment.attempt].id, len(rank)), number)
            for number, segment in enumerate(contents.segments)
            if segment.attempt is not None
            and contents.header.streams[segment.stream].name == stream
            and contents.attempts[segment.attempt].status == "kept"
        ]
        return min(kept)[1] if kept else None
