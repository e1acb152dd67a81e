"""Values that functions of other packages compute from a run file: entry-point group
``rig.analyses``.

An entry point's name says to which run files an analysis belongs (`rig.core.file_entry_points`):
``"creep.retardation" = "lab.retardation:analyse"``. The function takes the open `RunFile` and
returns a mapping of names to values: numbers, texts, truth values, None, or lists of numbers or
texts. The suffix of a name is its unit, as in ``stiffest_N_mm``.

A package that fails loses its own values; each failure is one sentence.
"""

from __future__ import annotations

import json
import math
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.atomic import write_text
from rig.core.errors import is_stop
from rig.core.file_entry_points import ANALYSES, FileEntry, entries_of, strays
from rig.core.quiet_stdout import quiet_stdout
from rig.core.settings import unit_of
from rig.core.time_limit import time_limit
from rig.files.checksum import sha256_of
from rig.files.errors import not_written
from rig.files.processed.values import FOLDER

if TYPE_CHECKING:
    from rig.files.runfile.reader import RunFile

DEFINITION, VERSION = "tactile-rig analyses", "1"
LONGEST_S = 120.0
"""Longest time of one analysis of a file."""

Value = float | int | str | bool | None | list[float | int | str | None]


@dataclass(frozen=True)
class Analysis:
    """Results of one analysis of a run file."""

    name: str
    """Name of its entry point."""
    package: str
    package_version: str
    values: Mapping[str, Value]

    @property
    def units(self) -> dict[str, str]:
        """The unit of each value that has one, from its name."""
        found = {name: unit_of(name) for name in self.values}
        return {name: unit for name, unit in found.items() if unit}


@dataclass(frozen=True)
class Analyses:
    """Results of all analyses of a run file, a sentence for each that was left out, and the
    tracebacks of those that failed."""

    found: tuple[Analysis, ...] = ()
    warnings: tuple[str, ...] = ()
    tracebacks: tuple[str, ...] = ()


def analyse(run: RunFile) -> Analyses:
    """Have every registered analysis of a run file's procedure compute its values, each within
    `LONGEST_S`. A run without a completed point has none."""
    found: list[Analysis] = []
    warnings: list[str] = list(strays(ANALYSES, (run.header.procedure,)))
    tracebacks: list[str] = []
    if not run.point_ids():
        return Analyses(warnings=tuple(warnings))
    for registered in entries_of(ANALYSES, run.header.procedure):
        if registered.entry.name in {one.name for one in found}:
            warnings.append(f"{registered} was left out: another analysis has its name")
            continue
        try:
            with time_limit(LONGEST_S), quiet_stdout():
                values = _analysis(registered, run)
            found.append(values)
        # A package may raise anything, and call sys.exit() where it was meant as a program.
        except (Exception, SystemExit) as error:
            if is_stop(error):
                raise
            warnings.append(f"{registered} failed: {registered.fault(error)}")
            tracebacks.append("".join(traceback.format_exception(error)))
    return Analyses(tuple(found), tuple(warnings), tuple(tracebacks))


def analyses_path(run_file: Path, folder: Path | None = None) -> Path:
    """Return where the values of a run file's analyses belong: in `folder`, or in ``processed``
    beside the run file."""
    place = run_file.parent / FOLDER if folder is None else folder
    return place / f"{run_file.stem}.analyses.json"


def keep(run: RunFile, analyses: Analyses, folder: Path | None = None) -> Path:
    """Write what was found, with the run file's SHA-256 and the versions of the packages, in place
    of an earlier file; return its path. Raises RecordingError where the disk does not take it."""
    target, header = analyses_path(run.path, folder), run.header
    content = {
        "definition": DEFINITION,
        "version": VERSION,
        "source": {
            "file_name": run.path.name,
            "sha256": sha256_of(run.path),
            "run_uuid": header.run_uuid,
            "title": header.marked(header.title),
            "simulated": bool(header.simulated),
        },
        "analyses": {
            one.name: {
                "package": one.package,
                "package_version": one.package_version,
                "values": dict(one.values),
                "units": one.units,
            }
            for one in analyses.found
        },
    }
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_text(target, json.dumps(content, indent=2, allow_nan=False) + "\n", shared=True)
    except OSError as error:
        raise not_written(target, error) from error
    return target


def _analysis(registered: FileEntry, run: RunFile) -> Analysis:
    """Return what one analysis found. Raises TypeError where that is not a mapping of names to
    values, and whatever its package raises."""
    from rig.files.runfile.reader import RunFile

    with RunFile.open(run.path) as its_own:  # it may close it, as `with run:` does
        given: Any = registered.load()(its_own)
    if not isinstance(given, Mapping):
        raise TypeError(f"it returned {type(given).__name__} where a mapping is expected")
    values = {}
    for name, value in given.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise TypeError(f"{name!r} is not a name")
        values[name] = _plain(name, value)
    return Analysis(registered.entry.name, registered.package, registered.version, values)


def _plain(name: str, value: Any) -> Value:
    """Return a value as JSON has it; numbers that are not finite are None."""
    if hasattr(value, "tolist"):  # numpy's numbers and arrays
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_scalar(name, one) for one in value]
    plain: Value = _scalar(name, value)
    return plain


def _scalar(name: str, value: Any) -> Any:
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, Real):
        return float(value) if math.isfinite(value) else None
    raise TypeError(f"{name} is a {type(value).__name__}, neither a number nor a text")
