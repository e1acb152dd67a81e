"""Reading a run file: a few plain questions, answered as values and arrays.

Opens with a plain read, never in SWMR mode, which can hang on a damaged file. Whatever is wrong
with the file is a RunFileError that names it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from rig.core.errors import shortened
from rig.core.units import counted
from rig.files.errors import RunFileError
from rig.files.hdf5.open_file import OpenFile
from rig.files.hdf5.safe_reading import text_of, texts_of, whole
from rig.files.journal.format import from_json
from rig.files.journal.values import Results, RunHeader
from rig.files.runfile.former_names import column_in, with_present_keys, with_present_names

if TYPE_CHECKING:
    import h5py
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True)
class RecordedOutcome:
    """The end of the run. `duration` in s; `status` is complete, stopped or failed."""

    status: str
    reason: str
    attempt: int
    points_planned: int
    points_done: int
    simulated: bool | None
    """None for an imported run, whose file does not state it."""
    seed: int
    exit: int
    duration: float
    warnings: tuple[str, ...]
    imported: bool = False
    """Made of another program's file, which the header's origin describes."""

    def extent(self, noun: tuple[str, str] = ("point", "points")) -> str:
        """Return how far the run came: ``stopped, 2 of 81 points``. `noun` is what its procedure
        calls a point, and several."""
        return f"{self.status}, {self.points_done} of {counted(self.points_planned, *noun)}"


@dataclass(frozen=True)
class Waveform:
    """Gapless samples of one stream. `counts` maps a channel to its raw counts, shape (n,)."""

    path: str
    point: str | None
    stream: str
    status: str
    rate_Hz: float | None
    first_index: int
    host_time: float
    counts: dict[str, NDArray[Any]]
    scale: dict[str, float]
    offset: dict[str, float]
    units: str
    """Unit of scale × count + offset."""

    def values(self, channel: str) -> NDArray[np.float64]:
        """Return a channel in `units`, float64 of shape (n,). Raises KeyError for one
        that the stream lacks."""
        if channel not in self.counts:
            there = ", ".join(self.counts)
            raise KeyError(f"no channel {channel!r} in the stream {self.stream!r}: it has {there}")
        values: NDArray[np.float64] = (
            self.counts[channel] * self.scale[channel] + self.offset[channel]
        )
        return values


class RunFile(OpenFile):
    """A run file that is open for reading; use it as a context."""

    KIND = "run file"
    REMEDY = "`rig recover` compiles it again if its journal still exists"

    def _check(self) -> None:
        if "entry/journal_header" not in self._file:
            if "entry/source/file_name" in self._file:
                made_from = text_of(self.entry["source/file_name"])
                raise RunFileError(
                    self.path,
                    "a processed file, not a run file",
                    f"name the run file that it was made from, {shortened(made_from)}",
                )
            raise RunFileError(
                self.path, "an HDF5 file, but not a run file: it has no journal header"
            )
        if not isinstance(self.header, RunHeader) or "outcome" not in self.entry:
            raise ValueError("it has no outcome")

    @cached_property
    def header(self) -> RunHeader:
        """The journal's header: settings, points, instruments, streams, layout."""
        return _header_of(self.entry)

    @property
    def settings(self) -> dict[str, Any]:
        """The run's resolved settings, nested."""
        return self.header.settings

    @property
    def end_time(self) -> str | None:
        """Time at which the run ended, ISO 8601. None for an imported run whose time is not
        known."""
        with self._naming():
            return text_of(self.entry["end_time"]) if "end_time" in self.entry else None

    @property
    def outcome(self) -> RecordedOutcome:
        """The end of the run: status, reason, number of points."""
        with self._naming():
            group = self.entry["outcome"]
            number = {name: int(whole(group[name])) for name in _NUMBERS}
            imported = "imported" in group and bool(whole(group["imported"]))
            return RecordedOutcome(
                status=text_of(group["status"]),
                reason=text_of(group["reason"]),
                attempt=number["attempt"],
                points_planned=number["points_planned"],
                points_done=number["points_done"],
                simulated=None if imported else bool(whole(group["simulated"])),
                seed=number["seed"],
                exit=number["exit"],
                duration=float(whole(group["duration"])),
                warnings=tuple(texts_of(group["warnings"])),
                imported=imported,
            )

    @property
    def results(self) -> Results | None:
        """What the procedure computed when the run ended, by present names; None where the file has
        no results, as those of earlier versions and of imports."""
        with self._naming():
            if "results" not in self.entry:
                return None
            stored = Results.model_validate(from_json(text_of(self.entry["results/record/data"])))
        values = with_present_names(self.header.layout, stored.values)
        return stored.model_copy(update={"values": values})

    def event_codes(self) -> list[tuple[float, str]]:
        """Return time, in s since the run's start, and code of each event of the run, in order."""
        with self._naming():
            times_s = whole(self.entry["events/time"]).tolist()
            return list(zip(times_s, texts_of(self.entry["events/code"]), strict=True))

    def point_ids(self) -> list[str]:
        """Return the ids of the kept points, in the order of ``column``'s rows."""
        with self._naming():
            return texts_of(self.entry["points/id"])

    def columns(self) -> list[str]:
        """Return the names of the columns of the readings."""
        return [column.name for column in self.header.layout.columns]

    def column(self, name: str) -> NDArray[Any]:
        """Return a column of the readings, float64 (or text) of shape (points,), in plot order.

        The present name also finds the column in files that were written before it was renamed.
        Raises RunFileError if the file lacks this column.
        """
        if name not in self.columns():
            name = column_in(self.header.layout, name)
        if name not in self.columns():
            raise RunFileError(self.path, f"no column {name!r}", f"it has {self.columns()}")
        with self._naming():
            if self.header.layout.column(name).kind == "text":
                import numpy as np

                return np.array(texts_of(self.entry[f"points/{name}"]), dtype=object)
            numbers: NDArray[Any] = whole(self.entry[f"points/{name}"])
            return numbers

    def readings(self) -> list[dict[str, Any]]:
        """Return the readings as the procedure gave them, by their present keys, in the order of
        ``point_ids``."""
        with self._naming():
            results = texts_of(self.entry["attempts/result"])
            readings = [
                from_json(results[n])["reading"] for n in whole(self.entry["points/attempt"])
            ]
        return [with_present_keys(self.header.layout, reading) for reading in readings]

    def waveforms(
        self, point: str | None = None, status: str = "kept", stream: str | None = None
    ) -> Iterator[Waveform]:
        """Yield samples, one segment at a time: of one point or all, of one stream or all.

        `status` is kept, discarded, unfinished or between (recorded while no point was open).
        Raises RunFileError if the file is damaged there.
        """
        places = {"kept": "waveforms", "between": "between_points"}
        place = places.get(status, "discarded")
        with self._naming():
            names = list(self.entry[place]) if place in self.entry else []
            for name in names:
                data = self.entry[f"{place}/{name}"]
                if (
                    data.attrs["status"] == status
                    and point in (None, data.attrs.get("point"))
                    and stream in (None, data.attrs["stream"])
                ):
                    yield _waveform(data)

    def sampling(self) -> dict[str, tuple[float | None, str]]:
        """Return for each recorded stream its rate in Hz and the unit of its values, without
        reading a sample. The rate is None where rows are not evenly spaced."""
        found: dict[str, tuple[float | None, str]] = {}
        with self._naming():
            for place in ("waveforms", "discarded", "between_points"):
                for data in self.entry[place].values() if place in self.entry else ():
                    if (stream := data.attrs.get("stream")) is not None and stream not in found:
                        channel = data[str(data.attrs["signal"])].attrs
                        rate = float(channel["rate_Hz"]) if "rate_Hz" in channel else None
                        unit = channel.get("scaled_units", channel.get("units", ""))
                        found[str(stream)] = rate, str(unit)
        return found


def _header_of(entry: h5py.Group) -> RunHeader:
    """Return the run's header from the file. Raises ValueError if it is not a header."""
    return RunHeader.model_validate(from_json(text_of(entry["journal_header/data"])))


_NUMBERS = ("attempt", "points_planned", "points_done", "seed", "exit")


def _waveform(data: h5py.Group) -> Waveform:
    names = [str(data.attrs["signal"]), *map(str, data.attrs.get("auxiliary_signals", ()))]
    first = data[names[0]].attrs
    return Waveform(
        path=data.name,
        point=data.attrs.get("point"),
        stream=data.attrs["stream"],
        status=data.attrs["status"],
        rate_Hz=float(first["rate_Hz"]) if "rate_Hz" in first else None,
        first_index=int(data.attrs["first_index"]),
        host_time=float(data.attrs["host_time"]),
        counts={name: whole(data[name]) for name in names},
        scale={name: float(data[name].attrs.get("scale", 1.0)) for name in names},
        offset={name: float(data[name].attrs.get("offset", 0.0)) for name in names},
        units=str(first.get("scaled_units", data[names[0]].attrs.get("units", ""))),
    )
