"""The command that makes a run file of another program's recording."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rig.cli.options.numbers import one_of, whole_number
from rig.cli.options.shared import RESULTS, AsJson, Debug, Notes, RunFolder
from rig.cli.options.utf8 import as_utf8
from rig.cli.outcome import log, print_json, reported, say, say_failure, start_log
from rig.core.errors import ConfigurationError, ExitCode, RigError

if TYPE_CHECKING:
    from rig.figures.drawing import Drawn
    from rig.files.imported.import_file import RecordingNotes
    from rig.files.imported.series import ChannelMap
    from rig.files.journal.values import Program

CHANNELS = ("v_1", "v_2", "F_n", "F_t", "motion", "slip", "lift_off")
SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".lvm", ".mat", ".npz")
"""Endings of the files of a folder that are imported."""
SCALED = {"v_1": "V", "v_2": "V", "F_n": "N", "F_t": "N", "time": "s"}
"""Unit of the values after scaling."""


def import_(
    file: Annotated[
        Path,
        typer.Argument(
            help="Text in columns (CSV, tabs), LVM, MATLAB or NumPy npz file; or a folder of them.",
            metavar="FILE",
        ),
    ],
    channels: Annotated[
        str,
        typer.Option(
            help="Column of each channel, a number from 1 or a name; of MATLAB and npz a variable. "
            "'2 - 3' is a difference, 2..11 are ten consecutive samples of a row. F_n and F_t may "
            "be left out, and so may motion, slip and lift_off: columns that are 0 until "
            "the event.",
            metavar="v_1=2,v_2=3,…",
        ),
    ],
    rate: Annotated[
        str | None, typer.Option(help="Sampling rate, if the file does not state it.", metavar="Hz")
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(help="Column of times, evenly spaced, in s.", metavar="COLUMN"),
    ] = None,
    scale: Annotated[
        str,
        typer.Option(
            help="Value of one unit of the file; negative for reversed polarity.  "
            "[default: 1V, 1N, 1s]",
            metavar="v_1=1mV,F_n=-2N,…",
        ),
    ] = "",
    delimiter: Annotated[
        Literal["tab", "semicolon", "comma", "space"] | None,
        typer.Option(
            help="Separator of a text's columns.  [default: recognised]",
            parser=one_of("tab", "semicolon", "comma", "space"),
            metavar="[tab|semicolon|comma|space]",
        ),
    ] = None,
    decimal: Annotated[
        Literal["point", "comma"] | None,
        typer.Option(
            help="Decimal sign of a text.  [default: recognised]",
            parser=one_of("point", "comma"),
            metavar="[point|comma]",
        ),
    ] = None,
    header_lines: Annotated[
        int | None,
        typer.Option(
            help="Lines above the numbers of a text.  [default: recognised]",
            parser=whole_number(0),
            metavar="COUNT",
        ),
    ] = None,
    sensor: Annotated[str, typer.Option(help="Sensor that was recorded.", metavar="NAME")] = "",
    sample: Annotated[
        str, typer.Option(help="Sample (skin or film) that was used.", metavar="NAME")
    ] = "",
    object_: Annotated[
        str, typer.Option("--object", help="Object that the skin touched.", metavar="NAME")
    ] = "",
    user: Annotated[
        str, typer.Option(help="Name of the person who recorded it.", metavar="NAME")
    ] = "",
    notes: Notes = "",
    start_time: Annotated[
        str | None,
        typer.Option(
            help="Time at which the recording began, with its offset from UTC.",
            metavar="2026-11-22T09:30:00+01:00",
        ),
    ] = None,
    results: RunFolder = RESULTS,
    as_json: AsJson = False,
    labels: Annotated[
        Path | None,
        typer.Option(
            help="CSV list of what happened: file, label, motion_s, ridge_slip_s, lift_off_s, … "
            "(s of the record). rig score --files and rig train --files use it.",
            metavar="FILE",
        ),
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw the figure of the recording.")] = True,
    debug: Debug = False,
) -> None:
    """Make a run file of another program's recording: text in columns, LVM, MATLAB, NumPy npz."""
    texts = {
        "channels": channels,
        "rate": rate,
        "time": time,
        "scale": scale,
        "delimiter": delimiter,
        "decimal": decimal,
        "header-lines": None if header_lines is None else str(header_lines),
        "labels": None if labels is None else str(labels),
    }
    with reported(debug, as_json):
        stored = {"sensor": sensor, "sample": sample, "object": object_, "user": user}
        for option, text in (stored | {"notes": notes}).items():
            as_utf8(f"--{option}", text, "a run file")
        columns = channel_map(channels) | ({} if time is None else {"time": time.strip()})
        scales = scale_map(scale)
        if unused := sorted(set(scales) - set(columns) - {"time"}):
            raise ConfigurationError(
                f"--scale {unused[0]}: no such channel in --channels", "leave it out, or map it"
            )
        rate_Hz = None if rate is None else _quantity("--rate", rate, "Hz")

        import rig
        from rig.files.imported.import_file import RecordingNotes
        from rig.files.imported.labels import read_labels
        from rig.files.imported.series import ChannelMap
        from rig.files.journal.values import Program
        from rig.run.job import PROGRAM
        from rig.run.source_state import source_state

        about = RecordingNotes(
            sensor=sensor,
            sample=sample,
            object=object_,
            user=user,
            notes=notes,
            start_time=None if start_time is None else _start(start_time),
            options={name: text for name, text in texts.items() if text},
        )
        lines = {} if labels is None else read_labels(labels)
        wanted = _files_of(file, labels)
        if strange := sorted(set(lines) - {path.name for path in wanted}):
            raise ConfigurationError(
                f"--labels {labels}: {strange[0]} is not among the files to import",
                "correct its name, or remove it from the list",
            )
        start_log(results)
        importing = _Importing(
            (delimiter, decimal, header_lines),
            ChannelMap(columns, scales, rate_Hz),
            results,
            Program(name=PROGRAM, version=rig.__version__, configuration=source_state()),
            figures,
        )
        answers, failures = [], []
        for path in wanted:
            try:
                done = importing.one(path, replace(about, labels=lines.get(path.name)))
            except RigError as error:
                if len(wanted) == 1:
                    raise
                say_failure(error, debug)
                failures.append(error)
                continue
            answers.append(done)
            if not as_json:
                print(done["file"])  # noqa: T201 - stdout carries data
        code = _code(len(answers), failures)
        if as_json:
            whole = answers[0] if len(wanted) == 1 else _of_all(answers, failures, code)
            print_json(whole)
        if code is not ExitCode.DONE:
            raise typer.Exit(int(code))


