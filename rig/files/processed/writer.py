"""Writes processed files: the results of a detector for a run file, in a file of their own beside
it.

The raw file is read and named by its SHA-256, never written to. A processed file holds nothing but
what follows from that file, the detector's code and its parameters, so that the same three give
the same bytes (with the same libraries), whoever computes them and when.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rig.core.settings import fingerprint, leaves, unit_of
from rig.core.units import counted
from rig.files.errors import RunFileError, not_written
from rig.files.hdf5.guarded_file import GuardedFile
from rig.files.hdf5.nexus import (
    UniqueNames,
    array_field,
    group,
    number_field,
    plain_text,
    set_attributes,
    text_field,
    texts_field,
    write_note,
    write_values,
)
from rig.files.hdf5.publishing import publishing
from rig.files.processed.reader import ProcessedFile
from rig.files.processed.values import (
    DEFINITION,
    LAYOUT_VERSION,
    DetectedTrial,
    ProcessedSource,
    StatedDetector,
    UnknownSettings,
)

if TYPE_CHECKING:
    import h5py

PROGRAM = "rig detect"


def write_processed(
    target: Path,
    source: ProcessedSource,
    detector: StatedDetector,
    made_by: str,
    trials: Sequence[DetectedTrial],
) -> None:
    """Write a processed file, in place of an earlier one; it appears when it is whole. `made_by` is
    the digest of code and parameters (`rig.processing.identity`).

    Raises RecordingError where the disk does not take it, RunFileError where it does not read back
    equal.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # `shared`: workers of a cluster may process the same run file at the same time.
        with publishing(target, shared=True) as part:
            _write(part, target.name, source, detector, made_by, trials)
            _read_back(part, target, source, detector, trials)
    except OSError as error:
        raise not_written(target, error) from error


def _read_back(
    part: Path,
    target: Path,
    source: ProcessedSource,
    detector: StatedDetector,
    trials: Sequence[DetectedTrial],
) -> None:
    """Raise RunFileError unless the file holds what it was made of, bit for bit."""
    with ProcessedFile.open(part) as written:
        found = written.trials()
        equal = written.source == source and _same(written.detector, detector)
    if not equal or not all(mine.same(own) for mine, own in zip(found, trials, strict=True)):
        raise RunFileError(target, "does not read back equal", "run it again")


def _same(read: StatedDetector, written: StatedDetector) -> bool:
    """Return whether a file states the detector that it was made by, its parameters compared as
    JSON has them."""
    plain = [
        replace(one, settings=UnknownSettings.model_validate(one.settings.model_dump(mode="json")))
        for one in (read, written)
    ]
    return plain[0] == plain[1]


def _write(
    path: Path,
    name: str,
    source: ProcessedSource,
    detector: StatedDetector,
    made_by: str,
    trials: Sequence[DetectedTrial],
) -> None:
    """Write it all and make it durable. Raises OSError if the disk does not take it."""
    import h5py

    guarded = GuardedFile(path)
    try:
        with h5py.File(guarded, "w") as file:
            _write_root(file, name, source)
            entry = group(file, "entry", "NXentry")
            entry.attrs["default"] = "data"
            _write_source(entry, source, len(trials))
            _write_process(entry, detector, made_by)
            _write_events(group(entry, "events", "NXcollection"), trials)
            _write_trials(entry, source, trials)
        guarded.check()
    except RuntimeError:
        guarded.check()  # what HDF5 makes of a full disk
        raise
    finally:
        guarded.close()


def _write_root(file: h5py.File, name: str, source: ProcessedSource) -> None:
    import h5py

    import rig

    file.attrs["NX_class"] = "NXroot"
    file.attrs["default"] = "entry"
    file.attrs["file_name"] = name
    if source.end_time is not None:
        file.attrs["file_time"] = source.end_time
    file.attrs["creator"] = PROGRAM
    file.attrs["creator_version"] = rig.__version__
    file.attrs["HDF5_Version"] = h5py.version.hdf5_version
    file.attrs["h5py_version"] = h5py.version.version


def _write_source(entry: h5py.Group, source: ProcessedSource, trials: int) -> None:
    text_field(entry, "definition", DEFINITION).attrs["version"] = LAYOUT_VERSION
    text_field(entry, "title", _title(source, trials))
    for name in ("start_time", "end_time"):
        if getattr(source, name) is not None:
            text_field(entry, name, getattr(source, name))
    text_field(entry, "identifier_experiment", source.run_uuid)
    made = group(entry, "source", "NXcollection")
    for name in ("file_name", "sha256", "definition", "title", "mark"):
        text_field(made, name, getattr(source, name))
    if source.simulated is not None:
        number_field(made, "simulated", source.simulated)


