"""Describes a file's run, as names and values to be shown."""

from __future__ import annotations

import contextlib
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.entry_points import OWN_PACKAGE
from rig.detector.events import SHOWN_AS, inverted_warning
from rig.files.journal.reader import JournalContents, ending
from rig.files.journal.values import PersonOrSample, RunHeader
from rig.files.runfile.reader import RecordedOutcome

if TYPE_CHECKING:
    from rig.detector.events import SlipEvent
    from rig.files.model_file import ModelFile, ModelQuantity
    from rig.files.processed.reader import ProcessedFile

MOST_VALUES = 16
"""Maximum number of values of a result that are shown one by one."""


def describe(file: Path, header: RunHeader, outcome: RecordedOutcome) -> dict[str, Any]:
    """Return what a run file says about its run, as JSON-able values. Empty values are left out;
    settings carry their units in their names.
    """
    values = {
        "file": str(file),
        "procedure": header.procedure,
        "title": header.marked(header.title),
        "start_time": header.start_time,
        "status": outcome.status,
        "reason": outcome.reason,
        "points_done": outcome.points_done,
        "points_planned": outcome.points_planned,
        "duration_s": outcome.duration,
        "attempt": outcome.attempt,
        "simulated": outcome.simulated,
        "imported": outcome.imported or None,
        "origin": {} if header.origin is None else header.origin.model_dump(exclude={"head"}),
        "user": _named(header.user),
        "sample": _named(header.sample),
        "notes": header.notes,
        "accepted": header.accepted,
        "bench": _bench(header),
        "fixture": mounted_on(header),
        "calibrations": [
            f"{record.get('kind', 'calibration')} of {record.get('sensor', 'unknown')}"
            for record in header.calibrations
        ],
        "program": f"{header.program.name} {header.program.version}",
        "settings": header.settings,
        "warnings": list(outcome.warnings),
    }
    return {name: value for name, value in values.items() if value not in ("", [], {}, None)}


