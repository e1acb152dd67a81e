"""Reading a processed file: its source, the detector's parameters, events and signals.

As with run files, whatever is wrong with one is a RunFileError that names it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import get_args

from rig.core.entry_points import OWN_PACKAGE
from rig.core.errors import shortened
from rig.core.settings import Settings, fingerprint
from rig.detector.events import EventKind, SlipEvent
from rig.detector.settings import settings_from_json
from rig.files.checksum import stated_sha256
from rig.files.errors import RunFileError
from rig.files.file_kind import kind_of
from rig.files.hdf5.open_file import OpenFile, definition_of
from rig.files.hdf5.safe_reading import text_of, texts_of, whole
from rig.files.journal.values import SIMULATED
from rig.files.processed.values import (
    DEFINITION,
    FOLDER,
    LAYOUT_VERSION,
    DetectedTrial,
    ProcessedSource,
    StatedDetector,
    UnknownSettings,
    processed_path,
)


def is_processed(path: Path) -> bool:
    """Return whether a file says that it is a processed file; of one that cannot say what it is,
    as it is damaged, whether it lies where these lie."""
    if said := definition_of(path):
        return said == DEFINITION
    return path.absolute().parent.name == FOLDER and kind_of(path) == "hdf5"


class ProcessedFile(OpenFile):
    """An open processed file; use it as a context."""

    KIND = "processed file"
    REMEDY = "`rig detect` writes it again from the run file"

    def _check(self) -> None:
        if "entry/definition" not in self._file or self._text("definition") != DEFINITION:
            raise RunFileError(self.path, "an HDF5 file, but not a processed file")
        layout = str(self.entry["definition"].attrs.get("version", LAYOUT_VERSION))
        if layout != LAYOUT_VERSION:
            raise RunFileError(
                self.path,
                f"a processed file of layout {shortened(layout)}, and this program reads layout "
                f"{LAYOUT_VERSION}",
                "install the version of tactile-rig that has written it, or a later one",
            )
        _ = self.source, self.detector

    @cached_property
    def source(self) -> ProcessedSource:
        """The run file that was processed."""
        with self._naming():
            simulated = "source/simulated" in self.entry
            return ProcessedSource(
                file_name=self._text("source/file_name"),
                sha256=self._text("source/sha256"),
                definition=self._text("source/definition"),
                title=self._text("source/title"),
                run_uuid=self._text("identifier_experiment"),
                start_time=self._text("start_time") if "start_time" in self.entry else None,
                end_time=self._text("end_time") if "end_time" in self.entry else None,
                simulated=bool(whole(self.entry["source/simulated"])) if simulated else None,
                mark=self._text("source/mark"),
            )

    @cached_property
    def detector(self) -> StatedDetector:
        """The detector: its name, version, package and parameters. Another package's does not have
        to be installed, and another version of this program may have had other parameters."""
        with self._naming():
            stated = self.entry["process/program"].attrs
            package = str(stated.get("package", ""))
            parameters = self._text("process/settings/data")
            try:
                own = package in ("", OWN_PACKAGE)
                settings = settings_from_json(parameters) if own else None
            except ValueError:  # another version of this program had other ones
                settings = None
            return StatedDetector(
                name=str(stated["detector"]),
                version=self.version,
                package=package,
                package_version=str(stated.get("package_version", "")),
                settings=settings or UnknownSettings.model_validate_json(parameters),
            )

    @property
    def settings(self) -> Settings:
        """The detector's parameters."""
        return self.detector.settings

    @property
    def title(self) -> str:
        """The file's title, with its mark."""
        with self._naming():
            return self._text("title")

    @property
    def version(self) -> str:
        """The detector's version."""
        with self._naming():
            return self._text("process/version")

    @property
    def made_by(self) -> str:
        """The digest of code and parameters that have made it; empty in a file without one."""
        with self._naming():
            return str(self.entry["process/version"].attrs.get("digest", ""))

    def trial_ids(self) -> list[str]:
        """Return the ids of the trials, in the order in which they were processed."""
        with self._naming():
            return texts_of(self.entry["trials/id"])

    def events(self) -> list[tuple[str, SlipEvent]]:
        """Return all events, each with its trial's id: trial after trial, in the order of time.

        Raises RunFileError if the file is damaged.
        """
        with self._naming():
            table = self.entry["events"]
            kinds = texts_of(table["kind"])
            if not set(kinds) <= set(get_args(EventKind)):
                raise ValueError("an event of another kind")
            features = [
                (str(column.attrs["long_name"]), whole(column).tolist())
                for column in table["features"].values()
            ]
            columns = (
                texts_of(table["trial"]),
                kinds,
                whole(table["sample"]).tolist(),
                whole(table["time"]).tolist(),
                whole(table["confidence"]).tolist(),
                texts_of(table["reason"]),
            )
            return [
                (
                    trial,
                    SlipEvent(
                        kind=kind,
                        sample=sample,
                        time_s=time,
                        confidence=confidence,
                        reason=reason,
                        features={
                            name: values[row]
                            for name, values in features
                            if not math.isnan(values[row])
                        },
                    ),
                )
                for row, (trial, kind, sample, time, confidence, reason) in enumerate(
                    zip(*columns, strict=True)
                )
            ]

    def trials(self) -> list[DetectedTrial]:
        """Return the trials with their signals and events."""
        events = self.events()
        with self._naming():
            groups = {
                data.attrs["trial"]: data
                for name, data in self.entry["trials"].items()
                if name != "id"
            }
            return [
                DetectedTrial(
                    id=trial,
                    rate_Hz=float(groups[trial].attrs["rate_Hz"]),
                    sample=whole(groups[trial]["sample"]),
                    v_d=whole(groups[trial]["v_d"]),
                    predictive=whole(groups[trial]["predictive"]),
                    events=tuple(event for of, event in events if of == trial),
                )
                for trial in self.trial_ids()
            ]

    def extent(self) -> str:
        """Return what the file holds: ``rig 1, 12 events in 3 trials``."""
        trials, events = len(self.trial_ids()), len(self.events())
        found = f"{events} event{'s' * (events != 1)} in {trials} trial{'s' * (trials != 1)}"
        return f"{self.detector.name} {self.version}, {found}"

    def doubts(self) -> Iterator[str]:
        """Run: whether the run file in the folder above is still the one that was processed, by the
        SHA-256 beside it. Nothing is yielded where none is there."""
        run_file = self.path.absolute().parent.parent / Path(self.source.file_name).name
        if stated_sha256(run_file) not in (None, self.source.sha256):
            yield (
                f"{run_file.name} has changed since, or is another run of that name: "
                "`rig detect` judges it as it is now"
            )

    def findings(self) -> Iterator[str]:
        """Contents: what is wrong with what the file says of itself, one sentence each."""
        source, detector = self.source, self.detector
        yield from self.doubts()
        for where, title in (("title", self.title), ("source/title", source.title)):
            if not title.startswith(source.mark):
                yield f"{where} does not say {source.mark}, as its source does"
        if (source.mark == SIMULATED) != bool(source.simulated):
            yield "source/simulated does not agree with source/mark"
        with self._naming():
            stated = self.entry["process/settings/data"].attrs["fingerprint"]
            if stated != fingerprint(detector.settings):
                yield "the parameters' fingerprint is not theirs"
            name = str(self._file.attrs["file_name"])
        if name != processed_path(Path(source.file_name), detector).name:
            yield "its name is not that of its run, detector and parameters"
        for trial in self.trials():
            rows = trial.sample.size
            if trial.v_d.shape != (rows,) or trial.predictive.shape != (rows,):
                yield f"trial {trial.id}: not one value a row"
            last = int(trial.sample[-1]) if rows else -1
            if any(not 0 <= event.sample <= last for event in trial.events):
                yield f"trial {trial.id}: an event lies outside its rows"
            if any(event.time_s != event.sample / trial.rate_Hz for event in trial.events):
                yield f"trial {trial.id}: an event's time is not its row's"
        if strangers := {of for of, _ in self.events()} - set(self.trial_ids()):
            yield f"events of trials that are not there: {', '.join(sorted(strangers))}"

    def _text(self, name: str) -> str:
        return text_of(self.entry[name])
