"""Verifying: what can be checked about a file of a run without its instruments.

HDF5 can crash on a damaged file, or loop for ever inside one call, which nothing in its process can
interrupt. A file whose checksum is missing or wrong is therefore read in a child process:
``python -m rig.files.verify FILE`` prints the verdict as JSON.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rig.core.child import ChildError, run_module
from rig.files.checksum import checksum_findings
from rig.files.describe import ending_of
from rig.files.errors import JournalError, RunFileError, in_words
from rig.files.file_kind import described, kind_of
from rig.files.hdf5.nexus import plain_text
from rig.files.hdf5.safe_reading import DAMAGE, checked, text_of, whole
from rig.files.journal.format import to_json
from rig.files.journal.reader import JournalContents, read_journal
from rig.files.journal.segments import RECORDED_BEFORE
from rig.files.journal.values import IMPORTED, SIMULATED
from rig.files.naming import journal_path
from rig.files.runfile.read_back import differences
from rig.files.runfile.reader import RunFile
from rig.files.runfile.sample_walk import SampleWalk

if TYPE_CHECKING:
    import h5py

    from rig.files.journal.values import RunHeader
    from rig.files.model_file import ModelFile
    from rig.files.processed.reader import ProcessedFile

AnyFile = TypeVar("AnyFile")

REQUIRED = (
    *("definition", "title", "start_time", "end_time", "duration", "identifier_experiment"),
    *("program_name", "user", "sample", "parameters", "configuration", "journal_header"),
    *("outcome", "events", "instrument", "attempts", "points", "blocks"),
)
"""Paths that every run file has in ``/entry``."""


Noun = tuple[str, str]
"""What a procedure calls a point, and several: ``("trial", "trials")``."""


def _as_points(_: RunHeader) -> Noun:
    return "point", "points"


@dataclass(frozen=True)
class FileVerdict:
    """Result of checking a file: one sentence for each finding, and how far the run came."""

    findings: tuple[str, ...]
    extent: str
    """``complete, 81 of 81 points``; empty if the file does not say."""

    @property
    def sound(self) -> bool:
        """True if nothing was found. The file of a run that was stopped can be sound; ``extent``
        says that it was stopped."""
        return not self.findings

    def __str__(self) -> str:
        findings = "; ".join(self.findings) or "sound"
        return f"{findings} ({self.extent})" if self.extent else findings


def verify(file: Path | str) -> list[str]:
    """Return findings about a run file, processed file or journal, one sentence each; empty if
    sound.
    """
    return list(verdict(file).findings)


def verdict(file: Path | str, noun_of: Callable[[RunHeader], Noun] = _as_points) -> FileVerdict:
    """Check a run file, a processed file or a journal; raises nothing for a bad file, however
    damaged. `noun_of` returns what the procedure of a run calls its points.

    Of a run file: the SHA-256 beside it, every dataset's checksum, the structure, the points, the
    lengths, the outcome, the simulated marks, and its journal if that is still there. Of a journal:
    every record's checksum, and that its records follow each other as they have to.
    """
    file = Path(file)
    kind = kind_of(file)
    if kind == "journal":
        return _verdict_on_journal(file, noun_of)
    if kind != "hdf5":
        what, hint = described(file, kind)
        return FileVerdict((f"{what}; {hint}" if hint else what,), "")
    from rig.files.model_file import is_model
    from rig.files.processed.reader import is_processed

    extent, findings = "", list(checksum_findings(file))
    if is_processed(file):
        return _verdict_on_processed(file, findings)
    if is_model(file):
        return _verdict_on_model(file, findings)
    try:
        with RunFile.open(file) as run:
            for check in _CHECKS:
                findings += _guarded(check, run)
            extent = run.outcome.extent(noun_of(run.header))
    except RunFileError as error:
        findings.append(error.reason)
    findings += _journal(file)
    return FileVerdict(tuple(findings), extent)


def _verdict_on_journal(file: Path, noun_of: Callable[[RunHeader], Noun]) -> FileVerdict:
    try:
        contents = read_journal(file)
    except JournalError as error:
        return FileVerdict((error.reason,), "")
    extent = ending_of(contents).extent(noun_of(contents.header))
    if contents.end is None:
        extent += ", never closed: `rig recover` makes its run file"
    findings = tuple(_contradictions(contents))
    if contents.problem is None:
        return FileVerdict(findings, extent)
    where = "torn at its end" if contents.torn else "damaged, with sound records behind that"
    damage = f"{where}: {contents.problem}; what is before it can be used"
    return FileVerdict((*findings, damage), extent)


def _contradictions(contents: JournalContents) -> Iterator[str]:
    """Yield what no run writes: each record is sound by itself, but not with those before it."""
    for attempt in contents.attempts:
        if not attempt.begin:
            yield f"point {attempt.id}: its end is recorded ({attempt.status}), but no begin"
        if attempt.reason == RECORDED_BEFORE:
            yield f"point {attempt.id}: recorded twice"
    kept = len(contents.kept_ids())
    if contents.end is not None and contents.end.points_done != kept:
        yield f"its end states {contents.end.points_done} points, {kept} are recorded"


def _verdict_on_processed(file: Path, findings: list[str]) -> FileVerdict:
    from rig.files.processed.reader import ProcessedFile

    extent = ""
    try:
        with ProcessedFile.open(file) as processed:
            findings += _guarded(_datasets, processed)
            findings += _guarded(ProcessedFile.findings, processed)
            extent = processed.extent()
    except RunFileError as error:
        findings.append(error.reason)
    return FileVerdict(tuple(findings), extent)


def _verdict_on_model(file: Path, findings: list[str]) -> FileVerdict:
    from rig.files.model_file import ModelFile

    extent = ""
    try:
        with ModelFile.open(file) as model:
            findings += _guarded(_datasets, model)
            extent = f"{model.program}, {len(model.results())} results"
    except RunFileError as error:
        findings.append(error.reason)
    return FileVerdict(tuple(findings), extent)


PATIENCE_S = 60.0
"""Time allowed for a small file in a child process; a large one gets more by BYTES_PER_S."""
BYTES_PER_S = 1e6
"""Slower than any disk and computer that runs this."""


def safe_verdict(
    file: Path | str, noun_of: Callable[[RunHeader], Noun] = _as_points
) -> FileVerdict:
    """Check any file (see `verdict`), in a child process unless its checksum shows it is intact.
    The child, which reads a file that may be damaged, calls points points.

    Raises nothing for a bad file: a crash or an endless loop of HDF5 is a finding.
    """
    file = Path(file)
    if kind_of(file) != "hdf5" or not list(checksum_findings(file)):
        return verdict(file, noun_of)
    try:
        return verdict_in_child(file)
    except RunFileError as error:
        return FileVerdict((error.reason,), "")


def verify_in_child(file: Path | str, patience_s: float = PATIENCE_S) -> list[str]:
    """Return the findings of `verify`, made in a child process.

    Raises RunFileError if HDF5 crashed on the file or did not finish with it in time.
    """
    return list(verdict_in_child(file, patience_s).findings)


def verdict_in_child(file: Path | str, patience_s: float = PATIENCE_S) -> FileVerdict:
    """Return `verdict`, made in a child process that may take `patience_s` and more for a large
    file.

    Raises RunFileError if HDF5 crashed on the file or did not finish with it in time.
    """
    file = Path(file)
    size = file.stat().st_size if file.is_file() else 0
    try:
        answer = run_module(__name__, [str(file)], timeout_s=patience_s + size / BYTES_PER_S)
    except ChildError as error:
        what = f"HDF5 hangs on it: {error}" if error.timed_out else f"HDF5 crashed on it: {error}"
        hint = "compile it again if its journal still exists: rig recover"
        raise RunFileError(file, f"damaged: {what}", hint) from None
    found = json.loads(answer)
    return FileVerdict(tuple(found["findings"]), found["extent"])


def _guarded(check: Callable[[AnyFile], Iterator[str]], run: AnyFile) -> list[str]:
    """Return a check's findings; if damage makes the check fail, that is a finding, too."""
    found: list[str] = []
    try:
        found.extend(check(run))
    except RunFileError as error:
        found.append(error.reason)
    except DAMAGE as error:
        what = (check.__doc__ or "").split(":")[0].rstrip(".")
        found.append(f"{what}: {in_words(error)}")
    return found


