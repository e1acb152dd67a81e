"""A recording from elsewhere becomes a run file like any other, marked as imported.

The journal is written and compiled as a run's is. Whatever ends it before the file is complete
takes away what was begun, and no file that was there before is touched.
"""

from __future__ import annotations

import hashlib
import stat
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.settings import fingerprint
from rig.files.errors import ForeignFileError, RecordingError
from rig.files.file_kind import IN_WORDS
from rig.files.hdf5.nexus import CHUNK_ROWS, plain_text
from rig.files.imported import lvm, matlab, matlab_variables
from rig.files.imported.dialect import Decimal, Delimiter
from rig.files.imported.labels import Label, label_of
from rig.files.imported.series import FORCES, STRIPS, UNIT, ChannelMap, Recording, recording_of
from rig.files.imported.source import MAX_BYTES, ImportSource
from rig.files.imported.text import read_text
from rig.files.journal.layout import Column, Layout, Trace
from rig.files.journal.values import IMPORTED, Origin, Program
from rig.files.journal.writer import JournalWriter, begin_journal
from rig.files.naming import RUN_SUFFIX, checksum_path
from rig.files.runfile.compile import compile_run

if TYPE_CHECKING:
    from numpy.typing import NDArray

PROCEDURE = "import"
POINT = "recording"
"""Id of the one point that the file holds."""


@dataclass(frozen=True)
class RecordingNotes:
    """The user's statements about a recording, apart from its numbers; all of them may be
    unknown."""

    sensor: str = ""
    sample: str = ""
    object: str = ""
    """The object that the skin touched."""
    user: str = ""
    notes: str = ""
    start_time: str | None = None
    """ISO 8601 with an offset from UTC."""
    options: Mapping[str, str] = field(default_factory=dict)
    """The command's options as they were written."""
    labels: Mapping[str, str] | None = None
    """Its line of a list of labels (`rig.files.imported.labels`)."""


@dataclass(frozen=True)
class ForeignFile:
    """A file that was read once: name, hash and columns are those of the same bytes."""

    name: str
    sha256: str
    size: int
    source: ImportSource


def read_foreign(
    path: Path,
    delimiter: Delimiter | None = None,
    decimal: Decimal | None = None,
    header_lines: int | None = None,
) -> ForeignFile:
    """Open a text, LVM, MATLAB or npz file, recognised by its first bytes.

    The last three are for text, where they are not to be recognised. Raises ForeignFileError for
    anything else, and for a file beyond MAX_BYTES.
    """
    name = plain_text(path.name)
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a pipe would be waited for
            raise ForeignFileError(str(path), "not a regular file")
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise ForeignFileError(str(path), IN_WORDS["missing"]) from error
    except OSError as error:
        raise ForeignFileError(str(path), error.strerror or str(error)) from error
    except ValueError as error:  # a NUL in the path
        raise ForeignFileError(repr(str(path)), str(error)) from error
    if len(content) > MAX_BYTES:
        raise ForeignFileError(
            name, f"larger than {MAX_BYTES >> 20} MiB", "cut it into several recordings"
        )
    source: ImportSource
    if content.startswith(
        (matlab_variables.MAGIC_5, matlab_variables.MAGIC_73, matlab_variables.MAGIC_NPZ)
    ):
        source = matlab.read_matlab(content, name)
    elif content.startswith(lvm.MAGIC):
        source = lvm.read_lvm(content, name)
    else:
        source = read_text(content, name, delimiter, decimal, header_lines)
    if source.format != "text" and (delimiter or decimal or header_lines is not None):
        raise ForeignFileError(
            name,
            f"{source.format} files say themselves how they are written",
            "leave out --delimiter, --decimal and --header-lines",
        )
    return ForeignFile(name, hashlib.sha256(content).hexdigest(), len(content), source)


def write_import(
    foreign: ForeignFile,
    stated: ChannelMap,
    about: RecordingNotes,
    results: Path,
    program: Program,
) -> tuple[Path, Recording]:
    """Write the run file into today's folder below `results`; return its path and what it holds.

    Raises ForeignFileError if the file does not agree with what was stated (nothing was begun), and
    RecordingError where the run file cannot be written (nothing is left).
    """
    recording = recording_of(foreign.source, stated, foreign.name)
    label = label_of(recording, about.labels, foreign.name)
    header = _header(foreign, recording, about, program, bool(label))
    writer = begin_journal(results, PROCEDURE, header)
    target = writer.path.with_suffix(RUN_SUFFIX)
    with _all_or_nothing(writer, target):
        _record(writer, foreign, recording, about, label)
        writer.close()
        compile_run(writer.path, target, retire=True)
    return target, recording


@contextmanager
def _all_or_nothing(writer: JournalWriter, target: Path) -> Iterator[None]:
    """Take away what was begun unless the run file is complete: then its journal is deleted."""
    others = target.exists()
    try:
        yield
    except BaseException as error:
        writer.close()
        if writer.path.exists():
            for begun in (writer.path,) if others else (target, checksum_path(target), writer.path):
                begun.unlink(missing_ok=True)
        if isinstance(error, RecordingError):
            hint = "free space or write access there, and import again; nothing was left behind"
            raise RecordingError(target, error.message.partition(": ")[2], hint) from error
        raise


