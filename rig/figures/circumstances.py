"""What a figure has to say so that it is understood without its file."""

from __future__ import annotations

import contextlib
import tomllib
from typing import TYPE_CHECKING

from rig.figures.style import NO_BREAK
from rig.files.describe import bench_name, mounted_on

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rig.files.runfile.reader import RunFile


def circumstances(run: RunFile) -> str:
    """Return in one line what a run states of object, speed, angle, start, preload, sample, bench
    and date, to be wrapped between them. The film and the load of a sweep are in its title."""
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
        parts.append(f"{speed:g} mm/s")
    if (angle := settings.get("angle_deg")) is not None and not settings.get("profile_times_s"):
        parts.append(f"{angle:g} deg")
    if (start := settings.get("start_mm")) is not None:
        parts.append(f"start {start:g} mm")
    if header.sample.name:
        parts.append(f"sample {header.sample.name}")
    parts.append(bench_name(header))
    parts.append(str(header.start_time or "")[:16].replace("T", " "))
    return [part for part in parts if part]


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
    return str(run.settings.get("object") or mounted_on(run.header) or "not stated")
