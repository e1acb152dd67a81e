"""Collects the reasons to hold a batch (`rig.batch.execute.drift`) from its queue, its bench file
and the disk. The worker acts on them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path

from rig.batch.execute.drift import (
    ZERO,
    HoldReason,
    ReferenceRun,
    disk_space,
    expiring,
    judge,
    part_names,
    watched_figures,
    zero_drift,
)
from rig.batch.folder import QUEUE
from rig.batch.plan.procedures import installed
from rig.batch.plan.settings import BatchFile
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, Claim
from rig.bench.apply_calibrations import records_of
from rig.bench.plan import BenchPlan, read_bench
from rig.bench.settings import BenchSettings

ACCEPTED = "accepted "
"""Prefix of the queue's entries that say from which run on a figure is compared, after a person has
looked at the bench and resumed the batch: of the force sensor's zero, and of each figure of each
reference. Earlier versions have one for all figures of a reference."""

PUT_BACK = (
    f"put its contents back into that folder, {QUEUE} last (a folder of this name may have been "
    "created meanwhile: keep the rescued journal in it); if it was deleted, end the batch with "
    "Ctrl-C"
)
"""Remedy where the folder of the batch is away. A run whose journal has lost its name has made a
folder of that name again, so that the other one cannot be moved to its place as a whole."""


class DriftWatch:
    """Judges a batch between its runs."""

    def __init__(self, queue: Queue, file: BatchFile, bench: Path | None, results: Path):
        self._queue, self._file, self._results = queue, file, results
        self._opened = queue.path.stat()
        """What the file system says of the queue's file, which is open."""
        self._plan: BenchPlan | None = None if bench is None else read_bench(bench)

    def before(self, claim: Claim, now: datetime) -> list[HoldReason]:
        """Return the reasons not to begin this run now."""
        batch = self._file.batch
        if away := self.folder():
            return away
        found = self.disk()
        if self._plan is not None and not batch.allow_expired:
            run_s = claim.condition.rest_s + claim.estimate_s
            records = [(path, record) for _, path, record in records_of(self._plan)]
            found += expiring(records, now, timedelta(seconds=run_s))
        return found

    def folder(self) -> list[HoldReason]:
        """Return the reason not to continue while the batch's folder is not in its place, or its
        queue is another file: what is recorded now would not be found there."""
        path = self._queue.path
        try:
            if os.path.samestat(path.stat(), self._opened):
                return []
        except OSError:
            text = f"the folder {path.parent} of the batch was moved or deleted"
            return [HoldReason("folder", text, PUT_BACK)]
        text = f"{path} was replaced by a copy, in which nothing is recorded"
        return [HoldReason("folder", text, "end the batch with Ctrl-C, then rig batch resume")]

    def disk(self) -> list[HoldReason]:
        """Return the reason not to continue on this disk, if there is one."""
        needed_B = self._queue.remaining().size_B
        free_B = shutil.disk_usage(self._results).free
        return disk_space(free_B, needed_B, self._file.batch.hold_when.free_disk_GB)

    def after(
        self, claim: Claim, ended: AttemptResult, bench: BenchSettings | None
    ) -> list[HoldReason]:
        """Return the reasons to hold that a finished run shows: drift of a reference's figures, or
        of the force sensor's zero. The parts are named as on this bench; without one, as in the
        bench file, if there is one."""
        if bench is None and self._plan is not None:
            bench = self._plan.settings
        parts = {} if bench is None else part_names(bench)
        return [*self._zero(claim, ended), *self._drift(claim, ended, parts)]

    def accept(self, claim: Claim, found: Sequence[HoldReason]) -> None:
        """Compare the figures of later runs that were `found` in this one with it, because a person
        has resumed the batch."""
        for figure in (figure for reason in found for figure in reason.figures):
            of = ZERO if figure == ZERO else f"{claim.condition.id} {figure}"
            self._queue.set_meta(ACCEPTED + of, str(claim.number))

    def _zero(self, claim: Claim, ended: AttemptResult) -> list[HoldReason]:
        now_N = (ended.summary or {}).get(ZERO)
        since = int(self._queue.meta(ACCEPTED + ZERO, "1"))
        first = self._queue.first_summary_with(ZERO, since)
        if now_N is None or first is None or first[0] == claim.number:
            return []
        limit_N = self._file.batch.hold_when.zero_drift_N
        return zero_drift(first[1][ZERO], now_N, limit_N, first[0])

    def _drift(
        self, claim: Claim, ended: AttemptResult, parts: Mapping[str, str]
    ) -> list[HoldReason]:
        condition = claim.condition
        if not condition.reference or ended.summary is None:
            return []
        usual = installed(condition.procedure).drift
        watched = watched_figures(usual, self._file.experiment[condition.experiment].drift)
        accepted = ACCEPTED + condition.id
        all_since = self._queue.meta(accepted, "1")
        since = {name: int(self._queue.meta(f"{accepted} {name}", all_since)) for name in watched}
        earlier = [
            ReferenceRun(number, summary)
            for number, summary in self._queue.summaries(condition.id)
            if number < claim.number
        ]
        now = ReferenceRun(claim.number, ended.summary)
        return judge(earlier, now, watched, parts, since)
