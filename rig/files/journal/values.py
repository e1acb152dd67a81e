"""The typed values a journal carries as JSON: the run's header, streams, events and its end.

Values only: no files, no bytes. Unknown keys are refused when a journal is written, which is before
anything moved. A key may be added to format 1 if older journals, which lack it, keep their meaning
and write back to the same text.
"""

from __future__ import annotations

import math
import re
from datetime import datetime
from functools import cached_property
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    StringConstraints,
    model_serializer,
    model_validator,
)

from rig.core.settings import Settings
from rig.core.toml_files import check_nesting
from rig.files.journal.layout import MOST_PARTS, Layout, Short

FORMAT = 1

PointId = Annotated[str, StringConstraints(min_length=1, max_length=256)]


def _with_offset(text: str) -> str:
    when = datetime.fromisoformat(text)
    if when.tzinfo is None:
        raise ValueError("a time needs its offset from UTC")
    if not 1970 <= when.year < 3000:
        raise ValueError(f"the year {when.year} cannot be that of a run")
    return text


def _sane(value: dict[str, Any]) -> dict[str, Any]:
    check_nesting(value)
    return value


Tree = Annotated[dict[str, Any], AfterValidator(_sane)]
"""Nested JSON values, no deeper and no more than `check_nesting` allows."""

LONGEST_S = 1e10
"""Three centuries: a longer time is an error, and no calendar can add it to the run's start."""
Seconds = Annotated[float, Field(ge=-LONGEST_S, le=LONGEST_S)]

LARGEST_COUNT = 10**9
Count = Annotated[int, Field(ge=0, le=LARGEST_COUNT)]

IsoTime = Annotated[str, StringConstraints(max_length=40), AfterValidator(_with_offset)]
"""ISO 8601 with an offset from UTC."""


class Program(Settings):
    """The program that made the run."""

    name: Short
    version: Short
    configuration: Short = ""
    """Hash of the source, with "+dirty" where it was changed."""


SIMULATED = "SIMULATED"
"""First word of every title and vendor of data that were computed and not measured."""
IMPORTED = "IMPORTED"
"""First word of every title of data that were recorded by another program."""


class Origin(Settings):
    """The file of another program that an imported run was made of, and what the user stated about
    it.
    """

    file_name: Short
    sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
    bytes: Annotated[int, Field(ge=0, le=2**63 - 1)]
    format: Short
    imported_at: IsoTime
    options: dict[str, str]
    """The command's options as they were written, by their names."""
    head: str = ""
    """The text in the file before its numbers."""


class PersonOrSample(Settings):
    """A person or a sample: a name and whatever else was stated."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=True)

    name: Short = ""

    @model_validator(mode="after")
    def _is_sane(self) -> PersonOrSample:
        check_nesting(self.details())
        return self

    def details(self) -> dict[str, Any]:
        """Return everything that was stated except the name."""
        return dict(self.model_extra or {})


def _without_empty(plain: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return what is stored without those of the named keys that are empty."""
    return {name: value for name, value in plain.items() if value or name not in names}