def _files_of(path: Path, labels: Path | None) -> list[Path]:
    """Return the file, or all files of a folder that are not hidden, by their names; the list of
    labels may be in the folder and is not a recording."""
    if not path.is_dir():
        return [path]
    found = sorted(one for one in path.iterdir() if one.is_file() and one.name[0] != ".")
    found = [one for one in found if one.suffix.lower() in SUFFIXES]
    if labels is not None:
        found = [one for one in found if not one.samefile(labels)]
    if not found:
        raise ConfigurationError(
            f"{path}: no recording in this folder", f"files end in {', '.join(SUFFIXES)}"
        )
    return found


def _code(done: int, failures: Sequence[RigError]) -> ExitCode:
    """Return the exit code: that of the first file if all failed, 5 if only some failed."""
    if not failures:
        return ExitCode.DONE
    return ExitCode.FINISHED_WITH_FAILURES if done else failures[0].code


@dataclass(frozen=True)
class _Importing:
    """What all files of a command have in common."""

    dialect: tuple[Any, Any, int | None]
    stated: ChannelMap
    results: Path
    program: Program
    figures: bool

    def one(self, path: Path, about: RecordingNotes) -> dict[str, Any]:
        """Import a file, say what it held, and return the same as a JSON object. Raises RigError
        where it cannot be imported; nothing of it is left then."""
        from rig.figures.drawing import Drawn, draw
        from rig.files.imported.import_file import read_foreign, write_import

        foreign = read_foreign(path, *self.dialect)
        run_file, recording = write_import(foreign, self.stated, about, self.results, self.program)
        for channel, column in recording.columns.items():
            say(f"  {channel}: {column}, {recording.scale[channel]:g} {SCALED[channel]} per unit")
        written = f" ({foreign.source.written_as})" if foreign.source.written_as else ""
        say(
            f"IMPORTED {foreign.name}: {foreign.source.format}{written}, {recording.rows} samples "
            f"at {recording.rate_Hz:.10g} Hz"
        )
        for warning in recording.warnings:
            say(f"warning: {warning}")
        drawn = draw(run_file) if self.figures else Drawn()
        for picture in drawn.files:
            say(f"figure: {picture}")
        for warning in drawn.warnings:
            say(f"warning: {warning}")
        for trace in drawn.tracebacks:
            log.warning("%s", trace)
        return _as_object(run_file, recording, drawn)


