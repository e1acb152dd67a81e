"""The data of a run that has ended: its journal is completed, summarised, closed and compiled.

Every step is tried even if an earlier one fails, and its failure is in the outcome.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rig.core.errors import RigError
from rig.core.text import in_shell
from rig.files.errors import DiskLateError, RecordingError
from rig.files.journal.reader import read_journal
from rig.files.runfile.compile import compile_run
from rig.run.checked_procedure import internal
from rig.run.in_brief import single_values
from rig.run.results import results_of

if TYPE_CHECKING:
    from rig.run.parts import RunParts
    from rig.run.points import Reading

log = logging.getLogger("rig")


class RunSaving:
    """Saves the data of one run."""

    def __init__(self, parts: RunParts, planned_readings: Callable[[], list[Reading]]):
        """Save the run's readings, and remove those from it that the disk did not take.
        `planned_readings` returns those of planned points, in the order of the plan."""
        self._job, self._procedure, self._run = parts.job, parts.procedure, parts.run
        self._recorder, self._journal = parts.recorder, parts.journal
        self._readings, self._observers = parts.readings, parts.observers
        self._outcome, self._planned_readings = parts.outcome, planned_readings

    def save(self) -> None:
        """Put the end on the disk, add the results, close the journal and compile it; every step is
        tried even if an earlier one fails."""
        outcome = self._outcome
        compiled = self._job.compiled or outcome.status != "complete"
        if outcome.points_done and compiled:
            self._observers.saving()
        self._keep_references()
        outcome.warnings = self._run.warnings + outcome.warnings
        late: DiskLateError | None = None
        with self._saving():
            self._recorder.check()  # before the end: a journal that has moved is a failure of it
        with self._saving():
            for failure in outcome.failures:
                if failure in self._run.ending.failures:
                    continue  # it is in the journal
                self._run.event("error", type(failure).__name__, failure.one_line())
            self._recorder.put_end(self._journal.end(outcome, self._run.elapsed_s()))
            try:
                self._recorder.barrier()
            except DiskLateError as error:  # what it has to write is complete, and in memory
                late = error
        if outcome.status == "failed" and late is None:
            self._forget_what_is_not_in_the_journal()
        self._summarise()
        with self._saving():
            self._recorder.close()  # waits for the disk, however long that takes
            if late is not None:
                outcome.warnings.append(f"{late.message}; it answered later, and nothing was lost")
                late = None
        if late is not None:
            self._forget_what_is_not_in_the_journal()
            outcome.summary, outcome.in_brief = {}, ()
        if compiled:
            with self._saving():
                outcome.file = compile_run(self._journal.path, retire=True)
                if outcome.points_done:
                    self._observers.saved(outcome.file)
        if self._journal.path.exists():
            outcome.journal = self._journal.path

    def _keep_references(self) -> None:
        """Keep what this run's presses have shown for later runs, where nothing spoke against them:
        the run has not failed, and a reading is valid."""
        if self._outcome.status == "failed":
            return
        try:
            if any(not self._procedure.why_invalid(r) for r in self._readings.values()):
                self._run.references.keep()
        except Exception as error:  # noqa: BLE001 - the data come next, whatever a hook raises
            reported_error = error if isinstance(error, RigError) else internal(error)
            self._outcome.warnings.append(reported_error.one_line())

    def _summarise(self) -> None:
        """Ask the procedure for its summary and record it as the run's results, if there is a
        reading. The data are on the disk already: whatever fails here is a warning and costs the
        results, nothing else."""
        if not self._readings:
            return
        try:
            # A run that was resumed and ended before its plan has those recorded earlier.
            readings = self._planned_readings() or list(self._readings.values())
            found = results_of(self._job.procedure, readings, self._run.bench.simulated)
            self._outcome.summary = found.values
            self._recorder.put_results(found)
            try:
                self._outcome.in_brief = self._procedure.in_brief(found.values, found.put_in)
            except RigError as error:  # a bug of the procedure: its values are shown one by one
                self._outcome.in_brief = single_values(
                    found.values, found.put_in, found.labels, self._job.procedure.put_in_label
                )
                self._warn_of_results("the results are not shown in brief", error)
        except Exception as error:  # noqa: BLE001 - a bug in an analysis does not end what follows
            reported_error = error if isinstance(error, RigError) else internal(error)
            self._warn_of_results("no results in the run file", reported_error)

    def _warn_of_results(self, what: str, error: RigError) -> None:
        """Warn in one line, and leave the traceback in the log."""
        self._outcome.warnings.append(f"{what}: {error.one_line()}")
        log.warning("%s", what, exc_info=error)

    def _forget_what_is_not_in_the_journal(self) -> None:
        """Drop the readings that are not in the journal, after a failure of the disk."""
        with contextlib.suppress(RigError, OSError):
            recorded = {point.id for point in read_journal(self._journal.path).kept()}
            for lost in self._readings.keys() - recorded:
                del self._readings[lost]
            self._outcome.points_done = len(self._readings)

    @contextlib.contextmanager
    def _saving(self) -> Iterator[None]:
        """Carry out one step of saving the data within the block. Its failure is reported and does
        not stop the next step."""
        try:
            yield
        except RigError as error:
            self._outcome.add_failure(error)
        except OSError as error:
            hint = f"free some disk space, then run: rig recover {in_shell(self._journal.path)}"
            text = f"the run file cannot be written: {error}"
            self._outcome.add_failure(RecordingError(self._journal.path, text, hint))