def _header(
    foreign: ForeignFile,
    recording: Recording,
    about: RecordingNotes,
    program: Program,
    labelled: bool,
) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "rate_Hz": recording.rate_Hz,
        "columns": recording.columns,
        "scale": recording.scale,
    } | {
        name: text
        for name, text in (
            ("written", foreign.source.written_as),
            ("sensor", about.sensor),
            ("object", about.object),
        )
        if text
    }
    origin = Origin(
        file_name=foreign.name,
        sha256=foreign.sha256,
        bytes=foreign.size,
        format=foreign.source.format,
        imported_at=datetime.now().astimezone().isoformat(timespec="milliseconds"),
        options=dict(about.options),
        head=foreign.source.head,
    )
    units = {f"scale.{channel}": UNIT[channel] for channel in recording.scale}
    return {
        "procedure": PROCEDURE,
        "layout": layout_of(recording, labelled).to_json(),
        "title": f"{IMPORTED} recording {foreign.name}",
        "run_uuid": str(uuid.uuid4()),
        "start_time": about.start_time,
        "program": program,
        "settings": settings,
        "setting_units": {"rate_Hz": "Hz"} | units,
        "fingerprint": fingerprint(PROCEDURE, settings, foreign.sha256),
        "simulated": None,
        "points": [POINT],
        "user": {"name": about.user},
        "sample": {"name": about.sample},
        "notes": about.notes,
        "streams": [
            {
                "name": name,
                "device": device,
                "channels": channels,
                "dtype": "<f8",
                "row_shape": [len(channels)],
                "units": units,
                "long_name": long_name,
            }
            for name, device, channels, units, long_name in _streams(recording)
        ],
        "origin": origin,
    }


def _forces(recording: Recording) -> list[str]:
    return [name for name in FORCES if name in recording.raw]


def _streams(recording: Recording) -> list[tuple[str, str, list[str], str, str]]:
    """Name, device, channels, unit and meaning of each stream."""
    streams = [
        ("strips", "file", ["strip_1", "strip_2"], "1", "PVDF strips as they stand in the file"),
        ("signals", "computed from strips", ["v_d", *STRIPS], "V", "Strips, v_d = v_1 - v_2"),
    ]
    if forces := _forces(recording):
        streams += [
            ("force_channels", "file", forces, "1", "Forces as they stand in the file"),
            ("force", "computed from force_channels", forces, "N", "Forces"),
        ]
    return streams


LABEL_COLUMNS = (
    Column("label", "", "What happened, as stated at the import", kind="text"),
    Column("motion", "s", "Start of the motion, as stated at the import"),
    Column("node_slip", "s", "Slip of the first part of the ridge, as stated at the import"),
    Column("ridge_slip", "s", "Slip of the whole ridge, as stated at the import"),
    Column("gross_slip", "s", "Slip of the whole contact, as stated at the import"),
    Column("lift_off", "s", "Lift-off of the ridge, as stated at the import"),
)


def layout_of(recording: Recording, labelled: bool = False) -> Layout:
    """Return how the run file shows a recording: the strips, the forces if there are any, and the
    label if it has one."""
    traces = [Trace("data", "signals", "v_d", STRIPS, title="Differential PVDF signal")]
    if forces := _forces(recording):
        traces.append(Trace("force", "force", forces[0], tuple(forces[1:]), title="Forces"))
    return Layout(
        definition="NXrig_import",
        version="1",
        columns=(
            Column("samples", "", "Samples of each channel"),
            Column("rate", "Hz", "Rate"),
            Column("length", "s", "Length"),
            *(LABEL_COLUMNS if labelled else ()),
        ),
        plots=(),
        traces=tuple(traces),
    )


def _record(
    writer: JournalWriter,
    foreign: ForeignFile,
    recording: Recording,
    about: RecordingNotes,
    label: Label,
) -> None:
    """Write the journal of an import: one point, all samples, the end."""
    import numpy as np

    length_s = recording.rows / recording.rate_Hz
    message = f"{recording.rows} rows of {foreign.name}"
    writer.event({"time": 0.0, "level": "info", "code": "imported", "message": message})
    for warning in recording.warnings:
        writer.event({"time": 0.0, "level": "warning", "code": "channel", "message": warning})
    writer.point_begin(POINT, {"time": 0.0})
    v_1, v_2 = map(recording.values, STRIPS)
    arrays = [
        [recording.raw[name] for name in STRIPS],
        [v_1 - v_2, v_1, v_2],
    ]
    states = [([recording.scale[name] for name in STRIPS], "V"), ([1.0] * 3, "V")]
    if forces := _forces(recording):
        arrays += [[recording.raw[f] for f in forces], [recording.values(f) for f in forces]]
        states += [([recording.scale[f] for f in forces], "N"), ([1.0] * len(forces), "N")]
    for stream, (scale, units) in enumerate(states):
        writer.stream(
            {
                "stream": stream,
                "rate_Hz": recording.rate_Hz,
                "scale": scale,
                "offset": [0.0] * len(scale),
                "units": units,
            }
        )
        _write_rows(writer, stream, np.column_stack(arrays[stream]), recording.rate_Hz)
    reading: dict[str, Any] = {
        "samples": recording.rows, "rate_Hz": recording.rate_Hz, "length_s": length_s, **label,
    }  # fmt: skip
    writer.point_keep(POINT, reading)
    writer.end(
        {
            "status": "complete",
            "end_time": None if about.start_time is None else _later(about.start_time, length_s),
            "duration_s": length_s,
            "points_done": 1,
            "points_planned": 1,
            "warnings": recording.warnings,
        }
    )
    writer.sync()


def _write_rows(writer: JournalWriter, stream: int, rows: NDArray[Any], rate_Hz: float) -> None:
    for first in range(0, len(rows), CHUNK_ROWS):
        writer.block(stream, first, first / rate_Hz, rows[first : first + CHUNK_ROWS])


def _later(start_time: str, length_s: float) -> str:
    return (datetime.fromisoformat(start_time) + timedelta(seconds=length_s)).isoformat()