def _of_all(
    answers: Sequence[dict[str, Any]], failures: Sequence[RigError], code: ExitCode
) -> dict[str, Any]:
    return {
        "file": None,
        "outcome": "complete" if code is ExitCode.DONE else "failed",
        "exit": int(code),
        "simulated": None,
        "imported": True,
        "summary": {"files": len(answers) + len(failures), "failed": len(failures)},
        "results": list(answers),
        "errors": [error.one_line() for error in failures],
    }


def _as_object(run_file: Path, recording: Any, drawn: Drawn) -> dict[str, Any]:
    return {
        "file": str(run_file),
        "outcome": "complete",
        "exit": 0,
        "simulated": None,
        "imported": True,
        "summary": {
            "samples": recording.rows,
            "rate_Hz": recording.rate_Hz,
            "columns": recording.columns,
            "scale": recording.scale,
        },
        "errors": [],
        "warnings": [*recording.warnings, *drawn.warnings],
        "figures": [str(path) for path in drawn.files],
    }


def channel_map(text: str) -> dict[str, str]:
    """Return the column of the file for each channel, from a text such as ``v_1=2,v_2=Voltage``;
    names of columns may hold commas and equals signs. Raises ConfigurationError for a text of
    another form, and where v_1 or v_2 is missing."""
    found = _pairs("--channels", text, CHANNELS)
    if missing := [channel for channel in ("v_1", "v_2") if channel not in found]:
        raise ConfigurationError(
            f"--channels {text}: {' and '.join(missing)} missing",
            "both strips are needed, v_d is their difference",
        )
    return found


def scale_map(text: str) -> dict[str, float]:
    """Return what one unit of the file is in V, N or s for each channel, from a text such as
    ``v_1=-1mV``; an empty dict for an empty text. Raises ConfigurationError for a text of another
    form, another unit, and a scale that is 0 or not finite."""
    found: Mapping[str, str] = _pairs("--scale", text, tuple(SCALED)) if text.strip() else {}
    return {
        channel: _quantity(f"--scale {channel}", value, SCALED[channel])
        for channel, value in found.items()
    }


def _pairs(option: str, text: str, known: tuple[str, ...]) -> dict[str, str]:
    names = "|".join(known)
    found: dict[str, str] = {}
    for part in re.split(rf",(?=\s*(?:{names})\s*=)", text):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals or not value or name not in known:
            raise ConfigurationError(
                f"{option} {text}: {part.strip()!r} is not NAME=VALUE, NAME one of "
                f"{', '.join(known)}",
                f"for example {option} v_1=2,v_2=3",
            )
        if name in found:
            raise ConfigurationError(f"{option} {text}: {name} appears twice")
        found[name] = value
    return found


def _quantity(option: str, text: str, unit: str) -> float:
    from rig.core.units import quantity

    try:
        value = quantity(text, unit)
    except ValueError as error:
        raise ConfigurationError(f"{option} {text}: {error}", "see --help for the units") from error
    if not math.isfinite(value) or value == 0:
        raise ConfigurationError(f"{option} {text}: must be a finite number in {unit}, not 0")
    return value


def _start(text: str) -> str:
    from pydantic import TypeAdapter, ValidationError

    from rig.files.journal.values import IsoTime

    try:
        return TypeAdapter(IsoTime).validate_python(text)
    except ValidationError as error:
        raise ConfigurationError(
            f"--start-time {text}: not an ISO 8601 time with an offset from UTC",
            "such as 2026-11-22T09:30:00+01:00",
        ) from error
