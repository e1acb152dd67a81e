"""What a figure has to say so that it is understood without its file."""

from __future__ import annotations

import contextlib
import json
import tomllib
from typing import TYPE_CHECKING, Any

from rig.core.text import to_the_minute
from rig.figures.style import NO_BREAK
from rig.files.describe import bench_name, mounted_on
from rig.files.journal.layout import TRUTH

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rig.files.runfile.reader import RunFile


MOST_CORNERS = 5
"""Maximum number of corners of a path or course that are named one by one."""


def circumstances(run: RunFile) -> str:
    """Return in one line what a run states of object, speed, angle, start, path, preload, sample,
    bench and date, to be wrapped between them. Film and load of a sweep are in its title."""
    return in_one_line(statements(run))


def in_one_line(statements: Iterable[str]) -> str:
    """Return statements in one line that is to be wrapped between them."""
    return ", ".join(each.replace(" ", NO_BREAK) for each in statements)


def statements(run: RunFile) -> list[str]:
    """Return what a run states of its circumstances, one by one."""
    header, settings = run.header, run.settings
    parts = ["" if loads_of(run) else f"object: {_object_of(run)}"]
    if (preload := settings.get("preload_N")) is not None:
        parts.append(f"{preload:g} N preload")
    if (speed := settings.get("speed_mm_s")) is not None:
        parts.append(_ramp(settings, speed) or f"{speed:g} mm/s")
    if (angle := settings.get("angle_deg")) is not None and not settings.get("profile_times_s"):
        parts.append(f"{angle:g} deg")
    if (start := settings.get("start_mm")) is not None:
        parts.append(f"start {start:g} mm")
    parts += _courses(run)
    if header.sample.name:
        parts.append(f"sample {header.sample.name}")
    parts.append(bench_name(header))
    parts.append("" if header.start_time is None else to_the_minute(header.start_time))
    return [part for part in parts if part]


def _ramp(settings: Mapping[str, Any], most_mm_s: float) -> str:
    """Return the ramp of F_t of a slip trial, whose speed is an upper bound; "" for a slide."""
    if settings.get("loading") != "ramp":
        return ""
    to_N = settings.get("hold_at_N") or settings["ramp_to_N"]
    return f"ramp {settings['ramp_N_s']:g} N/s to {to_N:g} N, at most {most_mm_s:g} mm/s"


def _courses(run: RunFile) -> list[str]:
    """Return the path of x, the course of the force and the angles of a roll, where a run has
    them."""
    settings = run.settings
    found = [
        course(what, settings[values], unit, settings[times])
        for what, values, unit, times in (
            ("x from start", "path_positions_mm", "mm", "path_times_s"),
            ("F_n times", "force_shares", "", "force_times_s"),
            ("angle", "profile_angles_deg", "deg", "profile_times_s"),
        )
        if settings.get(times)
    ]
    return ["x rests", *found] if settings.get("path_times_s") in ((), []) else found


def course(what: str, values: Sequence[float], unit: str, times_s: Sequence[float]) -> str:
    """Return a course in words.

    >>> course("x from start", [0, 0.3, 0], "mm", [0, 0.6, 1.2])
    'x from start 0, 0.3, 0 mm at 0, 0.6, 1.2 s'
    >>> course("x from start", [0, 1, -1, 1, -1, 0], "mm", [0, 1, 3, 5, 7, 8])
    'x from start -1 to 1 mm, 6 corners in 8 s'
    """
    if len(values) > MOST_CORNERS:
        extent = f"{min(values):g} to {max(values):g} {unit}".rstrip()
        return f"{what} {extent}, {len(values)} corners in {times_s[-1]:g} s"
    each = (", ".join(f"{one:g}" for one in row) for row in (values, times_s))
    return f"{what} {next(each)} {unit}".rstrip() + f" at {next(each)} s"


def film_of(run: RunFile) -> str:
    """Return the name of the film that the run's bench file states, or ""."""
    with contextlib.suppress(tomllib.TOMLDecodeError, AttributeError):
        return str(tomllib.loads(run.header.bench_toml).get("film", {}).get("name", ""))
    return ""


def loads_of(run: RunFile) -> list[float]:
    """Return the loads of a sweep in N peak; empty for another procedure."""
    settings = run.settings
    loads = settings.get("loads_N") or [settings.get("load_N")]
    return [float(load) for load in loads if load is not None]


def _object_of(run: RunFile) -> str:
    name = str(run.settings.get("object") or mounted_on(run.header) or "not stated")
    account = next((text for one in run.readings() if (text := one.get(TRUTH))), "{}")
    body = json.loads(str(account)).get("object", {})
    if body.get("shape") not in ("cylinder", "sphere"):
        return name
    return f"{name} (simulated: {body['shape']}, {body['radius_mm']:g} mm radius)"
