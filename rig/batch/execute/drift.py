"""Reasons to hold a batch: what a reference run shows, and what will run out.

Pure functions: they compare numbers and say in words what they find, naming the part. The worker
holds the batch (`rig.batch.execute.worker`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal

from rig.bench.settings import STRIPS, BenchSettings
from rig.core.settings import name_without_unit, unit_of
from rig.instruments.calibration import COMMANDS, CalibrationRecord
from rig.run.procedure import DriftFigure

LARGE_LOSS_dB = 20.0
"""A film that has lost this much gives next to nothing, which wear does not explain."""
LARGE_LOSS = 0.1
"""The same loss of a figure that is not in dB: the share that is left."""
AXES = "xyz"
ZERO = "force_zero_N"
"""The figure of a summary that holds the force sensor's reading in free air, before taring."""
DISK_HINT = (
    "free space there; or stop the batch and begin a new one with the runs that are left, in a "
    "results folder on another disk"
)
WORN_HINT = "check the film, its cable and its connector; replace it and calibrate the new one"


@dataclass(frozen=True)
class HoldReason:
    """A condition that a person has to check before the batch continues."""

    kind: Literal["drift", "no-figure", "force-zero", "disk", "calibration", "folder"]
    text: str
    """Part, value, unit and limit."""
    hint: str
    """The remedy, for the operator."""
    figures: tuple[str, ...] = ()
    """Names of the figures of the summary that it is about."""


@dataclass(frozen=True)
class ReferenceRun:
    """A run of the reference that has been finished."""

    number: int
    """Number of the run in the batch's queue."""
    summary: Mapping[str, Any]


@dataclass(frozen=True)
class _DriftedFigure:
    """A figure beyond its tolerance; `by` is None if it was not found any more."""

    figure: DriftFigure
    text: str
    by: float | None
    lost: bool
    """True if next to nothing is left."""
    crept: bool
    """No step since the reference before was beyond the tolerance."""


def watched_figures(
    usual: Mapping[str, DriftFigure], named: Mapping[str, float]
) -> dict[str, DriftFigure]:
    """Return the watched figures of a reference: those that the batch file names with their
    tolerances, or else those of the procedure's ``DRIFT``."""
    if not named:
        return dict(usual)
    return {
        name: replace(usual[name], tolerance=tolerance)
        if name in usual
        else DriftFigure(name_without_unit(name).replace("_", " "), "", tolerance)
        for name, tolerance in named.items()
    }


def part_names(bench: BenchSettings) -> dict[str, str]:
    """Return the parts that a figure may speak of, as people know them on this bench."""
    film = bench.film.name if bench.film is not None else ""
    names = {"film": f"film {film!r} in the clamp" if film else "the film in the clamp"}
    skin = bench.skin
    of = f" of skin {skin.name!r}" if skin is not None and skin.name else " of the skin"
    for number, strip in enumerate(STRIPS, 1):
        label = skin.films.get(strip, "") if skin is not None else ""
        names[strip] = (f"film {label!r} in " if label else "") + f"strip {number}{of}"
    return names


def judge(
    earlier: Sequence[ReferenceRun],
    now: ReferenceRun,
    watched: Mapping[str, DriftFigure],
    parts: Mapping[str, str],
    since: Mapping[str, int] | None = None,
) -> list[HoldReason]:
    """Return the changes of a reference run from the ones before it, oldest first.

    Each figure is compared with the first run that has it, from the run on whose number `since`
    gives; `parts` are names as of `part_names`.
    A small change that has crept is reported as wear, a sudden one as wear or a tear, one that
    leaves next to nothing as a tear or a cable; where all figures of several parts have moved
    alike, what they have in common is named instead. The first reference is only asked whether it
    has what is watched: a figure that is missing then cannot be judged.
    """
    if not earlier:
        return [
            _no_figure(name, figure, now)
            for name, figure in watched.items()
            if _number(now.summary.get(name)) is None
        ]
    moved = {
        name: found
        for name, figure in watched.items()
        if (found := _moved(name, figure, _from((since or {}).get(name, 1), earlier), now))
        is not None
    }
    if _together(list(moved.values()), watched):
        return [replace(_common_cause(moved, parts), figures=tuple(moved))]
    return [replace(_of_one_part(found, parts), figures=(name,)) for name, found in moved.items()]


def zero_drift(
    first_N: Sequence[float], now_N: Sequence[float], limit_N: float, since_run: int = 1
) -> list[HoldReason]:
    """Return whether the force sensor's zero (x, y, z in N, ``force_zero_N`` of a summary) has
    moved along any axis by more than the limit since an earlier run."""
    moves = [now - first for first, now in zip(first_N, now_N, strict=True)]
    axis = max(range(len(moves)), key=lambda k: abs(moves[k]))
    if abs(moves[axis]) <= limit_N:
        return []
    text = (
        f"force sensor: its zero along {AXES[axis]} moved by {moves[axis]:+.2f} N (from "
        f"{first_N[axis]:.2f} to {now_N[axis]:.2f} N; limit {limit_N:g} N) since run {since_run}: "
        "overloaded, warmed up, or touched by something"
    )
    hint = "check that nothing touches the sensor; let it warm up; if it stays so, have it checked"
    return [HoldReason("force-zero", text, hint, (ZERO,))]


