"""Results as `rig show` shows them: as they are stored, and with them what this program finds
otherwise; and the values of the installed analyses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rig.analysis.estimate import Estimate
from rig.cli.outcome import say, say_all
from rig.core.errors import ConfigurationError, RigError, is_stop
from rig.core.units import counted
from rig.files.journal.values import Program, Results
from rig.files.runfile.result_fields import ESTIMATE
from rig.run.results import Difference, differences, results_of

if TYPE_CHECKING:
    from rig.files.journal.values import RunHeader
    from rig.processing.analyses import Analyses
    from rig.run.points import Reading

COMMIT_LETTERS = 10


def compared(stored: Results, now: Results | None) -> dict[str, Any]:
    """Return the stored results, who computed them and how, and what differs now, for JSON.

    Without results of the present program nothing is said of differences.
    """
    shown: dict[str, Any] = {
        "results": stored.values,
        "results_by": stored.program.model_dump(),
        "results_method": stored.method,
        "results_origins": stored.origins,
        "results_put_in": stored.put_in,
    }
    if now is not None:
        found = differences(stored.values, now.values)
        shown["recomputed"] = {
            "by": now.program.model_dump(),
            "differences": {name: asdict(one) for name, one in found.items()},
        }
    return shown


def compared_in_words(stored: Results, now: Results | None) -> dict[str, Any]:
    """Return the stored results with a remark at each value that differs now, for reading."""
    found: dict[str, str] = {}
    if now is not None:
        full = stored.program.version == now.program.version
        by, recomputed_by = _named(stored.program, full), _named(now.program, full)
        found = {
            name: _remark(one, by, recomputed_by)
            for name, one in differences(stored.values, now.values).items()
        }
    return {"results": _in_words(stored.values, found), "results_by": computed_by(stored, now)}


def computed_now(now: Results, as_json: bool) -> dict[str, Any]:
    """Return the results of a file that has none, as the present program computes them."""
    if as_json:
        return {"results": now.values, "results_by": now.program.model_dump(), "stored": False}
    return {"results": _in_words(now.values, {}), "results_by": computed_by(None, now)}


def computed_by(stored: Results | None, now: Results | None) -> str:
    """Return which program has computed the results, and how many values the present one finds
    otherwise; "" without results."""
    if stored is None:
        by = "" if now is None else f"{now.program.name} {_named(now.program, full=True)}"
        return by and f"computed now by {by}; none are stored"
    said = f"{stored.program.name} {_named(stored.program, full=True)}"
    if now is None or (
        (found := differences(stored.values, now.values)) == {} and (stored.program == now.program)
    ):
        return said
    # A later version may say the same in other words.
    numbers = [one for one in found.values() if not _in_other_words(one)]
    same = "the same in other words" if found else "the same"
    finds = f"{counted(len(numbers), 'value')} otherwise" if numbers else same
    return f"{said}; this is {_named(now.program, full=True)}, which finds {finds}"


def recomputed(header: RunHeader, readings: Sequence[Reading]) -> Results | None:
    """Return what the procedure computes from the readings now, where it is installed and still
    takes them; one that is broken costs a line, not the command."""
    from pydantic import ValidationError

    from rig.core.entry_points import PROCEDURES, names
    from rig.core.validated import stored_settings
    from rig.run.checked_procedure import internal
    from rig.run.load_procedure import load_procedure

    if header.procedure not in names(PROCEDURES) or not readings:
        return None
    try:
        procedure = load_procedure(header.procedure)
    except ConfigurationError as error:
        say(f"warning: no summary: {error.one_line()}")
        return None
    try:
        settings = stored_settings(procedure.Settings, header.settings)
    except ValidationError:  # written by another version of the procedure
        return None
    try:
        return results_of(procedure(settings), readings, bool(header.simulated))
    except RigError as error:
        if not isinstance(error.__cause__, KeyError):  # then another version has written the file
            say(f"warning: no summary: {error.one_line()}")
    except Exception as error:
        if is_stop(error):
            raise
        say(f"warning: no summary: {internal(error).one_line()}")
    return None


def analysed(analyses: Analyses, debug: bool) -> dict[str, Any]:
    """Return the values of a run file's analyses by what computed them; one that has failed costs
    a line, not the command. `debug` shows its traceback."""
    for warning in analyses.warnings:
        say(f"warning: {warning}")
    for trace in analyses.tracebacks if debug else ():
        say_all(trace)
    return {
        f"{one.name} ({one.package} {one.package_version})": one.values for one in analyses.found
    }


def _in_other_words(one: Difference) -> bool:
    return isinstance(one.stored, str) and isinstance(one.recomputed, str)


def _named(program: Program, full: bool) -> str:
    """Return the version, with the commit where `full`: ``0.9.1 (1a2b3c4d5e+dirty)``."""
    if not full or not program.configuration:
        return program.version
    commit, plus, dirty = program.configuration.partition("+")
    return f"{program.version} ({commit[:COMMIT_LETTERS]}{plus}{dirty})"


def _remark(one: Difference, by: str, recomputed_by: str) -> str:
    """Return ``stored 20 dB/decade by A, recomputed 19.9 by B``."""
    unit = f" {one.unit}" if one.unit else ""
    recomputed = "nothing" if one.recomputed is None else _shown(one.recomputed)
    if one.stored is None:
        return f"not stored by {by}, {recomputed}{unit} by {recomputed_by}"
    return f"stored {_shown(one.stored)}{unit} by {by}, recomputed {recomputed} by {recomputed_by}"


def _in_words(values: Mapping[str, Any], found: Mapping[str, str]) -> dict[str, Any]:
    """Return the values, or their remarks, with an estimate as a line."""
    shown = {str(key): _worded(value, found, str(key)) for key, value in values.items()}
    elsewhere = {name: said for name, said in found.items() if name.partition(".")[0] not in shown}
    return shown | elsewhere


def _worded(value: Any, found: Mapping[str, str], name: str) -> Any:
    if name in found:
        return found[name]
    if isinstance(value, Mapping):
        if value.keys() == ESTIMATE:
            return str(Estimate(**{**value, **_infinite(value)}))
        return {key: _worded(inner, found, f"{name}.{key}") for key, inner in value.items()}
    if isinstance(value, list):
        return [_worded(inner, found, f"{name}.{number}") for number, inner in enumerate(value, 1)]
    return value


def _infinite(estimate: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of an estimate that JSON has as None: they are not finite."""
    return {key: math.inf for key, number in estimate.items() if number is None}


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"{len(value)} values" if isinstance(value, (list, Mapping)) else str(value)
