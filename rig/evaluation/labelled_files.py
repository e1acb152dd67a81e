"""Trials in run files whose truth is known: from a list of these files, or from a simulated
bench.

A list is CSV with a header. The columns ``file`` (relative to the list) and ``point`` (empty if the
file has only one) name a trial. ``label``, ``motion_s``, ``node_slip_s``, ``ridge_slip_s``,
``gross_slip_s`` and ``lift_off_s`` are its truth, in s of the record, empty for never. Any further
column is a trait of that name. If the list lacks a column of the truth, the value that a simulated
bench stored in the run file is used, up to the end of the record. A roll trial of a real bench is a
roll without a slip unless the list says otherwise, and a motion begins where its run file says. An
imported recording has the label and times that were stated at its import.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.csv_lists import ListRow, read_list
from rig.core.errors import ConfigurationError, RigError
from rig.detector.checking import DetectorError
from rig.detector.notices import Notice, notices_in
from rig.evaluation import simulated_truth
from rig.evaluation.scored_trials import judge_one
from rig.evaluation.scoring.contenders import Contender
from rig.evaluation.scoring.outcomes import LABELS, LIFT_OFF, SLIPPED, Truth, check_slip
from rig.evaluation.scoring.results import ScoredTrial
from rig.evaluation.scoring.tables import NAMES
from rig.files.errors import RunFileError
from rig.files.runfile.reader import RunFile

Floats = NDArray[np.float64]

TIMES = ("motion_s", "node_slip_s", "ridge_slip_s", "gross_slip_s", "lift_off_s")
"""Columns of the truth that are times, in s of the record."""
TEXTS = ("file", "point", "label", *NAMES)
"""Columns that are not numbers."""
LIKE = 0.8
"""Similarity, from 0 to 1, from which on the name of a column is taken for a slip of the pen."""
UNITS = ("_mm", "_um", "_deg", "_N", "_V", "_mV", "_Hz")
"""Ends of names that are of no time: ``motion_mm`` is a trait."""
OF_TRAITS = "leave the column out: one of your own is a trait of the trials and holds numbers"
MAX_LIST_BYTES = 16 << 20
"""Largest size of a list."""


@dataclass(frozen=True)
class ListedTrials:
    """All trials of a list with their outcomes."""

    judged: list[ScoredTrial]
    """The scored trials, in the order of the list."""
    simulated: bool
    """True if any of them comes from a simulated bench."""


@dataclass(frozen=True)
class ListedTrial:
    """A trial of a list: what a detector sees, and the truth that it does not see."""

    name: str
    """File and point."""
    where: str
    """List and line, for messages."""
    volts: Floats
    """Signals v_1 and v_2 in V, (n, 2)."""
    rate_Hz: float
    """Sampling rate of the rows, in samples/s."""
    truth: Truth
    """What happened."""
    slips_s: tuple[tuple[float, float], ...]
    """Begin and end of every slip of the whole ridge, as far as they are known."""
    traits: dict[str, float | str]
    """Further columns of the list."""
    rolls: bool
    """True for a roll trial."""
    sample: str
    """Sample that the run file names; empty if it names none."""
    day: str
    """Day of the run; empty if it is not known."""
    simulated: bool
    """True if it comes from a simulated bench."""
    notices: tuple[Notice, ...] = ()
    """What was commanded, where the file states it."""
    ends_known: bool = True
    """False where no one has stated when the ridge stuck again: `slips_s` end with the record."""


@dataclass(frozen=True)
class _Recorded:
    """What the file of a trial holds."""

    point: str
    volts: Floats
    rate_Hz: float
    truth: dict[str, Any]
    """Label and times that a simulated bench stored, by the names of a list's columns, or the
    little that the procedure says."""
    slips_s: tuple[tuple[float, float], ...]
    """Begin and end of every slip of the whole ridge, in s of the record."""
    rolls: bool
    sample: str
    day: str
    simulated: bool
    notices: tuple[Notice, ...]


def judge_files(
    listing: Path,
    contenders: Sequence[Contender],
    *,
    sweep: bool,
    done: Callable[[int, int], None],
) -> ListedTrials:
    """Score all trials of a list. Raises ConfigurationError, which names the line, where one cannot
    be used.

    `sweep` runs the detectors at all thresholds of a ROC. `done` is called after each trial with
    its number and the number of all.
    """
    # A line that cannot be used is named before the first trial is judged.
    rates_Hz: set[float] = set()
    for one, _ in listed_trials(listing):
        if one.rate_Hz not in rates_Hz:
            _check_rate(one, contenders)
        rates_Hz.add(one.rate_Hz)
    judged, simulated = [], False
    for number, (one, total) in enumerate(listed_trials(listing), 1):
        simulated |= one.simulated
        try:
            judged.append(
                judge_one(
                    one.name, one.truth, one.volts, one.rate_Hz, one.traits, contenders,
                    sweep=sweep, notices=one.notices,
                )
            )  # fmt: skip
        except ValueError as error:
            raise ConfigurationError(f"{one.where}: {one.name}: {error}") from error
        done(number, total)
    return ListedTrials(judged, simulated)


def _check_rate(one: ListedTrial, contenders: Sequence[Contender]) -> None:
    """Raise ConfigurationError for a trial at a rate that a detector does not judge."""
    for contender in contenders:
        try:
            # One that fails is named with the first trial.
            with contextlib.suppress(DetectorError):
                contender.reports(np.zeros((math.ceil(one.rate_Hz), 2)), one.rate_Hz, (1.0,))
        except ValueError as error:
            raise ConfigurationError(f"{one.where}: {one.name}: {error}") from error


def listed_trials(listing: Path) -> Iterator[tuple[ListedTrial, int]]:
    """Yield every trial of a list, with the number of all. Raises ConfigurationError, which names
    the line, where one cannot be used."""
    rows = _rows(listing)
    lines: dict[tuple[Path, str], int] = {}
    for line, row in rows:
        where = f"{listing}, line {line}"
        path = listing.parent / row["file"]
        recorded = _recorded(path, row.get("point", ""), where)
        first = lines.setdefault((path.resolve(), recorded.point), line)
        if first != line:
            raise ConfigurationError(
                f"{where}: the trial of line {first}, which would be judged twice",
                "remove one of them",
            )
        truth = _truth(row, recorded, where)
        name = f"{path.name} {recorded.point}"
        try:
            check_slip(truth)
        except ValueError as error:
            raise ConfigurationError(f"{where}: {name}: {error}") from error
        slips_s, ends_known = recorded.slips_s, True
        # Where the list states the truth itself, the bench's account may contradict it.
        if not slips_s or set(TIMES) & set(row) or "label" in row:
            slips_s = ((truth.ridge_slip_s, truth.record_s),) if truth.slipped else ()
            ends_known = False
        yield (
            ListedTrial(
                name=name,
                where=where,
                volts=recorded.volts,
                rate_Hz=recorded.rate_Hz,
                truth=truth,
                slips_s=slips_s,
                ends_known=ends_known,
                traits=_traits(row, where),
                rolls=recorded.rolls,
                sample=recorded.sample,
                day=recorded.day,
                simulated=recorded.simulated,
                notices=recorded.notices,
            ),
            len(rows),
        )


def _rows(listing: Path) -> list[ListRow]:
    heads, rows = read_list(listing, "list of labelled files", MAX_LIST_BYTES, TEXTS)
    if "file" not in heads:
        raise ConfigurationError(
            f"{listing}: has no column 'file'", "its first line names the columns"
        )
    known = (*TEXTS, *TIMES)
    for name in heads:  # a truth under a wrong name would be ignored as a trait
        close = get_close_matches(name.lower(), known, 1, LIKE)
        # Numbers that are of no time are a trait of the trials, whatever its name is like.
        a_trait = (
            name.endswith(UNITS) if close and close[0] in TIMES else _holds_numbers(name, rows)
        )
        if name not in known and close and not a_trait:
            raise ConfigurationError(
                f"{listing}: the column {name!r} is not known: did you mean {close[0]!r}?",
                f"a trait of your own needs a name less like {close[0]!r}",
            )
    if not rows:
        raise ConfigurationError(f"{listing}: lists no file")
    return rows


def _holds_numbers(name: str, rows: Sequence[ListRow]) -> bool:
    with contextlib.suppress(ValueError):
        return all(math.isfinite(float(row.cells[name] or 0.0)) for row in rows)
    return False


def _recorded(path: Path, point: str, where: str) -> _Recorded:
    """Return what a file holds of a point. Raises RigError, which names the line, for one that
    cannot be read."""
    try:
        opened = RunFile.open(path)
    except RunFileError as error:
        raise RigError(f"{where}: {error.message}", error.hint, error.code) from error
    with opened as run:
        points = run.point_ids()
        if not point and len(points) == 1:
            point = points[0]
        if point not in points:
            raise ConfigurationError(
                f"{where}: {path.name} has no point {point!r}",
                f"name one of {', '.join(points[:8])} in the column 'point'",
            )
        waves = [one for one in run.waveforms(point) if one.stream == "signals"]
        if len(waves) != 1 or not {"v_1", "v_2"} <= set(waves[0].counts):
            raise ConfigurationError(
                f"{where}: {path.name} has no uninterrupted v_1 and v_2 of point {point!r}",
                "list slip and roll trials",
            )
        (wave,) = waves
        reading = run.readings()[points.index(point)]
        volts = np.column_stack([wave.values("v_1"), wave.values("v_2")])
        time_s = run.entry[f"{wave.path}/time"][:2]
        rate_Hz = wave.rate_Hz or round(1 / float(time_s[1] - time_s[0]), 6)
        record_s = len(volts) / rate_Hz
        header = run.header
        return _Recorded(
            point=point,
            volts=volts,
            rate_Hz=rate_Hz,
            truth=_known(run, point, reading, record_s),
            slips_s=simulated_truth.slips_of(reading, record_s),
            rolls=header.procedure == simulated_truth.ROLL,
            sample=header.sample.name or "",
            day="" if header.start_time is None else str(header.start_time)[:10],
            simulated=run.outcome.simulated is True,
            notices=tuple(notices_in(reading)),
        )


def _known(run: RunFile, point: str, reading: dict[str, Any], record_s: float) -> dict[str, Any]:
    """Return label, times and quiet intervals that a simulated bench stored; of any other, when
    the motion began and that a roll trial is a roll."""
    times = simulated_truth.times_of(reading, record_s)
    if stated := reading.get("label"):  # at the import of a recording
        return {"label": stated, **{name: reading.get(name) for name in TIMES}}
    if not times:
        rolls = run.header.procedure == simulated_truth.ROLL
        begin_s = simulated_truth.begin_of(reading)
        return {"motion_s": begin_s, "label": "roll"} if rolls else {"motion_s": begin_s}
    ends_s = simulated_truth.motion_end_of(run, point, reading)
    quiet_s = simulated_truth.quiet_of(times, run.settings, reading, ends_s, record_s)
    label = simulated_truth.label_of(times, run.header.procedure, ends_s)
    return {**times, "label": label, "quiet_s": quiet_s}


def _truth(row: dict[str, str], recorded: _Recorded, where: str) -> Truth:
    label = row.get("label") or recorded.truth.get("label", "")
    if label not in LABELS:
        raise ConfigurationError(
            f"{where}: label {label!r} is not one of {', '.join(LABELS)}",
            "only files from the simulated bench and roll trials have one of their own; state it "
            "in the list's column 'label'",
        )
    if row.get("ridge_slip_s") and label not in (*SLIPPED, LIFT_OFF):
        raise ConfigurationError(
            f"{where}: label {label!r} with ridge_slip_s {row['ridge_slip_s']} s, the time at "
            "which the whole ridge slipped",
            f"correct one of them: the label of a slip is {', '.join(SLIPPED)}",
        )
    times = {}
    for name in TIMES:
        if name in row:
            times[name] = _number(row[name], f"{where}: {name}") if row[name] else math.nan
        else:
            at_s = recorded.truth.get(name)
            times[name] = math.nan if at_s is None else at_s
    if not math.isfinite(times["motion_s"]):
        raise ConfigurationError(
            f"{where}: motion_s is missing; it separates alarms before the motion from the others",
            "add the start of the motion, in s of the record",
        )
    record_s = len(recorded.volts) / recorded.rate_Hz
    for name in (name for name in TIMES if name in row):
        if not math.isnan(times[name]) and not 0 <= times[name] <= record_s:
            raise ConfigurationError(
                f"{where}: {name} {row[name]} s: the record is from 0 to {record_s:g} s"
            )
        if row.get("motion_s") and times[name] < times["motion_s"]:
            raise ConfigurationError(
                f"{where}: {name} {row[name]} s is before motion_s {row['motion_s']} s",
                "all times are in s from the first sample of the record",
            )
    if label in SLIPPED and math.isnan(times["node_slip_s"]):  # who knows no more than the slip
        times["node_slip_s"] = times["ridge_slip_s"]
    # Where the list states the truth itself, the bench's quiet intervals may contradict it.
    quiet_s = () if set(TIMES) & set(row) else recorded.truth.get("quiet_s", ())
    return Truth(label=label, record_s=record_s, quiet_s=quiet_s, **times)


def _traits(row: dict[str, str], where: str) -> dict[str, float | str]:
    known = {"file", "point", "label", *TIMES}
    return {
        name: cell if name in NAMES else _number(cell, f"{where}: {name}", OF_TRAITS)
        for name, cell in row.items()
        if name not in known and cell
    }


def _number(cell: str, what: str, hint: str | None = None) -> float:
    try:
        number = float(cell)
    except ValueError:
        raise ConfigurationError(f"{what} {cell!r} is not a number", hint) from None
    if not math.isfinite(number):
        raise ConfigurationError(f"{what} {cell!r} must be finite, or empty for never")
    return number
