"""What matters of a file, for `rig show` without ``--all``: what was measured, the settings that
differ from their defaults, the results with their verdicts, and how the run ended."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from rig.cli.outcome import say
from rig.cli.show.screen import COLUMNS, LINES, Section, end_of, on_a_screen
from rig.cli.show.words import in_words
from rig.core.errors import ConfigurationError, RigError
from rig.core.settings import unit_of
from rig.core.text import in_shell, readable_time
from rig.core.units import counted, time_span

if TYPE_CHECKING:
    from rig.files.journal.values import Results, RunHeader
    from rig.run.procedure import Procedure

LABELS = {"written": "text written with"}
"""What settings are called whose names say too little."""
AT_DEFAULTS = "all at their defaults"
INVALID = " is invalid: "
"""Part of the warning that says why a reading is invalid (`rig.run.point_loop`)."""
MORE = "--all shows everything"
MORE_AND_FIGURES = f"{MORE}, --figures draws the figures again"


def of_run(
    description: Mapping[str, Any],
    header: RunHeader,
    results: Results | None,
    results_by: str,
    analyses: Mapping[str, Mapping[str, Any]],
) -> list[str]:
    """Return the lines for a run, from its whole `description`, its results and who has
    computed them, and the values of analyses by what has computed these."""
    head = [f"file: {end_of(description['file'], COLUMNS - 6)}", f"title: {description['title']}"]
    procedure = installed_procedure(header)
    if procedure is None and header.origin is None:
        head.append(f"procedure: {not_usable(header)}")
    head += [_times(description), _status(description, procedure)]
    of = [str(description[name]) for name in ("bench", "fixture") if name in description]
    head += [f"bench: {'; '.join(of)}"] if of else []
    head += [
        f"{name}: {description[name]}"
        for name in ("user", "sample", "notes", "accepted")
        if name in description
    ]
    if origin := description.get("origin"):
        options = ", ".join(f"{name} {value}" for name, value in origin["options"].items())
        head.append(f"origin: {origin['file_name']} ({origin['format']}); {options}")
    other = _other_settings(description.get("settings", {}), procedure)
    sections = [_settings(other, rank=1, units=header.setting_units)]
    if results is not None:
        lines = _brief(header, procedure, results)
        scattered = any(" ± " in line for line in lines) and "trials" in results.values
        name = "results (mean ± standard deviation)" if scattered else "results"
        sections.append(Section(name, lines, rank=0))
    for name, found in analyses.items():
        sections.append(Section(name, [f"{k}: {in_words(v)}" for k, v in found.items()], rank=2))
    # Why a trial is invalid comes first: the list is shortened where it is long.
    warnings = sorted(description.get("warnings", ()), key=lambda text: INVALID not in text)
    sections.append(Section("warnings", warnings, rank=3))
    foot = [f"results computed by: {results_by}"] if results_by else []
    foot.append(MORE_AND_FIGURES if _can_be_drawn(description) else MORE)
    journal = Path(description["file"]).with_suffix(".rigj")
    if not journal.exists() or not _can_be_resumed(description):
        return on_a_screen(head, sections, foot)
    # As one line, however long: it is to be copied.
    resume = f"resume with: rig resume {in_shell(journal)}"
    room = LINES - math.ceil(len(resume) / COLUMNS)
    return [*on_a_screen(head, sections, foot, room), resume]


def of_processed(description: Mapping[str, Any], usual: Mapping[str, Any]) -> list[str]:
    """Return the lines for a processed file, from its whole description and the parameters that its
    detector has by default."""
    from rig.detector.events import EVENT_KINDS, SHOWN_AS, counted_events

    names = [f"{description['detector']} {description['version']}", description.get("package", "")]
    head = [f"file: {end_of(description['file'], COLUMNS - 6)}", f"title: {description['title']}"]
    head += [f"run: {end_of(description['run'], COLUMNS - 5)}"]
    if "start_time" in description:
        head.append(f"start: {readable_time(description['start_time'])}")
    head.append(f"detector: {', '.join(filter(None, names))}")
    changed = {
        k: v for k, v in description["parameters"].items() if k not in usual or usual[k] != v
    }
    events = [(trial, event) for trial, found in description["trials"].items() for event in found]
    kinds = Counter(event.partition(" at ")[0] for _, event in events)
    slips = [f"{trial}: {event}" for trial, event in events if event.startswith("incipient slip")]
    others = [f"{trial}: {event}" for trial, event in events if "judge" in event]
    in_order = sorted(EVENT_KINDS, key="incipient slip".__ne__)
    counts = [counted_events(k, kinds[SHOWN_AS[k]]) for k in in_order if SHOWN_AS[k] in kinds]
    found = (
        f"{counted(len(description['trials']), 'trial')}: {', '.join(counts) or 'nothing found'}"
    )
    sections = [
        Section("parameters", [_pairs(changed) or AT_DEFAULTS], rank=1),
        Section("found", [found, *slips, *others], rank=0),
        Section("warnings", description.get("warnings", ()), rank=0),
    ]
    return on_a_screen(head, sections, [MORE_AND_FIGURES])


def of_model(description: Mapping[str, Any]) -> list[str]:
    """Return the lines for a file of the skin model, from its description in words."""
    head = [f"file: {end_of(description['file'], COLUMNS - 6)}", f"title: {description['title']}"]
    head.append(f"program: {description['program']}")
    results = [f"{name}: {value}" for name, value in description["results"].items()]
    # What was asked for is little, and what was computed is a list of columns.
    settings = _settings(description["settings"], rank=0)
    return on_a_screen(head, [settings, Section("results", results, rank=1)], [MORE])


def _times(description: Mapping[str, Any]) -> str:
    begun = readable_time(description["start_time"]) if "start_time" in description else "unknown"
    of = "of bench time" if description.get("simulated") else ""
    return f"start: {begun}, took {time_span(description['duration_s'])} {of}".rstrip()


def _status(description: Mapping[str, Any], procedure: type[Procedure] | None) -> str:
    noun = _noun(procedure)
    reason = f" ({description['reason']})" if "reason" in description else ""
    done = f"{description['points_done']} of {counted(description['points_planned'], *noun)}"
    again = f", attempt {description['attempt']}" if description["attempt"] > 1 else ""
    return f"status: {description['status']}{reason}, {done}{again}"


def _can_be_drawn(description: Mapping[str, Any]) -> bool:
    """Return whether the file is a run file, not a journal, with a completed point."""
    return Path(description["file"]).suffix != ".rigj" and description["points_done"] > 0


def _can_be_resumed(description: Mapping[str, Any]) -> bool:
    return description["status"] != "complete" and not description.get("imported")


def _settings(other: Any, rank: int, units: Mapping[str, str] | None = None) -> Section:
    text = other if isinstance(other, str) else _pairs(_flat(other), units or {})
    return Section("settings", [text or AT_DEFAULTS], rank)


def noun_of(header: RunHeader) -> tuple[str, str]:
    """Return what the procedure of a run calls a point, and several."""
    return _noun(installed_procedure(header))


def _noun(procedure: type[Procedure] | None) -> tuple[str, str]:
    return ("point", "points") if procedure is None else procedure.point_name


def installed_procedure(header: RunHeader) -> type[Procedure] | None:
    """Return the procedure of a run; None where it is not installed, or broken."""
    from rig.core.entry_points import PROCEDURES, names
    from rig.run.load_procedure import load_procedure

    if header.procedure not in names(PROCEDURES):
        return None
    try:
        return load_procedure(header.procedure)
    except ConfigurationError:
        return None


def not_usable(header: RunHeader) -> str:
    """Return in words that the procedure of a run is not installed, or cannot be loaded."""
    from rig.core.entry_points import PROCEDURES, names

    package = f" of {header.procedure_package}" if header.procedure_package else ""
    why = "cannot be loaded" if header.procedure in names(PROCEDURES) else "is not installed"
    return f"{header.procedure}{package} {why} here"


def _other_settings(
    settings: Mapping[str, Any], procedure: type[Procedure] | None
) -> Mapping[str, Any]:
    """Return the settings that differ from the defaults of the installed procedure; all of them
    where it is not installed."""
    if procedure is None:
        return settings
    fields = procedure.Settings.model_fields
    usual = {
        name: field.get_default(call_default_factory=True)
        for name, field in fields.items()
        if not field.is_required()
    }
    return {
        name: value
        for name, value in settings.items()
        if name not in usual or _as_json(usual[name]) != _as_json(value)
    }


def _as_json(value: Any) -> Any:
    """Return a setting as JSON keeps it: a tuple becomes a list."""
    return json.loads(json.dumps(value))


def _brief(header: RunHeader, procedure: type[Procedure] | None, results: Results) -> Sequence[str]:
    """Return the results as the procedure has them in brief; their single values where it is not
    installed or takes none that another version has stored."""
    from rig.core.validated import stored_settings
    from rig.run.checked_procedure import CheckedProcedure
    from rig.run.in_brief import single_values

    of_one = results.values.get("valid_trials") == 1
    if procedure is None:
        return single_values(results.values, results.put_in, results.labels, of_one_trial=of_one)
    try:
        settings = stored_settings(procedure.Settings, header.settings)
        return CheckedProcedure(procedure(settings)).in_brief(results.values, results.put_in)
    except RigError as error:
        say(f"warning: the results are not shown in brief: {error.one_line()}")
    except ValueError:  # settings of another version
        pass
    label = procedure.put_in_label
    return single_values(results.values, results.put_in, results.labels, label, of_one_trial=of_one)


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values by dotted names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def _pairs(values: Mapping[str, Any], units: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return names and values in a line: ``trials 20, loads_N 0.5; 2, scale.v_1 0.001 V``. `units`
    are those of dotted names; one that its name carries is not repeated."""
    pairs = []
    for name, value in _flat(values).items():
        unit = "" if unit_of(name.rpartition(".")[2]) else units.get(name, "")
        pairs.append(f"{LABELS.get(name, name)} {in_words(value)} {unit}".rstrip())
    return ", ".join(pairs)
