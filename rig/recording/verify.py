"""Verifying: everything that can be checked about a run file without its instruments.

HDF5 can crash on a damaged file, or never come to an end inside one call, which nothing in its
process can interrupt. ``python -m rig.recording.verify FILE`` prints the findings as JSON: what a
command reads is read there first.
"""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rig.recording.comparison import differences
from rig.recording.compiled import sha256_of
from rig.recording.contents import read_journal
from rig.recording.errors import JournalError, RunFileError
from rig.recording.header import SIMULATED
from rig.recording.naming import checksum_path, journal_path
from rig.recording.nexus import plain_text, plot_sources
from rig.recording.reading import DAMAGE, checked, text_of, whole
from rig.recording.records import to_json
from rig.recording.runfile import RunFile

if TYPE_CHECKING:
    import h5py

MAX_CHECKSUM_CHARACTERS = 4096
"""Of the line beside a file: a checksum and a name."""

REQUIRED = (
    *("definition", "title", "start_time", "end_time", "duration", "identifier_experiment"),
    *("program_name", "user", "sample", "parameters", "configuration", "journal_header"),
    *("outcome", "events", "instrument", "attempts", "points", "blocks"),
)
"""What every run file has in ``/entry``."""


def verify(file: Path | str) -> list[str]:
    """Findings about a run file, one sentence each; empty if it is sound.

    Checks the SHA-256 beside it, every dataset's checksum, the structure, the points, the lengths,
    the outcome, the simulated marks, and its journal if that is still there. Raises nothing for a
    bad file, however damaged.
    """
    file = Path(file)
    if not file.is_file():
        return ["there is no such file"]
    findings = list(_checksum(file))
    try:
        with RunFile.open(file) as run:
            for check in _CHECKS:
                findings += _guarded(check, run)
    except RunFileError as error:
        findings.append(error.message)
    findings += _journal(file)
    return findings


PATIENCE_S = 60.0
"""For a small file; a large one has BYTES_A_S besides."""
BYTES_A_S = 1e6
"""Slower than any disk and computer that runs this."""
MAX_MEMORY_BYTES = 8 << 30
"""Of the process that verifies: the largest dataset in one piece, several times over."""


def verify_apart(file: Path | str, patience_s: float = PATIENCE_S) -> list[str]:
    """`verify` in a process of its own. RunFileError where HDF5 dies of the file or hangs."""
    file = Path(file)
    size = file.stat().st_size if file.is_file() else 0
    command = [sys.executable, "-m", "rig.recording.verify", str(file)]
    patience_s += size / BYTES_A_S
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=patience_s)
    except subprocess.TimeoutExpired:
        reason = f"damaged: HDF5 does not come to an end with it within {patience_s:.0f} s"
        raise RunFileError(file, reason, _DAMAGED_HINT) from None
    if done.returncode != 0:
        death = signal.Signals(-done.returncode).name if done.returncode < 0 else "error"
        last = done.stderr.strip().splitlines()[-1:]
        reason = f"damaged: HDF5 died of it ({': '.join([death, *last])})"
        raise RunFileError(file, reason, _DAMAGED_HINT)
    findings: list[str] = json.loads(done.stdout)
    return findings


_DAMAGED_HINT = "compile it again if its journal is still there: rig recover"


def _guarded(check: Callable[[RunFile], Iterator[str]], run: RunFile) -> list[str]:
    """A check's findings; its stumbling over damage is a finding too."""
    found: list[str] = []
    try:
        found.extend(check(run))
    except RunFileError as error:
        found.append(error.message)
    except DAMAGE as error:
        what = (check.__doc__ or "").split(":")[0].rstrip(".")
        found.append(f"{what}: {type(error).__name__}: {error}")
    return found


def _checksum(file: Path) -> Iterator[str]:
    beside = checksum_path(file)
    if beside.exists() and not beside.is_file():
        yield f"{beside.name}: not a regular file"
        return
    try:
        with beside.open(encoding="utf-8", errors="replace") as opened:
            words = opened.read(MAX_CHECKSUM_CHARACTERS).split()
    except OSError as error:
        yield f"{beside.name}: {error.strerror or error}"
        return
    if words[1:] != [file.name]:
        yield f"{beside.name} is not about this file"
    elif words[0] != sha256_of(file):
        yield f"the file is not the one that was written: its SHA-256 is not that of {beside.name}"


def _datasets(run: RunFile) -> Iterator[str]:
    """Checksums of the datasets: every byte is read."""
    import h5py

    names: list[str] = []
    run.entry.visititems(lambda name, item: names.append(name) if _is_dataset(item, h5py) else None)
    for name in names:
        try:
            _read_all(run.entry[name])
        except (OSError, RuntimeError, ValueError) as error:
            yield f"{name} cannot be read: {error}"


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
    for name in REQUIRED:
        if name not in run.entry:
            yield f"{name} is missing"
    layout = run.header.layout
    if text_of(run.entry["definition"]) != layout.definition:
        yield "definition is not that of the layout"
    for plot in layout.plots:
        for name in plot_sources(plot):
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
        yield "a point is there twice"
    for name in run.columns():
        if len(run.column(name)) != len(ids):
            yield f"column {name} has {len(run.column(name))} values for {len(ids)} points"
    for plot in run.header.layout.plots:
        for name in plot_sources(plot):
            if run.entry[f"{plot.group}/{name}"].shape != (len(ids),):
                yield f"{plot.group}/{name} has not one value a point"


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


def _simulated(run: RunFile) -> Iterator[str]:
    """Simulated: title, outcome, instruments and header agree."""
    simulated = run.header.simulated
    if run.outcome.simulated != simulated:
        yield f"outcome/simulated is {run.outcome.simulated}, the header says {simulated}"
    if text_of(run.entry["title"]).startswith(SIMULATED) != simulated:
        yield "the title does not agree with outcome/simulated"
    for name, part in run.entry["instrument"].items():
        if "fabrication" not in part:
            continue
        marked = text_of(part["fabrication/vendor"]).startswith(SIMULATED)
        if marked != bool(whole(part["details/simulated"])) or (marked and not simulated):
            yield f"instrument/{name} does not agree on whether it is simulated"


_CHECKS = (_datasets, _structure, _points, _samples, _outcome, _simulated)


def _journal(file: Path) -> Iterator[str]:
    journal = journal_path(file)
    if not journal.exists():
        return
    try:
        contents = read_journal(journal)
    except JournalError as error:
        yield f"its journal: {error.message}"
        return
    for difference in differences(contents, file):
        yield f"it is not what its journal holds: {difference}"


def main() -> None:
    """Print the findings about the file that is the only argument."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    print(json.dumps(verify(sys.argv[1])))  # noqa: T201 - the answer to `verify_apart`


if __name__ == "__main__":
    main()
