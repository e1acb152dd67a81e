"""Beginning and resuming a batch. The queue is written once, together with fingerprints of what it
was made from; they are compared before a batch is resumed."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

import rig
from rig.batch.execute.prepare import PreparedBatch
from rig.batch.folder import BatchFolder, new_folder
from rig.batch.plan.procedures import procedure_of
from rig.batch.plan.read import batch_text
from rig.batch.plan.settings import BatchFile, Simulation
from rig.batch.queue import Queue
from rig.batch.queue_records import RunState
from rig.batch.queue_view import QueueView
from rig.core.atomic import write_text
from rig.core.errors import ConfigurationError, RigError
from rig.core.settings import fingerprint
from rig.run.bench_selector import POPULATION
from rig.run.source_state import source_state

OF_BATCH_FILE = "fingerprint batch file"
"""The queue's entry with the fingerprint of the batch file."""
OF_PROGRAM = "fingerprint program"
"""The queue's entry with the version and the source of the program."""


def begin(batch_file: Path, prepared: PreparedBatch, now: datetime) -> BatchFolder:
    """Make the folder of a batch that may begin, with its queue. Raises ConfigurationError if the
    batch file is not what was checked any more."""
    own = prepared.batch.batch
    text = batch_text(batch_file, with_mark=True)
    if text.removeprefix("\ufeff") != prepared.text:
        raise ConfigurationError(
            f"{batch_file} was changed while the batch was checked; nothing was begun",
            "run it again",
        )
    folder = new_folder(Path(own.results), own.name, now)
    # Copy and fingerprint are of the text that was compared: the file may change at any moment.
    write_text(folder.batch_file, text)
    terms = terms_of(batch_file, prepared, now) | {OF_BATCH_FILE: _of_file(folder.batch_file)}
    write_text(folder.terms, json.dumps(terms, indent=1) + "\n")
    Queue.create(folder.queue, prepared.plan, prepared.estimates, terms).close()
    return folder


def terms_of(batch_file: Path, prepared: PreparedBatch, now: datetime) -> dict[str, str]:
    """Return what a batch is begun with, as entries of its queue."""
    batch, bench = prepared.batch, prepared.bench
    files_from = batch_file.absolute().parent
    return {
        "id": str(uuid.uuid4()),
        "name": batch.batch.name,
        "file": batch.model_dump_json(),
        "files_from": str(files_from),
        "batch_file": str(batch_file.absolute()),
        "bench": "" if bench is None else str(bench.absolute()),
        "begun": now.isoformat(),
        "state": "begun",
        "simulated": "yes" if bench is None else "",
        **fingerprints(batch_file, batch, files_from, bench),
    }


def read_terms(folder: BatchFolder) -> dict[str, str]:
    """Return what a batch was begun with; empty for one that an earlier version has begun.

    Raises ConfigurationError if the file cannot be read.
    """
    try:
        found = json.loads(folder.terms.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{folder.terms} cannot be read: {error}") from error
    return {str(key): str(value) for key, value in found.items()}


def fingerprints(
    batch_file: Path, batch: BatchFile, files_from: Path, bench: Path | None
) -> dict[str, str]:
    """Return the fingerprints of everything that has to be unchanged for a batch to be resumed."""
    found = {
        OF_BATCH_FILE: _of_file(batch_file),
        OF_PROGRAM: f"{rig.__version__} {source_state()}".strip(),
    }
    if bench is not None:
        found["fingerprint bench file"] = _of_file(bench)
    for name in _files_of(batch.simulation):
        found[f"fingerprint {name}"] = _of_file(files_from / name)
    return found


def refuse_changes(queue: Queue, batch: BatchFile) -> None:
    """Raise ConfigurationError where batch file, bench file, a simulated bench's files or the
    program are not what they were when the batch began."""
    bench = queue.meta("bench")
    now = fingerprints(
        Path(queue.meta("batch_file")),
        batch,
        Path(queue.meta("files_from")),
        Path(bench) if bench else None,
    )
    changed = []
    for key, value in now.items():
        if (was := queue.meta(key)) != value:
            what = key.removeprefix("fingerprint ")
            copy = BatchFolder(queue.path.parent).batch_file
            if key == OF_BATCH_FILE and value and copy.exists():
                was, value = str(copy), queue.meta("batch_file")
            elif key != OF_PROGRAM:  # whose states may differ in their last characters alone
                was, value = was[:12], value[:12]
            changed.append(f"{what} ({was or 'none'} then, {value or 'gone'} now)")
    if changed:
        raise ConfigurationError(
            f"{queue.path.parent}: changed since the batch began: {', '.join(changed)}",
            "restore it, or continue all the same with --despite-changes: the queue stays as it "
            "was expanded, and an interrupted run starts from its beginning",
        )


def refuse_missing(queue: QueueView, states: Sequence[RunState]) -> None:
    """Raise ConfigurationError where a procedure of the runs in these states, or something that its
    settings name, is not installed any more: every such run would fail."""
    conditions = queue.conditions()
    for name in dict.fromkeys(row.condition for row in queue.rows(states)):
        try:
            procedure_of(conditions[name])
        except RigError as error:
            raise ConfigurationError(
                f"{queue.path.parent}: the runs that are left cannot be taken: {error.one_line()}",
                "install the packages that were there when the batch began, or continue all the "
                "same with --despite-changes: such runs then fail",
            ) from error


def _files_of(simulation: Simulation | None) -> Iterator[str]:
    if simulation is None:
        return
    if simulation.world is not None and simulation.world != POPULATION:
        yield simulation.world
    yield from (fault.plan for fault in simulation.fault)
    yield from (change.settings for change in simulation.change)


def _of_file(path: Path) -> str:
    try:
        return fingerprint(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return ""