def _datasets(run: RunFile | ProcessedFile | ModelFile) -> Iterator[str]:
    """Checksums of the datasets: every byte is read."""
    import h5py

    names: list[str] = []
    run.entry.visititems(lambda name, item: names.append(name) if _is_dataset(item, h5py) else None)
    for name in names:
        try:
            _read_all(run.entry[name])
        except (OSError, RuntimeError, ValueError) as error:
            yield f"{name}: {in_words(error)}"


def _is_dataset(item: object, h5py: object) -> bool:
    return isinstance(item, h5py.Dataset)  # type: ignore[attr-defined]


def _read_all(dataset: h5py.Dataset) -> None:
    """Read it, chunk by chunk where it has chunks."""
    if dataset.chunks is None:
        whole(dataset)
        return
    for chunk in checked(dataset).iter_chunks():
        dataset[chunk]


def _structure(run: RunFile) -> Iterator[str]:
    """Structure: what every run file has."""
    header = run.header
    unknown = {"start_time", "end_time"} if header.start_time is None else set()
    further = ("origin",) if header.origin is not None else ()
    for name in (*REQUIRED, *further):
        if (name in run.entry) == (name in unknown):
            wrong = "there, although it was not known" if name in unknown else "missing"
            yield f"{name} is {wrong}"
    layout = run.header.layout
    if text_of(run.entry["definition"]) != layout.definition:
        yield "definition is not that of the layout"
    if str(run.entry["definition"].attrs.get("version", "")) != plain_text(layout.version):
        yield "definition/@version is not that of the layout"
    for plot in layout.plots:
        for name in plot.sources():
            if f"{plot.group}/{name}" not in run.entry:
                yield f"{plot.group}/{name} is missing"
    for trace in layout.traces if run.point_ids() else ():
        for name in trace.channels():
            if f"{trace.group}/{name}" not in run.entry:
                yield f"{trace.group}/{name} is missing"