def disk_space(free_bytes: float, needed_bytes: float, least_GB: float) -> list[HoldReason]:
    """Return whether the disk of the results has the space that the rest of the batch needs, and
    `least_GB` (1e9 bytes) in addition."""
    free_GB, needed_GB = free_bytes / 1e9, needed_bytes / 1e9
    if free_GB - needed_GB >= least_GB:
        return []
    rest = f"; the rest of the batch takes about {needed_GB:.3g} GB" if needed_GB else ""
    text = (
        f"disk of the results: {free_GB:.3g} GB free{rest}; {least_GB:g} GB have to remain free "
        "(hold_when.free_disk_GB)"
    )
    return [HoldReason("disk", text, DISK_HINT)]


def expiring(
    records: Iterable[tuple[Path, CalibrationRecord]], now: datetime, duration: timedelta
) -> list[HoldReason]:
    """Return the calibration records, each with its file, that have expired or will expire before a
    run of this duration, begun `now` (with time zone), is over."""
    findings = []
    for source, record in records:
        if record.valid_until > now + duration:
            continue
        date = record.date.strftime("%Y-%m-%d")
        ends = record.valid_until.astimezone(now.tzinfo).strftime("%Y-%m-%d %H:%M")
        expires = f"expired on {ends}"
        if record.valid_until > now:
            over = (now + duration).strftime("%Y-%m-%d %H:%M")
            expires = f"expires on {ends}, before the run is over (about {over})"
        findings.append(
            HoldReason(
                "calibration",
                f"{source}: the calibration of {record.sensor!r} of {date} {expires}",
                f"stop the batch, calibrate with `{COMMANDS[record.kind]}`, name the new record in "
                "the bench file, then: rig batch resume --despite-changes",
            )
        )
    return findings


# --- figures ----------------------------------------------------------------------------------


def _number(value: Any) -> float | None:
    """Return a finite number of a summary, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def _from(number: int, runs: Sequence[ReferenceRun]) -> list[ReferenceRun]:
    return [run for run in runs if run.number >= number]


def _moved(
    name: str, figure: DriftFigure, earlier: Sequence[ReferenceRun], now: ReferenceRun
) -> _DriftedFigure | None:
    """Return the figure's move beyond its tolerance, if it has made one."""
    known = [
        (run.number, value)
        for run in earlier
        if (value := _number(run.summary.get(name))) is not None
    ]
    if not known:
        return None  # reported after the first reference
    (run, first), (_, before) = known[0], known[-1]
    unit = f" {known_unit}" if (known_unit := unit_of(name)) else ""
    places = max(0, 1 - math.floor(math.log10(figure.tolerance))) if figure.tolerance > 0 else 2
    value = _number(now.summary.get(name))
    if value is None:
        text = f"{figure.what} could not be found any more (in run {run}: {first:.{places}f}{unit})"
        return _DriftedFigure(figure, text, None, lost=True, crept=False)
    by = value - first
    if abs(by) <= figure.tolerance:
        return None
    text = (
        f"{figure.what} moved by {by:+.{places}f}{unit} (from {first:.{places}f} to "
        f"{value:.{places}f}{unit}; tolerance {figure.tolerance:g}{unit}) since run {run}"
    )
    lost = by <= -LARGE_LOSS_dB if unit == " dB" else abs(value) <= LARGE_LOSS * abs(first)
    return _DriftedFigure(figure, text, by, lost, crept=abs(value - before) <= figure.tolerance)


def _together(moved: Sequence[_DriftedFigure], watched: Mapping[str, DriftFigure]) -> bool:
    """Return whether every watched figure of several parts has moved, all alike or all to
    nothing."""
    if len(moved) < len(watched) or len({found.figure.part for found in moved}) < 2:
        return False
    if all(found.lost for found in moved):
        return True
    moves = [found.by for found in moved if found.by is not None]
    widest = max(found.figure.tolerance for found in moved)
    return len(moves) == len(moved) and max(moves) - min(moves) <= widest


def _common_cause(moved: Mapping[str, _DriftedFigure], parts: Mapping[str, str]) -> HoldReason:
    text = "; ".join(_text_of(found, parts) for found in moved.values())
    if all(found.lost for found in moved.values()):
        why = "all of them together: unplugged, or an amplifier without power, rather than films"
        return HoldReason("drift", f"{text}: {why}", "check the plugs, the amplifiers and the DAQ")
    why = "all of them alike: amplifier, load cell or force sensor rather than a film"
    hint = "check the amplifiers' gains and supply; check the force sensor with a known weight"
    return HoldReason("drift", f"{text}: {why}", hint)


def _of_one_part(found: _DriftedFigure, parts: Mapping[str, str]) -> HoldReason:
    text = _text_of(found, parts)
    if found.figure.part not in parts:
        return HoldReason("drift", text, "find out what has changed on the bench since then")
    if found.lost:
        return HoldReason("drift", f"{text}: torn or unplugged", WORN_HINT)
    assert found.by is not None, "what was not found is lost"
    if found.by > 0:
        why = "not wear: its amplifier, its cable or how it is held has changed"
        return HoldReason("drift", f"{text}: {why}", "check amplifier, cable and clamp or skin")
    why = "worn, little by little" if found.crept else "worn or torn"
    return HoldReason("drift", f"{text}: {why}", WORN_HINT)


def _text_of(found: _DriftedFigure, parts: Mapping[str, str]) -> str:
    part = parts.get(found.figure.part)
    return f"{part}: {found.text}" if part else found.text


def _no_figure(name: str, figure: DriftFigure, run: ReferenceRun) -> HoldReason:
    return HoldReason(
        "no-figure",
        f"run {run.number}, the first of the reference, has no {figure.what} ({name}): whether it "
        "drifts cannot be judged",
        "have the reference measure it, or name figures of its summary in drift",
        (name,),
    )