class InstrumentRecord(Settings):
    """One instrument of the bench, as it identified itself."""

    name: Short
    role: Short = ""
    vendor: Short = ""
    model: Short = ""
    serial_number: Short = ""
    firmware: Short = ""
    driver: Short = ""
    driver_package: Short = ""
    """Package of a driver that is not this program's own; the record of any other instrument has
    neither this key nor the next."""
    driver_version: Short = ""
    """Version of that package."""
    simulated: bool = False

    @model_serializer(mode="wrap")
    def _without_no_package(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return _without_empty(serialize(self), "driver_package", "driver_version")


_DTYPE = re.compile(r"(\|[iu]1|[<>][iu][248]|[<>]f[48])\Z")


class Stream(Settings):
    """A source of sample rows: its channels, and what the bytes of its blocks mean."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,62}$")]
    device: Short = ""
    channels: Annotated[tuple[Short, ...], Field(min_length=1, max_length=64)]
    dtype: Short
    """NumPy's notation, byte order included: ``<i2``."""
    row_shape: tuple[int, ...]
    """Shape of one row, (channels,)."""
    units: Short = "count"
    """Unit of the rows as they are; empty where each of the stream's states gives it."""
    long_name: Short = ""
    times: Short = ""
    """Name of the stream whose rows are the times of this one's rows, in s; empty for none. The
    header of a stream that has none has no such key."""

    @model_serializer(mode="wrap")
    def _without_no_times(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        plain: dict[str, Any] = serialize(self)
        if not self.times:
            del plain["times"]
        return plain

    @model_validator(mode="after")
    def _row_is_channels(self) -> Stream:
        if not _DTYPE.match(self.dtype):
            raise ValueError(f"dtype {self.dtype!r}: expected an integer or float such as '<i2'")
        if self.row_shape != (len(self.channels),):
            raise ValueError(f"row_shape {self.row_shape} is not ({len(self.channels)},)")
        if len(set(self.channels)) != len(self.channels):
            raise ValueError("two channels of one name")
        return self

    @cached_property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return int(self.dtype[-1]) * len(self.channels)


class StreamState(Settings):
    """The conversion of a stream's counts from here on: value = scale × count + offset.

    Each list has one entry per channel. It applies to the stream's blocks that follow it in the
    journal, until the next one.
    """

    model_config = ConfigDict(extra="allow")

    stream: Annotated[int, Field(ge=0, le=65535)]
    rate_Hz: Annotated[float, Field(gt=0)] | None = None
    scale: tuple[float, ...]
    offset: tuple[float, ...]
    units: Short = "V"
    """Unit of scale × count + offset."""
    delay_s: tuple[float, ...] = ()
    """Delay of each channel's sampling after the row's time stamp (multiplexed converters)."""
    range: tuple[float, ...] = ()
    """Full scale, in ``units``."""


class JournalEvent(Settings):
    """An event of a run: a state change, a limit trip, a hold, a retry."""

    time: Seconds
    """Since the run's start."""
    level: Short
    code: Short
    message: str


class End(Settings):
    """The end of the run, or of this attempt at it."""

    status: Literal["complete", "stopped", "failed"]
    reason: str = ""
    attempt: Annotated[int, Field(ge=1, le=LARGEST_COUNT)] = 1
    end_time: IsoTime | None
    """ISO 8601. None if the run's start is not known."""
    duration_s: Annotated[Seconds, Field(ge=0)]
    points_done: Count
    points_planned: Count | None = None
    """Number of planned points, including those that the run itself planned. If it is missing, it
    is the header's number."""
    warnings: tuple[str, ...] = ()
    exit: Annotated[int, Field(ge=0, le=255)] = 0


class Results(Settings):
    """What the procedure has computed from the readings of the whole run: its summary.

    It follows the END that it belongs to. A journal may lack it: the summary is computed when the
    data are on the disk, and may fail.
    """

    model_config = ConfigDict(allow_inf_nan=True)

    program: Program
    """The program that computed it; a resumed run may have been begun by another version."""
    method: Short = ""
    """How it was computed, in a sentence."""
    values: Tree
    """The summary, nested. An estimate is a table with value, standard_error, low, high, unit."""
    origins: dict[Short, Short] = Field(default_factory=dict)
    """Dotted name of a value, or of a group of values, to where it comes from; whatever is not
    named was measured."""
    put_in: Tree = Field(default_factory=dict)
    """Dotted name of a value to what a simulated World had put in, in the same unit."""
    labels: dict[Short, Short] = Field(default_factory=dict)
    """Name of a value to what it means."""


class RunHeader(Settings):
    """The description of a run that a journal has before the first sample."""

    format: Literal[1] = 1
    procedure: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,60}$")]
    layout: Layout
    title: Short
    run_uuid: Short
    collection: Short | None = None
    """The batch it belongs to."""
    run_number: Count = 0
    """Number of the run in its batch, from 1; keys the noise of a simulated bench."""
    start_time: IsoTime | None
    """None for an imported run whose start is not known."""
    program: Program
    procedure_package: Short = ""
    """Package of a procedure that is not this program's own; the header of any other run has
    neither this key nor the next."""
    procedure_version: Short = ""
    """Version of that package."""
    settings: Tree
    setting_units: dict[str, Short] = Field(default_factory=dict)
    """Dotted name of a setting to its unit."""
    fingerprint: Short
    bench_toml: str = ""
    bench_file: Short = ""
    simulated: bool | None
    """None for an imported run, whose file does not state it."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    points: tuple[PointId, ...]
    """Ids of the planned points, in the planned order."""
    user: PersonOrSample = PersonOrSample()
    sample: PersonOrSample = PersonOrSample()
    notes: str = ""
    accepted: str = ""
    """Reason for which presses were accepted that do not fit earlier runs; empty for none."""
    instruments: Annotated[tuple[InstrumentRecord, ...], Field(max_length=MOST_PARTS)] = ()
    calibrations: Annotated[tuple[Tree, ...], Field(max_length=MOST_PARTS)] = ()
    streams: Annotated[tuple[Stream, ...], Field(max_length=MOST_PARTS)] = ()
    origin: Origin | None = None
    """Origin of an imported run; the header of any other run has no such key."""

    @model_serializer(mode="wrap")
    def _without_no_origin(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        plain: dict[str, Any] = serialize(self)
        if self.origin is None:
            del plain["origin"]
        if not self.accepted:
            del plain["accepted"]
        return _without_empty(plain, "procedure_package", "procedure_version")

    @model_validator(mode="after")
    def _imported_or_run_here(self) -> RunHeader:
        if self.origin is None and (self.simulated is None or self.start_time is None):
            raise ValueError("a run that was not imported knows its start and what it ran on")
        if self.origin is not None and self.simulated is not None:
            raise ValueError("it is not known whether an imported run was simulated")
        return self

    @model_validator(mode="after")
    def _names_are_unique(self) -> RunHeader:
        for what, names in (
            ("points", self.points),
            ("instruments", tuple(i.name for i in self.instruments)),
            ("streams", tuple(s.name for s in self.streams)),
        ):
            if len(set(names)) != len(names):
                raise ValueError(f"{what}: two of one name")
        if any(i.simulated for i in self.instruments) and not self.simulated:
            raise ValueError("an instrument is simulated, the run says it is not")
        return self

    @property
    def mark(self) -> str:
        """First word of every title: SIMULATED, IMPORTED or nothing."""
        return IMPORTED if self.origin is not None else SIMULATED if self.simulated else ""

    def marked(self, title: str) -> str:
        """Return a title that begins with the run's mark."""
        if not self.mark or title.startswith(self.mark):
            return title
        return f"{self.mark} {title}"

    def check_state(self, state: StreamState) -> None:
        """Raise ValueError unless the state belongs to a stream of the run and has a value for each
        channel.
        """
        if state.stream >= len(self.streams):
            raise ValueError(f"stream {state.stream} of {len(self.streams)}")
        channels = len(self.streams[state.stream].channels)
        for name in ("scale", "offset"):
            if len(getattr(state, name)) != channels:
                raise ValueError(f"{name}: {channels} channels need as many values")
        for name in ("delay_s", "range"):
            if len(getattr(state, name)) not in (0, channels):
                raise ValueError(f"{name}: {channels} channels need as many values, or none")

    def check_block(self, stream: int, nbytes: int, first_index: int, host_time: float) -> int:
        """Return the rows of a block of `nbytes`. ValueError unless the stream can have sent it."""
        if not 0 <= stream < len(self.streams):
            raise ValueError(f"stream {stream} of {len(self.streams)}")
        row = self.streams[stream].row_bytes
        if nbytes == 0 or nbytes % row:
            raise ValueError(f"{nbytes} bytes are not whole rows of {row} bytes")
        if not 0 <= first_index < 2**63:
            raise ValueError(f"first_index {first_index} is out of range")
        if not math.isfinite(host_time):
            raise ValueError("host_time is not finite")
        if abs(host_time) > LONGEST_S:
            raise ValueError(f"host_time {host_time:g} s is beyond {LONGEST_S:g} s")
        return nbytes // row