def describe_contents(
    header: RunHeader, sampling: Mapping[str, tuple[float | None, str]]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the columns of the readings and the streams of samples as JSON-able values, by name.

    `sampling` has rate and unit of each stream that was recorded. `times` is the stream whose rows
    are the times of rows that are not evenly spaced.
    """
    columns = {
        column.name: {"unit": column.units, "meaning": column.meaning or column.long_name}
        for column in header.layout.columns
    }
    streams = {}
    for stream in header.streams:
        rate_Hz, unit = sampling.get(stream.name, (None, stream.units))
        streams[stream.name] = {
            "channels": list(stream.channels),
            "unit": unit,
            "rate_Hz": rate_Hz,
            "times": stream.times or None,
            "recorded": stream.name in sampling,
            "meaning": stream.long_name,
        }
    return {"columns": columns, "streams": streams}


def ending_of(contents: JournalContents) -> RecordedOutcome:
    """Return how a journal's run ended, in the form in which a run file says it."""
    header, end = contents.header, ending(contents)
    planned = end.points_planned
    return RecordedOutcome(
        status=end.status,
        reason=end.reason,
        attempt=end.attempt,
        points_planned=len(header.points) if planned is None else planned,
        points_done=end.points_done,
        simulated=header.simulated,
        seed=header.seed,
        exit=end.exit,
        duration=end.duration_s,
        warnings=end.warnings,
        imported=header.origin is not None,
    )


def describe_processed(file: ProcessedFile) -> dict[str, Any]:
    """Return a processed file's source, detector, parameters and events as JSON-able values."""
    from rig.detector.network import Network

    source, detector = file.source, file.detector
    parameters = detector.settings.model_dump(exclude={"logic", "network"})
    network = getattr(detector.settings, "network", None)
    if isinstance(network, Network):
        parameters["network"] = f"{network.name}, trained on {network.trained_on}"
    elif network is not None:  # of another package, or another version: not all its weights
        parameters["network"] = network.get("name") if isinstance(network, dict) else network
    foreign = detector.package not in ("", OWN_PACKAGE)
    events = file.events()
    of_trials = {
        trial: [event for of, event in events if of == trial] for trial in file.trial_ids()
    }
    inverted = inverted_warning(of_trials)
    warnings = [*file.doubts(), *([inverted] if inverted else [])]
    return {
        "file": str(file.path),
        "title": file.title,
        "run": source.file_name,
        "run_sha256": source.sha256,
        **({} if source.start_time is None else {"start_time": source.start_time}),
        **({} if source.simulated is None else {"simulated": source.simulated}),
        "detector": detector.name,
        "version": detector.version,
        **({"package": f"{detector.package} {detector.package_version}"} if foreign else {}),
        "parameters": parameters,
        "trials": {
            trial: [_event(event) for event in found] or ["nothing found"]
            for trial, found in of_trials.items()
        },
        **({"warnings": warnings} if warnings else {}),
    }


def describe_model(file: ModelFile, all_settings: bool) -> dict[str, Any]:
    """Return what a file of the skin model holds as JSON-able values: of each result unit, meaning
    and shape, and its values where they are few, else the range of them."""
    changed = file.changed_settings()
    settings: Any = file.settings
    if not all_settings and changed is not None:
        settings = changed or "all at their defaults; --all shows them"
    return {
        "file": str(file.path),
        "title": file.title,
        "simulated": True,
        "program": file.program,
        "settings": settings,
        "results": {name: _quantity(one) for name, one in file.results().items()},
    }


def _quantity(one: ModelQuantity) -> dict[str, Any]:
    import numpy as np

    values = np.asarray(one.values)
    found = {"meaning": one.meaning, "unit": one.unit or None}
    if values.size <= MOST_VALUES:
        found["value" if values.ndim == 0 else "values"] = _finite(values.tolist())
    else:
        length = ", ".join(f"{n} {axis}" for n, axis in zip(values.shape, one.axes, strict=True))
        known = values[np.isfinite(values)]
        ends = (known.min(), known.max()) if known.size else (np.float64("nan"),) * 2
        found |= {
            "shape": length,
            "lowest": _finite(ends[0].item()),
            "highest": _finite(ends[1].item()),
        }
    return {name: value for name, value in found.items() if value is not None or "val" in name}


def _finite(values: Any) -> Any:
    """Return numbers as JSON has them: None for one that is not finite."""
    if isinstance(values, list):
        return [_finite(value) for value in values]
    return values if math.isfinite(values) else None


def _event(event: SlipEvent) -> str:
    """Return an event as text, such as ``incipient slip at 6.384 s, confidence 0.6``."""
    reason = f" ({event.reason})" if event.reason else ""
    sure = "" if "judge" in event.kind else f", confidence {event.confidence:.2f}"
    return f"{SHOWN_AS[event.kind]} at {event.time_s:.3f} s{sure}{reason}"


def _named(who: PersonOrSample) -> str:
    """Return a person's or sample's name with whatever else is known."""
    details = ", ".join(f"{name} {value}" for name, value in who.details().items())
    return f"{who.name} ({details})" if details else who.name


def mounted_on(header: RunHeader) -> str:
    """Return the mounted fixture, with the film that it holds; "" where the bench file does not
    say."""
    with contextlib.suppress(tomllib.TOMLDecodeError, TypeError, AttributeError):
        bench = tomllib.loads(header.bench_toml)
        mounted = str(bench.get("fixture", {}).get("mounted", ""))
        film = str(bench.get("film", {}).get("name", ""))
        return f"{mounted}, {film}" if film and mounted == "film-clamp" else mounted
    return ""


def bench_name(header: RunHeader) -> str:
    """Return the bench's name; "" where its file does not say."""
    with contextlib.suppress(tomllib.TOMLDecodeError):
        if name := str(tomllib.loads(header.bench_toml).get("name", "")):
            return f"bench {name}"
    return ""


def _bench(header: RunHeader) -> str:
    """Return the bench's name and the file that described it."""
    name = bench_name(header).removeprefix("bench ")
    if name and header.bench_file:
        return f"{name} ({header.bench_file})"
    return name or header.bench_file