def marked(source: ProcessedSource, title: str) -> str:
    """Return a title that begins with the mark of the run file: SIMULATED, IMPORTED or nothing."""
    return f"{source.mark} {title}" if source.mark else title


def _title(source: ProcessedSource, trials: int) -> str:
    """Return ``SIMULATED – slip detection in 2 trials: slip-trial on plate, 4 N normal force``."""
    dash = f"{source.mark} – " if source.mark else ""
    return f"{dash}slip detection in {counted(trials, 'trial')}: {_unmarked(source)}"


def _unmarked(source: ProcessedSource) -> str:
    return source.title.removeprefix(source.mark).lstrip(" –") or source.file_name


def _write_process(entry: h5py.Group, detector: StatedDetector, made_by: str) -> None:
    settings = detector.settings
    process = group(entry, "process", "NXprocess")
    program = text_field(process, "program", PROGRAM)
    program.attrs["detector"] = plain_text(detector.name)
    program.attrs["package"] = plain_text(detector.package)
    program.attrs["package_version"] = plain_text(detector.package_version)
    text_field(process, "version", detector.version).attrs["digest"] = made_by
    number_field(process, "sequence_index", 1)
    units = {name: unit for name, _, unit in leaves(settings) if unit is not None}
    write_values(group(process, "parameters", "NXparameters"), settings.model_dump(), units)
    write_note(process, "settings", "application/json", "", settings.model_dump_json())
    process["settings/data"].attrs["fingerprint"] = fingerprint(settings)


def _write_events(made: h5py.Group, trials: Sequence[DetectedTrial]) -> None:
    """Write the events of all trials as columns, one row for each event; NaN for a feature that an
    event lacks."""
    import numpy as np

    rows = [(trial.id, event) for trial in trials for event in trial.events]
    texts_field(made, "trial", [trial for trial, _ in rows])
    for name in ("kind", "reason"):
        texts_field(made, name, [getattr(event, name) for _, event in rows])
    columns = (
        ("sample", np.int64, "1", "sample", "Row of the trial"),
        ("time", np.float64, "s", "time_s", "Time since the trial's first row (s)"),
        ("confidence", np.float64, "1", "confidence", "Confidence"),
    )
    for name, dtype, units, source, long_name in columns:
        values = np.array([getattr(event, source) for _, event in rows], dtype)
        array_field(made, name, values, units, long_name)
    features = group(made, "features", "NXcollection")
    names = UniqueNames()
    for feature in dict.fromkeys(name for _, event in rows for name in event.features):
        values = np.array([event.features.get(feature, np.nan) for _, event in rows], np.float64)
        array_field(features, names.name(feature), values, unit_of(feature) or "1", feature)


def _write_trials(
    entry: h5py.Group, source: ProcessedSource, trials: Sequence[DetectedTrial]
) -> None:
    """Write one NXdata for each trial, and that of the first one again as the default plot."""
    made = group(entry, "trials", "NXcollection")
    texts_field(made, "id", [trial.id for trial in trials])
    names = UniqueNames("id")
    groups = [_write_trial(made, names.name(trial.id), source, trial) for trial in trials]
    if not groups:
        entry.attrs["default"] = "events"
        return
    made.attrs["default"] = groups[0].name.rpartition("/")[2]
    shown = group(entry, "data", "NXdata")
    set_attributes(shown, _PLOT)
    for name in ("title", "predictive", "v_d", "time"):
        shown[name] = groups[0][name]


_PLOT = {"signal": "predictive", "auxiliary_signals": ["v_d"], "axes": ["time"]}


def _write_trial(
    parent: h5py.Group, name: str, source: ProcessedSource, trial: DetectedTrial
) -> h5py.Group:
    data = group(parent, name, "NXdata")
    set_attributes(data, _PLOT)
    set_attributes(data, {"trial": plain_text(trial.id), "rate_Hz": trial.rate_Hz})
    text_field(data, "title", marked(source, f"{trial.id}: v_d and the predictive signal"))
    array_field(data, "predictive", trial.predictive, "V", "Predictive signal (V)")
    array_field(data, "v_d", trial.v_d, "V", "v_d = v_1 - v_2 (V)")
    array_field(data, "time", trial.time_s, "s", "Time (s)").make_scale("time")
    array_field(data, "sample", trial.sample, "1", "Row of the trial")
    for field in ("predictive", "v_d", "sample"):
        data[field].dims[0].attach_scale(data["time"])
    return data
