"""A job, which describes a run, and the journal that it is recorded in.

A fresh job begins a journal; a resumed one continues the interrupted run's journal, provided that
settings, bench and program are those of its beginning.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import rig
from rig.bench.connected import Bench
from rig.core.entry_points import DRIVERS, PROCEDURES, foreign_package
from rig.core.errors import ConfigurationError
from rig.core.settings import Settings, fingerprint, leaves, name_without_unit, unit_of
from rig.core.text import listed
from rig.files.journal.reader import JournalContents
from rig.files.journal.values import RunHeader
from rig.files.journal.writer import JournalWriter, begin_journal, begin_journal_at
from rig.run.changed_since import changes
from rig.run.locks.lock import BenchLock
from rig.run.making_safe.guard_report import GUARD_SUFFIX, report_path
from rig.run.outcome import RunOutcome
from rig.run.points import Point, Reading
from rig.run.procedure import Procedure
from rig.run.source_state import source_state
from rig.run.time_of_day import TimeOfDay

PROGRAM = "tactile-rig"


@dataclass
class Journal:
    """An open journal, with the readings of earlier attempts."""

    writer: JournalWriter
    attempt: int
    recorded: Mapping[str, Reading]
    """Readings of the points that an earlier attempt recorded, by point id."""
    time_of_day: TimeOfDay
    start_s: float
    """Bench time of the run's start: the zero of the times in the journal."""

    @property
    def path(self) -> Path:
        """Path of the journal; it changes if the file loses its name during the run."""
        return self.writer.path

    @property
    def stream_index(self) -> dict[str, int]:
        """Stream numbers by name."""
        return {stream.name: k for k, stream in enumerate(self.writer.header.streams)}

    def end(self, outcome: RunOutcome, duration_s: float) -> dict[str, Any]:
        """Return the record that closes this attempt."""
        reasons = [failure.one_line() for failure in outcome.failures]
        reasons += [f"not switched off: {f.name}: {f.reason}" for f in outcome.off_failures]
        return {
            "status": outcome.status,
            "reason": "; ".join(reasons),
            "attempt": self.attempt,
            "end_time": self.time_of_day.now_iso(),
            "duration_s": duration_s,
            "points_done": outcome.points_done,
            "points_planned": outcome.points_planned,
            "warnings": outcome.warnings,
            "exit": int(outcome.code),
        }


