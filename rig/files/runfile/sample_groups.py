"""Assigns the samples of a journal to groups of its run file: one group for each segment, by name.

Pure functions of the journal's contents, which the writer and the read-back share: both have to
know the same places and attributes, and neither takes them from the other.
"""

from __future__ import annotations

from typing import Any

from rig.files.hdf5.nexus import UniqueNames, plain_text
from rig.files.journal.reader import JournalContents
from rig.files.journal.segments import Segment
from rig.files.journal.values import StreamState

PLACES = {
    "kept": "waveforms",
    "discarded": "discarded",
    "unfinished": "discarded",
    "between": "between_points",
}
"""Group in ``/entry`` for a segment, by the status of its attempt."""


def segment_paths(contents: JournalContents) -> list[str]:
    """Return the path inside ``/entry`` of each segment, in the journal's order; all different.

    A segment is named after its point; with the stream's name if there are several streams, and
    with ``_part2`` and so on if the stream was interrupted or changed within the attempt.
    """
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
    """Return kept, discarded or unfinished as the attempt was, or between: no point was open."""
    return "between" if segment.attempt is None else contents.attempts[segment.attempt].status


def _name(contents: JournalContents, segment: Segment, part: int) -> str:
    if segment.attempt is None:
        name = contents.header.streams[segment.stream].name
    else:
        name = contents.attempts[segment.attempt].id
        if len(contents.header.streams) > 1:
            name += f"_{contents.header.streams[segment.stream].name}"
    return name if part == 1 else f"{name}_part{part}"


def channel_names(channels: tuple[str, ...]) -> list[str]:
    """Return the dataset names of a stream's channels, all different."""
    names = UniqueNames("title", "time", "sample")
    return [names.name(channel) for channel in channels]


def segment_attributes(contents: JournalContents, number: int) -> dict[str, Any]:
    """Return the attributes of a segment's group: which rows of which stream and attempt it has.

    ``host_time`` is the time of its first block in s since the run's start.
    """
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


def segments_of_times(contents: JournalContents) -> dict[int, int]:
    """Return, for each segment whose rows have no rate, the segment whose rows are their times.

    Left out are segments whose stream names no such stream, and those whose number of rows
    differs.
    """
    streams = contents.header.streams

    def rows_of(segment: Segment, stream: str) -> tuple[str, int | None, int, int]:
        return stream, segment.attempt, segment.first_index, segment.rows

    clocks = {
        rows_of(segment, streams[segment.stream].name): number
        for number, segment in enumerate(contents.segments)
        if len(streams[segment.stream].channels) == 1
    }
    return {
        number: clocks[key]
        for number, segment in enumerate(contents.segments)
        if (times := streams[segment.stream].times) and (key := rows_of(segment, times)) in clocks
    }


def channel_attributes(state: StreamState | None, channel: int) -> dict[str, Any]:
    """Return the attributes of a channel's dataset: value = scale × count + offset, in
    ``scaled_units``. None are known if the journal has no state for the stream.
    """
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


def scaling_of_cf(state: StreamState | None, channel: int) -> dict[str, Any]:
    """Return scale and offset under the names of the CF conventions, by which other programs apply
    them; nothing if they change nothing.

    They repeat what other fields state, and files of earlier versions lack them.
    """
    if state is None or (state.scale[channel], state.offset[channel]) == (1.0, 0.0):
        return {}
    return {"scale_factor": state.scale[channel], "add_offset": state.offset[channel]}