def _points(run: RunFile) -> Iterator[str]:
    """Points: unique, and as many everywhere."""
    ids = run.point_ids()
    if len(set(ids)) != len(ids):
        yield "a point appears twice"
    for name in run.columns():
        if len(run.column(name)) != len(ids):
            yield f"column {name} has {len(run.column(name))} values for {len(ids)} points"
    for plot in run.header.layout.plots:
        for name in plot.sources():
            if run.entry[f"{plot.group}/{name}"].shape != (len(ids),):
                yield f"{plot.group}/{name} does not have one value for each point"


def _samples(run: RunFile) -> Iterator[str]:
    """Samples: as many as the blocks brought, in every channel."""
    import numpy as np

    rows: dict[int, int] = {}
    for stream in run.header.streams:
        blocks = run.entry[f"blocks/{stream.name}"]
        segments, counts = whole(blocks["segment"]), whole(blocks["rows"])
        for segment in np.unique(segments):
            rows[int(segment)] = int(counts[segments == segment].sum())
    for place in ("waveforms", "discarded", "between_points"):
        for name, data in run.entry[place].items() if place in run.entry else ():
            expected = rows.pop(int(data.attrs["segment"]), None)
            for channel in (data.attrs["signal"], *data.attrs.get("auxiliary_signals", ())):
                if data[channel].shape != (expected,):
                    yield f"{place}/{name}/{channel}: {data[channel].shape} of {expected} samples"
    if rows:
        yield f"{len(rows)} segments of samples are missing"


def _outcome(run: RunFile) -> Iterator[str]:
    """Outcome: agrees with the points, the header and itself."""
    outcome = run.outcome
    if outcome.status not in ("complete", "stopped", "failed"):
        yield f"outcome/status is {outcome.status!r}"
    if outcome.points_done != len(run.point_ids()):
        yield f"outcome/points_done is {outcome.points_done} for {len(run.point_ids())} points"
    if outcome.points_planned < max(len(run.header.points), outcome.points_done):
        yield f"outcome/points_planned is {outcome.points_planned}"
    if outcome.status != "complete" and not outcome.reason:
        yield f"the run {outcome.status}, and no reason is given"
    if text_of(run.entry["identifier_experiment"]) != run.header.run_uuid:
        yield "identifier_experiment is not the run's"
    if text_of(run.entry["configuration/data"]) != plain_text(run.header.bench_toml):
        yield "configuration is not the bench's file"
    if text_of(run.entry["journal_header/data"]) != plain_text(to_json(run.header)):
        yield "journal_header was changed"


def _times(run: RunFile) -> Iterator[str]:
    """Times of day: the run does not end before it starts."""
    if not {"start_time", "end_time"} <= run.entry.keys():
        return  # The start of some imported recordings is not known.
    start, end = (text_of(run.entry[name]) for name in ("start_time", "end_time"))
    try:
        ended_early = datetime.fromisoformat(end) < datetime.fromisoformat(start)
    except ValueError:
        return
    if ended_early:
        yield f"it ends at {end}, before its start at {start}: the computer's clock was set back"


def _marks(run: RunFile) -> Iterator[str]:
    """Marks: title, outcome, instruments and header agree on simulated and imported."""
    simulated, imported = run.header.simulated, run.header.origin is not None
    for name, said, known in (
        ("simulated", run.outcome.simulated, simulated),
        ("imported", run.outcome.imported, imported),
    ):
        if said != known:
            yield f"outcome/{name} is {said}, the header says {known}"
    title = text_of(run.entry["title"])
    for mark, known in ((SIMULATED, bool(simulated)), (IMPORTED, imported)):
        if title.startswith(mark) != known:
            yield f"the title does not agree with outcome/{mark.lower()}"
    for name, part in run.entry["instrument"].items():
        if "fabrication" not in part:
            continue
        marked = text_of(part["fabrication/vendor"]).startswith(SIMULATED)
        if marked != bool(whole(part["details/simulated"])) or (marked and not simulated):
            yield f"instrument/{name} does not agree on whether it is simulated"


_CHECKS = (_datasets, _structure, _points, _samples, _outcome, _times, _marks)


def _journal(file: Path) -> Iterator[str]:
    journal = journal_path(file)
    if not journal.exists():
        return
    try:
        contents = read_journal(journal)
    except JournalError as error:
        yield f"its journal: {error.reason}"
        return
    for difference in differences(SampleWalk(contents).exhaust(), file):
        yield f"it is not what its journal holds: {difference}"


def main() -> None:
    """Print the verdict on the file that is the only argument, as JSON, for `verdict_in_child`."""
    print(json.dumps(asdict(verdict(sys.argv[1]))))  # noqa: T201 - the answer to the parent


if __name__ == "__main__":
    main()