@dataclass
class RunJob:
    """Description of one run: its procedure, bench options, and files."""

    procedure: Procedure
    """Procedure made for this run, with its settings."""
    seed: int
    results: Path
    user: str = ""
    sample: str = ""
    notes: str = ""
    accept: str = ""
    """Reason for which presses that do not fit earlier runs are accepted; empty for none."""
    resume: JournalContents | None = None
    collection: str | None = None
    """Name of the batch that the run belongs to."""
    run_number: int = 0
    """Number of the run within a batch, which seeds the simulated bench's noise."""
    journal: Path | None = None
    """Path of a fresh journal; None for the next name of the day."""
    compiled: bool = True
    """True if a complete run's journal is compiled as soon as the bench is safe; if not, the
    creator of the job compiles it later."""
    held: tuple[int, ...] = ()
    """File descriptors that the guard keeps open as long as it runs, in addition to those of the
    lock."""
    allow_expired: bool = False
    """True if calibration records that have expired may be used."""
    calibrations: list[dict[str, Any]] = field(default_factory=list)
    """Calibration records in use, in the form of the header."""
    recorded_toml: str | None = None
    """Bench file as it is recorded, if the connected one contains a process's port numbers."""
    proven: set[str] = field(default_factory=set)
    """Interlock contacts that were seen to open and close already; a batch gives all its runs the
    same set, so that a person is needed at its first run only."""
    lock: BenchLock | None = None
    """Lock on the bench's instruments; None if they belong to this command alone."""

    @property
    def settings(self) -> Settings:
        """Settings with which the procedure was made."""
        settings: Settings = self.procedure.settings
        return settings

    def fingerprint(self, bench_toml: str) -> str:
        """Return a hash of everything that must be equal for a run to be resumed."""
        return fingerprint(self.procedure.name, self.settings, self.seed, bench_toml)

    @property
    def recorded(self) -> dict[str, Reading]:
        """Readings of the points that an earlier attempt recorded, by point id."""
        return {} if self.resume is None else {p.id: p.reading for p in self.resume.kept()}

    def guard_report(self, bench: Bench, journal: Journal) -> Path:
        """Return the path of the guard's report: next to the run if the bench ends with it, else
        where the next run on that bench finds it."""
        if self.recorded_toml is not None:
            return journal.path.with_suffix(GUARD_SUFFIX)
        return report_path(self.results, bench.settings.name)

    def open_journal(self, bench: Bench, points: Sequence[Point]) -> Journal:
        """Begin the journal, or continue the interrupted one.

        Raises ConfigurationError if the bench, or what the procedure's readings consist of, has
        changed since the interrupted run began.
        """
        if self.resume is None:
            # Together: what follows until the first sample waits for the disk.
            time_of_day, start_s = TimeOfDay(), bench.clock.now()
            header = self._header(bench, points, time_of_day)
            return Journal(self._begin(header), 1, {}, time_of_day, start_s)
        time_of_day = TimeOfDay(_latest(self.resume))
        header, begun = self._header(bench, points, time_of_day), self.resume.header
        had = [column.key for column in begun.layout.columns]
        has = [column.key for column in self.procedure.layout.columns]
        changed = []
        if had != has:
            lost, new = ([key for key in a if key not in b] for a, b in ((had, has), (has, had)))
            changed.append(f"columns ({_or_none(lost)} then, {_or_none(new)} now)")
        if begun.fingerprint != header["fingerprint"]:
            settings, toml = header["settings"], header["bench_toml"]
            changed.append(changes(begun.settings, settings, begun.bench_toml, toml))
        if begun.program.version != header["program"]["version"]:
            version = header["program"]["version"]
            changed.append(f"program version ({begun.program.version} then, {version} now)")
        changed += _other_parts(begun, RunHeader.model_validate(header))
        if changed:
            raise ConfigurationError(
                f"{self.resume.path}: changed since the run began: {'; '.join(changed)}: its "
                "points would not belong together",
                "restore what has changed, or start a new run",
            )
        return Journal(
            JournalWriter.reopen(self.resume.path),
            len(self.resume.ends) + 1,
            self.recorded,
            time_of_day,
            bench.clock.now() - self._elapsed_s(),
        )

    def _begin(self, header: dict[str, Any]) -> JournalWriter:
        if self.journal is not None:
            return begin_journal_at(self.journal, header)
        return begin_journal(self.results, self.procedure.name, header)

    def _elapsed_s(self) -> float:
        """Return the time since the run's start. A bench that ended with its run stood still
        between two attempts; for any other one the time between them is included."""
        assert self.resume is not None
        if self.recorded_toml is not None:
            return self.resume.last_time
        start_time = self.resume.header.start_time
        assert start_time is not None, "only an import has none"
        begun = datetime.fromisoformat(start_time)
        # Where the clock was set back since, no time passed as far as anybody can know.
        passed_s = (datetime.now().astimezone() - begun).total_seconds()
        return max(passed_s, self.resume.last_time)

    def _title(self, bench: Bench) -> str:
        """Return what was measured, such as ``sweep of film 'A', 25 N preload``."""
        mounted, name = bench.settings.fixture.mounted, self.procedure.stated_in_title
        film = bench.settings.film.name if bench.settings.film is not None else ""
        of_film = f"of film {film!r}" if film else "of a film"
        on = of_film if mounted == "film-clamp" else f"on {mounted}"
        title = f"{self.procedure.name} {on}"
        values = dict.fromkeys(f"{value:g}" for value in self.procedure.values_in_title())
        if not values:
            return title
        words = name_without_unit(name).replace("_", " ")
        return f"{title}, {listed(values)} {unit_of(name) or ''} {words}"

    def _header(
        self, bench: Bench, points: Sequence[Point], time_of_day: TimeOfDay
    ) -> dict[str, Any]:
        bench_toml = self.recorded_toml or bench.plan.text
        simulated = bench.simulated
        marker = "SIMULATED – " if simulated else ""
        drivers = {part.role: part.driver_name for part in bench.plan.instruments}
        return {
            "procedure": self.procedure.name,
            "layout": self.procedure.layout.to_json(),
            "title": marker + self._title(bench),
            "run_uuid": str(uuid.uuid4()),
            "collection": self.collection,
            "run_number": self.run_number,
            "start_time": time_of_day.now_iso(),
            "program": present_program(),
            **_package("procedure", PROCEDURES, self.procedure.name),
            "settings": self.settings.model_dump(mode="json"),
            "setting_units": {name: unit for name, _, unit in leaves(self.settings) if unit},
            "fingerprint": self.fingerprint(bench_toml),
            "bench_toml": bench_toml,
            "bench_file": bench.plan.source,
            "simulated": simulated,
            "seed": self.seed,
            "points": [point.id for point in points],
            "user": {"name": self.user},
            "sample": {"name": self.sample},
            "notes": self.notes,
            **({"accepted": self.accept} if self.accept else {}),
            "calibrations": self.calibrations,
            "instruments": [
                {
                    "name": role,
                    "role": role,
                    "vendor": instrument.identity.vendor,
                    "model": instrument.identity.model,
                    "serial_number": instrument.identity.serial_number,
                    "firmware": instrument.identity.firmware,
                    "driver": drivers[role],
                    **_package("driver", DRIVERS, drivers[role]),
                    "simulated": instrument.identity.simulated,
                }
                for role, instrument in bench.instruments.items()
            ],
            "streams": [
                {
                    "name": stream.name,
                    "device": stream.device,
                    "channels": list(stream.channels),
                    "dtype": stream.dtype,
                    "row_shape": [len(stream.channels)],
                    "units": stream.units,
                    "long_name": stream.long_name,
                    **({"times": stream.times} if stream.times else {}),
                }
                for stream in self.procedure.streams
            ],
        }


