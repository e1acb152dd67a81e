"""The settings with which a batch was begun."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rig.batch.folder import BatchFolder
from rig.batch.plan.settings import BatchFile
from rig.batch.queue_view import QueueView


@dataclass(frozen=True)
class BatchTerms:
    """The settings with which a batch was begun, as its queue records them."""

    file: BatchFile
    bench: Path | None
    """Bench file; None where simulated benches are started, one a run."""
    results: Path
    """Folder in which the batch's folder lies, and the guard's report of a real bench."""
    batch_id: str
    begun: datetime
    files_from: Path
    """Folder that the batch file's own file names are relative to."""

    @classmethod
    def of(cls, queue: QueueView, folder: BatchFolder) -> BatchTerms:
        """Read from a queue."""
        bench = queue.meta("bench")
        return cls(
            BatchFile.model_validate_json(queue.meta("file")),
            Path(bench) if bench else None,
            folder.path.parent,
            queue.meta("id"),
            datetime.fromisoformat(queue.meta("begun")),
            Path(queue.meta("files_from")),
        )