def _package(what: str, group: str, name: str) -> dict[str, str]:
    """Return package and version of a procedure or driver as the journal has them; nothing for one
    of this program."""
    found = foreign_package(group, name)
    return {} if found is None else {f"{what}_package": found[0], f"{what}_version": found[1]}


def _other_parts(begun: RunHeader, now: RunHeader) -> list[str]:
    """Return what else the points of a run have in common and has changed: the instruments, and the
    versions of procedure and drivers that are not this program's own."""
    instruments = {one.name: one for one in now.instruments}
    pairs = [("version of the procedure's package", begun.procedure_version, now.procedure_version)]
    for was in begun.instruments:
        if (one := instruments.get(was.name)) is None:
            continue  # the bench file, which names it, has changed
        unit = f"{was.model} {was.serial_number}", f"{one.model} {one.serial_number}"
        pairs.append((was.name, *unit))
        pairs.append((f"version of {was.name}'s driver", was.driver_version, one.driver_version))
    return [
        f"{what} ({had or 'none'} then, {has or 'none'} now)"
        for what, had, has in pairs
        if had != has
    ]


def present_program() -> dict[str, str]:
    """Return name, version and source of this program, as journals have them."""
    return {"name": PROGRAM, "version": rig.__version__, "configuration": source_state()}


def _latest(interrupted: JournalContents) -> datetime | None:
    """Return the latest time of day that an interrupted run reached, None if its start is not
    known."""
    start = interrupted.header.start_time
    if start is None:
        return None
    return datetime.fromisoformat(start) + timedelta(seconds=interrupted.last_time)


def _or_none(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"
